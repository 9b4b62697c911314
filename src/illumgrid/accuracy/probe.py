"""Measure error and time of a run of a given size without building its grid.

The light that a grid would have at a point follows from the nodes around it; of a lattice with the queries of `Direct`,
these are eight. The probe lights the nodes around some points and compares the interpolated light with a reference at
these points.
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
    """The error of a run of one size with one number of paths, in parts, and its time."""

    grid: int  # nodes along the longest axis, of the lattice that is lit or that of the first look
    nodes: int  # to light, in total
    parts: Parts
    paths: int
    node: float  # seconds per node, without its paths
    path: float  # seconds per path of a node
    falls: float = 1.0  # variance of noise falls with this power of the paths; above 1 if well spread

    @property
    def floor(self) -> float:
        """Mean squared error that more paths cannot reduce, plus one standard error, since few points may carry it."""
        return float(max(0.0, self.parts.total - self.parts.noise) + self.parts.uncertain)

    def squared(self, paths: int) -> float:
        """Predicted mean squared error with this many paths."""
        return float(self.floor + self.parts.noise * (self.paths / paths) ** self.falls)

    def paths_for(self, squared: float) -> int | None:
        """Fewest paths that are predicted to reach a mean squared error; None if no number does."""
        return self.paths_within(squared - self.floor) if squared > self.floor else None

    def paths_within(self, noise: float) -> int:
        """Fewest paths whose noise is predicted to have at most this mean square."""
        needed = self.paths * (self.parts.noise / noise) ** (1 / self.falls)
        return min(MOST_PATHS, max(FEWEST_PATHS, 2 * int(np.ceil(needed / 2))))

    def seconds(self, nodes: int, paths: int) -> float:
        """Predicted time of this many nodes with this many paths each."""
        return nodes * (self.node + paths * self.path)

    def paths_in(self, seconds: float, nodes: int) -> int:
        """Paths per node that the time allows, an even number; 0 or negative if it allows none."""
        return min(MOST_PATHS, 2 * int((seconds / nodes - self.node) / self.path / 2))


@dataclass(frozen=True, eq=False)
class Probe:
    """A reference at points of a scene, with which runs are compared."""

    scene: Scene
    seed: int
    reference: Reference
    fewer: dict[int, Reference] = field(default_factory=dict)  # by bounces: the same paths, cut off after fewer

    @classmethod
    def start(cls, scene: Scene, tracer: Tracer, points: int, error: float, seed: int, most: int = 128) -> "Probe":
        """Light some points well enough to measure an `error`, with bounces that omit at most a tenth of it.

        The reference's variance is subtracted wherever it is used, so its own error may be as large as the one that is
        measured. It has at most `most` paths: more points say more than a more accurate reference at each.
        """
        followed, _ = enough_bounces(scene, tracer, seed, 0.1 * error)
        first = begin(tracer, unseen_in_volume(scene, points, seed), followed, seed)
        if not first.mean > 0:
            raise BadInput("no light reaches the surfaces of this scene; expected a background or a lamp that does")
        return cls(scene, seed, converge(first, error, most))

    def cut_off(self, bounces: int) -> Reference:
        """The reference from the same paths, cut off after fewer bounces."""
        if bounces not in self.fewer:
            self.fewer[bounces] = self.reference.cut_off(bounces)
        return self.fewer[bounces]

    def measure(self, ahead: Ahead, paths: int) -> Measured:
        """Measure error and time of a run without building it, from `paths` paths with each of two seeds."""
        fewer = self.reference if ahead.cached else self.cut_off(ahead.bounces)  # ending in a cache omits no bounces
        begun, parts = time.perf_counter(), list[Parts]()
        near = around(self.scene, ahead, self.reference.queries)
        asking, walking, reading = time.perf_counter() - begun, 0.0, 0.0
        pair = [Bake.of([near.asked], ahead.bounces, seed) for seed in (self.seed, shifted_seed(self.seed, 2**62))]
        # A quarter of the paths shows how fast noise falls; after a first look there are too few for that.
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
