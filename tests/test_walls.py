"""The light of walls: interpolated between texels, filled where a texel lies in a solid, stored, and shown."""

import json
from dataclasses import replace

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.backends.numba_ import Numba
from illumgrid.bake import bake
from illumgrid.bake.walls import texel_paths, wall_queries
from illumgrid.errors import BadInput
from illumgrid.field.scene import Field, Material, Quad, Scene, level_table
from illumgrid.grid import GridSpec, WallTexture
from illumgrid.grid.walls import calmed
from illumgrid.interpolators.nearest import Nearest
from illumgrid.io import store
from illumgrid.samplers.direct import Direct
from illumgrid.show import fit_camera, render
from shapes import ball, lit
from test_store import assert_same, example
from transport import waves

SIZE = {"width": 160, "height": 120}


def texture(rows=3, nv=4, nu=5, seed=0):
    rng = np.random.default_rng(seed)
    return WallTexture(rng.random((rows, nv, nu, 3), np.float32), np.ones((rows, nv, nu), np.float32))


# Lookup.


def test_a_lookup_in_the_middle_of_a_texel_is_the_texel():
    wall = texture()
    k, v, u = np.indices((3, 4, 5)).reshape(3, -1)
    found = wall.lookup((u + 0.5) / 5, (v + 0.5) / 4, k / 2)
    np.testing.assert_allclose(found, wall.values.reshape(-1, 3), atol=1e-6)
    assert found.dtype == np.float32


def test_between_texels_and_rows_light_is_trilinear():
    k, v, u = np.indices((3, 4, 5))
    values = np.stack([u + 10 * v + 100 * k, u * v * 1.0, v * k * 1.0], axis=-1).astype(np.float32)
    wall = WallTexture(values, np.ones((3, 4, 5), np.float32))
    x, y, z = np.random.default_rng(0).random((3, 50)) * np.array([[4], [3], [2]])
    found = wall.lookup((x + 0.5) / 5, (y + 0.5) / 4, z / 2)
    np.testing.assert_allclose(found[:, 0], x + 10 * y + 100 * z, rtol=1e-5)
    np.testing.assert_allclose(found[:, 1], x * y, atol=1e-4)
    np.testing.assert_allclose(found[:, 2], y * z, atol=1e-4)


def test_beyond_the_border_the_light_is_that_of_the_border():
    wall = texture()
    assert np.array_equal(wall.lookup(-0.2, 0.625, 0.5), wall.lookup(0.1, 0.625, 0.5))
    assert np.array_equal(wall.lookup(1.0, 1.0, 1.0)[0], wall.values[2, 3, 4])
    assert np.array_equal(wall.lookup(0.0, 0.0, -1.0)[0], wall.values[0, 0, 0])
    assert np.array_equal(wall.lookup(0.5, 9.0, 7.0)[0], wall.values[2, 3, 2])
    one = texture(2, 1, 1)
    np.testing.assert_allclose(one.lookup([0, 0.3, 1], [1, 0, 0.5], 0.5), np.tile(one.values.mean(axis=0)[0], (3, 1)))


# From a bake.


@pytest.fixture(scope="module")
def baked():
    """A wall that passes through the solid, with texels that are not square."""
    field = Field("solid", waves((9, 9, 9)), range=(-0.6, 0.6))
    wall = Quad("wall", (1, 1, 4.3), (6.5, 0, 0.1), (0, 5.7, 0.2), texels=(13, 7))
    scene = Scene((field,), (wall,), np.ones(3))
    levels = level_table(scene, 4)
    stages = Direct(), Numba().prepare(scene), Nearest()
    return scene, levels, bake(scene, [GridSpec.over(field.volume, 4)], levels, *stages, paths=[range(8)], bounces=2)


def test_texels_lie_at_the_middles_and_ids_are_their_own(baked):
    scene, levels, _ = baked
    (queries,) = wall_queries(scene, levels)
    wall = scene.quads[0]
    assert len(queries) == 4 * 7 * 13
    number = 2 * 7 * 13 + 5 * 13 + 3  # row 2, v 5, u 3
    np.testing.assert_allclose(queries.point[number], wall.corner + 3.5 / 13 * wall.edge_u + 5.5 / 7 * wall.edge_v)
    assert queries.level[number] == levels.table[2]
    assert (queries.target == 1).all() and len(np.unique(queries.id)) == len(queries)
    np.testing.assert_allclose(queries.normal, np.tile(wall.normal, (len(queries), 1)))
    grid = [GridSpec.over(scene.fields[0].volume, 9)]
    asked = np.concatenate([batch.id for batch in Direct().queries(scene, grid, 0)])
    assert not np.isin(queries.id, asked).any()


