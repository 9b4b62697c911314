"""Queries, each on the level set of its own row, and samples with error bars that cover."""

from dataclasses import replace

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.field.layers import ALL
from illumgrid.field.scene import Field, Scene
from illumgrid.field.volume import Volume, interpolate, world_to_index
from illumgrid.grid.channels import GREY, RGB, Channels
from illumgrid.transport import samples as samples_of
from illumgrid.transport import tracer
from illumgrid.transport.samples import Queries, Samples, check_request, combine, join_queries, join_samples
from shapes import DIRECTIONS, MIRRORED, ball, refused, sampled, sky


def shell(count=200, low=0.35, high=0.85, seed=0):
    """World points between two spheres about the origin."""
    random = np.random.default_rng(seed)
    way = random.normal(size=(count, 3))
    return way / np.linalg.norm(way, axis=1, keepdims=True) * random.uniform(low, high, (count, 1))


def value_at(scene, queries, field=0):
    volume = scene.fields[field].volume
    return interpolate(volume, world_to_index(volume, queries.point))


def is_hole(queries):
    return ~queries.normal.any(axis=1)


# Queries


def test_without_a_level_each_point_asks_on_the_level_set_through_itself():
    scene, points = sky(), shell()
    queries = Queries.at(scene, points)
    assert np.array_equal(queries.point, points)
    assert np.array_equal(queries.level[:, 0], value_at(scene, queries))
    assert not is_hole(queries).any()


@pytest.mark.parametrize("inside, sign", [("above", 1), ("below", -1)])
@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_normals_are_world_unit_vectors_towards_the_outside(direction, inside, sign):
    # the same ball in the world, stored along other axes
    step = 2 / 23
    origin = -direction @ np.ones(3)
    volume = sampled(lambda x: 1.2 - np.linalg.norm(x, axis=1), (24, 24, 24), origin, np.full(3, step), direction)
    points = shell()
    queries = Queries.at(sky(volume, inside=inside), points)
    np.testing.assert_allclose(np.linalg.norm(queries.normal, axis=1), 1, atol=1e-12)
    assert (sign * queries.normal * points).sum(axis=1).min() > 0.3
    np.testing.assert_allclose(queries.normal, sign * points / np.linalg.norm(points, axis=1, keepdims=True), atol=0.05)


def test_a_level_for_all_projects_all_points_onto_it():
    scene, points = sky(), shell(low=0.66, high=0.74)
    queries = Queries.at(scene, points, level=0.5)
    assert not is_hole(queries).any()
    np.testing.assert_allclose(value_at(scene, queries), 0.5, atol=1e-10)
    assert np.array_equal(queries.level, np.full((len(points), 1), 0.5))
    assert np.linalg.norm(queries.point - points, axis=1).max() < 0.06


def test_a_level_each_projects_each_point_onto_its_own():
    scene, points = sky(), shell()
    level = value_at(scene, Queries.at(scene, points)) + np.random.default_rng(1).uniform(-0.05, 0.05, len(points))
    queries = Queries.at(scene, points, level=level)
    assert np.array_equal(queries.level[:, 0], level)
    np.testing.assert_allclose(value_at(scene, queries), level, atol=1e-10)


def test_projection_is_right_in_a_mirrored_far_and_uneven_place():
    place = {"origin": (1e6, -2e6, 3e6), "spacing": (0.5, 1.25, 3.0), "direction": MIRRORED}
    volume = Volume(ball(24).values, **place)
    scene = sky(volume)
    index = np.random.default_rng(0).uniform(4, 19, (200, 3))
    points = volume.origin + (index * volume.spacing) @ volume.direction.T
    level = interpolate(volume, index) + 0.02
    queries = Queries.at(scene, points, level=level)
    good = ~is_hole(queries)
    assert good.mean() > 0.9
    np.testing.assert_allclose(value_at(scene, queries)[good], level[good], atol=1e-8)


def test_points_outside_the_volume_are_holes_that_stay_where_they_are():
    points = np.array([[1.5, 0, 0], [0, -1.001, 0], [np.nan, 0, 0], [0, np.inf, 0], [1, 0, 0], [0, 0, 0.5]])
    for level in (None, 0.25):
        queries = Queries.at(sky(), points, level=level)
        assert is_hole(queries)[:4].all() and not is_hole(queries)[4]
        assert np.array_equal(queries.point[:4], points[:4], equal_nan=True)
        assert np.isfinite(queries.level).all()


def test_points_on_a_plateau_or_far_from_their_level_are_holes():
    values = np.zeros((14, 5, 5))
    values[5:] = np.arange(9)[:, None, None]
    scene = sky(Volume(values), (0.5, 7))
    points = np.array([[1.5, 2, 2], [7.5, 2, 2], [7.5, 2, 2]])
    assert is_hole(Queries.at(scene, points)).tolist() == [True, False, False]
    queries = Queries.at(scene, points, level=[0.5, 2.75, 6.5])
    assert is_hole(queries).tolist() == [True, False, True]
    assert np.array_equal(queries.point[[0, 2]], points[[0, 2]])


