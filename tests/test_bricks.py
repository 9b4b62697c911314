"""Bricks: ranks never mark a cell empty that reaches the level, and cubes agree with plain loops."""

import numpy as np
import pytest

from illumgrid.constants import BRICK, REACH
from illumgrid.field.bricks import RANKS, lay_bricks

SHAPES = [(2, 2, 2), (5, 5, 5), (6, 9, 4), (37, 22, 81)]


def rank(steps, x):
    return np.searchsorted(steps, x, side="right")


@pytest.mark.parametrize("shape", SHAPES)
def test_a_record_holds_the_ranks_of_cells_and_of_cubes_towards_every_octant(shape):
    rng = np.random.default_rng(0)
    values = rng.normal(size=shape).astype(np.float32)
    bricks = lay_bricks(values)
    assert bricks.shape == tuple(-(-(n - 1) // BRICK) for n in shape)
    assert bricks.records.ctypes.data % 64 == 0 and bricks.records.flags.c_contiguous
    cells = bricks.records[:, :64].reshape(*bricks.shape, BRICK, BRICK, BRICK)
    largest = cells.max(axis=(3, 4, 5))
    for cell in rng.integers(0, np.array(shape) - 1, (300, 3)):
        expected = values[tuple(slice(c, c + 2) for c in cell)].max()
        assert cells[tuple(cell // BRICK) + tuple(cell % BRICK)] == rank(bricks.steps, expected)
    cubes = bricks.records[:, 64:].reshape(*bricks.shape, 8, len(REACH))
    for b in rng.integers(0, bricks.shape, (300, 3)):
        octant, k = rng.integers(8), rng.integers(len(REACH))
        part = tuple(
            slice(b[a], b[a] + REACH[k]) if octant >> (2 - a) & 1 else slice(max(0, b[a] - REACH[k] + 1), b[a] + 1)
            for a in range(3)
        )
        assert cubes[tuple(b)][octant, k] == largest[part].max()


@pytest.mark.parametrize("scale", [1e-38, 1, 1e37])
def test_what_ranks_below_a_level_is_below_it(scale):
    rng = np.random.default_rng(1)
    values = (np.concatenate([rng.normal(size=2000), np.zeros(999), [9.0]]) * scale).astype(np.float32)
    steps = lay_bricks(values.reshape(50, 30, 2)).steps
    assert steps.shape == (RANKS,) and (np.diff(steps[np.isfinite(steps)]) > 0).all()
    for level in [*rng.normal(size=200) * scale, *values.ravel()[:200].astype(float), 0.0]:
        below = rank(steps, values) < rank(steps, level)
        assert (values[below] < level).all()


def test_of_few_values_the_ranks_distinguish_every_level():
    values = np.random.default_rng(2).integers(0, 200, (20, 20, 20)).astype(np.float32)
    steps = lay_bricks(values).steps
    for level in [*np.arange(1.0, 200.0), 0.5, 17.01, 17.99]:
        assert ((rank(steps, values) < rank(steps, level)) == (values < level)).all()


def test_a_constant_field_has_one_rank():
    assert np.unique(lay_bricks(np.full((5, 5, 5), 3, np.float32)).records[:, :64]).size == 1
