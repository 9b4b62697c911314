"""Each node takes the value of the biharmonic spline through the samples around it."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats
from illumgrid.grid import IlluminationGrid, Nodes
from illumgrid.interpolators.neighbours import Neighbours, Sites, filled
from illumgrid.stages import Interpolator, hookimpl
from illumgrid.transport.samples import Samples


def _spline_values(places: Sites, around: Neighbours) -> tuple[Floats, Floats]:
    from illumgrid.interpolators.spline import AMPLIFIES, weigh

    weight, value = np.zeros(around.site.shape), np.zeros((len(around.node), places.mean.shape[1]))
    steps = np.zeros(len(around.node), np.int64)

    def chunk(rows: slice) -> None:
        weigh(
            around.point[rows], around.site[rows], around.distance[rows], places.point, places.mean,
            places.shown, AMPLIFIES, weight[rows], value[rows], steps[rows],
        )  # fmt: skip

    chunk(slice(0, 0))  # compiles in the main thread, where Ctrl-C can interrupt it
    size = 1 << 12
    with ThreadPoolExecutor() as pool:
        list(pool.map(chunk, (slice(i, i + size) for i in range(0, len(around.node), size))))
    return weight, value


@dataclass(frozen=True)
class Rbf:
    """Local biharmonic splines with a linear tail, clamped to the range of their samples.

    Parameters
    ----------
    neighbours : int
        Maximum number of samples per node.

    References
    ----------
    .. [1] J. Duchon, "Splines minimizing rotation-invariant semi-norms in Sobolev spaces", Constructive Theory of
           Functions of Several Variables, 1977.
    .. [2] J. C. Carr et al., "Reconstruction and representation of 3D objects with radial basis functions", SIGGRAPH
           2001.
    """

    name: ClassVar[str] = "rbf"
    neighbours: int = 16

    def __post_init__(self) -> None:
        if self.neighbours < 1:
            raise BadInput(f"rbf.neighbours is {self.neighbours}; expected at least 1 sample")

    def fill(self, samples: Samples, nodes: Nodes) -> IlluminationGrid:
        """Fill every node: see `illumgrid.stages.Interpolator`."""
        return filled(samples, nodes, self.neighbours, _spline_values)


@hookimpl
def register_interpolators() -> list[type[Interpolator]]:
    """Register the stage of this file, as a plugin does."""
    return [Rbf]
