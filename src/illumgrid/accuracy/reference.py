"""Reference light at unseen points, and the error of a grid in parts: noise, nodes, holes, bounces."""

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.accuracy.points import other_paths
from illumgrid.bake.accumulator import Bake
from illumgrid.field.volume import Floats
from illumgrid.rng import shifted_seed
from illumgrid.transport.samples import Queries
from illumgrid.transport.tracer import Tracer


@dataclass(frozen=True, eq=False)
class Reference:
    """Light at unseen points, with its own error, estimated from the difference of two halves with independent seeds.

    The error bars of the samples are not used: they are upper estimates, too large where few paths carry the light.
    """

    tracer: Tracer
    halves: tuple[Bake, Bake]  # of one batch of points each, without holes, with equally many paths

    def __len__(self) -> int:
        return len(self.queries)

    def __getitem__(self, rows: Any) -> "Reference":
        """Some of the points, by a slice, numbers or a mask."""
        one, other = (
            replace(h, targets=(h.targets[0][rows],), answers=tuple(a[rows] for a in h.answers)) for h in self.halves
        )
        return replace(self, halves=(one, other))

    @property
    def queries(self) -> Queries:
        """The points."""
        return self.halves[0].targets[0]

    @property
    def bounces(self) -> int:
        """Reflections that were followed."""
        return self.halves[0].bounces

    @property
    def paths(self) -> int:
        """Paths from each point, of both halves."""
        return 2 * self.halves[0].paths

    @property
    def light(self) -> Floats:
        """Irradiance (n, 3)."""
        return np.asarray(np.mean([half.samples.mean for half in self.halves], axis=0, dtype=float))

    @property
    def off(self) -> Floats:
        """Half the difference (n, 3) of the halves; the expectation of its square is the variance of `light`."""
        one, other = (half.samples.mean for half in self.halves)
        return (one.astype(float) - other) / 2

    @property
    def mean(self) -> float:
        """Mean irradiance over points and colours, to which errors are relative; 0 without points."""
        return float(self.light.mean()) if len(self) else 0.0

    @property
    def error(self) -> float:
        """Root mean square error of the reference itself, relative to the mean irradiance; 0 without light."""
        return float(np.sqrt((self.off**2).mean())) / self.mean if self.mean > 0 else 0.0

    def walk(self, paths: int) -> "Reference":
        """Trace more paths, up to this even number per point, half of them with each seed."""
        half = range(self.halves[0].paths, paths // 2)
        one, other = (h.walk(self.tracer, half) for h in self.halves)
        return replace(self, halves=(one, other))

    def cut_off(self, bounces: int) -> "Reference":
        """The same paths, cut off after fewer bounces."""
        one, other = (Bake.of(h.targets, min(bounces, self.bounces), h.seed) for h in self.halves)
        return replace(self, halves=(one, other)).walk(self.paths)


def begin(tracer: Tracer, asked: Queries, bounces: int, seed: int, paths: int = 64) -> Reference:
    """Trace a few paths that no run of `seed` traces; points inside another field's solid are omitted."""
    one, other = (Bake.of([asked], bounces, shifted_seed(other_paths(seed), k * 2**61)) for k in (0, 1))
    found = Reference(tracer, (one, other)).walk(paths)
    return found[found.halves[0].samples.paths > 0]


def converge(reference: Reference, error: float, most: int = 1 << 14, until: float = np.inf) -> Reference:
    """Trace more paths until the own relative error is at most `error`, there are `most`, or doubling takes too long.

    `until` is a time of `time.perf_counter`.
    """
    spent = 0.0
    while len(reference) and reference.error > error and reference.paths < most:
        begun = time.perf_counter()
        if begun + 2 * spent >= until:
            break
        reference = reference.walk(2 * reference.paths)
        spent = time.perf_counter() - begun
    return reference


@dataclass(frozen=True)
class Errors:
    """Error of a grid against a reference, relative to the mean irradiance."""

    rmse: float  # root mean square, without the reference's variance; at least a third of the reference's own error
    uncertain: float  # standard error of `rmse`, from the spread over the points
    median: float  # like p95, a quantile over points of the root mean square over colours
    p95: float
    bias: float  # mean difference; negative if the grid is too dark


def errors(light: Floats, reference: Reference) -> Errors:
    """Error of `light` (n, 3), looked up at the points of a reference."""
    off = (light - reference.light) / reference.mean
    square = (off**2).mean(axis=1)
    each, own = np.sqrt(square), reference.error
    rmse = float(np.sqrt(max(own**2 / 9, square.mean() - own**2)))
    spread = float(square.std() / np.sqrt(len(square)))
    median, p95 = np.quantile(each, (0.5, 0.95)).tolist()
    return Errors(rmse, spread / (2 * rmse) if rmse > 0 else 0.0, median, p95, float(off.mean()))


@dataclass(frozen=True)
class Parts:
    """The mean squared error of a grid in parts, each measured; all relative to the squared mean irradiance."""

    noise: float  # half the mean squared difference of two grids from independent seeds
    # Error of interpolation between nodes, at points whose nodes all have light of their own: the mean product of the
    # two grids' errors, in which noise cancels. Where it is 0, the estimate may be slightly negative.
    grid: float
    uncovered: float  # the same at points that read a node without support
    bounces: float  # mean square of the light that more bounces add at the points themselves
    cross: float  # total less the other four: the grid's error and the missing bounces are correlated
    uncertain: float  # standard error of `grid`, from the spread over the points

    @property
    def total(self) -> float:
        """Mean squared error."""
        return max(0.0, self.noise + self.grid + self.uncovered + self.bounces + self.cross)


def parts_of(one: Floats, other: Floats, covered: NDArray[np.bool_], fewer: Reference, reference: Reference) -> Parts:
    """Split the error of a grid into parts, from the light (n, 3) of two with different seeds at a reference's points.

    `covered` (n,) marks points whose nodes all have light of their own; `fewer` is the reference from the same
    paths, cut off after as many bounces as the grids had.
    """
    light, mean = fewer.light, reference.mean
    first, second = (one - light) / mean, (other - light) / mean
    more = (reference.light - fewer.light) / reference.mean
    # Both errors contain that of the reference, whose variance is therefore subtracted.
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
