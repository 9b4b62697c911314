"""Nodes of a lattice in blocks of equal shape: only those that are read, each block with its own node spacing.

A block holds the nodes on its border, too, so that a lookup reads one block. A lattice whose nodes are all held is one
block. M. J. Berger and P. Colella, "Local adaptive mesh refinement for shock hydrodynamics", Journal of Computational
Physics 82, 1989, for the nesting.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.constants import ON_A_VOXEL
from illumgrid.field.volume import Lattice

SIDE = 8
"""Cells along the side of a block."""


class Layout(NamedTuple):
    """Where blocks lie in the finest lattice, in whose nodes all numbers count: see `laid_out`."""

    shape: NDArray[np.int64]  # (3,) nodes of the finest lattice
    side: NDArray[np.int64]  # (3,) cells of a block along each axis
    corner: NDArray[np.int64]  # (n, 3) first node of each block
    step: NDArray[np.int64]  # (n,) from one of its nodes to the next, a power of two; the coarsest blocks come first
    slot: NDArray[np.int64]  # per box of `side` finest cells: the block that is read there, or ~ of the nearest

    def __len__(self) -> int:
        return len(self.step)

    @property
    def dense(self) -> bool:
        """Whether all nodes are held, in one block."""
        return len(self.step) == 1 and bool((self.side + 1 == self.shape).all())

    def place(self, blocks: NDArray[np.integer] | slice, rim: int = 0) -> NDArray[np.int64]:
        """Indices (m, n, 3) of the nodes of some blocks, with a rim of so many nodes around each."""
        local = np.moveaxis(np.indices(tuple(self.side + 1 + 2 * rim)), 0, -1).reshape(-1, 3) - rim
        return np.asarray(self.corner[blocks][:, None] + local * self.step[blocks][:, None, None])


def whole(shape: ArrayLike) -> Layout:
    """All nodes of a lattice (3,) in one block."""
    nodes = np.array(shape, np.int64)
    one = np.ones(1, np.int64)
    return Layout(nodes, nodes - 1, np.zeros((1, 3), np.int64), one, np.zeros((1, 1, 1), np.int64))


def laid_out(shape: ArrayLike, corner: NDArray[np.integer], step: NDArray[np.integer], side: int = SIDE) -> Layout:
    """Blocks of `side` cells in a lattice (3,) of so many nodes.

    Parameters
    ----------
    corner : (n, 3) int
        First node of each block, multiples of its `side` times its `step`.
    step : (n,) int
        Powers of two, the largest first: of blocks in one place the last is read.
    """
    from scipy.ndimage import distance_transform_edt

    nodes, sides = np.array(shape, np.int64), np.full(3, side, np.int64)
    slot = np.full(-(-(nodes - 1) // side), -1, np.int64)
    if not len(step):  # at least one block, so that there is something to read
        corner, step = np.zeros((1, 3), np.int64), np.ones(1, np.int64)
    for size in sorted(set(step.tolist()), reverse=True):
        these = np.flatnonzero(step == size)
        for offset in np.ndindex(size, size, size):
            box = corner[these] // side + np.array(offset)
            within = (box < slot.shape).all(axis=1)
            slot[tuple(box[within].T)] = these[within]
    if (empty := slot < 0).any():
        nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
        slot[empty] = ~slot[tuple(axis[empty] for axis in nearest)]
    return Layout(nodes, sides, np.asarray(corner, np.int64), np.asarray(step, np.int64), slot)


def boxes(index: NDArray[np.integer], shape: ArrayLike, step: int, side: int = SIDE) -> NDArray[np.int64]:
    """Corners (n, 3) of the blocks of a step that contain a node (m, 3), in order; a node on a border is in several."""
    size, most = side * step, (np.array(shape) - 2) // (side * step)
    counts = most + 1
    marked = np.zeros(counts, bool)
    for toward in np.ndindex(2, 2, 2):
        marked[tuple(np.clip((index - np.array(toward)) // size, 0, most).T)] = True
    return np.argwhere(marked) * size


def in_cells(shape: ArrayLike, cells: NDArray[np.bool_], step: int, side: int = SIDE) -> Layout:
    """Blocks of one step that contain the marked cells of the lattice of every `step`-th node."""
    ends = -np.array(cells.shape) % side
    padded = np.pad(cells, [(0, end) for end in ends])
    many = np.array(padded.shape) // side
    marked = padded.reshape(many[0], side, many[1], side, many[2], side).any(axis=(1, 3, 5))
    corner = np.argwhere(marked) * side * step
    return laid_out(shape, corner, np.full(len(corner), step), side)


def put(
    layout: Layout, index: NDArray[np.integer], step: int, into: Sequence[NDArray[Any]], what: Sequence[Any]
) -> None:
    """Put values (n, ...) of nodes (n, 3) `into` all blocks of a step that hold them, arrays (blocks, i, j, k, ...)."""
    size = layout.side * step
    most = (layout.shape - 2) // size
    number = np.full(most + 1, -1, np.int64)
    these = np.flatnonzero(layout.step == step)
    number[tuple((layout.corner[these] // size).T)] = these
    for toward in np.ndindex(2, 2, 2):
        box = np.clip((index - np.array(toward)) // size, 0, most)
        home = number[tuple(box.T)]
        local = (index - box * size) // step
        rows = np.flatnonzero((home >= 0) & (local <= layout.side).all(axis=1))
        place = home[rows], *local[rows].T
        for array, values in zip(into, what):
            array[place] = values if np.ndim(values) == 0 else values[rows]


def beside_coarser(layout: Layout, index: NDArray[np.integer], step: int) -> NDArray[np.bool_]:
    """Which nodes (n, 3) of blocks of this step are also in a coarser block, which then determines their values."""
    side, found = layout.side, np.zeros(len(index), bool)
    border = np.flatnonzero((index % (side * step) == 0).any(axis=1))
    node, most = np.minimum(index[border], layout.shape - 1), np.array(layout.slot.shape) - 1
    for toward in np.ndindex(2, 2, 2):
        slot = layout.slot[tuple(np.clip((node - np.array(toward)) // side, 0, most).T)]
        found[border] |= (slot >= 0) & (layout.step[np.maximum(slot, 0)] > step)
    return found


def read(layout: Layout, spec: Lattice, values: NDArray[np.float32], points: ArrayLike) -> NDArray[np.float32]:
    """Trilinear `values` (blocks, i, j, k, m) at world points (n, 3), clamped to the border: (n, m)."""
    from illumgrid.grid.trilinear import read

    world = np.ascontiguousarray(points, dtype=float).reshape(-1, 3)
    result = np.zeros((len(world), values.shape[4]), dtype=np.float32)
    place = (np.ascontiguousarray(x, dtype=float) for x in (spec.origin, spec.direction, spec.spacing))
    read(fixed(values), *layout, *place, ON_A_VOXEL, world, result)
    return result


def answer(
    layout: Layout, light: NDArray[np.float32], error: NDArray[np.float32], support: NDArray[np.float32],
    index: NDArray[Any],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:  # fmt: skip
    """Light (n, C), error (n,) and support (n,) at fractional indices (n, 3) from those of blocks.

    The error is the weighted mean of the eight nodes' errors, an upper bound for any correlation, and infinite if one
    is unknown; the support is the smallest. Outside all blocks the error is infinite and the support 0.
    """
    from illumgrid.grid.trilinear import answer

    at = np.ascontiguousarray(index, dtype=float).reshape(-1, 3)
    found = (
        np.empty((len(at), light.shape[4]), np.float32),
        np.empty(len(at), np.float32),
        np.empty(len(at), np.float32),
    )
    answer(fixed(light), fixed(error), fixed(support), *layout, ON_A_VOXEL, at, *found)
    return found


def fixed(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same, read-only in every case; otherwise Numba compiles again for another type."""
    view = np.ascontiguousarray(values, np.float32).view()
    view.flags.writeable = False
    return view
