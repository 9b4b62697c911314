"""Light of walls follows the scene: square texels in a number that suits it, calm where it is smooth, and judged."""

from functools import partial

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.accuracy.judge import judge
from illumgrid.accuracy.points import unseen_on_walls
from illumgrid.backends.numba_ import Numba
from illumgrid.bake.walls import look_up_walls, place_on_walls, wall_queries
from illumgrid.field.scene import Scene, level_table, with_texels
from illumgrid.grid import WallTexture
from illumgrid.grid.walls import calmed
from illumgrid.transport.tracer import prepare
from shapes import ball, refused, sky

QUICK = ("--grid", "6", "--paths", "2", "--bounces", "1", "--isovalues", "2", "--no-preview")


def box(n=10, **place):
    return Scene.box(ball(n, **place), range=(0.3, 0.9))


# The number of texels


def test_presets_have_square_texels_in_a_number_that_follows_the_volume():
    small, large = ({q.name: q for q in scene.quads} for scene in (box(10), box(64)))
    assert small["left"].texels == (6, 6) and small["floor"].texels == (12, 12)
    assert large["left"].texels == (24, 24) and large["floor"].texels == (48, 48)
    long = box(shape=(40, 20, 20), spacing=np.array([1.0, 1, 1]))
    for quad in long.quads[:6]:
        edges = np.linalg.norm([quad.edge_u, quad.edge_v], axis=1)
        assert edges / quad.texels == pytest.approx(np.full(2, (edges / quad.texels).mean()), rel=0.1)


def test_texels_that_are_asked_for_lie_along_the_longest_edge_and_lamps_keep_theirs():
    scene = with_texels(box(shape=(40, 20, 20), spacing=np.ones(3)), 30)
    assert max(max(q.texels) for q in scene.quads) == 30
    assert scene.quads[6].name == "lamp" and scene.quads[6].texels == (1, 1)
    assert with_texels(Scene.floor(ball(10), range=(0.3, 0.9)), 7).quads[0].texels == (7, 7)
    refused(lambda: with_texels(sky(), 8), "8 texels", "without walls")


@pytest.mark.judged
def test_the_command_line_takes_a_number_of_texels(call, refuse, tmp_path):
    said = call("run", "v.npy", "--range", "0.3", "0.9", "--scene", "floor", "--texels", "5", *QUICK, "-o", "out")
    assert ig.load(tmp_path / "out").walls[0].values.shape == (2, 5, 5, 3)
    assert "50 texels of walls" in said and "on walls" in said
    refuse("run", "v.npy", "--texels", "5", *QUICK, "-o", "no", words=["5 texels", "without walls"])


# The error of walls


def test_unseen_points_lie_on_the_fronts_of_walls_and_know_their_place():
    scene = box()
    asked = unseen_on_walls(scene, 300, 0)
    number, u, v, t = place_on_walls(scene, asked)
    assert set(number) == set(range(6))  # the lamp reflects nothing
    assert all(((x > 0) & (x < 1)).all() and x.std() == pytest.approx(1 / 12**0.5, rel=0.1) for x in (u, v, t))
    np.testing.assert_allclose(scene.levels(t), asked.level)
    for k in range(6):
        quad, own = scene.quads[k], number == k
        assert np.allclose((asked.point[own] - quad.corner) @ quad.normal, 0, atol=1e-9)
        assert (asked.normal[own] == quad.normal).all()
    assert not len(unseen_on_walls(sky(), 300, 0))


def test_what_textures_hold_is_looked_up_at_the_place_of_a_query():
    scene, rows = box(), 5
    queries = wall_queries(scene, level_table(scene, rows))
    walls = []
    for quad, asked in zip(scene.quads, queries):
        nu, nv = quad.texels
        light = (asked.point @ [1.0, 2, 3] + asked.level[:, 0]).reshape(rows, nv, nu)
        walls.append(WallTexture(np.repeat(light[..., None], 3, axis=3), np.ones((rows, nv, nu), np.float32)))
    for asked in queries[:6]:
        found = look_up_walls(scene, walls, asked)
        np.testing.assert_allclose(found[:, 0], asked.point @ [1.0, 2, 3] + asked.level[:, 0], atol=1e-4)


def test_the_error_of_walls_is_that_of_their_light():
    scene = with_texels(box(16), 12)
    tracer = prepare(Numba(), scene)
    light = ig.run(scene, grid=8, paths=64, bounces=3, isovalues=4)
    texels = sum(wall.support.size for wall in light.walls)
    brighter = [WallTexture(1.5 * wall.light, wall.support, wall.channels) for wall in light.walls]
    measured, off = (
        judge(scene, tracer, unseen_on_walls, partial(look_up_walls, scene, walls), 0, texels, 64, 3)
        for walls in (light.walls, brighter)
    )
    assert off.bias == pytest.approx(1.5 * (1 + measured.bias) - 1, abs=1e-4)  # the same points, by the same paths
    assert 0 < measured.rmse < off.rmse and measured.rmse < 0.25
    none = partial(look_up_walls, sky(), ())
    assert judge(sky(), prepare(Numba(), sky()), unseen_on_walls, none, 0, 0, 64, 3) is None


# Noise


def noisy(light, sigma, seed=0):
    values = (light + np.random.default_rng(seed).normal(0, sigma, light.shape)).astype(np.float32)
    return values, np.full(light.shape[:3], sigma, np.float32), np.ones(light.shape[:3], np.float32)


def test_noise_is_averaged_where_light_is_smooth():
    light = np.broadcast_to(np.linspace(1, 1.5, 24)[:, None], (6, 20, 24, 1))
    values, error, support = noisy(light, 0.1)
    calm = calmed(values, values, error, support)
    before, after = (np.sqrt(np.square(x - light).mean()) for x in (values, calm))
    assert before == pytest.approx(0.1, rel=0.05) and after < 0.4 * before


def test_the_edge_of_a_shadow_stays_where_it_is():
    light = np.ones((4, 20, 20, 3))
    light[:, :, 10:] = 0.2
    values, error, support = noisy(light, 0.03)
    calm = calmed(values, values, error, support)
    assert calm[:, :, :9].min() > 0.9 and calm[:, :, 11:].max() < 0.3
    assert np.abs(calm - light)[:, :, 9:11].max() < 0.3  # a blur would leave 0.4 beside a step of 0.8


def test_texels_without_light_or_error_bars_are_left_alone():
    values, error, support = noisy(np.ones((3, 8, 8, 1)), 0.1)
    support[:, 2:4, 2:4], values[:, 2:4, 2:4] = 0, 99
    calm = calmed(values, values, error, support)
    assert (calm[:, 2:4, 2:4] == 99).all() and calm[support > 0].max() < 1.5
    error[0, 0, 0] = np.inf
    assert calmed(values, values, error, support) is values


def test_layers_are_averaged_alike_so_that_their_sum_is_the_average_of_the_sum():
    one, error, support = noisy(np.ones((3, 8, 8, 1)), 0.1)
    other, *_ = noisy(np.broadcast_to(np.linspace(0, 1, 8)[:, None], (3, 8, 8, 1)), 0.1, seed=1)
    both = one + other
    parts = calmed(np.concatenate([one, other], axis=3), both, error, support)
    np.testing.assert_allclose(parts.sum(axis=3), calmed(both, both, error, support)[..., 0], atol=1e-6)
