"""Points at which a grid is judged: on level sets of the whole range, where neither grids nor probes asked."""

import numpy as np
from numpy.typing import NDArray

from illumgrid.bake import shifted_seed
from illumgrid.field.scene import Field, Scene
from illumgrid.field.volume import Floats, cell_gradient, index_to_world, interpolate, slabs
from illumgrid.stages import on_level_sets
from illumgrid.transport.samples import Queries, join_queries

_STEPS = 64  # of the isovalue, within which points are uniform by area


def other_paths(seed: int) -> int:
    """A seed whose paths have nothing in common with those of `seed`."""
    return shifted_seed(seed, 2**63)


def unseen_on_level_sets(scene: Scene, levels: int, points: int, seed: int) -> Queries:
    """About `points` uniform by area on level sets of their own, one at random from each of `levels` equal steps."""
    random = np.random.default_rng((other_paths(seed), 1))
    rows = scene.levels((np.arange(levels) + random.random(levels)) / levels)
    each = max(1, round(points / (levels * len(scene.fields))))
    none = Queries.at(scene, np.zeros((0, 3)))
    found = join_queries([none, *on_level_sets(scene, rows, other_paths(seed), points=each)])
    return found[np.flatnonzero(found.normal.any(axis=1))]


def unseen_in_volume(scene: Scene, points: int, seed: int) -> Queries:
    """As `unseen_on_level_sets`, but each point on a level set of its own, and no surface is extracted.

    By the co-area formula, points of a volume weighted by |∇h| are uniform by area on the level sets through them;
    weights that add up to the same within each of 64 equal steps of the range make them uniform in the isovalue.
    """
    found = []
    for number, field in enumerate(scene.fields):
        random = np.random.default_rng((other_paths(seed), 2, number))
        cells, chance = _cells_by_step(field)
        if not len(cells):
            continue
        upto = np.cumsum(chance)
        tried = np.searchsorted(upto, random.random(max(1 << 15, 64 * points)) * upto[-1]).clip(0, len(cells) - 1)
        shape = tuple(n - 1 for n in field.volume.shape)
        index = np.stack(np.unravel_index(cells[tried], shape), axis=1) + random.random((len(tried), 3))
        share = field.place(interpolate(field.volume, index))
        kept = (share >= 0) & (share <= 1)
        index, step = index[kept], np.minimum(share[kept] * _STEPS, _STEPS - 1).astype(int)
        weight = np.linalg.norm(cell_gradient(field.volume, index), axis=1) / chance[tried[kept]]
        total = np.bincount(step, weight, minlength=_STEPS)
        weight = weight / np.where(total > 0, total, 1.0)[step]
        if weight.any():
            # Systematic draws from the points in order of isovalue: the same number from every step, or nearly.
            order = np.argsort(step, kind="stable")
            mass = np.cumsum(weight[order]) / weight.sum()
            chosen = order[np.searchsorted(mass, (np.arange(points) + random.random()) / points).clip(0, len(mass) - 1)]
            world = index_to_world(field.volume, index[np.unique(chosen)])
            found.append(Queries.at(scene, world, field=number, first_id=number << 40))
    if not found:
        return Queries.at(scene, np.zeros((0, 3)))
    asked = join_queries(found)
    return asked[np.flatnonzero(asked.normal.any(axis=1))]


def _cells_by_step(field: Field) -> tuple[NDArray[np.int64], Floats]:
    """Flat numbers (n,) of the voxel cells that the range crosses, and chances (n,) that give every step as many.

    Chosen all alike, the few cells around a small level set would hardly be met.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    lowest, highest = map(float, field.stored_range)
    step = np.empty(field.volume.shape, np.int8)
    for slab in slabs(step.shape):
        share = field.volume.values[slab].astype(np.float32, copy=False) - lowest
        share *= _STEPS / (highest - lowest)
        step[slab] = np.clip(np.floor(share, out=share), -1, _STEPS, out=share)
    # Of the corners of each cell.
    low, high = (of(step, 2, origin=-1)[:-1, :-1, :-1] for of in (minimum_filter, maximum_filter))
    first, last = np.maximum(low, 0).reshape(-1), np.minimum(high, _STEPS - 1).reshape(-1)
    cells = np.flatnonzero(first <= last)
    first, last = first[cells], last[cells].astype(int) + 1
    many = np.cumsum(np.bincount(first, minlength=_STEPS + 1) - np.bincount(last, minlength=_STEPS + 1))
    rare = np.concatenate([[0.0], np.cumsum(1.0 / np.maximum(many, 1))])
    return cells, rare[last] - rare[first]
