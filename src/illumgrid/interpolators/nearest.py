"""Each node takes the light of the nearest sample."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.volume import Floats, world_to_index
from illumgrid.grid import GridSpec, IlluminationGrid, Nodes
from illumgrid.interpolators.neighbours import diagonal, near_samples
from illumgrid.stages import Interpolator, hookimpl
from illumgrid.transport.samples import Samples

_SLAB = 1 << 16  # nodes per search: bounds the memory
_ON_A_NODE = 1e-6  # of a spacing: no other sample is nearer


@dataclass(frozen=True)
class Nearest:
    """The nearest sample within a cell's diagonal, ignoring holes; nodes farther away are holes."""

    name: ClassVar[str] = "nearest"

    def fill(self, samples: Samples, nodes: Nodes) -> IlluminationGrid:
        """Fill every node: see `illumgrid.stages.Interpolator`."""
        from scipy.spatial import KDTree

        spec = nodes.spec
        light = np.zeros((len(nodes), samples.light.shape[1]), np.float32)
        error = np.full(len(nodes), np.inf, np.float32)
        support = np.zeros(len(nodes), np.float32)
        errors = np.full(light.shape, np.inf, np.float32) if samples.channels.mixable else None
        nowhere = samples.queries[:0]

        def take(node: NDArray[np.integer], sample: NDArray[np.integer]) -> None:
            for first in range(0, len(node), _SLAB):
                some, rows = node[first : first + _SLAB], sample[first : first + _SLAB]
                light_of, spread = samples.light[rows], samples.spread[rows]
                own = Samples(nowhere, light_of, spread, samples.paths[rows], samples.channels)
                light[some], error[some], support[some] = own.light, own.error, 1.0
                if errors is not None and own.errors is not None:
                    errors[some] = own.errors

        def points() -> Iterator[tuple[NDArray[np.int64], Floats]]:
            for first in range(
                0, len(samples), _SLAB
            ):  # in parts: the numbers of all samples would take a fifth of their memory
                good = first + np.flatnonzero(samples.paths[first : first + _SLAB] > 0)
                yield good, samples.queries[good].point

        many = np.zeros(len(nodes), np.uint8)  # samples on each node: 0, 1, or 2 for more

        def counted() -> Iterator[Floats]:
            for _, some in points():
                node, count = np.unique(on_nodes(spec, some)[0], return_counts=True)
                many[node] = np.minimum(many[node] + count, 2)
                yield some

        if (samples.paths > 0).any():
            reach = diagonal(spec)
            candidates = near_samples(spec, counted(), reach).reshape(-1)
            for good, some in points():
                node, sample = on_nodes(spec, some)
                alone = many[node] == 1
                take(node[alone], good[sample[alone]])
            candidates[many == 1] = False
            if candidates.any():
                # Coordinates relative to the grid's origin: differences of large world coordinates would lose digits.
                tree = KDTree(np.concatenate([some - spec.origin for _, some in points()]))
                number = np.flatnonzero(samples.paths > 0)
                for block in nodes.blocks(np.flatnonzero(candidates), _SLAB):
                    distance, sample = tree.query(block.point - spec.origin, distance_upper_bound=reach)
                    near = np.isfinite(distance)
                    take(block.flat[near], number[sample[near]])
                del tree
        return nodes.grid(light, error, support, samples.channels, errors)


def on_nodes(spec: GridSpec, points: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Flat numbers (m,) of the nodes that are one of the world points (n, 3), and which (m,)."""
    index = world_to_index(spec, points)
    closest = np.clip(np.round(index), 0, np.array(spec.shape) - 1)
    point = np.flatnonzero((np.abs(index - closest) < _ON_A_NODE).all(axis=1))
    return np.ravel_multi_index(tuple(closest[point].astype(np.int64).T), spec.shape), point


@hookimpl
def register_interpolators() -> list[type[Interpolator]]:
    """Register the stage of this file, as a plugin does."""
    return [Nearest]
