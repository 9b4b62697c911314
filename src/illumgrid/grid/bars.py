"""Error bars of a lookup: the error of linear interpolation between nodes, from second differences of the light."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.volume import Floats
from illumgrid.grid.blocks import Layout, answer, beside_coarser, laid_out
from illumgrid.grid.channels import Channels

Array = NDArray[np.float32]
_AT_ONCE = 256  # blocks


def alone(error: Array, support: Array) -> NDArray[np.bool_]:
    """Holes, and nodes that depend on a single sample that no other node uses."""
    return (support <= 1) | ~np.isfinite(error)


def bend(light: Array, error: Array, lone: NDArray[np.bool_], axis: int, step: int) -> Floats:
    """Mean square over RGB of second differences along an axis of blocks, `step` nodes apart, minus their noise."""
    along, bars = (np.moveaxis(a, axis + 1, 0) for a in (light, error))
    after, here, before = slice(2 * step, None), slice(step, -step), slice(None, -2 * step)
    square = np.square(along[after] - 2 * along[here] + along[before], dtype=float).mean(axis=-1)
    # Infinite at holes. Noise that neighbours share, since they use the same samples, cancels in the differences.
    noise = np.where(np.moveaxis(lone, axis + 1, 0), np.square(bars, dtype=float), 0.0)
    return np.moveaxis(square - (noise[after] + 4 * noise[here] + noise[before]), 0, axis + 1)


def of_blocks(layout: Layout, light: Array, error: Array, support: Array, channels: Channels) -> Array:
    """Standard error (blocks, i, j, k) of a lookup near each node: see `illumgrid.grid.IlluminationGrid.bar`."""
    if not ((support > 0) & np.isfinite(error)).any():
        return np.full(error.shape, np.inf, np.float32)
    if layout.dense:
        return _with_bends(error, support, _of_lattice(channels.shown(light), error, support))
    found = np.full(error.shape, np.inf, np.float32)
    for some, coarser in _level_by_level(layout):
        bends = _of_rimmed(layout, some, channels, light, error, support)
        found[some] = _with_bends(error[some], support[some], bends)
        index = layout.place(some).reshape(-1, 3)
        if coarser and (there := beside_coarser(layout, index, int(layout.step[some.start]))).any():
            n = len(coarser)
            _, bars, _ = answer(coarser, light[:n, ..., :0], found[:n], support[:n], index[there])
            found[some].reshape(-1)[there] = bars
    return found


def _level_by_level(layout: Layout) -> Iterator[tuple[slice, Layout | None]]:
    """Yield the blocks of each step, the coarsest first, with all blocks that are coarser."""
    for step in sorted(set(layout.step.tolist()), reverse=True):
        these = np.flatnonzero(layout.step == step)
        first, last = int(these[0]), int(these[-1]) + 1
        coarser = (
            laid_out(layout.shape, layout.corner[:first], layout.step[:first], int(layout.side[0])) if first else None
        )
        for begin in range(first, last, _AT_ONCE):
            yield slice(begin, min(begin + _AT_ONCE, last)), coarser


def _of_lattice(light: Array, error: Array, support: Array) -> list[Floats]:
    """Second differences along each axis at the nodes of one block; a border node has those of its neighbour."""
    lone, found = alone(error, support), []
    for axis in range(3):
        if error.shape[axis + 1] > 2:  # two nodes have no second difference
            edges = [(1, 1) if a == axis + 1 else (0, 0) for a in range(4)]
            found.append(np.pad(_known(bend(light, error, lone, axis, 1)), edges, mode="edge"))
    return found


def _of_rimmed(
    layout: Layout, some: slice, channels: Channels, light: Array, error: Array, support: Array
) -> list[Floats]:
    """Second differences along each axis at the nodes of some blocks of one step, with the values read around them."""
    index, (bx, by, bz) = layout.place(some, 1), layout.side + 3
    parts = answer(layout, light, error, support, index)
    shown = channels.shown(parts[0]).reshape(len(index), bx, by, bz, -1)
    bars, counts = (part.reshape(len(index), bx, by, bz) for part in parts[1:])
    lone, found, step = alone(bars, counts), [], int(layout.step[some.start])
    for axis in range(3):
        last = layout.shape[axis] - 1
        if last < 2 * step:
            continue
        inner = [slice(1, -1)] * 4
        inner[0], inner[axis + 1] = slice(None), slice(None)
        each = _known(bend(shown, bars, lone, axis, 1))[tuple(inner)]
        at = layout.corner[some, axis][:, None] + np.arange(each.shape[axis + 1]) * step
        # At the border of the lattice, use the next node, since nothing lies beyond.
        toward = np.where(at == 0, 1, np.where(at >= last, -1, 0)) + np.arange(at.shape[1])
        toward = np.clip(toward, 0, at.shape[1] - 1)
        shape = [len(at), 1, 1, 1]
        shape[axis + 1] = at.shape[1]
        found.append(np.take_along_axis(each, toward.reshape(shape), axis + 1))
    return found


def _known(bends: Floats) -> Floats:
    """Next to a hole, count only the other axes."""
    return np.maximum(np.nan_to_num(bends, neginf=0.0), 0.0)


def _with_bends(error: Array, support: Array, bends: list[Floats]) -> Array:
    known = (support > 0) & np.isfinite(error)
    if not known.any():
        return np.full(known.shape, np.inf, np.float32)
    kept = np.where(alone(error, support), 8 / 27, 1.0)
    square = np.where(known, kept * np.square(error, where=known, out=np.zeros(known.shape)), np.inf)
    for each in bends:
        square += each / 64
    return np.sqrt(square).astype(np.float32)


def resolution(layout: Layout, light: Array, error: Array, support: Array, channels: Channels) -> float:
    """See `illumgrid.grid.IlluminationGrid.resolution`: of bends within blocks."""
    near, far, shown, lone = 0.0, 0.0, channels.shown(light), alone(error, support)
    for axis in range(3) if np.isfinite(error).any() else ():
        if error.shape[axis + 1] > 4:
            bends = (bend(shown, error, lone, axis, step) for step in (1, 2))
            one, two = (each[np.isfinite(each)] for each in bends)
            near += float(one.mean()) if one.size else 0.0
            far += float(two.mean()) if two.size else 0.0
    return float(np.sqrt(far / near)) if near > 0 and far > 0 else np.inf
