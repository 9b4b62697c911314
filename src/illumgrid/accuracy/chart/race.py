"""The race: who is how far off after how many seconds, cheapest and most promising first, within a budget."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from illumgrid.accuracy.chart.contestants import COUNTS, Way
from illumgrid.accuracy.chart.picture import Studio
from illumgrid.accuracy.probe import corners, specs_of
from illumgrid.accuracy.truth import Truth, errors, look_up
from illumgrid.errors import BadInput
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats
from illumgrid.grid import GridSpec, IlluminationGrid, Nodes
from illumgrid.stages import Interpolator
from illumgrid.transport.samples import Queries, Samples, combine, join_samples
from illumgrid.transport.stages import fill_nodes

PATHS = (8, 32, 128, 512, 2048)
"""Of the rungs of a lane: `run`'s default is one of them."""

SEEDS = 3


@dataclass(eq=False)
class Point:
    """One contestant at one setting: a point of the chart, of as many runs as there are seeds.

    Parameters
    ----------
    way : Way
    interpolator : Interpolator
    grid, paths, queries : int
    seconds : list of float
        One a seed: sampler, backend and interpolator.
    filling : float
        Of those of the first seed, what the interpolator took.
    light : list of (n, 3) float64
        One a seed: what the grids hold at the points of the truth.
    covered : (n,) bool
        Points that read only nodes with light of their own.
    memory : float, optional
        Megabytes by which the process grew at most, in one run; known on Linux.
    flip : float, optional
        Of a picture at an unseen isovalue.
    default : bool
        Whether it is what `run` does when nothing is asked for.
    built : bool
        Whether the grid was built; if not, `seconds` are predicted, and only the nodes around the points were lit.
    """

    way: Way
    interpolator: Interpolator
    grid: int
    paths: int
    queries: int
    covered: NDArray[np.bool_]
    seconds: list[float] = field(default_factory=list)
    filling: float = 0.0
    light: list[Floats] = field(default_factory=list)
    memory: float | None = None
    flip: float | None = None
    default: bool = False
    built: bool = True

    @property
    def label(self) -> str:
        """Name of the contestant."""
        return self.way.label(self.interpolator)

    @property
    def time(self) -> float:
        """Median seconds over the seeds."""
        return float(np.median(self.seconds))

    def rmse(self, truth: Truth) -> float:
        """Relative root mean square error, the mean over the seeds."""
        return float(np.mean([errors(light, truth).rmse for light in self.light]))


@dataclass(eq=False)
class Run:
    """A way on a grid with one seed, that goes on with more paths: earlier ones are kept."""

    scene: Scene
    way: Way
    grid: int
    bounces: int
    seed: int
    batches: list[Queries] = field(default_factory=list)
    answers: list[Samples] = field(default_factory=list)
    paths: int = 0
    asking: float = 0.0
    tracing: float = 0.0

    @property
    def specs(self) -> list[GridSpec]:
        """Lattices, one a field."""
        return specs_of(self.scene, self.grid)

    def go_on(self, paths: int) -> None:
        """Trace until each query has so many paths."""
        if paths <= self.paths:
            return
        begun = time.perf_counter()
        if not self.batches:
            self.batches = [q for q in self.way.sampler.queries(self.scene, self.specs, self.seed) if len(q)]
            self.asking = time.perf_counter() - begun
            begun = time.perf_counter()
        more = range(self.paths, paths)
        new = [
            self.way.backend.solve(self.scene, batch, paths=more, bounces=self.bounces, seed=self.seed)
            for batch in self.batches
        ]
        self.answers = [combine(a, b) for a, b in zip(self.answers, new)] if self.answers else new
        self.paths = paths
        self.tracing += time.perf_counter() - begun

    def fill(self, interpolator: Interpolator) -> tuple[list[IlluminationGrid], float]:
        """Grids from the samples so far, and the seconds that this took, all in all."""
        begun = time.perf_counter()
        grids = []
        for number, spec in enumerate(self.specs):
            own = [a for a in self.answers if len(a) and a.queries.target[0] == number]
            grids.append(fill_nodes(interpolator, join_samples(own), Nodes(spec, self.scene.fields[number], number)))
        return grids, self.asking + self.tracing + time.perf_counter() - begun


def covered(grids: list[IlluminationGrid], asked: Queries) -> NDArray[np.bool_]:
    """Points that read only nodes with light of their own."""
    result = np.zeros(len(asked), bool)
    for number, grid in enumerate(grids):
        own = asked.target == number
        result[own] = grid.covered(asked.point[own])
    return result


def front(points: Iterable[Point], truths: dict[str, Truth]) -> list[Point]:
    """Points that nobody beats in both time and error, from fast to accurate."""
    best, found = np.inf, []
    for point in sorted(points, key=lambda p: p.time):
        if (rmse := point.rmse(truths[point.way.surface])) < best:
            best = rmse
            found.append(point)
    return found