def test_a_wall_holds_the_light_of_the_backend(baked):
    scene, levels, light = baked
    (wall,) = light.walls
    (queries,) = wall_queries(scene, levels)
    more = texel_paths(light.queries - len(queries), len(queries))
    answer = Numba().solve(scene, queries, paths=range(8 * more), bounces=2, seed=0)
    good = answer.paths.reshape(4, 7, 13) > 0
    np.testing.assert_array_equal(wall.support > 0, good)
    mean, error = answer.light.reshape(4, 7, 13, -1), answer.error.reshape(4, 7, 13)
    np.testing.assert_array_equal(wall.light[good], calmed(mean, answer.mean.reshape(4, 7, 13, 3), error, good)[good])
    assert wall.values.dtype == wall.support.dtype == np.float32
    assert light.queries > len(queries)


def test_texels_get_more_paths_while_they_are_few():
    assert [texel_paths(nodes, 100) for nodes in (0, 100, 250, 799, 800, 10**6)] == [1, 1, 2, 7, 8, 8]
    assert texel_paths(1000, 0) == 8  # no walls


def test_a_texel_inside_the_solid_takes_the_nearest_one_of_the_same_row(baked):
    scene, _, light = baked
    (wall,), quad = light.walls, scene.quads[0]
    assert 0.05 < (wall.support == 0).mean() < 0.95
    step = np.array([np.linalg.norm(quad.edge_v) / 7, np.linalg.norm(quad.edge_u) / 13])
    for values, support in zip(wall.values, wall.support):
        good = np.argwhere(support > 0)
        for hole in np.argwhere(support == 0):
            distance = np.linalg.norm((good - hole) * step, axis=1)
            nearest = good[distance < distance.min() + 1e-9]
            assert any(np.array_equal(values[tuple(hole)], values[tuple(at)]) for at in nearest)


def test_a_run_lights_the_walls_of_the_box_and_colours_bleed():
    scene = ig.Scene.box(ball(8), range=(0.5, 0.9))
    scene = replace(scene, quads=tuple(replace(q, texels=(4, 4)) for q in scene.quads))
    light = ig.run(scene, grid=5, paths=64, bounces=3, isovalues=2)
    assert [w.values.shape for w in light.walls] == [(2, 4, 4, 3)] * 7
    floor = light.walls[0].values.mean(axis=(0, 1))
    assert min(w.values[w.support > 0].mean() for w in light.walls) > 0
    # along edge_u the floor runs from the red wall to the green one
    redness = floor[:, 0] / floor[:, 1]
    assert redness[0] > 1.1 * redness[-1]
    assert light.recipe["bounces"] == 3 and 0 < light.recipe["left_out"] < 0.3


# On the disk.


def test_walls_come_back_bit_by_bit(tmp_path):
    stored = example(2)
    store.write(tmp_path / "out", stored, None, False)
    back = store.read(tmp_path / "out")
    assert_same(back, stored)
    for one, other in zip(back.walls, stored.walls, strict=True):
        assert one.values.tobytes() == other.values.tobytes() and one.values.flags.c_contiguous
        assert one.support.tobytes() == other.support.tobytes()


@pytest.mark.parametrize(
    "shape", [(3, 2, 3), (4, 3, 2), (4, 2, 4), (1, 2, 3)], ids=["rows", "turned", "wide", "one row"]
)
def test_a_texture_of_another_size_is_not_written(tmp_path, shape):
    stored = example(2)
    wrong = WallTexture(np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32))
    with pytest.raises(BadInput, match="its parts are not those"):
        store.write(tmp_path / "out", replace(stored, walls=(wrong, stored.walls[1])), None, False)
    assert not list(tmp_path.iterdir())


BAD = {
    "name": [None, 7, "", "lamp", "protons", ["wall"], {}],
    "texels": [None, [3], [3, 2, 1], [2, 3], [6, 1], [3, 0], [3.0, 2], ["3", 2], [-3, -2], [10**9, 2]],
    "corner": [None, [1, 2], "here", [1, 2, {}]],
    "edge_u": [None, [0, 0, 0], [0, 1e-9, 3e-9], [1], {}],
    "edge_v": [None, [0.1, 0, 1 / 7], "up"],
    "albedo": [None, 0.5, [0, 0, 1.1]],
    "emission": [None, [-1, 0, 0], [1, 2]],
}


