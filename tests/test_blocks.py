"""Nodes in blocks of different density: what a lookup reads in them, on every border between them, and in none."""

from dataclasses import replace

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.field.scene import level_table
from illumgrid.field.volume import slabs
from illumgrid.grid import GREY, GridSpec, IlluminationGrid, Nodes, illumination
from illumgrid.grid.blocks import SIDE, answer, beside_coarser, boxes, in_cells, laid_out, put
from illumgrid.grid.cache import cache_of
from illumgrid.grid.illumination import Held
from illumgrid.grid.nested import finer
from illumgrid.grid.nodes import reachable
from illumgrid.interpolators.nested import Nested
from illumgrid.io import grids
from illumgrid.samplers.direct import NodeQueries
from illumgrid.transport.samples import Samples
from shapes import ball, sky


def cut(grid, cells=None):
    """The same nodes in blocks, those that hold some cells."""
    shape = grid.spec.shape
    layout = in_cells(shape, np.ones([n - 1 for n in shape], bool) if cells is None else cells, 1)
    at = tuple(np.moveaxis(np.minimum(layout.place(slice(None)), np.array(shape) - 1), -1, 0))
    parts = [a[at].reshape(len(layout), *layout.side + 1, *a.shape[3:]) for a in (grid.light, grid.error, grid.support)]
    return IlluminationGrid(grid.spec, channels=grid.channels, held=Held(layout, *parts))


def random_grid(shape=(20, 11, 18), holes=0.0, seed=1):
    random = np.random.default_rng(seed)
    spec = GridSpec(shape, (1, 2, 3), (0.5, 1, 2))
    support = (random.random(shape) >= holes).astype(np.float32)
    error = np.where(support > 0, random.random(shape), np.inf)
    return IlluminationGrid(spec, random.random((*shape, 1)), error, support, GREY)


@pytest.fixture(scope="module")
def uneven():
    """Three densities: random light at the nodes of a ball's grid, finer ones in two corners of it, one a quarter."""
    scene = sky(ball(40), (0.1, 0.9))
    base = GridSpec.over(scene.fields[0].volume, 27)
    spec, random = finer(base, 2), np.random.default_rng(5)
    found = np.zeros(spec.shape, bool)
    coarse = np.zeros(base.shape, bool)
    coarse.reshape(-1)[reachable(scene.fields[0], base)] = True
    found[::4, ::4, ::4] = coarse
    may = np.zeros(spec.shape, bool)
    may.reshape(-1)[reachable(scene.fields[0], spec)] = True
    half = np.zeros(spec.shape, bool)
    half[:45:2, :70:2, ::2] = True
    half[61::2, 20:41:2, 10:33:2] = True
    quarter = np.zeros(spec.shape, bool)
    quarter[8:30, 5:44, 20:61] = True
    flat = np.flatnonzero(found | (half & may) | (quarter & may))
    queries = NodeQueries(scene, 0, spec, flat)
    count = len(flat)
    light = random.random((count, 1)).astype(np.float32)
    paths = np.where(random.random(count) < 0.01, 0, 8).astype(np.int32)
    samples = Samples(queries, np.where(paths[:, None] > 0, light, 0).astype(np.float32), 0.1 * light, paths, GREY)
    return Nested(2).fill(samples, Nodes(spec, scene.fields[0]))


# A grid cut into blocks is the same grid.


