"""Where the error of a grid comes from: noise, the grid itself, what no sample covered, bounces left out."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from illumgrid.accuracy.reference import Reference
from illumgrid.field.volume import Floats


@dataclass(frozen=True)
class Parts:
    """The mean squared error of a grid in parts, each measured; all as squares relative to the mean irradiance."""

    noise: float  # half the mean squared difference of two grids from independent seeds
    # What interpolation between nodes does, at points whose nodes all have light of their own: the mean product of the
    # two grids' errors, in which noise cancels. An estimate of 0 may come out slightly negative.
    grid: float
    uncovered: float  # the same at points that read a node without support
    bounces: float  # mean square of the light that more bounces add at the points themselves
    cross: float  # what the sum of the four lacks of the total: the grid's error and missing bounces are correlated
    uncertain: float  # standard error of `grid`, from the spread over the points

    @property
    def total(self) -> float:
        """Mean squared error."""
        return max(0.0, self.noise + self.grid + self.uncovered + self.bounces + self.cross)


def missing(fewer: Reference, reference: Reference) -> Floats:
    """Light (n, 3), relative, that the bounces beyond those of `fewer` add to the same paths."""
    return (reference.light - fewer.light) / reference.mean


def parts_of(one: Floats, other: Floats, covered: NDArray[np.bool_], fewer: Reference, reference: Reference) -> Parts:
    """Split the error of a grid, from what two that differ in their seeds hold, (n, 3), at the points of a reference.

    `covered` (n,) marks points whose nodes all have light of their own; `fewer` is the light at the points by the same
    paths, cut off after as many bounces as the grids had.
    """
    light, mean = fewer.light, reference.mean
    first, second = (one - light) / mean, (other - light) / mean
    more = missing(fewer, reference)
    # The paths that stand for the exact light are in both errors: their own variance is subtracted.
    both = (first * second).mean(axis=1) - (fewer.off**2).mean(axis=1) / mean**2
    inside = np.where(covered, both, 0.0)
    return Parts(
        noise=float(((first - second) ** 2).mean()) / 2,
        grid=float(inside.mean()),
        uncovered=float(np.where(covered, 0.0, both).mean()),
        bounces=float((more**2).mean()),
        cross=-float(((first + second) * more).mean()),
        uncertain=float(inside.std() / np.sqrt(len(both))),
    )
