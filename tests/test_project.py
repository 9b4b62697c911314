"""Projection onto a level set: near points arrive, and every point reported as arrived lies on it."""

import warnings

import numpy as np
import pytest

from illumgrid.field import newton
from illumgrid.field.volume import (
    Volume,
    cell_gradient,
    interpolate,
    outward_normals,
    project,
    smooth_gradient,
    unit,
)
from shapes import ball
from test_volume import UNEVEN, noise, within

pytestmark = pytest.mark.plain
REACH = 1.0  # cells: how far a point may be moved along an axis


def misses(volume, at, level):
    return np.abs(interpolate(volume, at) - level)


def test_projection_reaches_every_near_level_of_a_smooth_field():
    volume = ball(24)
    start = within(volume, 500, margin=2)
    start = start[np.abs(1.2 - interpolate(volume, start)) > 0.3]
    level = interpolate(volume, start) + np.random.default_rng(3).uniform(-0.05, 0.05, len(start))
    at, arrived = project(volume, start, level)
    assert arrived.all()
    assert misses(volume, at, level).max() < 1e-9 * 0.1


@pytest.mark.parametrize("scale", [1e-30, 1, 1e30])
def test_projection_on_noise_never_says_arrived_where_it_is_not(scale):
    volume = Volume(noise((12, 11, 10)).values.astype(float) * scale, spacing=UNEVEN)
    start = within(volume, 2000)
    level = interpolate(volume, start) + scale * np.random.default_rng(4).uniform(-0.1, 0.1, len(start))
    at, arrived = project(volume, start, level)
    assert arrived.mean() > 0.9
    assert misses(volume, at, level)[arrived].max() < 1e-8 * scale
    assert np.abs(at - start)[arrived].max() <= REACH
    assert (at >= 0).all() and (at <= np.array(volume.shape) - 1).all()


def test_a_point_on_its_own_level_stays_where_it_is():
    volume = noise()
    start = within(volume, 200)
    at, arrived = project(volume, start, interpolate(volume, start))
    assert arrived.all() and np.array_equal(at, start)


def test_projection_does_not_arrive_on_a_plateau_out_of_reach_or_from_outside():
    values = np.zeros((14, 4, 4))
    values[5:] = np.arange(9)[:, None, None] * 10
    volume = Volume(values)
    start = np.array([[2, 1.5, 1.5], [5.5, 1, 1], [5.5, 1, 1], [5.5, 1, 1], [-0.5, 1, 1], [5.5, 1, 3.2]])
    level = np.array([3.0, 7.0, 45.0, 100.0, 0.0, 5.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        at, arrived = project(volume, start, level)
    assert arrived.tolist() == [False, True, False, False, False, False]
    np.testing.assert_allclose(at[1], [5.7, 1, 1], atol=1e-12)


def test_projection_leaves_the_edge_of_a_plateau():
    values = np.zeros((6, 3, 3))
    values[3:] = np.arange(1, 4)[:, None, None]
    at, arrived = project(Volume(values), np.array([[1.9, 1, 1]]), np.array([0.5]))
    assert arrived.all()
    np.testing.assert_allclose(at, [[2.5, 1, 1]], atol=1e-12)


def test_nothing_to_project_is_no_trouble():
    at, arrived = project(noise(), np.zeros((0, 3)), np.zeros(0))
    assert at.shape == (0, 3) and arrived.shape == (0,)


@pytest.mark.parametrize("side", ["above", "below"])
def test_compiled_values_and_normals_are_those_of_numpy_bit_for_bit(side):
    volume = Volume(np.random.default_rng(7).integers(0, 4, (7, 5, 6)), spacing=UNEVEN)  # some differences cancel
    index = np.concatenate([within(volume, 300), np.argwhere(np.ones(volume.shape)).astype(float)])
    slopes = smooth_gradient(volume, index)
    flat = ~slopes.any(axis=1)
    assert flat.any()
    slopes[flat] = cell_gradient(volume, index[flat])
    expected = unit(slopes if side == "below" else -slopes)
    np.testing.assert_array_equal(outward_normals(volume, index, side), expected)
    values = [newton.value_at(volume.values, *point) for point in index]
    np.testing.assert_array_equal(values, interpolate(volume, index))
