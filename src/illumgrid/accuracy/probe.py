"""The error of a grid of some size, before it is built.

`Direct` asks at nodes, so the light that a grid of any size would hold at a point is known from the eight nodes around
that point alone. The probe lights those for some points on grids of many sizes and compares with the light at the
points: that measures the error of a grid without building it.
"""

import time
from dataclasses import dataclass, field

import numpy as np

from illumgrid.accuracy.around import around
from illumgrid.accuracy.cost import Pace
from illumgrid.accuracy.points import unseen_in_volume
from illumgrid.accuracy.reference import Parts, Reference, begin, converge, parts_of
from illumgrid.bake.accumulator import Bake
from illumgrid.bake.ahead import Ahead
from illumgrid.bake.bounces import enough_bounces
from illumgrid.errors import BadInput
from illumgrid.field.scene import Scene
from illumgrid.rng import shifted_seed
from illumgrid.transport.tracer import Tracer

FEWEST_PATHS, MOST_PATHS = 4, 1 << 16  # from each node of a planned run


@dataclass(frozen=True)
class Measured:
    """The error of grids of one size with one number of paths, in parts."""

    grid: int  # nodes along the longest axis
    nodes: int  # to light, in all
    parts: Parts
    paths: int
    falls: float = 1.0  # the noise (squared) falls as paths to this power; more than 1 for well-spread paths
    pace: Pace | None = None  # of its own, where a first look chose the nodes

    @property
    def looked(self) -> bool:
        """Whether a first look chose the nodes, from a lattice of `grid`."""
        return self.pace is not None

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
    fewer: dict[int, Reference] = field(default_factory=dict)  # the same with fewer bounces

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
        return cls(scene, seed, converge(first, error, most))

    def cut_off(self, bounces: int) -> Reference:
        """The reference by the same paths, ended after fewer bounces."""
        if bounces not in self.fewer:
            self.fewer[bounces] = self.reference.cut_off(bounces)
        return self.fewer[bounces]

    def measure(self, ahead: Ahead, paths: int) -> Measured:
        """The error of a run before it is built, by `paths` paths from two seeds each."""
        clock, parts = [time.perf_counter()], list[Parts]()
        near = around(self.scene, ahead, self.reference.queries)
        clock.append(time.perf_counter())
        pair = [Bake.of([near.asked], ahead.bounces, seed) for seed in (self.seed, shifted_seed(self.seed, 2**62))]
        fewer = self.reference if ahead.cached else self.cut_off(ahead.bounces)  # in known light paths have no end
        # How fast noise falls is seen by a quarter of the paths; of a first look there are too few.
        for walked in [range(paths)] if ahead.refined else [range(paths // 4), range(paths // 4, paths)]:
            pair = [bake.walk(ahead.tracer, walked) for bake in pair]
            clock.append(time.perf_counter())
            (one, covered), (other, _) = (near.read(bake.samples) for bake in pair)
            parts.append(parts_of(one, other, covered, fewer, self.reference))
        longest, first, last = max(max(spec.shape) for spec in ahead.specs), parts[0], parts[-1]
        if ahead.refined:
            asking, walking, reading = np.diff([*clock, time.perf_counter()]) / max(1, len(near.asked))
            pace, grid = Pace(asking + reading / 2, walking / (2 * paths)), (longest - 1 >> ahead.refined["levels"]) + 1
            return Measured(grid, near.nodes, last, paths, pace=pace)
        falls = np.log(first.noise / last.noise) / np.log(4) if min(first.noise, last.noise) > 0 else 1.0
        return Measured(longest, near.nodes, last, paths, float(np.clip(falls, 0.8, 1.6)))
