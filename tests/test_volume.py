"""Volumes: positions of voxels, interpolation between them, and outward normals."""

import numpy as np
import pytest

from illumgrid.errors import IllumgridWarning
from illumgrid.field.filters import finite, smooth
from illumgrid.field.volume import (
    Volume,
    cell_gradient,
    cells,
    index_to_world,
    interpolate,
    outward_normals,
    smooth_gradient,
    world_to_index,
)
from shapes import DIRECTIONS, MIRRORED, ball, refused, sampled

UNEVEN = np.array([0.5, 1.25, 3.0])


def noise(shape=(7, 6, 8), seed=0, **place):
    return Volume(np.random.default_rng(seed).random(shape), **place)


def within(volume, count, seed=1, margin=0.0):
    top = np.array(volume.shape) - 1
    return margin + np.random.default_rng(seed).random((count, 3)) * (top - 2 * margin)


# Place


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_index_and_world_are_inverse_of_each_other(direction):
    volume = noise(origin=(-3, 40, 10.5), spacing=UNEVEN, direction=direction)
    index = within(volume, 100)
    np.testing.assert_allclose(world_to_index(volume, index_to_world(volume, index)), index, atol=1e-12)


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_a_step_along_an_axis_is_a_column_of_direction_times_spacing(direction):
    volume = noise(origin=(1, 2, 3), spacing=UNEVEN, direction=direction)
    for axis in range(3):
        step = index_to_world(volume, np.eye(3)[axis]) - index_to_world(volume, np.zeros(3))
        np.testing.assert_allclose(step, volume.direction[:, axis] * UNEVEN[axis], atol=1e-14)


@pytest.mark.parametrize("extents", [0, 1, 1e3, 1e5])
@pytest.mark.parametrize("scale", [1e-6, 1, 1e6])
def test_a_voxel_stays_a_voxel_after_a_trip_through_the_world_also_far_away(extents, scale):
    spacing = UNEVEN * scale
    away = np.array([1, -1, 0.3]) * extents * 128 * spacing.max()
    volume = noise(origin=away, spacing=spacing, direction=MIRRORED)
    index = np.random.default_rng(0).integers(0, 128, (500, 3)).astype(float)
    assert np.array_equal(world_to_index(volume, index_to_world(volume, index)), index)


def test_what_is_beside_a_voxel_is_not_moved_onto_it():
    index = world_to_index(noise(), [[1 + 1e-6, 2 - 1e-6, 3.4]])
    np.testing.assert_allclose(index, [[1 + 1e-6, 2 - 1e-6, 3.4]], rtol=0, atol=1e-15)


# What a volume takes


@pytest.mark.parametrize(
    "values, words",
    [
        (np.zeros((3, 3, 3), complex), ["complex128", "real"]),
        (np.zeros((3, 3, 3), object), ["object", "real"]),
        (np.full((3, 3, 3), "a"), ["U1", "real"]),
        (np.zeros((3, 3)), ["(3, 3)", "three axes"]),
        (np.zeros((3, 3, 3, 3)), ["(3, 3, 3, 3)", "three axes"]),
        (np.zeros((3, 1, 3)), ["(3, 1, 3)", "at least 2"]),
        (np.zeros((0, 3, 3)), ["(0, 3, 3)", "at least 2"]),
        (np.full((2, 2, 2), np.nan), ["all NaN or infinite", "finite"]),
        (np.full((2, 2, 2), 1e300), ["all NaN or infinite"]),
    ],
)
def test_values_that_are_no_scalar_field_are_refused_in_a_sentence(values, words):
    refused(lambda: Volume(values), *words)


@pytest.mark.parametrize(
    "place, words",
    [
        ({"origin": (0, 0)}, ["origin", "three finite"]),
        ({"origin": (0, np.nan, 0)}, ["origin", "nan", "three finite"]),
        ({"spacing": (1, 0, 1)}, ["spacing", "three positive"]),
        ({"spacing": (1, -1, 1)}, ["spacing", "direction"]),
        ({"spacing": (1, np.inf, 1)}, ["spacing", "inf"]),
        ({"spacing": 1.0}, ["spacing", "three positive"]),
        ({"direction": np.ones((3, 3))}, ["direction", "orthonormal"]),
        ({"direction": np.eye(3) * 2}, ["direction", "orthonormal"]),
        ({"direction": np.eye(2)}, ["direction", "3x3"]),
        ({"direction": np.full((3, 3), np.nan)}, ["direction", "orthonormal"]),
    ],
)
def test_a_place_that_is_none_is_refused_in_a_sentence(place, words):
    refused(lambda: Volume(np.zeros((2, 2, 2)), **place), *words)


