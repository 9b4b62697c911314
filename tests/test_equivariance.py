"""Light is independent of the array's memory layout, its placement in the world, and the sign and unit of its values.

Raw integer noise has nodes on voxels. Each node is the corner of eight cells, and a method that selects one of them by
the order of the axes fails here. The oracle chain cannot detect this: all three implementations could agree on it.
"""

import numpy as np
import pytest

from illumgrid.backends.numba_ import Numba
from illumgrid.backends.reference import Reference
from illumgrid.bake import bake
from illumgrid.field.scene import Field, Scene, level_table
from illumgrid.field.volume import Volume, outward_normals, smooth_gradient
from illumgrid.grid import GridSpec
from illumgrid.interpolators.nearest import Nearest
from illumgrid.samplers.direct import Direct
from illumgrid.transport.samples import Queries
from transport import assert_standard_normal, colored, furnace, noise, on_sets, on_voxels, rotation, voxels, waves

SHAPE, PATHS = (10, 8, 9), 600
SPACING = (1.0, 0.7, 1.6)
TURNS = {
    "mirror x": ((0, 1, 2), (0,)),
    "mirror y": ((0, 1, 2), (1,)),
    "mirror z": ((0, 1, 2), (2,)),
    "quarter turn about z": ((1, 0, 2), (0,)),
    "quarter turn about y": ((2, 1, 0), (2,)),
    "quarter turn about x": ((0, 2, 1), (1,)),
    "cycle and invert": ((1, 2, 0), (0, 1, 2)),
}
"""Permutation of the axes, then axes to flip."""


def turn(array, name):
    axes, flips = TURNS[name]
    return np.flip(array.transpose(*axes, *range(3, array.ndim)), flips)


def direct_grid(volume, limits, inside="above", seed=0):
    scene = Scene.sky(volume, (0.5, 0.5, 0.5), limits, inside)
    spec = GridSpec.over(volume, max(volume.shape))
    assert spec.shape == volume.shape
    stages = Direct(), Numba().prepare(scene), Nearest()
    light = bake(scene, [spec], level_table(scene, 2), *stages, paths=[range(PATHS)], bounces=3, seed=seed)
    return light.grids[0]


CASES = {
    "nine grays": (9, "above", (-0.5, 8.5)),
    "bytes below": (256, "below", (-0.5, 255.5)),
    "bytes with rim": (256, "above", (60, 190)),
}
"""Gray values, side, range: where that ends within the data, nodes of the rim are projected onto the end of it."""


@pytest.fixture(scope="module", params=["nine grays", "bytes below", "bytes with rim"])
def straight(request):
    grays, inside, limits = CASES[request.param]
    volume = noise(grays, SHAPE, seed=4, spacing=SPACING)
    return volume, limits, inside, direct_grid(volume, limits, inside)


@pytest.mark.parametrize("name", TURNS)
def test_the_direct_grid_turns_with_the_array(straight, name):
    volume, limits, inside, grid = straight
    turned = Volume(turn(volume.values, name), spacing=np.take(SPACING, TURNS[name][0]))
    other = direct_grid(turned, limits, inside, seed=1)
    # Where central differences cancel, the normal is that of one of eight cells, and no choice among them is symmetric.
    index = np.argwhere(np.ones(SHAPE)) * 1.0
    known = turn(smooth_gradient(volume, index).any(axis=1).reshape(SHAPE), name)
    assert known.mean() > 0.98
    support = turn(grid.support, name)
    np.testing.assert_array_equal(support[known], other.support[known])

    both = known & (support > 0) & (other.support > 0)
    off = (turn(grid.values, name)[..., 0] - other.values[..., 0])[both].astype(float)
    bar = np.hypot(turn(grid.error, name)[both], other.error[both], dtype=float)
    sure = bar < 0.02  # all but no path escapes, or all but all: too few to be normal
    assert np.abs(off[sure]).max() < 0.25
    assert (~sure).sum() > 300
    assert_standard_normal(off[~sure] / bar[~sure])


