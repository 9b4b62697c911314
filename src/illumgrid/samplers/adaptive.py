"""Isovalues in equal steps of space, denser where the topology changes, and points scattered over each level set.

The distance between neighbouring level sets is dc / |∇h|. By the co-area formula, its mean over L_c is a ratio of two
sums over cells, which need no extraction (Federer, "Curvature measures", Trans. AMS 93, 1959; on histograms and areas
of level sets: Scheidegger et al., "Revisiting histograms and isosurface statistics", TVCG 14(6), 2008).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.scene import Field, Scene, level_table
from illumgrid.field.volume import Floats
from illumgrid.grid import GridSpec
from illumgrid.stages import Sampler, hookimpl, on_level_sets
from illumgrid.transport.samples import Queries

_BINS = 1024  # of the sweep: four times the isovalues of a field of bytes
_CELLS = 1 << 18  # cells per block: bounds the memory
TOPOLOGY = 0.1
"""Share of the levels that is assigned to changes of topology."""


def _cells_in_range(field: Field) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Lowest and highest stored value and mean slope (m,) of the cells that the range crosses, in blocks.

    The slope is the mean of |∇h| over the 8 Gauss points of the trilinear cell: at the centre alone it may vanish.
    """
    values, (lowest, highest) = field.volume.stored, field.stored_range
    rows = max(1, _CELLS // (values.shape[1] * values.shape[2]))
    shares = 0.5 + np.array([-0.5, 0.5]) / 3**0.5
    weight = np.array([(1 - shares), shares])  # (end, Gauss point)
    for first in range(0, len(values) - 1, rows):
        block = values[first : first + rows + 1].astype(float)
        corners = np.stack([block[tuple(slice(c, n - 1 + c) for c, n in zip(at, block.shape))].ravel()
                            for at in product((0, 1), repeat=3)])  # fmt: skip
        low, high = corners.min(axis=0), corners.max(axis=0)
        crossed = (low < high) & (low < highest) & (high > lowest)
        cube = corners[:, crossed].reshape(2, 2, 2, -1)
        x, y, z = (np.diff(cube, axis=axis).squeeze(axis) / field.volume.spacing[axis] for axis in range(3))
        x, y, z = (np.einsum("abm,ap,bq->pqm", edges, weight, weight) for edges in (x, y, z))
        slope = np.sqrt(x[None] ** 2 + y[:, None] ** 2 + z[:, :, None] ** 2).mean(axis=(0, 1, 2))
        yield low[crossed], high[crossed], slope


def distance_between(field: Field, edges: Floats) -> Floats:
    """Mean distance (n - 1,), world units, between the level sets of neighbouring isovalues `edges` (n,), increasing.

    The distance is ∫ 1/|∇h| dA / ∫ dA over the level sets from one edge to the next: dV over ∫ |∇h| dV. Both are sums
    over cells, and each cell spreads its volume evenly over the isovalues that cross it. The result is therefore
    insensitive to the comb in a histogram of integers and to plateaus, whose volume no level set crosses. It is 0 where
    there is no level set.
    """
    edges = field.volume.to_stored(edges)
    step = np.diff(edges)
    volume, area = np.zeros((2, len(step)))
    for low, high, slope in _cells_in_range(field):
        middle, span = 0.5 * (low + high), np.maximum(high - low, step.min())  # smaller spans would lose digits
        for weight, total in ((1 / span, volume), (slope / span, area)):
            # The cumulative sum of starts minus that of ends, integrated: ramps, exact at the edges.
            ramps = np.zeros(len(edges))
            for start, sign in ((middle - span / 2, 1.0), (middle + span / 2, -1.0)):
                bins = np.searchsorted(edges, start, side="right")
                count = np.bincount(bins, weight, len(edges) + 1)[:-1].cumsum()
                moment = np.bincount(bins, weight * (start - edges[0]), len(edges) + 1)[:-1].cumsum()
                ramps += sign * (count * (edges - edges[0]) - moment)
            total += np.diff(ramps)
    found = area > 1e-12 * area.max(initial=0.0)
    return np.divide(step * volume, area, out=np.zeros(len(step)), where=found)


def critical_values(field: Field) -> tuple[Floats, NDArray[np.int64]]:
    """Isovalues (m,) within the range at which the topology changes, and by how much (m,), one for each such voxel.

    The solid consists of the lattice cells whose corners all belong to it. A voxel that joins it, as the isovalue
    passes, changes the Euler characteristic by the alternating sum of the cells that it completes, which is 0 unless
    the voxel is critical. Equal values are ordered by their position in the array, so that a plateau counts once.
    """
    values = np.pad(np.float32(field.upward) * field.volume.stored.astype(np.float32), 1, constant_values=-np.inf)
    low, high = field.stored_range
    within = (field.volume.stored >= low) & (field.volume.stored <= high)
    own = np.flatnonzero(np.pad(within, 1))
    stride = np.array([values.shape[1] * values.shape[2], values.shape[2], 1])
    steps = np.array(list(product((-1, 0, 1), repeat=3)))
    flat, change = values.ravel(), np.zeros(len(own), np.int64)
    for first in range(0, len(own), _CELLS):
        voxel = own[first : first + _CELLS]
        above = np.ones((27, len(voxel)), bool)
        for number, offset in enumerate(steps @ stride):
            other = flat[voxel + offset]
            above[number] = (other > flat[voxel]) if offset < 0 else (other >= flat[voxel])
        around = above.reshape(3, 3, 3, -1)
        for step in steps:
            corners = around[np.ix_(*([1, 1 + s] if s else [1] for s in step))].reshape(-1, len(voxel))
            change[first : first + _CELLS] += (-1) ** np.count_nonzero(step) * corners.all(axis=0)
    critical = change != 0
    return field.volume.in_units(flat[own[critical]].astype(float) * field.upward), change[critical]


def adaptive_rows(scene: Scene, count: int, topology: float = TOPOLOGY) -> Floats:
    """At most `count` rows of levels (K, F), in equal steps of space for the field that moves farthest.

    Parameters
    ----------
    scene : Scene
    count : int
    topology : float
        Share of the rows that is assigned to isovalues at which the topology changes, 0 to 1.
    """
    sweep = np.linspace(0.0, 1.0, _BINS + 1)
    edges = scene.levels(sweep)
    step_length, changes = np.zeros((2, _BINS))
    for number, field in enumerate(scene.fields):
        order = -1 if field.falling else 1
        rising = edges[::order, number]
        step_length = np.maximum(step_length, distance_between(field, rising)[::order])
        at, change = critical_values(field)
        changes += np.histogram(at, rising, weights=np.abs(change))[0][::order]
    if not step_length.any():
        return level_table(scene, count).table  # no cell is crossed: nothing to choose by
    changes[step_length == 0] = 0
    share = step_length / step_length.sum()
    if changes.any():
        share = (1 - topology) * share + topology * changes / changes.sum()
    reached = np.concatenate([[0.0], share.cumsum()])
    begin, end = np.flatnonzero(share)[[0, -1]]  # empty ends of the range get no row
    inner = np.interp(np.linspace(0, reached[-1], count)[1:-1], reached, sweep)
    return scene.levels(np.unique(np.concatenate([[sweep[begin]], inner, [sweep[end + 1]]])))


@dataclass(frozen=True)
class Adaptive:
    """Level sets in equal steps of space, denser where the topology changes, with points uniform by area on each.

    Parameters
    ----------
    count : int
        Maximum number of isovalues.
    points : int
        Points on each level set; 0 selects one per squared node spacing, at least 64.
    """

    name: ClassVar[str] = "adaptive"
    count: int = 32
    points: int = 0

    def __post_init__(self) -> None:
        if self.count < 2:
            raise BadInput(f"adaptive.count is {self.count}; expected at least 2 isovalues")
        if self.points < 0:
            raise BadInput(
                f"adaptive.points is {self.points}; expected a positive number, or 0 for one per squared node spacing"
            )

    def queries(self, scene: Scene, specs: Sequence[GridSpec], seed: int) -> Iterator[Queries]:
        """Queries on at most `count` rows of the common sweep: see `illumgrid.stages.Sampler`."""
        rows = adaptive_rows(scene, self.count)
        yield from on_level_sets(scene, rows, seed, specs=specs, points=self.points or None)


@hookimpl
def register_samplers() -> list[type[Sampler]]:
    """Register the stage of this file, as a plugin does."""
    return [Adaptive]
