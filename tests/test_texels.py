"""How finely walls are divided for an asked error."""

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.accuracy.points import unseen_on_walls
from illumgrid.accuracy.texels import SHARE, walls_for
from illumgrid.bake.around import texels_around
from illumgrid.bake.walls import wall_queries
from illumgrid.field.scene import finer_texels, level_table, with_texels
from illumgrid.transport.samples import join_queries
from illumgrid.transport.tracer import prepare
from shapes import ball


@pytest.fixture(scope="module")
def room():
    scene = with_texels(ig.Scene.box(ball(10), range=(0.3, 0.6)), 5)
    return scene, level_table(scene, 4), prepare(ig.backend("numba"), scene)


def test_the_texels_around_a_point_hold_what_a_texture_looks_up(room):
    scene, levels, _ = room
    asked = unseen_on_walls(scene, 60, 3)
    around = texels_around(scene, levels, asked)
    whole = join_queries(wall_queries(scene, levels))
    place = {int(number): row for row, number in enumerate(whole.id)}
    rows = [place[int(number)] for number in around.asked.id]
    for name in ("point", "normal", "level", "target"):
        np.testing.assert_array_equal(getattr(around.asked, name), getattr(whole, name)[rows])
    made_up = np.random.default_rng(0).random((len(whole), 3)).astype(np.float32)
    samples = ig.Samples(around.asked, made_up[rows], 0 * made_up[rows], np.ones(len(rows), np.int32))
    expected = np.zeros((len(asked), 3))
    for k, quad in enumerate(scene.quads):
        own = asked.target == k + len(scene.fields)
        nu, nv = quad.texels
        light = made_up[whole.target == k + len(scene.fields)].reshape(4, nv, nu, 3)
        texture = ig.WallTexture(light, np.ones((4, nv, nu), np.float32))
        at = asked.point[own] - quad.corner
        u, v = (at @ edge / (edge @ edge) for edge in (quad.edge_u, quad.edge_v))
        expected[own] = texture.lookup(u, v, scene.fields[0].place(asked.level[own, 0]))
    np.testing.assert_allclose(around.read(samples)[0], expected, atol=1e-6)


def test_walls_get_the_texels_that_an_error_takes_and_no_more(room):
    scene, levels, tracer = room
    loose, strict = (walls_for(scene, tracer, levels, 3, error, 0) for error in (0.5, 0.06))
    assert loose.finer == 1 and loose.off <= SHARE * 0.5
    assert strict.finer > 1 and strict.off < loose.off


def test_a_run_for_an_error_refines_the_walls_unless_their_texels_are_given(room, monkeypatch):
    from illumgrid import chain
    from illumgrid.accuracy.choose import Plan

    scene, given = room[0], []

    def planned(*_, texels, **how):
        given.append(texels)
        return Plan(6, 2, 2, 0.1, 1.0, 0.0, True, (), finer=1.0 if texels else 2.0), None

    monkeypatch.setattr(chain, "planned", planned)
    finer, asked = (ig.run(scene, error=0.1, isovalues=4, judge=False, texels=n) for n in (None, 7))
    assert given == [None, 7]
    assert [q.texels for q in finer.scene.quads] == [q.texels for q in finer_texels(scene, 2.0).quads]
    assert finer.scene.quads[0].texels == tuple(2 * n for n in scene.quads[0].texels)
    assert [w.light.shape[2:0:-1] for w in finer.walls] == [q.texels for q in finer.scene.quads]
    assert max(n for q in asked.scene.quads for n in q.texels) == 7
