"""Positions of queries: at the nodes that a lookup can read, or scattered uniformly over level sets."""

from fractions import Fraction
from itertools import product
from math import floor

import numpy as np
import pytest
from scipy.stats import chi2

from illumgrid.bake.targets import node_queries
from illumgrid.field.scene import Field, Scene, level_table
from illumgrid.field.volume import Volume, interpolate, world_to_index
from illumgrid.grid import GridSpec
from illumgrid.grid.nodes import reachable
from illumgrid.samplers import direct
from illumgrid.samplers.direct import Direct, NodeQueries
from illumgrid.samplers.uniform import Uniform
from illumgrid.stages import Sampler, on_level_sets
from illumgrid.transport.samples import join_queries
from shapes import MIRRORED, ball, refused, sampled, sky

UNEVEN = np.array([0.5, 1.25, 3.0])


def noise(shape=(9, 7, 8), seed=0, **place):
    return Volume(np.random.default_rng(seed).random(shape), **place)


def asked(sampler, scene, specs, seed=0):
    return join_queries(list(sampler.queries(scene, specs, seed)))


def values_at(volume, points):
    return interpolate(volume, world_to_index(volume, points))


# Direct


def touched(field, spec):
    """The nodes of `reachable`, by loops over all cells and exact fractions."""
    values, (low, high) = field.volume.values, field.range
    cells = [n - 1 for n in field.volume.shape]
    nodes = set()
    for cell in np.ndindex(*cells):
        corners = values[tuple(slice(c, c + 2) for c in cell)]
        if corners.max() < low or corners.min() > high:
            continue
        spans = []
        for c, n, m in zip(cell, cells, (k - 1 for k in spec.shape)):
            first, last = floor(Fraction(c * m, n)), -floor(-Fraction((c + 1) * m, n))
            spans.append(range(first, last))  # grid cells that overlap this voxel cell
        for grid_cell in product(*spans):
            nodes |= {tuple(g + c for g, c in zip(grid_cell, corner)) for corner in product((0, 1), repeat=3)}
    return sorted(int(np.ravel_multi_index(node, spec.shape)) for node in nodes)


@pytest.mark.parametrize("longest", [2, 4, 7, 9, 14, 17])
def test_the_nodes_asked_are_the_corners_of_grid_cells_that_meet_a_crossed_voxel_cell(longest):
    volume = noise(spacing=UNEVEN, direction=MIRRORED)
    scene = sky(volume, (0.93, 0.96))
    spec = GridSpec.over(volume, longest)
    nodes = reachable(scene.fields[0], spec)
    assert nodes.tolist() == touched(scene.fields[0], spec)
    assert longest < 9 or len(nodes) < np.prod(spec.shape)
    assert asked(Direct(), scene, [spec]).id.tolist() == nodes.tolist()


@pytest.mark.parametrize("longest", [3, 5, 9, 20])
@pytest.mark.parametrize("limits", [(0.5, 0.52), (-1, 0.05), (0.97, 5)])
def test_a_lookup_within_the_range_touches_no_node_that_was_not_asked(longest, limits):
    volume = noise(seed=1)
    field = sky(volume, limits).fields[0]
    spec = GridSpec.over(volume, longest)
    # about voxels, where the extremes are
    random = np.random.default_rng(0)
    top = np.array(volume.shape) - 1
    index = np.clip(random.integers(0, top + 1, (60000, 3)) + random.normal(scale=0.1, size=(60000, 3)), 0, top)
    value = interpolate(volume, index)
    index = index[(value >= limits[0]) & (value <= limits[1])]
    assert len(index) > 20
    cell = np.minimum(np.floor(world_to_index(spec, index)).astype(int), np.array(spec.shape) - 2)
    used = {n for c in product((0, 1), repeat=3) for n in np.ravel_multi_index((cell + c).T, spec.shape).tolist()}
    assert used <= set(reachable(field, spec).tolist())


