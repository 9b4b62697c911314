"""The error of a grid of some size, before it is built.

`Direct` asks at nodes, so the light that a grid of any size would hold at a point is known from the eight nodes around
that point alone. The probe lights those for some points on grids of many sizes and compares with the light at the
points: that measures the error of a grid without building it.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from illumgrid.accuracy.cost import Pace
from illumgrid.accuracy.looked import Around
from illumgrid.accuracy.points import unseen_in_volume
from illumgrid.accuracy.reference import Parts, Reference, begin, converge, missing, parts_of
from illumgrid.bake.accumulator import Bake
from illumgrid.bake.ahead import Ahead
from illumgrid.bake.bounces import enough_bounces
from illumgrid.errors import BadInput
from illumgrid.field.scene import Scene
from illumgrid.grid import GridSpec
from illumgrid.rng import shifted_seed
from illumgrid.samplers.direct import Corners, corners
from illumgrid.transport.tracer import Tracer

FEWEST_PATHS, MOST_PATHS = 4, 1 << 16  # from each node of a planned run
BOUNCES = (0, 1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48, 64, 96, 128)


@dataclass(frozen=True)
class Measured:
    """The error of grids of one size with one number of paths, in parts."""

    grid: int  # nodes along the longest axis
    nodes: int  # to light, in all
    parts: Parts
    paths: int
    falls: float = 1.0  # the noise (squared) falls as paths to this power; more than 1 for well-spread paths
    looked: bool = False  # whether these nodes are those of a first look, which chose the nodes to light
    pace: Pace | None = None  # of its own, if other than that of lattices

    @property
    def floor(self) -> float:
        """Mean squared error at any number of paths, and one standard error more: few points may carry it."""
        return float(max(0.0, self.parts.total - self.parts.noise) + self.parts.uncertain)

    def squared(self, paths: int) -> float:
        """Predicted mean squared error with this many paths."""
        return float(self.floor + self.parts.noise * (self.paths / paths) ** self.falls)

    def paths_for(self, squared: float) -> int | None:
        """Fewest paths that are predicted to reach a mean squared error; None if none do."""
        return self.paths_within(squared - self.floor) if squared > self.floor else None

    def paths_within(self, noise: float) -> int:
        """Fewest paths whose noise is predicted to have at most this mean square."""
        needed = self.paths * (self.parts.noise / noise) ** (1 / self.falls)
        return min(MOST_PATHS, max(FEWEST_PATHS, 2 * int(np.ceil(needed / 2))))


@dataclass(frozen=True, eq=False)
class Probe:
    """Points of a scene at which light is known, to measure grids against."""

    scene: Scene
    seed: int
    reference: Reference
    few: Reference  # some points with fewer paths: enough to see what bounces add, since both sides walk the same

    @classmethod
    def start(cls, scene: Scene, tracer: Tracer, points: int, error: float, seed: int, most: int = 1024) -> "Probe":
        """Light some points well enough to judge an `error`, with paths so long that a tenth of it is left out.

        The reference's own variance is subtracted wherever it is used, so it may be as large as the error judged; it
        has at most `most` paths.
        """
        followed, _ = enough_bounces(scene, tracer, seed, 0.1 * error)
        first = begin(tracer, unseen_in_volume(scene, points, seed), followed, seed)
        if not first.mean > 0:
            raise BadInput("no light reaches the surfaces of this scene; expected a background or a lamp that does")
        few = first[:: max(1, len(first) // 512)]
        return cls(scene, seed, converge(first, error, most), few)

    def fewer(self, bounces: int) -> Reference:
        """The light at the points with fewer bounces, by the same paths."""
        return self.reference.cut_off(bounces)

    def left_out(self, bounces: int) -> float:
        """Root mean square of the light that more bounces would add, relative."""
        return float(np.sqrt((missing(self.few.cut_off(bounces), self.few) ** 2).mean()))

    def bounces_for(self, tolerance: float) -> int:
        """Fewest bounces that leave out less than a `tolerance`."""
        most = self.reference.bounces
        return next((b for b in BOUNCES if b < most and self.left_out(b) <= tolerance), most)

    def measure(self, specs: Sequence[GridSpec], fewer: Reference, paths: int) -> Measured:
        """The error of grids with these lattices and the bounces of `fewer`, by `paths` paths from two seeds each."""
        around, tracer = corners(self.scene, specs, self.reference.queries), self.reference.tracer
        some = self._walked(around, tracer, fewer.bounces, range(paths // 4))
        first, last = (
            self._parts(around, pair, fewer)
            for pair in (some, [bake.walk(tracer, range(paths // 4, paths)) for bake in some])
        )
        falls = np.log(first.noise / last.noise) / np.log(4) if min(first.noise, last.noise) > 0 else 1.0
        grid = max(max(spec.shape) for spec in specs)
        return Measured(grid, around.nodes, last, paths, float(np.clip(falls, 0.8, 1.6)))

    def measure_looked(self, longest: int, ahead: Ahead, bounces: int, fewer: Reference, paths: int) -> Measured:
        """The error of a run whose nodes a first look at a lattice chose: see `measure`."""
        clock = [time.perf_counter()]
        around = Around(self.scene, ahead, self.reference.queries)
        clock.append(time.perf_counter())
        pair = self._walked(around, ahead.tracer, bounces, range(paths))
        clock.append(time.perf_counter())
        parts = self._parts(around, pair, fewer)
        clock.append(time.perf_counter())
        asking, walking, reading = np.diff(clock) / max(1, len(around.asked))
        pace = Pace(asking + reading / 2, walking / (2 * paths))
        return Measured(longest, around.nodes, parts, paths, looked=True, pace=pace)

    def _walked(self, around: Corners | Around, tracer: Tracer, bounces: int, paths: range) -> list[Bake]:
        seeds = self.seed, shifted_seed(self.seed, 2**62)
        return [Bake.of([around.asked], bounces, seed).walk(tracer, paths) for seed in seeds]

    def _parts(self, around: Corners | Around, pair: Sequence[Bake], fewer: Reference) -> Parts:
        (one, covered), (other, _) = (around.read(bake.samples) for bake in pair)
        return parts_of(one, other, covered, fewer, self.reference)