def test_the_other_fields_take_the_isovalue_of_the_same_place_in_the_sweep():
    fields = (Field("a", ball(), range=(0.2, 0.6)), Field("b", ball(16), range=(1.0, 0.5 + 1)))
    scene = Scene(fields)
    queries = Queries.at(scene, shell(20, 0.75, 0.85), field=0, level=0.4)
    np.testing.assert_allclose(queries.level, np.tile([0.4, 1.25], (20, 1)))
    assert queries.target.tolist() == [0] * 20
    own = Queries.at(scene, shell(20, 0.05, 0.15), field=1)
    np.testing.assert_allclose(own.level[:, 0], np.clip(0.2 + 0.4 * (own.level[:, 1] - 1.0) / 0.5, 0.2, 0.6))
    assert own.target.tolist() == [1] * 20


def test_ids_count_up_from_the_first():
    queries = Queries.at(sky(), shell(5), first_id=1 << 40)
    assert queries.id.dtype == np.uint64 and queries.id.tolist() == [(1 << 40) + k for k in range(5)]


@pytest.mark.parametrize("field", [-1, 1, 7])
def test_a_field_that_is_none_is_refused(field):
    refused(lambda: Queries.at(sky(), shell(2), field=field), f"field {field}", "from 0 to 0")


def test_queries_are_cut_by_slices_masks_and_numbers_and_joined_again():
    queries = Queries.at(sky(), shell(9))
    assert len(queries) == 9
    for rows in (slice(2, 6), np.arange(9) % 2 == 0, np.array([7, 1])):
        part = queries[rows]
        for name in ("id", "point", "normal", "level", "target"):
            assert np.array_equal(getattr(part, name), getattr(queries, name)[rows])
    again = join_queries([queries[:4], queries[4:]])
    assert all(np.array_equal(a, b) for a, b in zip(vars(again).values(), vars(queries).values()))


def test_no_points_are_no_queries():
    queries = Queries.at(sky(), np.zeros((0, 3)), level=0.5)
    assert len(queries) == 0 and queries.level.shape == (0, 1) and queries.normal.shape == (0, 3)


# Samples


def answers(worth, queries):
    """Samples of path worths (paths, n, 3)."""
    mean = worth.mean(axis=0) if len(worth) else np.zeros(worth.shape[1:])
    m2 = ((worth - mean) ** 2).sum(axis=0)
    return Samples(queries, mean.astype(np.float32), m2.astype(np.float32), np.full(len(queries), len(worth), np.int32))


def test_the_standard_error_is_that_of_the_mean_of_the_paths():
    queries = Queries.at(sky(), shell(6))
    worth = np.random.default_rng(0).exponential(size=(40, 6, 3))
    samples = answers(worth, queries)
    expected = worth.std(axis=0, ddof=1) / np.sqrt(40)
    np.testing.assert_allclose(samples.stderr, expected, rtol=1e-5)
    np.testing.assert_allclose(samples.error, np.sqrt((expected**2).mean(axis=1)), rtol=1e-5)
    assert samples.stderr.dtype == samples.error.dtype == np.float32


@pytest.mark.parametrize("paths", [0, 1])
def test_below_two_paths_the_standard_error_is_infinite(paths):
    queries = Queries.at(sky(), shell(3))
    samples = answers(np.ones((paths, 3, 3)), queries)
    assert np.isinf(samples.stderr).all() and np.isinf(samples.error).all()


def test_two_ranges_of_paths_combine_to_that_of_all():
    queries = Queries.at(sky(), shell(5))
    worth = np.random.default_rng(0).exponential(size=(30, 5, 3))
    whole = answers(worth, queries)
    for cut in (0, 1, 11, 30):
        both = combine(answers(worth[:cut], queries), answers(worth[cut:], queries))
        np.testing.assert_allclose(both.mean, whole.mean, rtol=1e-6)
        np.testing.assert_allclose(both.m2, whole.m2, rtol=1e-5)
        assert both.paths.tolist() == [30] * 5


@pytest.mark.parametrize("stage", ["numba", "reference"])
def test_more_paths_than_are_held_at_once_are_answered_in_turn(stage, monkeypatch):
    monkeypatch.setattr(samples_of, "LONGEST", 16)
    scene, backend = sky(), ig.backend(stage)
    asked = Queries.at(scene, shell(4))
    whole = backend.solve(scene, asked, paths=range(8, 50), bounces=1, seed=3)
    parts = [
        backend.solve(scene, asked, paths=p, bounces=1, seed=3) for p in (range(8, 24), range(24, 40), range(40, 50))
    ]
    by_hand = combine(combine(parts[0], parts[1]), parts[2])
    np.testing.assert_array_equal(whole.paths, by_hand.paths)
    np.testing.assert_array_equal(whole.mean, by_hand.mean)
    np.testing.assert_array_equal(whole.m2, by_hand.m2)
    assert (whole.paths == 42).all()


def test_nothing_and_nothing_combine_to_a_hole():
    queries = Queries.at(sky(), shell(2))
    none = answers(np.ones((0, 2, 3)), queries)
    both = combine(none, none)
    assert not both.paths.any() and not both.mean.any() and not both.m2.any() and np.isinf(both.error).all()


