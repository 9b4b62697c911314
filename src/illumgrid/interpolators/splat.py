"""Each node takes the mean of the samples around it, weighted by a smooth kernel."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats
from illumgrid.grid import IlluminationGrid, Nodes
from illumgrid.interpolators.neighbours import Neighbours, Sites, filled
from illumgrid.stages import Interpolator, hookimpl
from illumgrid.transport.samples import Samples


def _kernel_means(places: Sites, around: Neighbours) -> tuple[Floats, Floats]:
    """Weights of Wendland's kernel on each sheet, the sheets weighted inversely to their distance, and the means.

    Weights are proportional to paths, not to inverse variances: the variance is estimated from the same paths as the
    mean, and dark estimates, which vary least, would dominate.
    """
    weight = np.zeros(around.site.shape)
    sheet = np.where(np.isfinite(around.distance), places.sheet[around.site], -1)
    nearest = np.stack([np.where(sheet == s, around.distance, np.inf).min(axis=1) for s in (0, 1)], axis=1)
    # Linear between the sheets; elsewhere only the nearer sheet counts, which agrees on the sheet itself.
    share = np.where(around.between[:, None], nearest[:, ::-1], nearest == nearest.min(axis=1, keepdims=True))
    share /= share.sum(axis=1, keepdims=True)
    for number in (0, 1):
        there = sheet == number
        radius = 1.1 * np.where(there, around.distance, 0.0).max(axis=1, keepdims=True)
        q = np.divide(around.distance, radius, out=np.zeros_like(weight), where=there & (radius > 0))
        kernel = np.where(there, (1 - q) ** 4 * (4 * q + 1) * places.paths[around.site], 0.0)
        sums = kernel.sum(axis=1)
        weight += kernel * np.divide(share[:, number], sums, out=np.zeros_like(sums), where=sums > 0)[:, None]
    value = np.zeros((len(weight), places.mean.shape[1]))
    for w, site in zip(weight.T, around.site.T):  # in this order for any number of channels, unlike einsum
        value += w[:, None] * places.mean[site]
    return weight, value


@dataclass(frozen=True)
class Splat:
    """Means of the nearest samples on the two level sets around a node, linear between them.

    The mean on a level set is weighted by a kernel whose width adapts to the spacing of the samples there.

    Parameters
    ----------
    neighbours : int
        Maximum number of samples per node, half of them on each level set. The farthest one on a level set determines
        the radius of the kernel there.

    References
    ----------
    .. [1] D. Shepard, "A two-dimensional interpolation function for irregularly-spaced data", ACM National Conference,
           1968.
    .. [2] H. Wendland, "Piecewise polynomial, positive definite and compactly supported radial functions of minimal
           degree", Advances in Computational Mathematics 4, 1995.
    """

    name: ClassVar[str] = "splat"
    neighbours: int = 16

    def __post_init__(self) -> None:
        if self.neighbours < 1:
            raise BadInput(f"splat.neighbours is {self.neighbours}; expected at least 1 sample")

    def fill(self, samples: Samples, nodes: Nodes) -> IlluminationGrid:
        """Fill every node: see `illumgrid.stages.Interpolator`."""
        return filled(samples, nodes, self.neighbours, _kernel_means)


@hookimpl
def register_interpolators() -> list[type[Interpolator]]:
    """Register the stage of this file, as a plugin does."""
    return [Splat]
