"""The grid: positions of nodes, lookup between them, and filling of holes."""

import dataclasses

import numpy as np
import pytest

from illumgrid.field.scene import Scene
from illumgrid.field.volume import Volume, index_to_world
from illumgrid.grid import (
    GREY,
    RGB,
    Channels,
    GridSpec,
    IlluminationGrid,
    WallTexture,
    channels_of,
    fill_holes,
    illumination,
    read_lattice,
)
from shapes import DIRECTIONS, MIRRORED, ball, refused

UNEVEN = np.array([0.5, 1.25, 3.0])


def volume(shape, **place):
    return Volume(np.zeros(shape), **place)


def random_grid(shape=(4, 5, 3), **place):
    spec = GridSpec(shape, **place)
    random = np.random.default_rng(0)
    return IlluminationGrid(spec, random.random((*shape, 3)), random.random(shape), np.ones(shape))


# Where the nodes lie


@pytest.mark.parametrize(
    "voxels, longest, nodes",
    [
        ((10, 10, 10), 10, (10, 10, 10)),
        ((10, 10, 10), 4, (4, 4, 4)),
        ((10, 10, 10), 25, (25, 25, 25)),
        ((124, 160, 140), 160, (124, 160, 140)),
        ((124, 160, 140), 128, (99, 128, 112)),  # 1 + round(98.245), 1 + round(111.03)
        ((409, 415, 119), 128, (126, 128, 37)),  # 1 + round(125.16), 1 + round(36.20)
        ((2, 100, 3), 2, (2, 2, 2)),
        ((2, 200, 30), 20, (2, 20, 4)),
        ((3, 5, 7), 4, (2, 3, 4)),
        ((2, 5, 3), 4, (2, 4, 3)),  # 1 + round(0.75), 1 + round(1.5): halves go up
        ((6, 11, 2), 6, (4, 6, 2)),  # 1 + round(2.5): halves go up
        ((2, 2, 2), 5, (5, 5, 5)),
    ],
)
def test_the_longest_axis_gets_the_nodes_asked_for_and_the_others_in_proportion(voxels, longest, nodes):
    assert GridSpec.over(volume(voxels), longest).shape == nodes


@pytest.mark.parametrize("voxels", [(10, 7, 4), (2, 2, 2), (5, 2, 9)])
@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_as_many_nodes_as_voxels_are_the_voxels_to_the_last_bit(voxels, direction):
    place = volume(voxels, origin=(1 / 3, -1e5, 7), spacing=UNEVEN / 3, direction=direction)
    spec = GridSpec.over(place, max(voxels))
    assert spec.shape == voxels
    for name in ("origin", "spacing", "direction"):
        assert np.array_equal(getattr(spec, name), getattr(place, name))
    index = np.indices(voxels).reshape(3, -1).T
    assert np.array_equal(spec.nodes(), index_to_world(place, index))


@pytest.mark.parametrize("longest", [2, 5, 13, 40])
def test_nodes_reach_from_the_first_to_the_last_voxel_centre(longest):
    place = volume((9, 14, 5), origin=(1, 2, 3), spacing=UNEVEN, direction=MIRRORED)
    spec = GridSpec.over(place, longest)
    nodes = spec.nodes()
    np.testing.assert_allclose(nodes[0], place.origin, atol=1e-12)
    np.testing.assert_allclose(nodes[-1], index_to_world(place, [8, 13, 4]), atol=1e-12)


def test_nodes_are_numbered_in_c_order():
    spec = GridSpec((2, 3, 4), (1, 2, 3), UNEVEN)
    assert spec.nodes(np.array([0, 1, 4, 12, 23])).tolist() == [
        [1, 2, 3], [1, 2, 6], [1, 3.25, 3], [1.5, 2, 3], [1.5, 4.5, 12],
    ]  # fmt: skip


@pytest.mark.parametrize("shape", [(1, 3, 3), (3, 3), (0, 2, 2)])
def test_a_grid_of_too_few_nodes_is_refused(shape):
    refused(lambda: GridSpec(shape), str(shape), "at least 2")


def test_a_grid_of_one_node_along_the_longest_axis_is_refused():
    for count in (1, 0, -4):
        refused(lambda count=count: GridSpec.over(volume((3, 3, 3)), count), f"{count} nodes", "at least 2")