def test_answers_to_different_queries_do_not_combine():
    queries = Queries.at(sky(), shell(4))
    samples = answers(np.ones((2, 4, 3)), queries)
    refused(lambda: combine(samples[:2], samples[2:]), "different queries", "same ids")


def test_samples_are_cut_and_joined():
    queries = Queries.at(sky(), shell(6))
    samples = answers(np.random.default_rng(0).random((8, 6, 3)), queries)
    assert len(samples) == 6
    again = join_samples([samples[:2], samples[np.arange(6) >= 2]])
    for name in ("mean", "m2", "paths"):
        assert np.array_equal(getattr(again, name), getattr(samples, name))
    assert np.array_equal(again.queries.id, queries.id)


# Channels


@pytest.mark.parametrize(
    "stage, options", [("numba", {}), ("numba", {"surface": "mesh"}), ("reference", {}), ("embree", {})]
)
def test_a_grey_scene_takes_one_channel_whose_rgb_is_what_three_would_be(stage, options, monkeypatch):
    if stage == "embree":
        pytest.importorskip("embreex")
    backend = ig.backend(stage, **options)
    scene = Scene(sky().fields, Scene.floor(sky().fields[0].volume).quads, np.full(3, 0.5))
    asked = Queries.at(scene, shell(20), level=0.5)
    request = {"paths": range(12), "bounces": 2, "seed": 1}
    grey = backend.solve(scene, asked, **request)
    assert grey.channels == GREY and grey.light.shape == grey.spread.shape == (20, 1) and grey.paths.any()
    monkeypatch.setattr(tracer, "channels_of", lambda scene: RGB)
    monkeypatch.setattr(tracer, "columns_of", lambda scene: ALL)
    colored = backend.solve(scene, asked, **request)
    assert colored.channels == RGB and colored.light.shape == (20, 3)
    for name in ("mean", "m2", "stderr", "error"):
        assert np.array_equal(getattr(grey, name), getattr(colored, name))


def test_channels_are_inferred_from_the_arrays_and_survive_cuts_and_replacements():
    queries, paths = Queries.at(sky(), shell(4)), np.full(4, 8, np.int32)
    light = np.random.default_rng(0).random((4, 3)).astype(np.float32)
    rgb = Samples(queries, light, m2=light, paths=paths)
    assert rgb.channels == RGB and np.shares_memory(rgb.mean, light)
    grey = Samples(queries, light[:, :1], light[:, 1:2], paths)
    assert grey.channels == GREY and grey.mean.shape == grey.m2.shape == (4, 3)
    with pytest.raises(ValueError, match="read-only"):
        grey.mean[0] = 1
    cut = join_samples([grey[:2], replace(grey, paths=2 * paths)[2:]])
    assert cut.channels == GREY and cut.light.nbytes == 16 and cut.paths.tolist() == [8, 8, 16, 16]
    assert np.array_equal(cut.mean, grey.mean)
    changed = replace(grey, mean=2 * light)
    assert changed.channels == RGB and np.array_equal(changed.mean, 2 * light)
    two = Channels(("key", "dome"), ((1.0, 1.0, 1.0), (0.5, 0.0, 0.0)))
    mixed = Samples(queries, light[:, :2], light[:, :2], paths, channels=two)
    np.testing.assert_allclose(mixed.mean[:, 0], light[:, 0] + 0.5 * light[:, 1], rtol=1e-6)


def test_grey_and_coloured_answers_combine_to_coloured_ones():
    queries, paths = Queries.at(sky(), shell(4)), np.full(4, 8, np.int32)
    light = np.random.default_rng(0).random((4, 3)).astype(np.float32)
    grey, rgb = Samples(queries, light[:, :1], light[:, :1], paths), Samples(queries, light, light, paths)
    flat = Samples(queries, grey.mean.copy(), grey.m2.copy(), paths)
    for put_together in (combine, lambda *parts: join_samples(parts)):
        both, expected = put_together(grey, rgb), put_together(flat, rgb)
        assert both.channels == RGB
        assert np.array_equal(both.mean, expected.mean) and np.array_equal(both.m2, expected.m2)


@pytest.mark.parametrize("paths", [range(0, 8, 2), range(8, 0, -1), range(-1, 4), 8, [0, 1]])
def test_paths_that_do_not_count_up_by_one_are_refused(paths):
    refused(lambda: check_request(paths, 1), "paths is", "range(64)")


def test_bounces_below_zero_are_refused_and_no_paths_are_not():
    refused(lambda: check_request(range(8), -1), "-1 bounces", "0")
    check_request(range(0), 0)
    check_request(range(5, 9), 3)


def test_samples_of_other_columns_than_channels_are_refused():
    queries = Queries.at(sky(), shell(4))
    light, paths = np.ones((4, 2), np.float32), np.ones(4, np.int32)
    one = Channels(("key",), ((1.0, 1.0, 1.0),))
    refused(lambda: Samples(queries, light, light, paths, one), "2 and 2 columns", "1 channels")
