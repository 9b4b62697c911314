"""Each node takes the light of the nearest sample."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from illumgrid.grid import IlluminationGrid, Nodes
from illumgrid.interpolators.neighbours import diagonal, near_samples
from illumgrid.stages import Interpolator, hookimpl
from illumgrid.transport.samples import Samples

_SLAB = 1 << 18  # nodes per search: bounds the memory


@dataclass(frozen=True)
class Nearest:
    """The nearest sample within a cell's diagonal, ignoring holes; nodes farther away are holes."""

    name: ClassVar[str] = "nearest"

    def fill(self, samples: Samples, nodes: Nodes) -> IlluminationGrid:
        """Fill every node: see `illumgrid.stages.Interpolator`."""
        from scipy.spatial import KDTree

        spec, good = nodes.spec, samples[samples.paths > 0]
        light = np.zeros((len(nodes), samples.light.shape[1]), np.float32)
        error = np.full(len(nodes), np.inf, np.float32)
        support = np.zeros(len(nodes), np.float32)
        errors = None if samples.errors is None else np.full(light.shape, np.inf, np.float32)
        if len(good):
            # Coordinates relative to the grid's origin: differences of large world coordinates would lose digits.
            tree = KDTree(good.queries.point - spec.origin)
            reach, own_error, own_errors = diagonal(spec), good.error, good.errors
            for block in nodes.blocks(np.flatnonzero(near_samples(spec, good.queries.point, reach)), _SLAB):
                distance, sample = tree.query(block.point - spec.origin, distance_upper_bound=reach)
                near = np.isfinite(distance)
                light[block.flat[near]] = good.light[sample[near]]
                error[block.flat[near]] = own_error[sample[near]]
                support[block.flat[near]] = 1.0
                if errors is not None and own_errors is not None:
                    errors[block.flat[near]] = own_errors[sample[near]]
        return nodes.grid(light, error, support, samples.channels, errors)


@hookimpl
def register_interpolators() -> list[type[Interpolator]]:
    """Register the stage of this file, as a plugin does."""
    return [Nearest]