def test_a_grid_takes_only_arrays_of_its_shape():
    spec, ones = GridSpec((2, 3, 4)), np.ones((2, 3, 4))
    refused(lambda: IlluminationGrid(spec, ones, ones, ones), "values", "(2, 3, 4)", "(2, 3, 4, 3)")
    refused(lambda: IlluminationGrid(spec, np.ones((2, 3, 4, 3)), ones[1:], ones), "error", "(1, 3, 4)")
    refused(lambda: IlluminationGrid(spec, np.ones((2, 3, 4, 3)), ones, ones.T), "support", "(4, 3, 2)")
    refused(lambda: GridSpec((2, 2, 2), spacing=(1, 0, 1)), "spacing")


# Lookup


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
@pytest.mark.parametrize("origin", [(0, 0, 0), (1e5, -2e5, 0.1)])
def test_a_lookup_at_a_node_returns_the_node(direction, origin):
    grid = random_grid(origin=origin, spacing=UNEVEN / 3, direction=direction)
    assert np.array_equal(grid.lookup(grid.spec.nodes()), grid.values.reshape(-1, 3))


def test_a_lookup_in_the_middle_of_a_cell_is_the_mean_of_its_corners():
    grid = random_grid(spacing=UNEVEN, direction=MIRRORED)
    middle = index_to_world(grid.spec, [[1.5, 2.5, 0.5], [0.5, 0, 2]])
    expected = [grid.values[1:3, 2:4, 0:2].mean(axis=(0, 1, 2)), grid.values[0:2, 0, 2].mean(axis=0)]
    np.testing.assert_allclose(grid.lookup(middle), expected, rtol=1e-6)


def test_light_that_is_linear_in_space_is_read_exactly():
    spec = GridSpec((4, 5, 6), (1, 2, 3), UNEVEN, MIRRORED)
    slopes = np.random.default_rng(0).normal(size=(3, 3))
    values = (spec.nodes() @ slopes).reshape(4, 5, 6, 3)
    grid = IlluminationGrid(spec, values, np.zeros((4, 5, 6)), np.ones((4, 5, 6)))
    points = index_to_world(spec, np.random.default_rng(1).random((100, 3)) * [3, 4, 5])
    np.testing.assert_allclose(grid.lookup(points), points @ slopes, atol=1e-5)
    assert grid.lookup(points).dtype == np.float32


def test_beyond_the_border_the_light_is_that_of_the_border():
    grid = random_grid()
    points = np.random.default_rng(0).uniform(-20, 20, (200, 3))
    clamped = np.clip(points, 0, np.array(grid.spec.shape) - 1)
    np.testing.assert_allclose(grid.lookup(points), grid.lookup(clamped), atol=1e-6)


def test_a_lookup_is_never_nan():
    grid = random_grid()
    bad = [np.nan, np.inf, -np.inf, 1e300, -1e300, 1.0]
    points = np.array(np.meshgrid(bad, bad, bad)).reshape(3, -1).T
    light = grid.lookup(points)
    assert np.isfinite(light).all() and light.min() >= 0 and light.max() <= 1
    assert grid.lookup(np.zeros((0, 3))).shape == (0, 3)
    assert grid.lookup([1.0, 2.0, 1.0]).shape == (1, 3)


def test_any_number_of_channels_is_read():
    spec = GridSpec((2, 2, 2))
    values = np.arange(40, dtype=np.float32).reshape(2, 2, 2, 5)
    assert read_lattice(spec, values, [[1, 0, 1]]).tolist() == [values[1, 0, 1].tolist()]


# Holes


def test_a_hole_takes_the_value_of_the_nearest_supported_node_in_the_world():
    spec = GridSpec((6, 5, 4), spacing=UNEVEN)
    random = np.random.default_rng(0)
    values = random.random((6, 5, 4, 3)).astype(np.float32)
    support = (random.random((6, 5, 4)) < 0.2).astype(np.float32)
    filled = fill_holes(spec.spacing, values, support).reshape(-1, 3)
    nodes, good = spec.nodes(), support.ravel() > 0
    distance = np.linalg.norm(nodes[:, None] - nodes[good][None], axis=2)
    for node in range(len(nodes)):
        candidates = values.reshape(-1, 3)[good][distance[node] <= distance[node].min() + 1e-9]
        assert (candidates == filled[node]).all(axis=1).any()
    assert np.array_equal(filled[good], values.reshape(-1, 3)[good])


@pytest.mark.parametrize("support", [0.0, 1.0])
def test_all_or_no_support_leaves_the_values(support):
    spec = GridSpec((2, 3, 4))
    values = np.random.default_rng(0).random((2, 3, 4, 3)).astype(np.float32)
    assert np.array_equal(fill_holes(spec.spacing, values, np.full((2, 3, 4), support, np.float32)), values)


# Channels