@pytest.mark.parametrize("name", TURNS)
def test_normals_turn_with_the_array(name):
    volume = noise(9, SHAPE, seed=4, spacing=SPACING)
    axes, flips = TURNS[name]
    turned = Volume(turn(volume.values, name), spacing=np.take(SPACING, axes))
    index = np.argwhere(np.ones(SHAPE)) * 1.0
    known = smooth_gradient(volume, index).any(axis=1)
    normal = np.where(known[:, None], outward_normals(volume, index, "above"), 0.0).reshape(*SHAPE, 3)
    sign = np.where(np.isin(np.arange(3), flips), -1.0, 1.0)
    expected = turn(normal, name)[..., list(axes)] * sign
    there = outward_normals(turned, np.argwhere(np.ones(turned.shape)) * 1.0, "above").reshape(expected.shape)
    known = turn(known.reshape(SHAPE), name)
    np.testing.assert_allclose(there[known], expected[known], atol=1e-14)


BACKENDS = {"numba": (Numba(), 16), "reference": (Reference(), 2)}


def light(scene, queries, backend):
    solver, paths = BACKENDS[backend]
    return solver.solve(scene, queries, paths=range(paths), bounces=4, seed=7)


def assert_equal(one, other):
    for name in ("paths", "mean", "m2"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.paths.any()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shift", [0.0, 1024.0, -1e6])
@pytest.mark.parametrize("scale", [2.0**-20, 0.5, 2.0**20])
def test_a_place_in_the_world_changes_no_bit(shift, scale, backend):
    values = noise(9).values
    here = colored(furnace(Volume(values)))
    there = colored(furnace(Volume(values, origin=np.array([shift, -shift, shift]), spacing=[scale] * 3)))
    assert_equal(light(here, on_voxels(here), backend), light(there, on_voxels(there), backend))


def test_a_place_in_the_world_changes_no_path_between_voxels():
    values = waves().values
    here = colored(furnace(Volume(values, spacing=(0.5, 2.0, 1.3))))
    there = colored(furnace(Volume(values, origin=(1e5, 2e5, -3e5), spacing=(0.5, 2.0, 1.3), direction=rotation())))
    queries = on_sets(here)
    moved = Queries.at(there, there.from_frame(queries.point), level=queries.level[:, 0])
    one, other = (light(s, q, "numba") for s, q in ((here, queries), (there, moved)))
    both = (one.paths > 0) & (other.paths > 0)
    assert both.mean() > 0.99
    # 1e-16 of 3e5 is 1e-10 of a voxel: enough for a grazing path now and then, out of 16 a query.
    assert (np.abs(one.mean - other.mean)[both].max(axis=1) > 1e-6).mean() < 0.01


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("values", [v.values for v in (noise(9), noise(4), waves())], ids=["grays", "flats", "smooth"])
def test_below_on_the_negative_is_above(values, backend):
    up = colored(furnace(Volume(values, spacing=SPACING)))
    field = up.fields[0]
    negative = Field(field.name, field.volume.with_stored(-values), field.material, -field.range[::-1], "below")
    down = Scene((negative,), background=up.background)
    queries = on_voxels(up)
    mirrored = on_voxels(down)
    np.testing.assert_array_equal(queries.level, -mirrored.level)
    assert_equal(light(up, queries, backend), light(down, mirrored, backend))
    if backend == "numba":
        at = voxels(field.volume)[::3] * 0.98 + 0.03
        level = up.fields[0].range.mean()
        one, other = Queries.at(up, at, level=level), Queries.at(down, at, level=-level)
        np.testing.assert_array_equal(one.point, other.point)
        assert_equal(light(up, one, backend), light(down, other, backend))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("grays", [4, 256])
def test_another_unit_of_the_values_changes_no_bit(grays, backend):
    one = colored(furnace(noise(grays, spacing=SPACING)))
    other = colored(furnace(Volume(2 * noise(grays).values + 8, spacing=SPACING)))
    np.testing.assert_array_equal(2 * one.fields[0].volume.values + 8, other.fields[0].volume.values)
    assert_equal(light(one, on_voxels(one), backend), light(other, on_voxels(other), backend))