def test_nodes_in_range_ask_on_their_own_level_set_and_rim_nodes_at_an_end_of_the_range():
    scene = sky(ball(24), (0.4, 0.8))
    spec = GridSpec.over(scene.fields[0].volume, 24)
    queries = asked(Direct(), scene, [spec])
    nodes = spec.nodes(queries.id.astype(int))
    own = values_at(scene.fields[0].volume, nodes)
    within = (own >= 0.4) & (own <= 0.8)
    assert 0 < within.sum() < len(own)
    assert np.array_equal(queries.level[within, 0], own[within])
    np.testing.assert_allclose(queries.point[within], nodes[within], atol=1e-14)
    assert np.array_equal(queries.level[~within, 0], np.where(own[~within] < 0.4, 0.4, 0.8))
    good = queries.normal.any(axis=1)
    level = values_at(scene.fields[0].volume, queries.point)
    np.testing.assert_allclose(level[good], queries.level[good, 0], atol=1e-9)
    assert good.mean() > 0.9  # a corner of a crossed cell may be more than a cell away along an axis: a hole
    assert np.linalg.norm(queries.point - nodes, axis=1).max() <= 3**0.5 * spec.spacing[0]  # a corner of a crossed cell


def test_direct_queries_of_two_fields_have_ids_of_their_own_and_come_in_batches(monkeypatch):
    monkeypatch.setattr(direct, "_BATCH", 50)
    fields = (Field("a", ball(8), range=(0.2, 0.6)), Field("b", ball(10), range=(0.5, 1.0)))
    scene = Scene(fields, background=np.ones(3))
    specs = [GridSpec.over(f.volume, n) for f, n in zip(fields, (8, 6))]
    batches = list(Direct().queries(scene, specs, 0))
    assert len(batches) > 4 and all(0 < len(b) <= 50 and len(set(b.target.tolist())) == 1 for b in batches)
    queries = join_queries(batches)
    assert len(set(queries.id.tolist())) == len(queries)
    for f, spec in enumerate(specs):
        own = queries[queries.target == f]
        assert (own.id - np.uint64(f << 40)).tolist() == reachable(fields[f], spec).tolist()
        # the other slider stands at the same place of the sweep
        share = [(own.level[:, g] - fields[g].range[0]) / np.ptp(fields[g].range) for g in (0, 1)]
        np.testing.assert_allclose(share[0], share[1], atol=1e-9)


def test_nodes_whose_numbers_alone_are_kept_ask_what_direct_asks(monkeypatch):
    fields = (Field("a", ball(8), range=(0.2, 0.6)), Field("b", ball(10), range=(0.5, 1.0)))
    scene = Scene(fields, background=np.ones(3))
    specs = [GridSpec.over(f.volume, n) for f, n in zip(fields, (5, 6))]  # coarser than the field: rim nodes move
    whole = asked(Direct(), scene, specs)
    monkeypatch.setattr(direct, "_BATCH", 50)
    kept = node_queries(scene, specs, Direct(), 0)
    assert [type(batch) for batch in kept] == [NodeQueries, NodeQueries]
    joined, rows = join_queries(kept), np.arange(3, 90, 7)
    some = [batch[np.arange(3, len(batch), 7)] for batch in kept]
    for name in ("id", "point", "normal", "level", "target"):
        assert np.array_equal(getattr(joined, name), getattr(whole, name))
        assert np.array_equal(getattr(some[0], name)[: len(rows)], getattr(whole, name)[rows])
    assert sum(a.nbytes for batch in kept for a in vars(batch).values() if isinstance(a, np.ndarray)) == 4 * len(whole)
    held = Scene((fields[0], Field("b", ball(10), range=(0.5, 1.0), isovalue=0.7)), background=np.ones(3))
    assert NodeQueries not in map(type, node_queries(held, specs, Direct(), 0))


# Uniform


def test_stages_have_names_and_options_and_refuse_nonsense():
    for stage in (Direct(), Uniform()):
        assert isinstance(stage, Sampler)
    assert (Direct.name, Uniform.name) == ("direct", "uniform")
    assert Uniform(3, 5) == Uniform(count=3, points=5) != Uniform() and repr(Uniform()) == "Uniform(count=32, points=0)"
    refused(lambda: Uniform(count=1), "uniform.count", "1", "at least 2")
    refused(lambda: Uniform(points=-1), "uniform.points", "-1", "positive")


def test_uniform_takes_equal_steps_with_points_on_every_level_set():
    scene = sky(ball(16, origin=-MIRRORED @ np.ones(3), spacing=(2 / 15,) * 3, direction=MIRRORED))
    batches = list(Uniform(count=5, points=100).queries(scene, [GridSpec.over(scene.fields[0].volume, 8)], seed=3))
    rows = level_table(scene, 5).table
    assert [len(b) for b in batches] == [100] * 5
    for batch, row in zip(batches, rows):
        assert np.array_equal(batch.level, np.tile(row, (100, 1)))
    queries = join_queries(batches)
    assert sorted(queries.id.tolist()) == list(range(500))
    good = queries.normal.any(axis=1)
    assert good.mean() > 0.99
    miss = values_at(scene.fields[0].volume, queries.point[good]) - queries.level[good, 0]
    assert np.abs(miss).max() < 1e-9 * 0.6


