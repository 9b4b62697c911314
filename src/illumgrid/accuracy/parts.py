"""Where the error of a grid comes from: noise, the grid itself, what no sample covered, bounces left out."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from illumgrid.accuracy.truth import Truth
from illumgrid.field.volume import Floats


@dataclass(frozen=True)
class Split:
    """The mean squared error of a grid in four parts, each measured; all as squares relative to the mean irradiance.

    Parameters
    ----------
    noise : float
        Half the mean squared difference of two grids from independent seeds.
    grid : float
        What interpolation between nodes does, at points whose nodes all have light of their own: the mean product of
        the two grids' errors, in which noise cancels. An estimate of 0 may come out slightly negative.
    uncovered : float
        The same at points that read a node without support.
    bounces : float
        Mean square of the light that more bounces add at the points themselves.
    cross : float
        What the sum of the four lacks of the total: the grid's error and the missing bounces go together.
    uncertain : float
        Standard error of `grid`, from the spread over the points.
    """

    noise: float
    grid: float
    uncovered: float
    bounces: float
    cross: float
    uncertain: float

    @property
    def total(self) -> float:
        """Mean squared error."""
        return max(0.0, self.noise + self.grid + self.uncovered + self.bounces + self.cross)


def missing(fewer: Truth, truth: Truth) -> Floats:
    """Light (n, 3), relative, that the bounces beyond those of `fewer` add; the truth walks the same paths further."""
    return (truth.light - fewer.light) / truth.mean


def split(one: Floats, other: Floats, covered: NDArray[np.bool_], fewer: Truth, truth: Truth) -> Split:
    """Split the error of a grid.

    Parameters
    ----------
    one, other : (n, 3) float64
        What two grids that differ in nothing but their seeds hold at the points of the truth.
    covered : (n,) bool
        Points whose nodes all have light of their own.
    fewer : Truth
        The light at those points by the paths of the truth, cut off after as many bounces as the grids had.
    truth : Truth
    """
    light = fewer.light
    first, second = (one - light) / truth.mean, (other - light) / truth.mean
    more = missing(fewer, truth)
    # The paths that stand for the truth here are in both errors: their own variance is subtracted.
    own = (fewer.off**2).mean(axis=1) / truth.mean**2
    both = (first * second).mean(axis=1) - own
    return Split(
        noise=float(((first - second) ** 2).mean()) / 2,
        grid=float(np.where(covered, both, 0.0).mean()),
        uncovered=float(np.where(covered, 0.0, both).mean()),
        bounces=float((more**2).mean()),
        cross=-float(((first + second) * more).mean()),
        uncertain=float(np.where(covered, both, 0.0).std() / np.sqrt(len(both))),
    )
