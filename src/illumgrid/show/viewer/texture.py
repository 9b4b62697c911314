"""Light of a field's nodes or of a wall as a page shows it while it comes in: coarse first, then node by node."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.volume import Floats
from illumgrid.grid import Channels, GridSpec, IlluminationGrid, fill_holes

STEP = 4
"""Nodes from one of the coarse lattice to the next; as many on a side of a block, whose nodes are lit together."""
SIDE = 16
"""Nodes on a side of the boxes in which light goes to the page."""


@dataclass(frozen=True, eq=False)
class Coming:
    """Light that is still to come to a page: what is newer than `stamp`, at the nodes of `specs`, one lattice a field.

    The page begins with the light of every `STEP`-th node along each axis, in straight lines between them, and with the
    view `opening` of `illumgrid.show.viewer.packing`, if that is known already.
    """

    stamp: int
    specs: Sequence[GridSpec]
    opening: dict[str, Any] | None = None


@dataclass(eq=False)
class Texture:
    """Light that is shown (nx, ny, nz, C) of a field's nodes, or (K, nv, nu, C) of a wall's texels, as far as known."""

    light: NDArray[np.float32]
    known: NDArray[np.bool_]
    stamps: NDArray[np.int64]
    """Of each box of `SIDE` on a side: when its light last changed."""

    @classmethod
    def of(cls, shape: Sequence[int], channels: int) -> "Texture":
        """Nothing is lit."""
        boxes = [-(-n // SIDE) for n in shape]
        return cls(np.zeros((*shape, channels), np.float32), np.zeros(shape, bool), np.zeros(boxes, np.int64))

    def paint(self, flat: NDArray[np.int64], light: NDArray[np.float32], stamp: int) -> None:
        """Put the light (n, C) of some nodes in its place."""
        self.light.reshape(-1, self.light.shape[-1])[flat] = light
        self.known.reshape(-1)[flat] = True
        at = np.unravel_index(flat, self.known.shape)
        self.stamps[tuple(index // SIDE for index in at)] = stamp

    def coarse(self, spacing: Floats) -> NDArray[np.float32]:
        """Light of every node of the coarse lattice, so far apart; what it lacks, it has from nearby."""
        every = tuple(slice(None, None, STEP) for _ in range(3))
        support = self.known[every].astype(np.float32)
        if support.any():
            return fill_holes(spacing, self.light[every], support)
        some, shape = self.light[self.known], (*support.shape, self.light.shape[-1])
        return np.broadcast_to(some.mean(axis=0) if len(some) else np.float32(0), shape)

    def every_fourth(self, spec: GridSpec, channels: Channels) -> IlluminationGrid:
        """The coarse lattice of these nodes as a grid, whose errors are not known: at least two nodes along an axis."""
        shape = np.maximum(2, -(-np.array(spec.shape) // STEP))
        every = GridSpec(tuple(shape.tolist()), spec.origin, STEP * spec.spacing, spec.direction)
        light, known = self.coarse(every.spacing), self.known[::STEP, ::STEP, ::STEP]
        more = [(0, n - m) for n, m in zip(every.shape, known.shape)]
        light, support = np.pad(light, [*more, (0, 0)], mode="edge"), np.pad(known, more).astype(np.float32)
        return IlluminationGrid(every, light, np.full(every.shape, np.inf, np.float32), support, channels)

    def fill(self, spacing: Floats, stamp: int) -> None:
        """Give nodes without light that of the coarse lattice, in straight lines."""
        even = self.coarse(spacing)
        for axis in (2, 1):
            even = np.moveaxis(np.tensordot(self._weights(axis), even, (1, axis)), 0, axis)
        even = np.ascontiguousarray(even)
        for x, weights in enumerate(self._weights(0)):  # a slab at a time, which stays near the processor
            low, high = weights.nonzero()[0][[0, -1]]
            slab, known = weights[low] * even[low], self.known[x]
            if high > low:
                slab += weights[high] * even[high]
            slab[known] = self.light[x][known]
            self.light[x] = slab
        self.stamps[:] = stamp

    def _weights(self, axis: int) -> NDArray[np.float32]:
        """Of the coarse lattice along an axis at each node (n, m); beyond the last of the lattice, it alone counts."""
        count = self.known.shape[axis]
        at, nodes = np.arange(count) / STEP, np.arange(-(-count // STEP))
        away = np.abs(np.minimum(at, nodes[-1])[:, None] - nodes)
        return np.asarray(np.maximum(1 - away, 0), np.float32)
