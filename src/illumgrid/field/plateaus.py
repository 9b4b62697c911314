"""Connected regions in which a field is constant: a level set has no normal there."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.volume import Floats, Volume, index_to_world, slabs

FEWEST = 27
"""Connected flat cells: integer data have fewer at every maximum."""

Plateau = tuple[float, float, Floats]
"""Value, share of all cells, and the world position (3,) of a cell of the largest piece."""


def plateaus(volume: Volume) -> list[Plateau]:
    """Values at which the field is constant over `FEWEST` connected cells or more, lowest first.

    Returns
    -------
    list of Plateau
    """
    v = volume.stored
    parts = [Pieces(*(each[pieces.size >= FEWEST] for each in pieces)) for pieces in _flat_pieces(v)]
    size, first = (np.concatenate(each) for each in zip(*parts))
    if not len(size):
        return []
    order = np.argsort(first)
    size, first = size[order], first[order]
    cells = (volume.shape[0] - 1, volume.shape[1] - 1, volume.shape[2] - 1)
    place = np.stack(np.unravel_index(first, cells), axis=1)
    value = volume.in_units(v[tuple(place.T)].astype(float))
    found = []
    for level in np.unique(value):
        own = value == level
        at = index_to_world(volume, place[own][np.argmax(size[own])][None] + 0.5)[0]
        found.append((float(level), float(size[own].sum() / np.prod(cells, dtype=float)), at))
    return found


class Pieces(NamedTuple):
    """Connected components of flat cells."""

    size: NDArray[np.int64]  # (n,) cells in each piece
    first: NDArray[np.int64]  # (n,) flat number of its first cell


def _flat_pieces(v: NDArray[Any]) -> Iterator[Pieces]:
    """All components, in no order, slab by slab: a component is complete when a slab ends that it does not leave.

    Apart from a slab, only the components that continue into the next one are held, at most as many as a plane has
    cells: a field without noise may have as many small components as a tenth of its voxels.
    """
    from illumgrid.field.pieces import number_cells

    size, first = np.zeros((2, 0), np.int64)
    plane = np.full((v.shape[1] - 1, v.shape[2] - 1), -1, np.int32)
    for rows in slabs((v.shape[0] - 1, *v.shape[1:])):
        flat = _flat_cells(v[rows.start : rows.stop + 1])
        room = len(size) + flat.size // 2 + 1
        sizes, firsts, parent = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.int32)
        sizes[: len(size)], firsts[: len(first)] = size, first
        count = number_cells(flat, plane, parent, sizes, firsts, rows.start * plane.size, len(size))
        goes_on, whole = np.zeros(count + 1, bool), parent[:count] == np.arange(count)
        goes_on[plane] = True  # the last entry, -1, belongs to no component
        ends, goes_on = whole & ~goes_on[:-1], goes_on[:-1]
        yield Pieces(sizes[:count][ends], firsts[:count][ends])
        size, first = sizes[:count][goes_on], firsts[:count][goes_on]
        again = np.append(np.cumsum(goes_on, dtype=np.int32) - 1, np.int32(-1))
        plane = again[plane]
    yield Pieces(size, first)


def _flat_cells(v: NDArray[Any]) -> NDArray[np.bool_]:
    """Cells whose eight corners are equal."""
    x, y, z = v[1:] == v[:-1], v[:, 1:] == v[:, :-1], v[:, :, 1:] == v[:, :, :-1]
    flat: NDArray[np.bool_] = z[:-1, :-1] & z[1:, :-1]
    for edges in (z[:-1, 1:], z[1:, 1:], y[:-1, :, :-1], y[1:, :, :-1], x[:, :-1, :-1]):
        flat &= edges
    return flat
