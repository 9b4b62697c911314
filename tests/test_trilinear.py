"""The compiled lookup equals SciPy's trilinear interpolation at the index of `world_to_index`, to the last bit."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from illumgrid.constants import ON_A_VOXEL
from illumgrid.field.volume import index_to_world, world_to_index
from illumgrid.grid import GridSpec, read_lattice
from shapes import DIRECTIONS

pytestmark = pytest.mark.plain


def by_scipy(spec, values, points):
    index = world_to_index(spec, np.nan_to_num(points, posinf=1e300, neginf=-1e300)).T
    index = np.clip(index, -9, 99)  # SciPy overflows where an index is no integer that fits
    result = np.zeros((len(points), values.shape[3]), np.float32)
    for channel in range(values.shape[3]):
        map_coordinates(values[..., channel], index, output=result[:, channel], order=1, mode="nearest")
    return result


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_the_lookup_is_that_of_scipy(direction, channels):
    random = np.random.default_rng(channels)
    spec = GridSpec((4, 6, 3), (1e3, -2, 1 / 3), (0.5, 1.25, 3.0), direction)
    values = random.random((*spec.shape, channels), dtype=np.float32)
    index = random.uniform(-1.5, 7, (300, 3))
    index[:50] = random.integers(0, 6, (50, 3)) + random.uniform(-2, 2, (50, 3)) * ON_A_VOXEL  # on nodes, or nearly
    index[50:100, 1] = np.round(index[50:100, 1])
    points = index_to_world(spec, index)
    # The place is summed in another order than NumPy's: by 1e-13 of a thousand units, it may be another one.
    np.testing.assert_allclose(read_lattice(spec, values, points), by_scipy(spec, values, points), atol=3e-7)


def test_where_the_place_is_exact_the_light_is_exact():
    random = np.random.default_rng(0)
    spec = GridSpec((5, 4, 6))
    values = random.random((*spec.shape, 3), dtype=np.float32)
    points = random.uniform(-1, 7, (500, 3))
    assert np.array_equal(read_lattice(spec, values, points), by_scipy(spec, values, points))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e308, -1e308])
@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_a_coordinate_that_is_none_reads_the_border(bad, direction):
    spec = GridSpec((3, 4, 5), (1, 2, 3), direction=direction)
    values = np.random.default_rng(1).random((*spec.shape, 3), dtype=np.float32)
    points = np.full((3, 3), 2.5)
    points[np.arange(3), np.arange(3)] = bad
    found = read_lattice(spec, values, points)
    np.testing.assert_allclose(found, by_scipy(spec, values, points), atol=3e-7)
    assert np.isfinite(found).all()


def test_a_view_of_points_and_values_is_read_as_a_copy_would_be():
    spec = GridSpec((3, 4, 5))
    values = np.random.default_rng(2).random((5, 4, 3, 6), dtype=np.float32).transpose(2, 1, 0, 3)[..., ::2]
    points = np.random.default_rng(3).uniform(0, 2, (20, 6))[::2, ::2]
    assert np.array_equal(read_lattice(spec, values, points), by_scipy(spec, values.copy(), points.copy()))
    assert read_lattice(spec, values, points[:0]).shape == (0, 3)