@pytest.mark.parametrize("spacing", [(0.1, 0.1, 0.1), (0.06, 0.1, 0.16)], ids=["even", "uneven"])
def test_points_are_uniform_by_area(spacing):
    shape = tuple(round(2.4 / s) + 1 for s in spacing)
    volume = sampled(lambda x: -np.linalg.norm(x, axis=1), shape, (-1.2, -1.2, -1.2), spacing)
    queries = join_queries(list(on_level_sets(sky(volume, (-1.1, -0.5)), [-1.0], seed=1, points=8000)))
    way = queries.point / np.linalg.norm(queries.point, axis=1, keepdims=True)
    # Archimedes: on a sphere each coordinate is uniform; with the octants that is 3 x 10 + 8 bins.
    counts = [np.histogram(way[:, axis], 10, (-1, 1))[0] for axis in range(3)]
    counts.append(np.bincount((way > 0) @ [1, 2, 4], minlength=8))
    for observed in counts:
        expected = observed.sum() / len(observed)
        statistic = ((observed - expected) ** 2 / expected).sum()
        assert statistic < chi2.ppf(1 - 1e-4 / len(counts), len(observed) - 1)


def test_equal_seeds_give_equal_points_and_others_do_not():
    scene = sky()
    one, same, other = (join_queries(list(on_level_sets(scene, [0.5, 0.7], seed, points=50))) for seed in (7, 7, 8))
    assert np.array_equal(one.point, same.point)
    assert not np.isclose(one.point, other.point).all(axis=1).any()
    largest = 2**64 - 1
    assert len(next(on_level_sets(scene, [0.5], largest, points=3))) == 3


def test_isovalues_of_the_first_field_take_the_others_along_and_whole_rows_stand_as_given():
    fields = (Field("a", ball(10), range=(0.2, 0.6)), Field("b", ball(12), range=(0.5, 0.9)))
    scene = Scene(fields, background=np.ones(3))
    along = list(on_level_sets(scene, [0.3, 0.5], 0, points=10))
    assert [b.target[0] for b in along] == [0, 1, 0, 1]
    for batch, row in zip(along, [(0.3, 0.6)] * 2 + [(0.5, 0.8)] * 2):
        np.testing.assert_allclose(batch.level, np.tile(row, (10, 1)))
    rows = list(on_level_sets(scene, [(0.3, 0.9), (0.5, 0.55)], 0, points=10))
    assert [b.level[0].tolist() for b in rows] == [[0.3, 0.9]] * 2 + [[0.5, 0.55]] * 2
    ids = join_queries(rows).id
    assert len(set(ids.tolist())) == 40 and ids[:10].tolist() == list(range(10)) and ids[10] == 1 << 40


def test_an_empty_level_set_is_passed_over():
    assert list(on_level_sets(sky(), [5.0, -3.0], 0, points=10)) == []
    batches = list(on_level_sets(sky(), [5.0, 0.5], 0, points=10))
    assert [b.id.tolist() for b in batches] == [list(range(10))] and batches[0].level[0, 0] == 0.5


def test_by_default_there_is_a_point_for_each_squared_spacing_and_at_least_64():
    scene = sky(ball(24))  # radius 0.7, voxels of 2/23
    (voxels,) = on_level_sets(scene, [0.5], 0)
    assert len(voxels) == pytest.approx(4 * np.pi * 0.49 * 11.5**2, rel=0.02)
    spec = GridSpec.over(scene.fields[0].volume, 12)
    (nodes,) = on_level_sets(scene, [0.5], 0, specs=[spec])
    assert len(nodes) == pytest.approx(4 * np.pi * 0.49 * 5.5**2, rel=0.02)
    (few,) = on_level_sets(scene, [1.1], 0)
    assert len(few) == 64


@pytest.mark.parametrize("levels", [[[0.5, 0.6]], [[[0.5]]], [0.5, np.nan], np.inf])
def test_levels_that_are_no_rows_are_refused(levels):
    refused(lambda: list(on_level_sets(sky(), levels, 0)), "levels", "(K,) or (K, 1)", "finite")
