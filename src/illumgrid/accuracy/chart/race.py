"""The race: error and seconds of every method, the cheapest and most promising first, within a budget."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from illumgrid.accuracy.chart.contestants import COUNTS, Method
from illumgrid.accuracy.reference import Reference, errors
from illumgrid.bake.accumulator import Bake
from illumgrid.bake.ahead import Ahead, looked, nodes_to_light
from illumgrid.bake.around import around, look_up
from illumgrid.bake.targets import filled
from illumgrid.constants import BASE, DENSITY
from illumgrid.errors import BadInput
from illumgrid.field.lattice import along_longest, specs_over
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats
from illumgrid.grid import IlluminationGrid
from illumgrid.rng import shifted_seed
from illumgrid.stages import Interpolator

STEPS = (8, 32, 128, 512, 2048)  # paths; `run`'s default is one of them
SEEDS = 3

Flip = Callable[[list[IlluminationGrid]], float]  # visible difference of a picture of grids from the converged one


@dataclass(eq=False)
class Point:
    """A method with an interpolator at one setting: a point of the chart, with one run per seed."""

    method: Method
    interpolator: Interpolator
    grid: int | None  # nodes along the longest axis of every field; None: the default of `run`
    paths: int
    queries: int
    covered: NDArray[np.bool_]  # (n,) points that read only nodes with light of their own
    longest: int = 0  # nodes along the longest axis of all fields
    seconds: list[float] = field(default_factory=list)  # one per seed: sampler, backend and interpolator
    filling: float = 0.0  # of the seconds of the first seed, those of the interpolator
    light: list[Floats] = field(default_factory=list)  # one per seed, (n, 3): light of the grids at the points
    memory: float | None = None  # largest growth of the process in one run, in megabytes; on Linux only
    flip: float | None = None  # of a picture at an unseen isovalue
    default: bool = False  # whether it is the default of `run`
    built: bool = True  # else only nodes around the points were lit, and `seconds` are predicted

    @property
    def time(self) -> float:
        """Median seconds over the seeds."""
        return float(np.median(self.seconds))

    def rmse(self, reference: Reference) -> float:
        """Relative root mean square error, the mean over the seeds."""
        return float(np.mean([errors(light, reference).rmse for light in self.light]))


class Run:
    """A method on one size of grid with one seed, to which more paths are added step by step.

    In a race it is a contestant, with the cost of its next step and a measure of how promising it is.
    """

    def __init__(self, scene: Scene, method: Method, grid: int | None, bounces: int, seed: int) -> None:
        self.scene, self.method, self.grid, self.seed = scene, method, grid, seed
        specs = specs_over(scene, grid, BASE if method.looked else DENSITY)
        self.longest = along_longest(specs)
        self.ahead = Ahead(specs, method.sampler, method.tracer, method.interpolators[0], bounces=bounces)
        self.bake = Bake.of([], bounces, seed)
        self.asking = self.tracing = 0.0
        self.interpolators = method.interpolators
        self.step = 0  # index into STEPS of the next step; beyond them, or none, at the end
        self.cost = 0.0  # of that step, predicted
        # Until it has run, a slow backend counts as behind the front by its slowness.
        self.factor = method.slow  # on the slowdown of `ranked_by`
        self.ranked_by: Sequence[Point] = ()  # its own last points; at first those of the run that it derives from

    def look(self) -> Ahead:
        """Take the first look of a method that has one."""
        if self.method.looked:
            self.ahead = looked(self.scene, self.method.tracer, self.grid, None, self.seed)
        return self.ahead

    def go_on(self, paths: int | None) -> None:
        """Trace until each query has this many paths, by default as many as `run` takes after a first look."""
        begun = time.perf_counter()
        if not self.bake.targets:
            ahead = self.look()
            asked = [q for q in ahead.sampler.queries(self.scene, ahead.specs, self.seed) if len(q)]
            self.bake = Bake.of(asked, ahead.bounces, self.seed)
            self.asking = time.perf_counter() - begun
            begun = time.perf_counter()
        paths = paths or self.ahead.paths
        if paths > self.bake.paths:
            self.bake = self.bake.walk(self.ahead.tracer, range(self.bake.paths, paths))
            self.tracing += time.perf_counter() - begun

    def fill(self, interpolator: Interpolator) -> tuple[list[IlluminationGrid], float]:
        """Grids from the samples so far, and the seconds that the interpolator took."""
        begun = time.perf_counter()
        filler = self.ahead.interpolator if self.method.looked else interpolator
        grids = list(filled(self.scene, self.ahead.specs, filler, self.bake.answers))
        return grids, time.perf_counter() - begun


def front(points: Iterable[Point], references: dict[str, Reference]) -> list[Point]:
    """The Pareto front: points that no other beats in both time and error, from fast to accurate."""
    best, found = np.inf, []
    for point in sorted(points, key=lambda p: p.time):
        if (rmse := point.rmse(references[point.method.surface])) < best:
            best = rmse
            found.append(point)
    return found


def slowdown(point: Point, error: dict[Point, float]) -> float:
    """Relative to the front: time ratio at equal error, or squared-error ratio at equal time, whichever is larger."""
    own = error[point]  # its ratio is squared, as noise halves with four times the paths
    least = min(e for p, e in error.items() if p.time <= 1.05 * point.time)
    quick = min(p.time for p, e in error.items() if e <= 1.05 * own)
    return float(max(1.0, (own / least) ** 2, point.time / quick))


@dataclass(eq=False)
class Race:
    """Methods on grids of `sizes`, coarse to fine, advanced step by step; each surface has a reference."""

    scene: Scene
    references: dict[str, Reference]
    methods: list[Method]
    sizes: list[int]
    bounces: int
    seed: int
    points: list[Point] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        # The first predicts the cost of the others: it should build no meshes.
        ordered = sorted(self.methods, key=lambda m: (m.surface != "levelset", m.slow))
        self.contestants = [self._run(method, self.sizes[0]) for method in ordered]

    def _run(self, method: Method, grid: int | None, again: int = 0) -> Run:
        return Run(self.scene, method, grid, self.bounces, shifted_seed(self.seed, again))

    def show_default(self, method: Method, filler: Interpolator, grid: int | None, paths: int | None) -> None:
        """Add the default of `run` to the chart before all others, and to the contestants from there on."""
        run = self._run(method, grid)
        run.go_on(paths)
        point, _ = self._point(run, filler)
        point.default = True
        self.points.append(point)
        run.step, run.factor, run.ranked_by = sum(fewer < point.paths for fewer in STEPS), 1.0, [point]
        self._foresee(run, point.time - run.tracing)
        self.contestants.append(run)

    def predict(
        self, method: Method, filler: Interpolator, grid: int | None, paths: int | None, default: bool = False
    ) -> None:
        """Add a run to the chart, of which only the nodes around the points are lit, as the whole run would light them.

        Its seconds are predicted from those of these nodes. After a first look there is one seed only.
        """
        run, begun = self._run(method, grid), time.perf_counter()
        ahead, reference = run.look(), self.references[method.surface]
        look, paths = time.perf_counter() - begun, paths or ahead.paths
        near = around(self.scene, ahead if method.looked else replace(ahead, interpolator=filler), reference.queries)
        seeds, begun = range(1 if method.looked else SEEDS), time.perf_counter()
        bakes = [Bake.of([near.asked], ahead.bounces, shifted_seed(self.seed, k)) for k in seeds]
        found = [near.read(bake.walk(ahead.tracer, range(paths)).samples) for bake in bakes]
        nodes = nodes_to_light(self.scene, ahead)
        takes = look + (time.perf_counter() - begun) / len(seeds) * nodes / max(1, len(near.asked))
        point = Point(method, filler, grid, paths, nodes, found[0][1], run.longest, default=default, built=False)
        self.points.append(replace(point, seconds=[takes] * len(seeds), light=[light for light, _ in found]))

    def advance(self, run: Run) -> None:
        """Take the next step of a contestant, and fill the grid by each of its interpolators."""
        paths, begun = STEPS[run.step], time.perf_counter()
        same = [p for p in self.points if (p.method, p.grid, p.paths) == (run.method, run.grid, paths)]
        known = {p.interpolator: p for p in same if p.built}
        try:
            run.go_on(paths)
            new = [known.get(filler) or self._point(run, filler)[0] for filler in run.interpolators]
        except BadInput as reason:
            self.notes.append(f"{run.method.label(run.method.interpolators[0])}, {run.longest} nodes: {reason}")
            run.step = len(STEPS)
            return
        spent = time.perf_counter() - begun
        for other in self.contestants:
            if other.cost == 0.0:  # no contestant has run before
                other.cost = spent * other.method.slow / run.method.slow
        self.points = [p for p in self.points if p.built or p not in same]  # built ones replace predicted ones
        self.points += [p for p in new if p.interpolator not in known]
        self._rank(run, new)
        self._foresee(run, sum(p.filling for p in new if p.interpolator in run.interpolators))
        self._unlock(run, spent)

    def _rank(self, run: Run, new: list[Point]) -> None:
        """Compare new points with the front: drop slow interpolators, and end a run that has converged."""
        reference, paths = self.references[run.method.surface], STEPS[run.step]
        before = [p for p in run.ranked_by if p.grid == run.grid and p.paths < paths]
        now, then = (min((p.rmse(reference) for p in points), default=np.inf) for points in (new, before))
        run.step = run.step + 1 if now <= 0.9 * then else len(STEPS)
        standing, run.ranked_by, run.factor = self._standing(), new, 1.0
        least, light = self._slowdown(run, standing), run.asking + run.tracing
        run.interpolators = tuple(
            p.interpolator for p in new if p.filling <= 0.5 * light or slowdown(p, standing) <= max(4.0, 2.0 * least)
        )

    def _foresee(self, run: Run, filling: float) -> None:
        """Predict the cost of the next step: each additional path takes as long as one so far."""
        if run.step < len(STEPS):
            run.cost = run.tracing * (STEPS[run.step] / run.bake.paths - 1) + filling

    def _unlock(self, run: Run, spent: float) -> None:
        """After a first step, add contestants: the next finer grid and, on the coarsest, more level sets."""
        entering = []  # method, grid, cost of its first step and factor of its slowdown
        if run.grid in self.sizes and run.grid != self.sizes[-1]:
            finer = next(size for size in self.sizes if size > run.longest)
            # Twice the nodes may halve the error, for which noise would need four times the paths: hence the factor.
            more = finer / run.longest
            entering.append((run.method, finer, spent * more**3, 1 / more**2))
        if run.method.denser and run.grid == self.sizes[0]:
            entering.append((run.method.denser, self.sizes[0], spent * COUNTS[1] / COUNTS[0], 1.0))
        for method, grid, cost, factor in entering:
            if not any((c.method, c.grid) == (method, grid) for c in self.contestants):
                new = self._run(method, grid)
                new.interpolators, new.cost, new.factor, new.ranked_by = run.interpolators, cost, factor, run.ranked_by
                self.contestants.append(new)

    def _point(self, run: Run, interpolator: Interpolator) -> tuple[Point, list[IlluminationGrid]]:
        grids, filling = run.fill(interpolator)
        light, covered = look_up(grids, self.references[run.method.surface].queries)
        queries, seconds = sum(map(len, run.bake.answers)), run.asking + run.tracing + filling
        point = Point(run.method, interpolator, run.grid, run.bake.paths, queries, covered, run.longest)
        return replace(point, seconds=[seconds], filling=filling, light=[light]), grids

    def _standing(self) -> dict[Point, float]:
        """Errors of all points."""
        return {p: max(1e-9, p.rmse(self.references[p.method.surface])) for p in self.points}

    def least(self, surface: str) -> float:
        """Smallest error measured against the reference of a surface."""
        own = (p.rmse(self.references[surface]) for p in self.points if p.method.surface == surface)
        return min(own, default=np.inf)

    def _slowdown(self, run: Run, standing: dict[Point, float]) -> float:
        """Expected slowdown of a contestant, relative to the front."""
        return run.factor * min((slowdown(p, standing) for p in run.ranked_by), default=1.0)

    def next(self, left: float) -> Run | None:
        """The contestant with the least product of predicted time and slowdown; None if all are too costly.

        Time is reserved for the seeds that the front still lacks.
        """
        kept = 1.1 * (SEEDS - 1) * sum(seconds for seconds, _ in self.missing_seeds())
        able = (c for c in self.contestants if c.step < len(STEPS) and (kept + SEEDS * c.cost < left or c.cost == 0.0))
        standing = self._standing()
        return min(able, key=lambda c: (c.cost * self._slowdown(c, standing), c.longest), default=None)

    def missing_seeds(self) -> list[tuple[float, list[Point]]]:
        """Points of the front that lack seeds, by method and grid, and the seconds that one more seed takes."""
        groups: dict[tuple[Method, int | None], list[Point]] = {}
        for p in front(self.points, self.references):
            if p.built and len(p.seconds) < SEEDS:
                groups.setdefault((p.method, p.grid), []).append(p)
        return [(max(p.time - p.filling for p in g) + sum(p.filling for p in g), g) for g in groups.values()]

    def repeat(self, deadline: float, report: Callable[[], object], flip: Flip | None = None) -> None:
        """Run the points of the front with other seeds, until each has `SEEDS` or the deadline is too near."""
        while missing := self.missing_seeds():
            seconds, points = min(missing, key=lambda found: found[0])
            if time.perf_counter() + seconds > deadline:
                return
            again = min(len(p.seconds) for p in points)
            run, before = self._run(points[0].method, points[0].grid, again), resident(reset=True)
            for point in sorted((p for p in points if len(p.seconds) == again), key=lambda p: p.paths):
                run.go_on(point.paths)
                new, grids = self._point(run, point.interpolator)
                point.seconds += new.seconds
                point.light += new.light
                point.memory = (resident() or 0.0) - before if before else None
                if flip and point.flip is None:
                    point.flip = flip(grids)
            report()


def resident(reset: bool = False) -> float | None:
    """Peak resident memory of the process in megabytes, since the last reset; None if the system does not report it."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        lines = Path("/proc/self/status").read_text("utf-8").splitlines()
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        return None
