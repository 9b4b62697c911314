"""Where a field is empty at any isovalue, so that rays can skip that space.

The sign of a field is chosen so that its solid is {sign v >= level}. Its values become ranks of one byte, and its cells
are grouped into bricks of BRICK³. Comparing bytes then shows what can be skipped at a level: nothing has to be built
for a new one.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from illumgrid.constants import BRICK, BRICK_SHIFT, REACH
from illumgrid.field.volume import AT_ONCE, slabs

RANKS = 255
"""Steps from the lowest rank to the highest."""

LARGE = 1 << 27
"""Voxels from which on a brick has twice as many cells along each side: its records then take an eighth of the memory,
a quarter of a byte for each voxel."""

Bytes = NDArray[np.uint8]


class Bricks(NamedTuple):
    """The ranks of one field.

    rank(x) is the number of `steps` that are not above x. It never falls as x grows, so a value whose rank is below
    that of a level is below the level. The converse may fail; a cell is then tested without a hit.
    """

    steps: NDArray[np.float32]  # (RANKS,) ascending, filled up with inf
    shape: tuple[int, int, int]  # bricks along each axis
    shift: int  # a brick has 2^shift cells along each side
    records: Bytes  # (bricks, 128) for each brick, in C order: first its cells, then its cubes towards the 8 octants
    # cells: (BRICK³) in C order, the rank of the largest value at the corners of a cell (of 2³ cells in a large field)
    # cubes: (8, len(REACH)) the largest rank in the cube of so many bricks from here; octants in C order, up is 1


def lay_bricks(values: NDArray[Any], sign: float = 1.0) -> Bricks:
    """Ranks of the cells of a field turned by `sign`, and of the cubes of bricks towards the eight octants.

    Works slab by slab, so that it needs no other array as large as the field.
    """
    steps = _steps(values, sign)
    shift = BRICK_SHIFT + (values.size >= LARGE)
    side = 1 << shift
    nx, ny, nz = (-(-int(n - 1) // side) for n in values.shape)
    shape = nx, ny, nz
    records = _aligned(nx * ny * nz, BRICK**3 + 8 * len(REACH))
    largest: Bytes = np.empty(shape, np.uint8)
    of_value = _ranks_of_all(values.dtype, steps, sign)
    for bricks in slabs((nx, *values.shape[1:]), AT_ONCE // side):
        voxels = values[bricks.start * side : bricks.stop * side + 1]
        if of_value is None:
            turned = voxels if sign > 0 else -voxels
            ranks: Bytes = np.searchsorted(steps, turned.reshape(-1), side="right").astype(np.uint8)
        else:
            ranks = of_value[voxels.reshape(-1).view(f"u{voxels.itemsize}")]
        cells = _cells(ranks.reshape(voxels.shape), (bricks.stop - bricks.start, ny, nz), side // BRICK)
        at = slice(bricks.start * ny * nz, bricks.stop * ny * nz)
        records[at, : BRICK**3] = cells
        largest[bricks] = cells.max(axis=1).reshape(-1, ny, nz)
    _write_cubes(largest, records[:, BRICK**3 :].reshape(len(records), 8, len(REACH)))
    return Bricks(steps, shape, shift, records)


def _ranks_of_all(kind: np.dtype[Any], steps: NDArray[np.float32], sign: float) -> Bytes | None:
    """The rank of every possible value of 8 or 16 bits, by its bits."""
    if kind.itemsize > 2:
        return None
    numbers = np.arange(1 << 8 * kind.itemsize, dtype=f"u{kind.itemsize}").view(kind)
    return np.searchsorted(steps, np.float32(sign) * numbers.astype(np.float32), side="right").astype(np.uint8)


def _cells(ranks: Bytes, shape: tuple[int, int, int], fine: int) -> Bytes:
    """For each brick (m, BRICK³), the largest rank at the corners of its groups of fine³ cells, 0 beyond the border."""
    for axis in range(3):
        line = np.moveaxis(ranks, axis, 0)
        ranks = np.moveaxis(np.maximum(line[:-1], line[1:]), 0, axis)
    ranks = np.pad(ranks, [(0, m * BRICK * fine - int(n)) for m, n in zip(shape, ranks.shape)])
    for axis in range(3 if fine > 1 else 0):
        line = np.moveaxis(ranks, axis, 0)
        ranks = np.moveaxis(np.maximum(line[::2], line[1::2]), 0, axis)
    split = ranks.reshape(shape[0], BRICK, shape[1], BRICK, shape[2], BRICK)
    return np.ascontiguousarray(split.transpose(0, 2, 4, 1, 3, 5)).reshape(-1, BRICK**3)


def _aligned(bricks: int, size: int) -> Bytes:
    """Memory for records that lie on whole cache lines."""
    room = np.empty(bricks * size + 64, np.uint8)
    first = -room.ctypes.data % 64
    return room[first : first + bricks * size].reshape(bricks, size)


def _steps(values: NDArray[Any], sign: float) -> NDArray[np.float32]:
    """Steps for the ranks: half of them equal shares of the voxels, half of them equal steps of the value.

    They lie an ulp above values: for data with few distinct values the ranks distinguish every level.
    """
    flat = values.reshape(-1)
    found = np.unique(np.float32(sign) * flat[:: max(1, flat.size >> 16)].astype(np.float32))
    if len(found) > RANKS:
        by_share = found[np.linspace(0, len(found) - 1, RANKS // 2).astype(int)]
        by_value = np.linspace(found[0], found[-1], RANKS - RANKS // 2, dtype=np.float32)
        found = np.unique(np.concatenate([by_share, by_value]))
    steps = np.full(RANKS, np.inf, np.float32)
    steps[: len(found)] = np.nextafter(found, np.float32(np.inf))
    return steps


def _write_cubes(largest: Bytes, out: Bytes) -> None:
    """Write the largest rank in the cubes of REACH bricks that begin at each brick, (bricks, 8, len(REACH))."""
    for octant in range(8):
        # Arranged along the octant, so that every axis goes up.
        turn = tuple(slice(None, None, 1 if octant >> (2 - axis) & 1 else -1) for axis in range(3))
        cube = largest[turn]
        side = 1
        for k, reach in enumerate(REACH):
            cube = _reaching(cube, side, reach)
            side = reach
            out[:, octant, k] = cube[turn].reshape(-1)


def _reaching(cube: Bytes, side: int, reach: int) -> Bytes:
    """Largest rank in cubes of `reach` bricks up each axis, from cubes of `side` that overlap to cover it."""
    for axis in range(3):
        line = np.moveaxis(cube, axis, 0)
        if reach >= len(line):
            line = np.maximum.accumulate(line[::-1])[::-1]
        else:
            n, covered, line = len(line), int(side), line.copy()
            while covered < reach:
                shift = min(covered, reach - covered)
                line[: n - shift] = np.maximum(line[: n - shift], line[shift:])
                covered += shift
        cube = np.moveaxis(line, 0, axis)
    return cube