@dataclass(eq=False)
class Lane:
    """A way on one grid: what its next step would cost, and the points by which its hopes are judged.

    Those are its own last ones, or before its first step those of the lane that it came from, with a factor on the lag.
    """

    run: Run
    interpolators: tuple[Interpolator, ...]
    rung: int = 0
    cost: float = 0.0
    hopes: tuple[Point, ...] = ()
    factor: float = 1.0
    stuck: bool = False
    first: bool = True


def lag(point: Point, error: dict[Point, float]) -> float:
    """How much less time would do: that of the quickest as good, or what noise takes to become as good as the best.

    Noise halves with four times the paths, hence the square of the error over the least of any no slower.
    """
    own = error[point]
    lead = min(e for p, e in error.items() if p.time <= 1.05 * point.time)
    quick = min(p.time for p, e in error.items() if e <= 1.05 * own)
    return float(max(1.0, (own / lead) ** 2, point.time / quick))


class Race:
    """Lanes of ways on grids, stepped one at a time.

    Parameters
    ----------
    scene : Scene
    truths : dict of Truth
        By surface.
    ways : sequence of Way
    sizes : sequence of int
        Grids, from coarse to fine.
    bounces, seed : int
    """

    def __init__(
        self, scene: Scene, truths: dict[str, Truth], ways: list[Way], sizes: list[int], bounces: int, seed: int
    ) -> None:
        self.scene, self.truths, self.sizes, self.bounces, self.seed = scene, truths, sizes, bounces, seed
        # Until it has run, a slow backend counts as off the front by its slowness. The first lane tells what the others
        # will cost: one that builds no meshes.
        self.lanes = [
            Lane(Run(scene, way, sizes[0], bounces, seed), way.interpolators, factor=way.slow)
            for way in sorted(ways, key=lambda way: (way.surface != "levelset", way.slow))
        ]
        self.points: list[Point] = []
        self.notes: list[str] = []

    def show_default(self, way: Way, nearest: Interpolator, grid: int, paths: int) -> None:
        """Chart what `run` does when nothing is asked for, before all others; its lane goes on from there."""
        run = Run(self.scene, way, grid, self.bounces, self.seed)
        run.go_on(paths)
        point, _ = self._point(run, nearest)
        point.default = True
        self.points.append(point)
        rung = sum(fewer < paths for fewer in PATHS)
        if rung < len(PATHS):
            cost = point.time - run.tracing + run.tracing * (PATHS[rung] / paths - 1)
            self.lanes.append(Lane(run, way.interpolators, rung, cost, (point,), first=grid in self.sizes))

    def foresee(
        self, way: Way, nearest: Interpolator, grid: int, paths: int, takes: float, default: bool = False
    ) -> None:
        """Chart a grid of `Direct` by the nodes around the truth's points, which hold what they would in all of it."""
        around = corners(self.scene, grid, self.truths[way.surface].queries)
        found = []
        for k in range(SEEDS):
            seed = (self.seed + k) % 2**64
            found.append(around.read(way.backend.solve(
                self.scene, around.asked, paths=range(paths), bounces=self.bounces, seed=seed
            )))  # fmt: skip
        point = Point(way, nearest, grid, paths, around.nodes, found[0][1], default=default, built=False)
        point.seconds, point.light = [takes] * len(found), [light for light, _ in found]
        self.points.append(point)

    def step(self, lane: Lane) -> None:
        """Take the next rung of a lane, and fill the grid by every interpolator."""
        run, paths = lane.run, PATHS[lane.rung]
        begun = time.perf_counter()
        try:
            run.go_on(paths)
            same = [p for p in self.points if p.way is run.way and (p.grid, p.paths) == (run.grid, paths)]
            known = {p.interpolator: p for p in same if p.built}
            new = [known.get(filler) or self._point(run, filler)[0] for filler in lane.interpolators]
        except BadInput as reason:
            self.notes.append(f"{run.way.label(run.way.interpolators[0])}, {run.grid} nodes: {reason}")
            self.lanes.remove(lane)
            return
        spent = time.perf_counter() - begun
        for other in self.lanes:
            if other.cost == 0.0:  # nobody has run before this one
                other.cost = spent * other.run.way.slow / run.way.slow
        truth = self.truths[run.way.surface]
        before = [p for p in self.points if p.way is run.way and p.grid == run.grid and p.paths == PATHS[lane.rung - 1]]
        self.points = [p for p in self.points if p.built or p not in same]  # built is better than foreseen
        self.points += [p for p in new if p.interpolator not in known]
        now, standing = [p.rmse(truth) for p in new], self._standing()
        lane.hopes, lane.factor = tuple(new), 1.0
        light, least = run.asking + run.tracing, self._lag(lane, standing)
        fillers = {p.interpolator: p.filling for p in new}
        for p in new:  # a slow filler that is also far off holds the others up
            if fillers[p.interpolator] > 0.5 * light and lag(p, standing) > max(4.0, 2.0 * least):
                del fillers[p.interpolator]
        lane.interpolators = tuple(fillers)
        lane.stuck = bool(before) and min(now) > 0.9 * min(p.rmse(truth) for p in before)
        lane.rung += 1
        if lane.rung < len(PATHS):
            lane.cost = run.tracing * (PATHS[lane.rung] / paths - 1) + sum(fillers.values())
        if lane.first:
            lane.first = False
            self._unlock(lane, spent)

    def _unlock(self, lane: Lane, spent: float) -> None:
        """What comes after the first rung of a lane: the next finer grid, and on the coarsest more level sets."""
        run = lane.run
        finer = [size for size in self.sizes if size > run.grid]
        if finer and not any(other.run.way is run.way and other.run.grid == finer[0] for other in self.lanes):
            # Twice the nodes may halve the error, for which noise would need four times the paths: so much sooner.
            more = finer[0] / run.grid
            ahead = Run(self.scene, run.way, finer[0], self.bounces, self.seed)
            self.lanes.append(Lane(ahead, lane.interpolators, 0, spent * more**3, lane.hopes, 1 / more**2))
        if run.way.denser and run.grid == self.sizes[0]:
            ahead = Run(self.scene, run.way.denser, run.grid, self.bounces, self.seed)
            self.lanes.append(Lane(ahead, lane.interpolators, 0, spent * COUNTS[1] / COUNTS[0], lane.hopes))

    def _point(self, run: Run, interpolator: Interpolator) -> tuple[Point, list[IlluminationGrid]]:
        grids, seconds = run.fill(interpolator)
        asked = self.truths[run.way.surface].queries
        queries = sum(len(a) for a in run.answers)
        point = Point(run.way, interpolator, run.grid, run.paths, queries, covered(grids, asked))
        point.seconds.append(seconds)
        point.filling = seconds - run.asking - run.tracing
        point.light.append(look_up(grids, asked))
        return point, grids

    def _standing(self) -> dict[Point, float]:
        """Errors of all points."""
        return {p: max(1e-9, p.rmse(self.truths[p.way.surface])) for p in self.points}

    def _lag(self, lane: Lane, standing: dict[Point, float]) -> float:
        """How much slower than the front a lane is to be expected."""
        return lane.factor * min((lag(p, standing) for p in lane.hopes), default=1.0)

    def next(self, left: float) -> Lane | None:
        """The lane to step: least predicted time, those who lag counted as slower; None if the rest is too costly.

        What the seeds will cost that the front still lacks is kept back.
        """
        kept = 1.1 * (SEEDS - 1) * sum(self.front_ladders().values())
        able = [lane for lane in self.lanes if not lane.stuck and lane.rung < len(PATHS)]
        able = [lane for lane in able if kept + SEEDS * lane.cost < left or lane.cost == 0.0]
        standing = self._standing()
        return min(able, key=lambda lane: (lane.cost * self._lag(lane, standing), lane.run.grid), default=None)

    def front_ladders(self) -> dict[tuple[int, int, int], float]:
        """Way, grid and most paths of the front's points that lack seeds, with the seconds that one more seed takes."""
        best = front(self.points, self.truths)
        found: dict[tuple[int, int], Point] = {}
        for point in best:
            key = id(point.way), point.grid
            if point.built and len(point.seconds) < SEEDS and (key not in found or found[key].paths < point.paths):
                found[key] = point
        return {
            (*key, p.paths): p.time - p.filling + sum(q.filling for q in self._ladder(best, *key, p.paths))
            for key, p in found.items()
        }

    def _ladder(self, best: list[Point], way: int, grid: int, most: int) -> list[Point]:
        """What is run again together: a way on a grid, with so many paths or fewer, by the fillers of the front."""
        fillers = {p.interpolator for p in best}
        same = [p for p in self.points if id(p.way) == way and p.grid == grid and p.paths <= most and p.built]
        return [p for p in same if p.interpolator in fillers]

    def repeat(self, deadline: float, tell: Callable[[], None], studio: Studio | None = None) -> None:
        """Run what the front consists of with other seeds, until every point on it has enough of them."""
        while ladders := self.front_ladders():
            way, grid, most = min(ladders, key=lambda key: ladders[key])
            if time.perf_counter() + ladders[way, grid, most] > deadline:
                return
            same = self._ladder(front(self.points, self.truths), way, grid, most)
            again = max(len(p.seconds) for p in same if p.paths == most)
            seed = (self.seed + again) % 2**64
            run, before = Run(self.scene, same[0].way, grid, self.bounces, seed), resident(reset=True)
            for paths in sorted({p.paths for p in same}):
                run.go_on(paths)
                for point in same:
                    if point.paths == paths and len(point.seconds) == again:
                        new, grids = self._point(run, point.interpolator)
                        point.seconds += new.seconds
                        point.light += new.light
                        point.memory = (resident() or 0.0) - before if before else None
                        if studio and point.flip is None:
                            point.flip = studio.flip(grids)
            tell()


def resident(reset: bool = False) -> float | None:
    """Megabytes that the process held at most since the last reset; None where the system does not tell."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        lines = Path("/proc/self/status").read_text("utf-8").splitlines()
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        return None
