"""The error of a run of some size, before it is built.

The light that a grid would hold at a point is known from the nodes around it: of a lattice whose nodes `Direct` asks,
from eight. The probe lights those for some points and compares with the light at the points: that measures the error of
a run, and its time, without building it.
"""

import time
from dataclasses import dataclass, field

import numpy as np

from illumgrid.accuracy.points import unseen_in_volume
from illumgrid.accuracy.reference import Parts, Reference, begin, converge, parts_of
from illumgrid.bake.accumulator import Bake
from illumgrid.bake.ahead import Ahead, nodes_to_light
from illumgrid.bake.around import around
from illumgrid.bake.bounces import enough_bounces
from illumgrid.errors import BadInput
from illumgrid.field.lattice import along_longest
from illumgrid.field.scene import Scene
from illumgrid.rng import shifted_seed
from illumgrid.transport.tracer import Tracer

FEWEST_PATHS, MOST_PATHS = 4, 1 << 16  # from each node of a planned run


@dataclass(frozen=True)
class Measured:
    """The error of runs of one size with one number of paths, in parts, and their time."""

    grid: int  # nodes along the longest axis, of the lattice that is lit or that a first look is taken at
    nodes: int  # to light, in all
    parts: Parts
    paths: int
    node: float  # seconds for each node
    path: float  # and for each path of a node
    falls: float = 1.0  # the noise (squared) falls as paths to this power; more than 1 for well-spread paths

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

    def seconds(self, nodes: int, paths: int) -> float:
        """Predicted time of so many nodes."""
        return nodes * (self.node + paths * self.path)

    def paths_in(self, seconds: float, nodes: int) -> int:
        """Paths from each of the nodes that the time allows, an even number; below 0 if it allows none."""
        return min(MOST_PATHS, 2 * int((seconds / nodes - self.node) / self.path / 2))


@dataclass(frozen=True, eq=False)
class Probe:
    """Points of a scene at which light is known, to measure runs against."""

    scene: Scene
    seed: int
    reference: Reference
    fewer: dict[int, Reference] = field(default_factory=dict)  # the same with fewer bounces

    @classmethod
    def start(cls, scene: Scene, tracer: Tracer, points: int, error: float, seed: int, most: int = 128) -> "Probe":
        """Light some points well enough to judge an `error`, with paths so long that a tenth of it is left out.

        The reference's own variance is subtracted wherever it is used, so it may be as large as the error judged. It
        has at most `most` paths: more points tell more than a sharper reference at each.
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
        """The error of a run before it is built, by `paths` paths from two seeds each, and its time."""
        fewer = self.reference if ahead.cached else self.cut_off(ahead.bounces)  # in known light paths have no end
        begun, parts = time.perf_counter(), list[Parts]()
        near = around(self.scene, ahead, self.reference.queries)
        asking, walking, reading = time.perf_counter() - begun, 0.0, 0.0
        pair = [Bake.of([near.asked], ahead.bounces, seed) for seed in (self.seed, shifted_seed(self.seed, 2**62))]
        # How fast noise falls is seen by a quarter of the paths; of a first look there are too few.
        rounds = [range(paths)] if ahead.refined else [range(paths // 4), range(paths // 4, paths)]
        for walked in rounds:
            begun = time.perf_counter()
            pair = [bake.walk(ahead.tracer, walked) for bake in pair]
            lit = time.perf_counter()
            (one, covered), (other, _) = (near.read(bake.samples) for bake in pair)
            walking, reading = walking + lit - begun, reading + time.perf_counter() - lit
            parts.append(parts_of(one, other, covered, fewer, self.reference))
        (first, *_, last), many = (parts[0], *parts), max(1, len(near.asked))
        falls = np.log(first.noise / last.noise) / np.log(4) if min(first.noise, last.noise) > 0 else 1.0
        longest = (along_longest(ahead.specs) - 1 >> ahead.levels) + 1
        return Measured(
            longest, nodes_to_light(self.scene, ahead), last, paths,
            node=(asking + reading / (2 * len(rounds))) / many, path=walking / (2 * paths * many),
            falls=1.0 if ahead.refined else float(np.clip(falls, 0.8, 1.6)),
        )  # fmt: skip
