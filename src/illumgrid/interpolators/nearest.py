"""Each node takes the answer of the sample nearest to it."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from illumgrid.grid import GridSpec, IlluminationGrid, fill_holes
from illumgrid.interpolators.neighbours import diagonal, near_samples
from illumgrid.stages import Interpolator, hookimpl
from illumgrid.transport.samples import Samples

_SLAB = 1 << 18  # nodes asked at once: bounds the memory of a search


@dataclass(frozen=True)
class Nearest:
    """The nearest sample within a cell's diagonal, holes passed over; nodes beyond are holes."""

    name: ClassVar[str] = "nearest"

    def fill(self, samples: Samples, spec: GridSpec, field: int) -> IlluminationGrid:
        """Fill every node: see `illumgrid.stages.Interpolator`."""
        from scipy.spatial import KDTree

        good = np.flatnonzero(samples.paths > 0)
        size = int(np.prod(spec.shape))
        values = np.zeros((size, 3), np.float32)
        error = np.full(size, np.inf, np.float32)
        support = np.zeros(size, np.float32)
        if len(good):
            # Distances from the grid's origin: far from the world's, differences of large numbers would lose digits.
            points = samples.queries.point[good] - spec.origin
            tree = KDTree(points)
            reach = diagonal(spec)
            mean, own_error = samples.mean[good], samples.error[good]
            candidates = np.flatnonzero(near_samples(spec, samples.queries.point[good], reach))
            for first in range(0, len(candidates), _SLAB):
                nodes = candidates[first : first + _SLAB]
                distance, sample = tree.query(spec.nodes(nodes) - spec.origin, distance_upper_bound=reach)
                near = np.isfinite(distance)
                values[nodes[near]] = mean[sample[near]]
                error[nodes[near]] = own_error[sample[near]]
                support[nodes[near]] = 1.0
        shape = tuple(spec.shape)
        support = support.reshape(shape)
        return IlluminationGrid(
            spec, fill_holes(spec.spacing, values.reshape(*shape, 3), support), error.reshape(shape), support
        )


@hookimpl
def register_interpolators() -> list[type[Interpolator]]:
    """Name this file's stage to the registry, as a plugin does."""
    return [Nearest]
