"""Textures of nodes or texels for a page during the computation: coarse light first, then node by node."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.volume import Floats
from illumgrid.grid import Channels, GridSpec, IlluminationGrid, fill_holes

STEP = 4
"""Spacing of the coarse lattice in nodes; also the side of the blocks whose nodes are lit together."""
SIDE = 16
"""Nodes along the side of the boxes in which light is sent to the page."""


@dataclass(frozen=True, eq=False)
class Coming:
    """Light still to come to a page: everything newer than `stamp`, at the nodes of `specs`, one lattice per field.

    The page begins with the light of every `STEP`-th node along each axis, in straight lines between them, and with the
    view `opening` of `illumgrid.show.viewer.packing`, if that is known already.
    """

    stamp: int
    specs: Sequence[GridSpec]
    opening: dict[str, Any] | None = None


@dataclass(eq=False)
class Texture:
    """The light so far (nx, ny, nz, C) of a field's nodes, or (K, nv, nu, C) of a wall's texels."""

    light: NDArray[np.float32]
    known: NDArray[np.bool_]
    stamps: NDArray[np.int64]
    """For each box of `SIDE` nodes: when its light last changed."""

    @classmethod
    def of(cls, shape: Sequence[int], channels: int) -> "Texture":
        """A texture without any light."""
        boxes = [-(-n // SIDE) for n in shape]
        return cls(np.zeros((*shape, channels), np.float32), np.zeros(shape, bool), np.zeros(boxes, np.int64))

    def paint(self, flat: NDArray[np.int64], light: NDArray[np.float32], stamp: int) -> None:
        """Set the light (n, C) of some nodes."""
        self.light.reshape(-1, self.light.shape[-1])[flat] = light
        self.known.reshape(-1)[flat] = True
        at = np.unravel_index(flat, self.known.shape)
        self.stamps[tuple(index // SIDE for index in at)] = stamp

    def coarse(self, spacing: Floats) -> NDArray[np.float32]:
        """Light of every node of the coarse lattice; nodes without light have that of a neighbour."""
        every = tuple(slice(None, None, STEP) for _ in range(3))
        support = self.known[every].astype(np.float32)
        if support.any():
            return fill_holes(spacing, self.light[every], support)
        some, shape = self.light[self.known], (*support.shape, self.light.shape[-1])
        return np.broadcast_to(some.mean(axis=0) if len(some) else np.float32(0), shape)

    def every_fourth(self, spec: GridSpec, channels: Channels) -> IlluminationGrid:
        """The coarse lattice of these nodes as a grid with unknown errors: at least two nodes along an axis."""
        shape = np.maximum(2, -(-np.array(spec.shape) // STEP))
        every = GridSpec(tuple(shape.tolist()), spec.origin, STEP * spec.spacing, spec.direction)
        light, known = self.coarse(every.spacing), self.known[::STEP, ::STEP, ::STEP]
        more = [(0, n - m) for n, m in zip(every.shape, known.shape)]
        light, support = np.pad(light, [*more, (0, 0)], mode="edge"), np.pad(known, more).astype(np.float32)
        return IlluminationGrid(every, light, np.full(every.shape, np.inf, np.float32), support, channels)

    def fill(self, spacing: Floats, stamp: int) -> None:
        """Give nodes without light that of the coarse lattice, interpolated linearly."""
        even = self.coarse(spacing)
        for axis in (2, 1):
            even = np.moveaxis(np.tensordot(self._weights(axis), even, (1, axis)), 0, axis)
        even = np.ascontiguousarray(even)
        for x, weights in enumerate(self._weights(0)):  # slab by slab, which stays in the cache
            low, high = weights.nonzero()[0][[0, -1]]
            slab, known = weights[low] * even[low], self.known[x]
            if high > low:
                slab += weights[high] * even[high]
            slab[known] = self.light[x][known]
            self.light[x] = slab
        self.stamps[:] = stamp

    def _weights(self, axis: int) -> NDArray[np.float32]:
        """Weights of the coarse lattice along an axis at each node (n, m); beyond its last node, that alone counts."""
        count = self.known.shape[axis]
        at, nodes = np.arange(count) / STEP, np.arange(-(-count // STEP))
        away = np.abs(np.minimum(at, nodes[-1])[:, None] - nodes)
        return np.asarray(np.maximum(1 - away, 0), np.float32)