def test_grey_light_is_stored_once_and_read_as_rgb():
    random = np.random.default_rng(0)
    light, ones = random.random((3, 4, 5, 1)).astype(np.float32), np.ones((3, 4, 5))
    spec = GridSpec((3, 4, 5), (1, 2, 3), UNEVEN, MIRRORED)
    grey, rgb = IlluminationGrid(spec, light, ones, ones), IlluminationGrid(spec, np.repeat(light, 3, 3), ones, ones)
    assert grey.channels == GREY and rgb.channels == RGB
    assert grey.light.nbytes * 3 == rgb.light.nbytes and np.shares_memory(grey.values, grey.light)
    assert np.shares_memory(rgb.values, rgb.light)
    assert np.array_equal(grey.values, rgb.values) and not grey.values.flags.writeable
    points = random.random((50, 3)) * 9
    for name in ("lookup", "uncertainty"):
        assert np.array_equal(getattr(grey, name)(points), getattr(rgb, name)(points))
    assert np.array_equal(grey.bar, rgb.bar) and grey.resolution == rgb.resolution and grey.mean == rgb.mean
    assert grey.lookup(points).flags.writeable
    assert dataclasses.replace(grey, support=2 * ones).channels == GREY


def test_channels_are_mixed_to_what_is_shown():
    """Two lamps, one red and one white: light is linear, so their sum is what both together give."""
    two = Channels(("lamp", "sky"), ((0.5, 0.0, 0.0), (2.0, 2.0, 2.0)))
    light, ones = np.random.default_rng(0).random((3, 4, 5, 2)), np.ones((3, 4, 5))
    grid = IlluminationGrid(GridSpec((3, 4, 5)), light, ones, ones, two)
    np.testing.assert_allclose(grid.values[..., 0], 0.5 * light[..., 0] + 2 * light[..., 1], rtol=1e-6)
    np.testing.assert_allclose(grid.values[..., 2], 2 * light[..., 1], rtol=1e-6)
    points = np.random.default_rng(1).random((50, 3)) * 3
    shown = IlluminationGrid(grid.spec, grid.values, ones, ones)
    np.testing.assert_allclose(grid.lookup(points), shown.lookup(points), rtol=1e-5)
    np.testing.assert_allclose(grid.bar, shown.bar, rtol=1e-5)
    wall = WallTexture(light.transpose(2, 1, 0, 3), ones.T, two)
    assert wall.lookup(0.5, 0.5, 0.5).shape == (1, 3) and wall.values.shape == (5, 4, 3, 3)
    refused(lambda: IlluminationGrid(grid.spec, light, ones, ones), "2 channels", "1 (grey) or 3 (RGB)")
    refused(lambda: IlluminationGrid(grid.spec, light, ones, ones, RGB), "3: R, G, B")


def test_a_scene_is_grey_unless_something_in_it_has_a_colour():
    volume = ball(6)
    assert channels_of(Scene.sky(volume, (0.5, 0.5, 0.5))) == GREY
    assert channels_of(Scene.sky(volume, (0.5, 0.5, 0.6))) == RGB
    assert channels_of(Scene.box(volume, (0.5, 0.5, 0.5))) == RGB  # its walls are red and green


# What a grid is asked


def test_a_point_is_covered_if_every_node_of_its_cell_has_light_of_its_own():
    support = np.ones((4, 4, 4))
    support[1, 1, 1] = 0
    grid = IlluminationGrid(GridSpec((4, 4, 4)), np.ones((4, 4, 4, 3)), np.ones((4, 4, 4)), support)
    points = [[1.5, 1.5, 1.5], [2.5, 1.5, 1.5], [2, 1, 1], [1, 1, 1], [0.5, 0.5, 2.0], [0.5, 1.0, 1.0], [9, 9, 9]]
    assert grid.covered(points).tolist() == [False, True, True, False, True, False, True]


def test_blocks_are_the_nodes_of_the_dense_arrays_in_their_order(monkeypatch):
    monkeypatch.setattr(illumination, "_BLOCK", 17)
    for channels in (1, 3):
        light = np.random.default_rng(0).random((3, 4, 5, channels))
        support = np.arange(60.0).reshape(3, 4, 5)
        grid = IlluminationGrid(GridSpec((3, 4, 5)), light, 0.1 * support, support)
        nodes, *arrays = zip(*grid.blocks())
        assert [n.stop for n in nodes] == [17, 34, 51, 60]
        for parts, whole in zip(arrays, grid.dense()):
            assert np.array_equal(np.concatenate(parts), whole.reshape(60, *whole.shape[3:]))