def test_a_direction_in_single_precision_becomes_exactly_orthonormal():
    volume = noise(direction=MIRRORED.astype(np.float32))
    np.testing.assert_allclose(volume.direction.T @ volume.direction, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(volume.direction, MIRRORED, atol=1e-6)
    assert np.array_equal(noise(direction=volume.direction).direction, volume.direction)


@pytest.mark.parametrize(
    ("kind", "kept"),
    [
        *((kind, kind) for kind in ("uint8", "int8", "uint16", "int16", "float32")),
        *((">i2", "int16"), ("bool", "uint8"), ("float16", "float32"), ("int64", "float32"), ("float64", "float32")),
    ],
)
def test_any_real_values_are_kept_read_only_in_their_type_or_as_singles(kind, kept):
    values = np.arange(8).reshape(2, 2, 2).astype(kind)
    volume = Volume(values)
    assert volume.values.dtype == kept and np.array_equal(volume.values, values.astype(np.float32))
    assert np.shares_memory(volume.values, values) == (kind == kept)
    assert np.array_equal(Volume(values, slope=-2.0).values, -2.0 * values)
    for array in (volume.values, volume.origin, volume.spacing, volume.direction):
        assert not array.flags.writeable
    assert values.flags.writeable
    assert volume == volume and volume != Volume(values) and "2x2x2" in repr(volume)


# Not a number, and noise


@pytest.mark.parametrize("inside, outermost", [("above", 0.0), ("below", 7.0)])
def test_nan_becomes_the_value_farthest_outside_and_infinities_the_extremes(inside, outermost):
    values = np.arange(12.0).reshape(2, 2, 3) - 2
    values.flat[[0, 1, 10, 11]] = np.nan, -np.inf, np.inf, np.nan
    values.flat[[2, 9]] = 0, 7
    with pytest.warns(IllumgridWarning, match=r"4 of 12 voxels .*\(0, 0, 0\).*farthest outside") as caught:
        whole = finite(Volume(values), inside).values.ravel()
    assert len(caught) == 1
    assert whole[[0, 1, 10, 11]].tolist() == [outermost, 0, 7, outermost]
    assert np.array_equal(whole[2:10], values.ravel()[2:10])


def test_finite_values_come_back_as_they_are():
    volume = noise()
    assert finite(volume, "above") is volume


def test_smoothing_by_nothing_changes_nothing_and_by_more_calms():
    volume = noise((12, 12, 12), origin=(1, 2, 3), spacing=UNEVEN, direction=MIRRORED)
    assert smooth(volume, 0) is volume
    calm = smooth(volume, 1.0)
    assert calm.values.std() < 0.3 * volume.values.std()
    assert calm.values.mean() == pytest.approx(volume.values.mean(), abs=0.01)
    assert np.array_equal(calm.origin, volume.origin) and np.array_equal(calm.direction, volume.direction)
    assert np.array_equal(smooth(Volume(np.full((4, 4, 4), 3.0)), 2.0).values, np.full((4, 4, 4), 3.0))


@pytest.mark.parametrize("sigma", [-1, np.nan, np.inf])
def test_smoothing_by_what_is_no_width_is_refused(sigma):
    refused(lambda: smooth(noise(), sigma), f"{sigma}", "from 0 to")


# Between the voxels


def test_interpolation_at_a_voxel_is_its_value():
    volume = noise()
    index = np.indices(volume.shape).reshape(3, -1).T.astype(float)
    assert np.array_equal(interpolate(volume, index), volume.values.ravel())


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_value_and_both_gradients_of_a_linear_field_are_exact(direction):
    slope = np.array([0.75, -0.5, 0.25])
    volume = sampled(lambda x: x @ slope + 3, (5, 6, 4), (1, -2, 0.5), UNEVEN, direction)
    index = within(volume, 200)
    np.testing.assert_allclose(interpolate(volume, index), index_to_world(volume, index) @ slope + 3, atol=2e-6)
    along = slope @ volume.direction
    for gradient in (smooth_gradient, cell_gradient):
        np.testing.assert_allclose(gradient(volume, index), np.tile(along, (200, 1)), atol=5e-6)


def test_interpolation_beyond_the_border_is_that_of_the_border():
    volume = noise()
    top = np.array(volume.shape) - 1.0
    index = np.random.default_rng(0).uniform(-5, 15, (100, 3))
    np.testing.assert_allclose(interpolate(volume, index), interpolate(volume, np.clip(index, 0, top)), atol=1e-12)


def test_the_cell_of_the_last_voxel_is_the_last_cell():
    volume = noise((3, 4, 5))
    cell, f = cells(volume, np.array([[0, 0, 0], [2, 3, 4], [1, 1.5, 3.25]], float))
    assert cell.tolist() == [[0, 0, 0], [1, 2, 3], [1, 1, 3]]
    assert f.tolist() == [[0, 0, 0], [1, 1, 1], [0, 0.5, 0.25]]


def test_the_gradient_of_a_cell_is_the_difference_quotient_of_its_interpolant():
    volume = noise(spacing=UNEVEN)
    index = np.floor(within(volume, 200)) + np.random.default_rng(2).uniform(0.1, 0.9, (200, 3))
    index = np.minimum(index, np.array(volume.shape) - 1.1)
    for axis in range(3):
        step = 0.01 * np.eye(3)[axis]
        rise = interpolate(volume, index + step) - interpolate(volume, index - step)
        np.testing.assert_allclose(cell_gradient(volume, index)[:, axis], rise / (0.02 * UNEVEN[axis]), atol=1e-9)


def test_the_smooth_gradient_of_a_quadratic_field_is_exact_away_from_the_border():
    curve = np.diag([1.0, -0.5, 0.25])
    volume = sampled(lambda x: np.einsum("ni,ij,nj->n", x, curve, x), (6, 7, 8), spacing=UNEVEN)
    index = within(volume, 200, margin=1.0)
    expected = 2 * index_to_world(volume, index) @ curve
    np.testing.assert_allclose(smooth_gradient(volume, index), expected, atol=1e-4)


def test_the_smooth_gradient_has_no_jump_between_cells():
    volume = noise(spacing=UNEVEN)
    before, after = np.array([[[3 - 1e-9, 2.3, 4.6]], [[3 + 1e-9, 2.3, 4.6]]])
    assert np.abs(smooth_gradient(volume, after) - smooth_gradient(volume, before)).max() < 1e-7
    assert np.abs(cell_gradient(volume, after) - cell_gradient(volume, before)).max() > 0.01


# Normals


@pytest.mark.parametrize("inside, sign", [("above", 1), ("below", -1)])
def test_normals_of_a_ball_lead_outwards_as_inside_says(inside, sign):
    volume = ball(32)
    index = within(volume, 300, margin=3)
    away = index_to_world(volume, index)
    far = np.linalg.norm(away, axis=1) > 0.4
    normal = outward_normals(volume, index[far], inside)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-12)
    cosine = sign * (normal * away[far]).sum(axis=1) / np.linalg.norm(away[far], axis=1)
    assert cosine.min() > 0.999


def test_a_plateau_has_no_normal():
    values = np.zeros((8, 4, 4))
    values[6:] = 1
    normal = outward_normals(Volume(values), np.array([[1, 1, 1], [2.5, 1.5, 1.5], [5.5, 1, 1]]), "above")
    assert normal.tolist() == [[0, 0, 0], [0, 0, 0], [-1, 0, 0]]


def test_where_central_differences_cancel_the_cell_decides():
    ridge = np.zeros((3, 3, 3))
    ridge[1] = 1
    normal = outward_normals(Volume(ridge), np.array([[1.0, 1, 1], [0.999, 1, 1]]), "above")
    assert np.abs(normal[0]).tolist() == [1, 0, 0]
    assert normal[1].tolist() == [-1, 0, 0]


@pytest.mark.parametrize("power", [-140, -100, 100, 126])
def test_normals_do_not_depend_on_the_scale_of_the_values(power):
    values = np.round(noise().values * 16)
    index = within(Volume(values), 100)
    expected = outward_normals(Volume(values), index, "above")
    scaled = Volume(values.astype(float) * 2.0**power / 16)
    assert np.array_equal(outward_normals(scaled, index, "above"), expected)
