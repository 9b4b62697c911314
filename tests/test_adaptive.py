"""Isovalues in equal steps of space: the co-area sums on known fields, and the resulting levels."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from skimage.measure import euler_number

from illumgrid.field.scene import Field, Scene, level_table
from illumgrid.field.volume import Volume, index_to_world
from illumgrid.grid import GridSpec
from illumgrid.samplers.adaptive import Adaptive, adaptive_rows, critical_values, distance_between
from illumgrid.stages import Sampler
from illumgrid.transport.samples import join_queries
from shapes import MIRRORED, ball, refused, sampled, sky

UNEVEN = np.array([0.5, 1.25, 2.0])


def field_of(volume, limits, inside="above"):
    return Field("f", volume, range=limits, inside=inside)


# The distance between level sets


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])
@pytest.mark.parametrize("slope", [(2.0, 0.0, 0.0), (1.0, -2.0, 0.5)])
def test_level_sets_of_a_linear_field_are_as_far_apart_as_its_slope_says(slope, scale):
    volume = sampled(lambda x: scale * (x @ np.array(slope)), (12, 9, 8), spacing=UNEVEN, direction=MIRRORED)
    low, high = np.percentile(volume.values, [20, 80])
    edges = np.linspace(low, high, 33)
    distance = distance_between(field_of(volume, (low, high)), edges)
    np.testing.assert_allclose(distance, np.diff(edges) / (scale * np.linalg.norm(slope)), rtol=1e-4)


def test_level_sets_of_a_paraboloid_come_closer_as_its_slope_grows():
    volume = sampled(lambda x: -(x * x).sum(axis=1), (41, 41, 41), (-10, -10, -10), np.full(3, 0.5))
    edges = np.linspace(-81, -9, 73)
    distance = distance_between(field_of(volume, (-81, -9)), edges)
    np.testing.assert_allclose(distance, -np.diff(np.sqrt(-edges)), rtol=0.01)


def test_whole_numbers_leave_no_comb():
    fine = sampled(lambda x: 60 - 3 * np.linalg.norm(x, axis=1), (33, 33, 33), (-16, -16, -16))
    edges = np.linspace(20, 50, 301)  # ten bins to a whole number
    distance = distance_between(field_of(fine.with_stored(np.round(fine.values)), (20, 50)), edges)
    assert np.abs(distance / (0.1 / 3) - 1).max() < 0.15


def test_a_plateau_is_no_distance_and_an_empty_part_of_the_range_neither():
    values = np.zeros((30, 4, 4))
    values[10:] = 5  # a step from 0 to 5 within one cell, and two plateaus
    edges = np.linspace(-5, 10, 31)
    distance = distance_between(field_of(Volume(values), (-5, 10)), edges)
    within = (edges[:-1] >= 0) & (edges[1:] <= 5)
    np.testing.assert_allclose(distance[within], 1 / 10, rtol=1e-9)
    assert not distance[~within].any()


@pytest.mark.parametrize("inside", ["above", "below"])
def test_the_distance_does_not_depend_on_the_side(inside):
    edges = np.linspace(0.3, 0.9, 13)
    np.testing.assert_allclose(distance_between(field_of(ball(32), (0.3, 0.9), inside), edges), 0.05, rtol=0.02)


# Changes of topology


@pytest.mark.parametrize("inside", ["above", "below"])
def test_changes_add_up_to_the_euler_characteristic(inside):
    values = np.random.default_rng(0).integers(0, 8, (9, 10, 11))  # many are equal
    for level in (2, 4, 7) if inside == "above" else (0, 2, 5):
        limits = (level, 7.5) if inside == "above" else (-0.5, level)
        at, change = critical_values(field_of(Volume(values), limits, inside))
        solid = values >= level if inside == "above" else values <= level
        assert change.sum() == euler_number(solid, connectivity=1)
        assert (change != 0).all() and set(at) <= set(range(8))


def test_two_balls_that_join_are_two_tops_and_a_saddle():
    def two(x):
        top = np.array([0, 0, 2])
        return np.exp(-((x - top) ** 2).sum(axis=1) / 4) + 0.9 * np.exp(-((x + top) ** 2).sum(axis=1) / 4)

    volume = sampled(two, (25, 25, 25), (-6, -6, -6), np.full(3, 0.5))
    at, change = critical_values(field_of(volume, (0.2, 1.1)))
    order = np.argsort(at)
    assert change[order].tolist() == [-1, 1, 1]
    np.testing.assert_allclose(at[order], [two(np.zeros((1, 3)))[0], 0.9 + np.exp(-4), 1 + 0.9 * np.exp(-4)], rtol=0.02)


def test_a_plateau_is_one_step():
    values = np.zeros((9, 9, 9))
    values[2:7, 2:7, 2:7] = 3
    at, change = critical_values(field_of(Volume(values), (1, 4)))
    assert at.tolist() == [3] and change.tolist() == [1]


# Rows


def steep(r):
    return np.exp(-r / 6)


def radial(n=41):
    return sampled(lambda x: steep(np.linalg.norm(x, axis=1)), (n, n, n), np.full(3, -(n - 1) / 2))


def test_rows_are_equal_steps_of_space():
    scene = sky(radial(), (steep(18), steep(2)))
    rows = adaptive_rows(scene, 9, topology=0.0)
    np.testing.assert_allclose(-6 * np.log(rows[:, 0]), np.linspace(18, 2, 9), atol=0.1)


def test_adaptive_closes_the_gaps_that_uniform_leaves():
    scene = sky(radial(), (steep(18), steep(2)))
    spec = GridSpec.over(scene.fields[0].volume, 41)
    index = np.argwhere(np.ones((41, 41, 41)))
    value = scene.fields[0].volume.values.ravel()
    inside = (value >= scene.fields[0].range[0]) & (value <= scene.fields[0].range[1])
    nodes = index_to_world(scene.fields[0].volume, index[inside])
    largest = {}
    for name, rows in (("uniform", level_table(scene, 9).table), ("adaptive", adaptive_rows(scene, 9))):
        radii = -6 * np.log(rows)  # of the spheres that are visited: exact
        largest[name] = KDTree(radii).query(np.linalg.norm(nodes, axis=1)[:, None])[0].max()
    assert largest["uniform"] > 2.5  # half of 18 - 12.6: the first step of the isovalue
    assert largest["adaptive"] < 1.5  # equal steps would leave 1
    assert len(join_queries(list(Adaptive(count=9, points=64).queries(scene, [spec], 0)))) == 9 * 64


def test_there_are_more_levels_where_the_topology_changes():
    def comb(x):  # a slope along z, with bumps that all come up about 10
        return x[:, 2] + 6 * np.cos(np.pi * x[:, 0] / 4) * np.exp(-((x[:, 2] - 10) ** 2) / 8)

    scene = sky(sampled(comb, (33, 5, 21)), (1, 19))
    plain, closer = adaptive_rows(scene, 100, 0.0)[:, 0], adaptive_rows(scene, 100)[:, 0]
    at, _ = critical_values(scene.fields[0])
    assert 4 < len(at) < 40
    near = [(np.abs(rows[:, None] - at).min(axis=1) < 1).sum() for rows in (plain, closer)]
    assert near[1] > near[0]


def test_at_most_as_many_rows_as_asked_for_within_the_part_of_the_range_that_has_level_sets():
    volume = ball(16)
    top = float(volume.values.max())
    for count in (2, 3, 17, 200):
        rows = adaptive_rows(sky(volume, (0.5, 3.0)), count)
        assert 2 <= len(rows) <= count and (np.diff(rows[:, 0]) > 0).all()
        assert rows[0, 0] == 0.5 and top - 0.01 < rows[-1, 0] <= top + 0.01


def test_where_no_cell_is_crossed_the_rows_are_those_of_uniform():
    volume = ball(8)
    scene = sky(volume, (float(volume.values.max()), 9.0))
    assert np.array_equal(adaptive_rows(scene, 5), level_table(scene, 5).table)


def test_several_fields_step_so_that_none_leaves_a_gap():
    flat = sampled(lambda x: x[:, 2], (8, 8, 41))
    bent = sampled(lambda x: np.where(x[:, 2] < 20, 0.1 * x[:, 2], 2 + 0.9 * (x[:, 2] - 20)), (8, 8, 41))
    fields = (Field("flat", flat, range=(0, 40)), Field("bent", bent, range=(0, 20)))
    rows = adaptive_rows(Scene(fields, background=np.ones(3)), 21, topology=0.0)
    places = [rows[:, 0], np.interp(rows[:, 1], [0, 2, 20], [0, 20, 40])]
    # The first tenth of the sweep takes the second field through half of its space, the rest is led by the first.
    steps = np.max(np.abs(np.diff(places, axis=1)), axis=0)
    step = (20 + 36) / 20
    assert (steps < 1.01 * step).all() and (steps > 0.99 * step).sum() == 19  # but for the step across the kink


def test_the_side_that_is_solid_and_the_units_do_not_move_the_rows():
    plain = adaptive_rows(sky(radial(21), (steep(9), steep(2))), 7)
    below = adaptive_rows(sky(radial(21), (steep(9), steep(2)), inside="below"), 7, 0.0)
    np.testing.assert_allclose(below, adaptive_rows(sky(radial(21), (steep(9), steep(2))), 7, 0.0), rtol=1e-9)
    volume = radial(21)
    for scale in (2.0**-40, 2.0**40):
        scaled = Volume(volume.values * np.float32(scale), volume.origin * scale, volume.spacing * scale)
        rows = adaptive_rows(sky(scaled, (scale * steep(9), scale * steep(2))), 7)
        np.testing.assert_allclose(rows, scale * plain, rtol=1e-6)


def test_adaptive_is_a_sampler_that_refuses_nonsense_and_repeats_itself():
    assert isinstance(Adaptive(), Sampler) and Adaptive.name == "adaptive"
    assert repr(Adaptive(3, 5)) == "Adaptive(count=3, points=5)"
    refused(lambda: Adaptive(count=1), "adaptive.count", "1", "at least 2")
    refused(lambda: Adaptive(points=-1), "adaptive.points", "-1", "positive")
    scene = sky(ball(10))
    spec = [GridSpec.over(scene.fields[0].volume, 10)]
    one, same = (join_queries(list(Adaptive(4, 20).queries(scene, spec, 3))) for _ in range(2))
    assert np.array_equal(one.point, same.point) and np.array_equal(one.id, same.id) and len(one) == 80
