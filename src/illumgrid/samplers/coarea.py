"""Points uniform by area on level sets, each on its own level set: no surface is extracted."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.scene import Field, Scene
from illumgrid.field.storing import read_at_random
from illumgrid.field.volume import AT_ONCE, Floats, cell_gradient, index_to_world, interpolate
from illumgrid.transport.samples import Queries, join_queries

_LOOKED_AT = 1 << 24  # voxels of a field that is examined as a whole
_AT_ONCE = 1 << 20  # cells whose probabilities are held
_STEPS = 64  # of the isovalue, within which points are uniform by area


def points_on_level_sets(scene: Scene, points: int, seed: tuple[int, ...]) -> Queries:
    """About `points` points for each field, with equal numbers from each of 64 equal steps of its range.

    By the co-area formula, points of a volume weighted by |∇h| are uniform by area on the level sets through them;
    weights that add up to the same within each step make them uniform in the isovalue.
    """
    found = []
    for number, field in enumerate(scene.fields):
        random = np.random.default_rng((*seed, number))
        cells = _cells_by_step(field, random)
        if not len(cells.number):
            continue
        tried = cells.drawn(random.random(max(1 << 15, 64 * points)))
        chance = cells.chance(tried)
        shape = tuple(n - 1 for n in field.volume.shape)
        index = np.stack(np.unravel_index(cells.number[tried], shape), axis=1) + random.random((len(tried), 3))
        share = field.place(_in_order(partial(interpolate, field.volume), index))
        kept = (share >= 0) & (share <= 1)
        index, step = index[kept], np.minimum(share[kept] * _STEPS, _STEPS - 1).astype(int)
        weight = np.linalg.norm(_in_order(partial(cell_gradient, field.volume), index), axis=1) / chance[kept]
        total = np.bincount(step, weight, minlength=_STEPS)
        weight = weight / np.where(total > 0, total, 1.0)[step]
        if weight.any():
            # Systematic draws from the points in order of isovalue: about the same number from every step.
            order = np.argsort(step, kind="stable")
            mass = np.cumsum(weight[order]) / weight.sum()
            chosen = order[np.searchsorted(mass, (np.arange(points) + random.random()) / points).clip(0, len(mass) - 1)]
            world = index_to_world(field.volume, index[np.unique(chosen)])
            with read_at_random([field.volume.stored]):  # few, and far apart
                found.append(Queries.at(scene, world, field=number, first_id=number << 40))
    if not found:
        return Queries.at(scene, np.zeros((0, 3)))
    asked = join_queries(found)
    return asked[np.flatnonzero(asked.normal.any(axis=1))]


def _in_order(look: Callable[[Floats], Floats], index: Floats) -> Floats:
    """The values found at indices (n, 3), looked up slab by slab: a field that is paged is then read once."""
    order = np.argsort(index[:, 0])
    found = look(index[order])
    back = np.empty_like(found)
    back[order] = found
    return back


@dataclass(frozen=True, eq=False)
class _Cells:
    """Voxel cells that the range crosses, and probabilities with which each step of the isovalue gets equally many.

    With equal probabilities, the few cells around a small level set would hardly be chosen.
    """

    number: NDArray[np.integer]  # (n,) flat
    first: NDArray[np.int8]  # (n,) step of the range that the cell crosses first
    last: NDArray[np.int8]  # (n,) one beyond the last
    rare: Floats  # (steps + 1,) cumulative over the steps: 1 over the number of cells that cross each

    def chance(self, some: slice | NDArray[np.integer]) -> Floats:
        """Probabilities of some cells."""
        return np.asarray(self.rare[self.last[some]] - self.rare[self.first[some]])

    def drawn(self, shares: Floats) -> NDArray[np.int64]:
        """The cell at each share (m,) of the sum of all probabilities, which is never held as a whole."""
        ends, total = [], 0.0
        begins = range(0, len(self.number), _AT_ONCE)
        for begin in begins:
            total = float(self._upto(begin, total)[-1])
            ends.append(total)
        wanted, found = shares * total, np.empty(len(shares), np.int64)
        part = np.searchsorted(ends, wanted).clip(0, len(ends) - 1)
        for k, begin in enumerate(begins):
            here = np.flatnonzero(part == k)
            found[here] = begin + np.searchsorted(self._upto(begin, ends[k - 1] if k else 0.0), wanted[here])
        return found.clip(0, len(self.number) - 1)

    def _upto(self, begin: int, before: float) -> Floats:
        """Cumulative probabilities up to each of some cells; `before` is the sum for the cells ahead of them."""
        chance = self.chance(slice(begin, begin + _AT_ONCE))
        chance[0] += before
        return np.cumsum(chance, out=chance)


def _cells_by_step(field: Field, random: np.random.Generator) -> _Cells:
    """The cells that the range crosses; for a volume of more than `_LOOKED_AT` voxels, those of some columns."""
    nx, ny, nz = field.volume.shape
    many, at_once = (nx - 1) * (ny - 1), max(1, AT_ONCE // (4 * nz))
    columns = np.arange(many)
    if field.volume.stored.size > _LOOKED_AT:
        columns = np.sort(random.choice(many, _LOOKED_AT // nz, replace=False))
    parts = [_crossed(field, columns[first : first + at_once]) for first in range(0, len(columns), at_once)]
    many_in = np.zeros(_STEPS + 1, np.int64)
    for _, first, last in parts:
        many_in += np.bincount(first, minlength=_STEPS + 1) - np.bincount(last, minlength=_STEPS + 1)
    rare = np.concatenate([[0.0], np.cumsum(1.0 / np.maximum(np.cumsum(many_in), 1))])
    each = [list(of) for of in zip(*parts)]
    del parts  # as many cells as voxels examined: their parts are freed as they are joined
    number, begin, end = (np.concatenate(each.pop(0)) for _ in range(3))
    return _Cells(number, begin, end, rare)


def _crossed(
    field: Field, columns: NDArray[np.int64]
) -> tuple[NDArray[np.integer], NDArray[np.int8], NDArray[np.int8]]:
    """Cells that the range crosses, of some columns along the last axis: number, first step, last step + 1."""
    (lowest, highest), (_, ny, nz) = map(float, field.stored_range), field.volume.shape
    x, y = np.divmod(columns, ny - 1)
    steps = []
    for corner in np.ndindex(2, 2):
        share = field.volume.stored[x + corner[0], y + corner[1]].astype(np.float32, copy=False) - lowest
        share *= _STEPS / (highest - lowest)
        steps.append(np.clip(np.floor(share, out=share), -1, _STEPS, out=share).astype(np.int8))
    low, high = (of.reduce(steps) for of in (np.minimum, np.maximum))
    first = np.maximum(np.minimum(low[:, :-1], low[:, 1:]), 0)
    last = np.minimum(np.maximum(high[:, :-1], high[:, 1:]), _STEPS - 1)
    row, z = np.nonzero(first <= last)
    number = columns[row] * (nz - 1) + z
    small = np.int32 if field.volume.stored.size < 1 << 31 else np.int64
    return number.astype(small), first[row, z], last[row, z] + np.int8(1)