def test_a_grid_in_blocks_answers_as_the_dense_one():
    dense = random_grid(holes=0.02)
    blocks = cut(dense)
    assert len(blocks.held.layout) == 3 * 2 * 3 and not blocks.held.layout.dense
    points = np.random.default_rng(3).random((4000, 3)) * [14, 16, 44] - [1, 1, 2]
    points[:3] = [np.nan, np.inf, -np.inf]
    np.testing.assert_allclose(blocks.lookup(points), dense.lookup(points), rtol=0, atol=2e-7)
    np.testing.assert_array_equal(blocks.covered(points), dense.covered(points))
    for one, other in zip(blocks.certainty(points), dense.certainty(points)):
        np.testing.assert_allclose(one, other, rtol=1e-5)
    np.testing.assert_allclose(blocks.uncertainty(points), dense.uncertainty(points), rtol=1e-5)
    for name in ("light", "values", "error", "support", "bar", "lit", "dark"):
        np.testing.assert_array_equal(getattr(blocks, name), getattr(dense, name), name)
    assert blocks.mean == dense.mean and blocks.relative_error == dense.relative_error
    for one, other in zip(blocks.blocks(), dense.blocks()):
        assert one.nodes == other.nodes
        for name in ("values", "error", "support"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    other = GridSpec((7, 6, 5), (1, 2, 3), (1.5, 2, 8))
    for one, two in zip(blocks.onto(other).dense(), dense.onto(other).dense()):
        np.testing.assert_allclose(one, two, rtol=1e-6)


def test_replacing_arrays_makes_a_dense_grid_and_replacing_channels_keeps_the_blocks():
    blocks = cut(random_grid())
    brighter = replace(blocks, values=2 * blocks.light)
    assert brighter.held.layout.dense and np.array_equal(brighter.error, blocks.error)
    same = replace(blocks, channels=GREY)
    assert same.held is blocks.held and blocks.showing(GREY).held.layout is blocks.held.layout


def test_where_no_block_lies_the_border_of_the_nearest_is_read_and_nothing_is_covered():
    dense = random_grid()
    cells = np.zeros([n - 1 for n in dense.spec.shape], bool)
    cells[3, 4, 5] = True
    blocks = cut(dense, cells)
    assert len(blocks.held.layout) == 1
    points = blocks.spec.nodes(np.ravel_multi_index(([4, 4, 19, 4], [4, 10, 4, 4], [4, 4, 4, 15]), dense.spec.shape))
    at = ([4, 4, 8, 4], [4, 8, 4, 4], [4, 4, 4, 8])
    np.testing.assert_array_equal(blocks.lookup(points)[:, :1], dense.light[at])
    assert blocks.covered(points).tolist() == [True, False, False, False]
    assert np.isfinite(blocks.uncertainty(points)).tolist() == [True, False, False, False]
    assert blocks.support[19, 10, 17] == 0 and np.isinf(blocks.error[19, 10, 17]) and not blocks.dark.any()


def test_thinned_light_and_a_cache_are_made_without_the_whole_lattice(monkeypatch):
    scene = sky(ball(20), (0.1, 0.9))
    spec = GridSpec.over(scene.fields[0].volume, 30)
    dense = replace(random_grid(spec.shape, holes=0.02), spec=spec)
    blocks, few = cut(dense), GridSpec.over(scene.fields[0].volume, 13)
    whole, cache = dense.onto(few), cache_of(scene, [dense], [], alike=1.5)
    monkeypatch.setattr(illumination, "_BLOCK", 1000)
    monkeypatch.setattr(slabs, "__defaults__", (30 * 30 * 4,))
    for name in ("light", "error", "support"):
        np.testing.assert_allclose(getattr(blocks.onto(few), name), getattr(whole, name), rtol=1e-5, atol=2e-7)
    parts = cache_of(scene, [blocks], [], alike=1.5)
    assert 0.1 < cache.trusted.mean() < 0.9 and "_arrays" not in vars(blocks)
    for one, other in zip(parts, cache):
        np.testing.assert_array_equal(one, other)


def test_a_grid_of_no_blocks_is_dark():
    layout = laid_out((9, 9, 9), np.zeros((0, 3), int), np.zeros(0, int))
    none = np.zeros((1, *layout.side + 1), np.float32)
    grid = IlluminationGrid(GridSpec((9, 9, 9)), channels=GREY, held=Held(layout, none[..., None], none + np.inf, none))
    assert grid.lookup([[1, 2, 3]]).tolist() == [[0, 0, 0]] and grid.mean == 0 and grid.relative_error is None


# Where blocks lie.


def test_a_node_on_a_border_is_held_by_all_blocks_around_it():
    shape = (4 * SIDE + 1, 2 * SIDE + 3, 2 * SIDE + 1)
    node = np.array([[2 * SIDE, 2 * SIDE, 5]])
    corner = boxes(node, shape, 1)
    assert corner.tolist() == [[x, y, 0] for x in (SIDE, 2 * SIDE) for y in (SIDE, 2 * SIDE)]
    layout = laid_out(shape, corner, np.ones(4, int))
    into = np.zeros((4, *layout.side + 1), np.float32)
    put(layout, node, 1, [into], [np.ones(1, np.float32)])
    assert into.sum(axis=(1, 2, 3)).tolist() == [1, 1, 1, 1]
    parts = into[..., None], into, into
    assert answer(layout, *parts, node)[0].tolist() == [[1]]
    assert boxes(np.array([[4 * SIDE, 0, 0]]), shape, 2).tolist() == [[2 * SIDE, 0, 0]]


# Borders.


def borders(layout, random, each=40):
    """Indices (n, 3) on the faces of all blocks that are read, which are read on both sides, axes (n,), both blocks."""
    found = []
    for axis in range(3):
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        one, other = layout.slot[tuple(low)], layout.slot[tuple(high)]
        box = np.argwhere((one != other) & (one >= 0) & (other >= 0))
        index = (box[:, None] + random.random((len(box), each, 3))) * layout.side
        index[..., axis] = (box[:, None, axis] + 1) * layout.side[axis]
        index[:, ::4] = np.round(index[:, ::4])  # on nodes, edges and corners as well
        steps = layout.step[np.stack([one[tuple(box.T)], other[tuple(box.T)]])]
        found.append((index, np.full(index.shape[:2], axis), np.repeat(steps[..., None], each, axis=2)))
    index, axes = (np.concatenate([f[k].reshape(-1, *f[k].shape[2:]) for f in found]) for k in (0, 1))
    steps = np.concatenate([f[2].reshape(2, -1) for f in found], axis=1)
    kept = (index <= layout.shape - 1).all(axis=1)
    return index[kept], axes[kept], steps[:, kept]


def test_no_seam_on_any_border_at_equal_and_unequal_density(uneven):
    layout = uneven.held.layout
    assert set(layout.step.tolist()) == {4, 2, 1}
    index, axes, steps = borders(layout, np.random.default_rng(2))
    pairs = set(map(tuple, np.sort(steps, axis=0).T.tolist()))
    assert pairs == {(1, 1), (2, 2), (4, 4), (1, 2), (2, 4), (1, 4)}
    aside = 1e-6 * np.eye(3)[axes]
    held = uneven.held
    one, other = (answer(layout, held.light, uneven.bars, held.support, index + way * aside) for way in (-1, 1))
    assert np.ptp(one[0]) > 0.5 and np.abs(one[0] - other[0]).max() < 4e-6
    known = np.isfinite(one[1]) & np.isfinite(other[1])  # a hole on one side counts there alone
    assert {tuple(pair) for pair in np.sort(steps[:, known], axis=0).T.tolist()} == pairs
    assert np.ptp(one[1][known]) > 0.3 and np.abs(one[1][known] - other[1][known]).max() < 1e-5
    world = [uneven.spec.origin + uneven.spec.spacing * (index + way * aside) for way in (-1, 1)]
    one, other = (uneven.lookup(points) for points in world)
    assert np.abs(one - other).max() < 4e-6


def test_what_is_read_in_a_finer_block_beside_no_finer_node_is_what_the_coarser_reads(uneven):
    layout, held = uneven.held.layout, uneven.held
    first = int((layout.step == 4).sum())
    coarse = laid_out(layout.shape, layout.corner[:first], layout.step[:first])
    index = layout.place(slice(first, None)).reshape(-1, 3)
    below = answer(coarse, held.light[:first], held.error[:first], held.support[:first], index)[0]
    same = (held.light[first:].reshape(-1, 1) == below)[:, 0]
    assert 0.2 < same.mean() < 0.9 and (index[~same] % 4 > 0).any(axis=1).any()


def test_nodes_beside_a_coarser_block_are_those_on_its_border():
    shape = (33, 17, 17)
    layout = laid_out(shape, np.array([[0, 0, 0], [0, 0, 0], [16, 0, 0]]), np.array([2, 1, 2]))
    index = layout.place(slice(1, 2)).reshape(-1, 3)
    there = beside_coarser(layout, index, 1)
    np.testing.assert_array_equal(there, (index == SIDE).any(axis=1))


def test_every_point_of_the_range_lies_in_a_block(uneven):
    scene = sky(ball(40), (0.1, 0.9))
    flat = reachable(scene.fields[0], GridSpec.over(scene.fields[0].volume, 27))
    index = 4 * np.stack(np.unravel_index(flat, (27, 27, 27)), axis=1)
    assert uneven.dark[tuple(index.T)].mean() < 0.05
    assert uneven.held.size < 0.5 * np.prod(uneven.spec.shape)


# On the disk.


def test_a_grid_of_blocks_is_read_as_it_was_written(uneven, tmp_path):
    scene = sky(ball(40), (0.1, 0.9))
    ig.Illumination(scene, level_table(scene, 2), (uneven,), (), {"seed": 0}).save(tmp_path / "out", preview=False)
    again = ig.load(tmp_path / "out").grids[0]
    for one, other in zip(again.held.layout, uneven.held.layout):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(again.held[1:4], uneven.held[1:4]):
        np.testing.assert_array_equal(one, other)
    dense = replace(uneven, values=uneven.light, error=uneven.error, support=uneven.support)
    ig.Illumination(scene, level_table(scene, 2), (dense,), (), {"seed": 0}).save(tmp_path / "dense", preview=False)
    one, other = (tmp_path / name / "illumination.exr" for name in ("out", "dense"))
    assert one.stat().st_size < other.stat().st_size


@pytest.mark.parametrize("places", [[[0, 0, 4, 1]], [[-8, 0, 0, 1]], [[96, 0, 0, 1]], [[0, 0, 0, 3]],
                                    [[0, 0, 0, np.nan]], [[0, 0, 0, 1], [0, 0, 0, 2]]])  # fmt: skip
def test_blocks_that_lie_nowhere_are_refused(places):
    count = len(places)
    light = {name: np.zeros((count, 9**3), np.float32) for name in ("Y", "error", "support")}
    parts = {"light/a": light, "blocks/a": {"Y": np.array(places, np.float32)}}
    with pytest.raises(ig.BadInput, match="'a' do not lie in its lattice"):
        grids.rebuilt("a", GridSpec((90, 20, 20)), GREY, parts, count)


@pytest.mark.parametrize("count", [-1, 1.5, "x", None, 2**30])
def test_a_number_of_blocks_that_is_none_is_refused(count):
    with pytest.raises(ig.BadInput, match="blocks of nodes came"):
        grids.count_of({"blocks": count})
