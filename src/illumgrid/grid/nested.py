"""Nested lattices: every second node of a fine lattice is a node of the next coarser one."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from illumgrid.constants import FINEST
from illumgrid.field.lattice import GridSpec, along_longest
from illumgrid.grid.illumination import IlluminationGrid


def finer(spec: GridSpec, levels: int) -> GridSpec:
    """The lattice over the same box with 2**`levels` steps for each."""
    steps = np.array(spec.shape) - 1
    nx, ny, nz = (int(n) for n in steps * 2**levels + 1)
    return GridSpec((nx, ny, nz), spec.origin, spec.spacing / 2**levels, spec.direction)


def halvings(specs: Sequence[GridSpec]) -> int:
    """How often the node spacing is halved where light is rough: up to twice, 0 if the lattices are too large."""
    return next((levels for levels in (2, 1) if (along_longest(specs) - 1) * 2**levels < FINEST), 0)


def coarser(spec: GridSpec, levels: int) -> GridSpec:
    """The lattice of every 2**`levels`-th node; the inverse of `finer`."""
    nx, ny, nz = ((n - 1) // 2**levels + 1 for n in spec.shape)
    return GridSpec((nx, ny, nz), spec.origin, spec.spacing * 2**levels, spec.direction)


def all_corners(nodes: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells (nx - 1, ny - 1, nz - 1) all of whose corners are marked."""
    for axis in range(3):
        line = np.moveaxis(nodes, axis, 0)
        nodes = np.moveaxis(line[1:] & line[:-1], 0, axis)
    return nodes


def spread(grid: IlluminationGrid) -> NDArray[np.float32]:
    """Range (nx - 1, ny - 1, nz - 1) of the light at the corners of each cell, without corners that have no light."""
    shown, dark = grid.channels.shown(grid.light).mean(axis=-1), grid.support == 0
    low, high = np.where(dark, np.float32(np.inf), shown), np.where(dark, np.float32(-np.inf), shown)
    for axis in range(3):
        low, high = (np.moveaxis(corner, axis, 0) for corner in (low, high))
        low, high = np.minimum(low[:-1], low[1:]), np.maximum(high[:-1], high[1:])
        low, high = (np.moveaxis(corner, 0, axis) for corner in (low, high))
    return np.asarray(np.maximum(high - low, np.float32(0)), np.float32)


def within(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Nodes of the next finer lattice that lie in, or on the border of, the marked cells."""
    nodes = np.zeros([2 * n + 1 for n in cells.shape], bool)
    for corner in np.ndindex(3, 3, 3):
        nodes[tuple(slice(c, c + 2 * n - 1, 2) for c, n in zip(corner, cells.shape))] |= cells
    return nodes