@pytest.mark.parametrize("key", BAD)
def test_wrong_entries_of_a_quad_are_refused(tmp_path, key):
    out = tmp_path / "out"
    store.write(out, example(2), None, False)
    whole = json.loads((out / store.RUN).read_text("utf-8"))
    for value in [*BAD[key], "remove"]:
        record = json.loads(json.dumps(whole))
        record["scene"]["quads"][0][key] = value
        if value == "remove":
            del record["scene"]["quads"][0][key]
        record["checksum"] = store._checksum(record, out / store.EXR)
        (out / store.RUN).write_text(json.dumps(record))
        with pytest.raises(BadInput, match=r"(run\.json|illumination\.exr) .*; give a folder that"):
            store.read(out)


# In a picture.


def hues(picture):
    """Share of red and of green pixels, and the mean column of each."""
    p = picture.astype(int)
    red = (p[..., 0] > p[..., 1] + 40) & (p[..., 0] > p[..., 2] + 40)
    green = (p[..., 1] > p[..., 0] + 30) & (p[..., 1] > p[..., 2] + 30)
    return {n: (m.mean(), np.nonzero(m)[1].mean() if m.any() else np.nan) for n, m in (("red", red), ("green", green))}


@pytest.mark.parametrize("flip", [1, -1])
def test_in_the_box_red_is_left_and_green_is_right_and_the_front_wall_is_not_there(flip):
    volume = ball(12)
    volume = ig.Volume(volume.values, (-flip, -1, -1), volume.spacing, np.diag([flip, 1.0, 1.0]))
    scene = ig.Scene.box(volume, range=(0.6, 0.9))
    light = lit(scene, 2.0)
    seen = hues(render(light, **SIZE))
    assert seen["red"][0] > 0.05 and seen["green"][0] > 0.05
    assert seen["red"][1] < 50 and seen["green"][1] > 110
    # with the front wall gone for good, the same picture
    camera_scene = replace(light, scene=scene)
    front = [q.name for q in scene.quads].index("front")
    dark = [w if k != front else replace(w, values=w.values + 1e3) for k, w in enumerate(light.walls)]
    np.testing.assert_array_equal(render(replace(camera_scene, walls=tuple(dark)), **SIZE), render(light, **SIZE))
    # the camera looks straight in
    camera = fit_camera(scene, scene.levels(0.5)[0], 4 / 3)
    assert np.degrees(np.arctan2(camera.forward[0], camera.forward[1])) == pytest.approx(0, abs=1e-6)


def test_the_lamp_is_white_and_walls_show_their_light_at_the_row_of_the_sweep():
    scene = ig.Scene.box(ball(12), range=(0.6, 0.9))
    light = lit(scene, 2.0)
    lamp = scene.quads[-1]
    camera = fit_camera(scene, scene.levels(0.5)[0], 4 / 3)

    def pixel(world):
        ray = world - camera.eye
        depth = ray @ camera.forward
        x, y = ray @ camera.right / depth / camera.tangent / (4 / 3), ray @ camera.up / depth / camera.tangent
        return int((1 - y) / 2 * SIZE["height"]), int((1 + x) / 2 * SIZE["width"])

    at = pixel(lamp.corner + 0.5 * lamp.edge_u + 0.8 * lamp.edge_v)
    near = [pixel(lamp.corner + 0.5 * lamp.edge_u + v * lamp.edge_v) for v in (0.2, 0.5, 0.8)]
    picture = render(light, **SIZE)
    assert any(picture[p].min() == 255 for p in [at, *near])

    back = scene.quads[4]
    spot = pixel(back.corner + 0.1 * back.edge_u + 0.9 * back.edge_v)
    values = light.walls[4].values.copy()
    values[1] = 0  # dark at the high end of the sweep
    walls = [replace(w, values=values) if k == 4 else w for k, w in enumerate(light.walls)]
    swept = replace(light, walls=tuple(walls))
    tones = [render(swept, isovalue=c, **SIZE)[spot].astype(int).max() for c in (0.6, 0.75, 0.9)]
    assert tones[0] == render(light, isovalue=0.6, **SIZE)[spot].max() > tones[1] > tones[2] + 20
    local = render(light, local=True, **SIZE)
    assert np.array_equal(local, render(swept, local=True, **SIZE))
    assert Material().emission.max() == 0
