"""No more than a scene needs: nodes, paths and bounces for an asked error or time, from a short probe."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from illumgrid.accuracy.around import lattice, looked
from illumgrid.accuracy.cost import Pace, measure_pace
from illumgrid.accuracy.probe import FEWEST_PATHS, MOST_PATHS, Measured, Probe
from illumgrid.accuracy.texels import Walls, walls_for
from illumgrid.bake.ahead import Ahead
from illumgrid.bake.bounces import enough_bounces
from illumgrid.bake.walls import texel_paths, wall_queries
from illumgrid.field.lattice import specs_over
from illumgrid.field.scene import Levels, Scene, finer_texels
from illumgrid.rng import shifted_seed
from illumgrid.transport.tracer import Tracer

SHARE = 0.25  # of the asked error that the bounces left out may be
JUDGED = 0.95  # of the asked seconds: the rest is for the judgement at the end
TRIAL_PATHS = 16  # from each node, with which grids are tried
LOOKED_PATHS = 4  # the same where a first look chose the nodes
LOOKED_COST = 100 * 12  # paths that take as long as one point there: it reads so many nodes, each of which reads others
REFERENCE_COST = 4  # of its paths, over others: they are walked twice, with more bounces and with fewer
SOON = 5.0  # seconds that a look at more points may take even before a shorter run
CRUDE, LONG = 0.1, 60.0  # relative error, and seconds, beyond which a plan is announced with an alternative
MOST_NODES = 40_000_000  # a grid of about 2 GB with all that belongs to it


@dataclass(frozen=True)
class Goal:
    """What is asked of a run, and what is not left to choose."""

    error: float | None = None  # relative, root mean square, to reach in the least time; else the least in `seconds`
    seconds: float = np.inf
    texels: int = 0  # of the walls, which take their time too
    paths: int | None = None
    bounces: int | None = None

    def work(self, nodes: int) -> int:
        """Nodes that take as long as these together with the texels."""
        return nodes + self.texels * texel_paths(nodes, self.texels)


@dataclass(frozen=True)
class Choice:
    """A size and a number of paths, with the predicted relative error and seconds of the run."""

    measured: Measured
    paths: int
    error: float
    seconds: float
    met: bool


@dataclass(frozen=True)
class Plan:
    """What the probe chose, and why."""

    grid: int
    paths: int
    bounces: int | None  # None: as many as a run takes by itself, whose paths end in the light of the first look
    error: float  # predicted, relative
    seconds: float  # predicted, of the run
    fill: float  # seconds of those that go into queries and grids, not into paths
    met: bool  # whether the asked error, or time, is predicted to be kept
    why: tuple[str, ...]  # sentences for the user
    finer: float = 1.0  # texels of walls along each edge, for each of the scene's
    looked: bool = False  # whether a first look at a lattice of `grid` nodes chooses those that are lit
    outlook: str = ""  # said before the light is computed: a time that is too short, an error that takes long


def sizes(scene: Scene) -> list[int]:
    """Grid sizes worth trying, in steps of about √2, up to two nodes for each voxel's side."""
    longest = max(max(field.volume.shape) for field in scene.fields)
    return [max(4, round(longest * 2.0 ** (k / 2))) for k in range(-8, 3) if longest * 2.0 ** (k / 2) > 5]


def choose(tried: Sequence[Measured], pace: Pace, goal: Goal) -> Choice:
    """The least time for an error, or else the least error for a time; if neither can be had, what comes nearest."""

    def choice(m: Measured, count: int, met: bool) -> Choice:
        takes = (m.pace or pace).seconds(goal.work(m.nodes), count)
        return Choice(m, count, float(np.sqrt(m.squared(count))), takes, met)

    if goal.error is not None:
        square = goal.error**2
        counts = [goal.paths or m.paths_for(square) for m in tried]
        kept = [choice(m, n, True) for m, n in zip(tried, counts) if n and m.squared(n) <= 1.001 * square]
        if kept:
            return min(kept, key=lambda c: c.seconds)
        least = min(m.floor for m in tried)
        best = min((m for m in tried if m.floor <= 1.2 * least), key=lambda m: m.nodes)  # a tenth off, no more
        return choice(best, goal.paths or best.paths_for(1.25 * best.floor) or 64, False)
    able = [goal.paths or min(MOST_PATHS, (m.pace or pace).paths_in(goal.seconds, goal.work(m.nodes))) for m in tried]
    kept = [choice(m, n, True) for m, n in zip(tried, able) if n >= FEWEST_PATHS]
    if kept:
        return min(kept, key=lambda c: c.error)
    return choice(min(tried, key=lambda m: m.nodes), goal.paths or FEWEST_PATHS, False)


@dataclass(frozen=True, eq=False)
class Look:
    """Grids measured at some points with some bounces, and the best of them."""

    points: int
    bounces: int
    choice: Choice
    tried: tuple[Measured, ...]


@dataclass(frozen=True, eq=False)
class Search:
    """What all looks share."""

    scene: Scene
    tracer: Tracer
    goal: Goal
    pace: Pace
    looking: bool  # whether a first look may choose the nodes
    seed: int  # of the run
    until: float  # of the clock: then the run is to end
    ahead: dict[int, Ahead] = field(default_factory=dict)  # first looks so far
    took: dict[int, float] = field(default_factory=dict)  # seconds of a look and of what was measured of it

    def look(
        self, sizes: Sequence[int], points: int, error: float, seed: int, most: int,
        kinds: Sequence[bool] = (False, True),
    ) -> Look:  # fmt: skip
        """Measure grids from coarse to fine at some points, until finer ones cannot be the choice.

        First lattices, then nodes that first looks choose.
        """
        probe = Probe.start(self.scene, self.tracer, points, error, seed, most)
        followed = self.goal.bounces
        if followed is None:
            followed, _ = enough_bounces(self.scene, self.tracer, seed, SHARE * error)
        found, goal = list[Measured](), replace(self.goal, texels=0)
        for looking in kinds[: 1 + self.looking]:
            for left, size in zip(range(len(sizes), 0, -1), sizes):
                if looking and self._too_late(size, found):
                    break
                found.append(now := self._measured(probe, size, looking, followed))
                pace = now.pace or self.pace
                if pace.seconds(now.nodes, FEWEST_PATHS) > goal.seconds or now.nodes > MOST_NODES:
                    break
                if goal.error is not None:
                    choice = choose(found, self.pace, replace(goal, paths=None))
                    # A finer grid has twice the nodes or more, and needs the paths that the noise alone asks for.
                    least = pace.seconds(2 * now.nodes, now.paths_within(goal.error**2))
                    hopeless = looking and now.floor > (2.0**left * goal.error) ** 2  # at best half the error each
                    if hopeless or (choice.met and least >= choice.seconds):
                        break
        return Look(points, followed, choose(found, self.pace, self.goal), tuple(found))

    def _measured(self, probe: Probe, size: int, looking: bool, bounces: int) -> Measured:
        if not looking:
            return probe.measure(lattice(specs_over(self.scene, size), self.tracer, bounces), TRIAL_PATHS)
        begun = time.perf_counter()
        if size not in self.ahead:
            self.ahead[size] = looked(self.scene, self.tracer, size, self.goal.bounces, self.seed)
        found = probe.measure(self.ahead[size], LOOKED_PATHS)
        self.took[size] = time.perf_counter() - begun
        return found

    def _too_late(self, size: int, found: Sequence[Measured]) -> bool:
        """Whether a first look at so many nodes takes longer than what is known to do, or than there is time."""
        before = found[-1] if found and found[-1].looked else None
        if size in self.ahead or before is None or before.pace is None or len(self.took) < 2:  # the first loads kernels
            return False
        times: float = (size / before.grid) ** 3
        takes: float = times**0.75 * self.took[before.grid]  # part of it is the same for any size
        if self.goal.error is None:
            return time.perf_counter() + takes + times * before.pace.seconds(before.nodes, FEWEST_PATHS) > self.until
        best = choose(found, self.pace, self.goal)
        return takes > (best.seconds if best.met else LONG)

    def first(self, sizes: Sequence[int], seed: int) -> Look:
        """For an error, a few hundred points; for a time, a tenth of it, and half of that for the reference."""
        points, most = 384, 1024
        if self.goal.error is None:
            each = 2 * 8 * TRIAL_PATHS * self.pace.path
            if len(sizes) > 1 and each * len(sizes) * 96 > 0.1 * self.goal.seconds:
                sizes = sizes[len(sizes) % 2 :: 2]
            each += self.looking * LOOKED_COST * self.pace.path
            points = int(np.clip(0.1 * self.goal.seconds / (each * len(sizes)), 64, 384))
            most = int(np.clip(0.05 * self.goal.seconds / (REFERENCE_COST * self.pace.path * points), 64, most))
        return self.look(sizes, points, self.goal.error or 0.02, seed, most)

    def closer(self, look: Look, sizes: Sequence[int], seed: int, late: bool) -> Look:
        """Look at more points around the choice: for a sixth of the run's time, for an error as long as they differ.

        For an error every finer grid, in turn: the choice may have been so good by chance.
        """
        goal, chosen = self.goal, look.choice.measured.grid
        near = [size for size in sizes if 0.6 < size / chosen < (1.7 if goal.error is None else np.inf)]
        if look.choice.measured.looked and goal.error is None:
            near = [size for size in near if size in self.ahead]
        of_grid = LOOKED_COST if look.choice.measured.looked else 2 * 8 * TRIAL_PATHS
        each = self.pace.path * (of_grid * len(near[:3]) + REFERENCE_COST * 128)  # seconds a point
        more = 4096
        if goal.error is None:  # after a slow first look, what is left is for the run
            more = 0 if late else int(min(8192.0, look.choice.seconds / 6 / each))
        while more > 1.5 * look.points:
            # More points tell more than a sharper reference at each: its variance is subtracted.
            error = goal.error or look.choice.error
            look, more = self.look(near, more, error, seed, 128, (look.choice.measured.looked,)), 0
            if goal.error is not None and look.choice.measured.parts.uncertain > 0.05 * goal.error**2:
                # A few points carry the error, as where the field is noisy: many more are needed to tell it.
                more = int(min(4 * look.points, 16384, max(SOON, look.choice.seconds) / each))
        return look


def planned(
    scene: Scene,
    tracer: Tracer,
    levels: Levels,
    *,
    error: float | None = None,
    seconds: float | None = None,
    grid: int | None = None,
    paths: int | None = None,
    bounces: int | None = None,
    texels: int | None = None,
    looking: bool = False,
    seed: int = 0,
) -> tuple[Plan, Ahead | None]:
    """Choose nodes, paths and bounces of a run with `Direct` and `Nearest`, as far as they are not given.

    In the least time for a relative root mean square `error`, or the least error in `seconds`, with this choice and the
    light of walls at `levels` included; the tracer marches level sets. For an error, texels as well: of each wall, at
    least as many as it has. If `looking`, or else, nodes that a first look chooses, which comes with the plan.
    """
    begun = time.perf_counter()
    left = np.inf if seconds is None else JUDGED * seconds
    goal = Goal(error, left, sum(len(queries) for queries in wall_queries(scene, levels)), paths, bounces)
    candidates = sizes(scene) if grid is None else [grid]
    depth = 4 if scene.open else 12  # light lives long in a closed room
    middle = specs_over(scene, candidates[len(candidates) // 2])
    pace = measure_pace(scene, tracer, middle, 32, depth, seed, 1 << 14)
    search = Search(scene, tracer, goal, pace, looking, seed, begun + left)
    look = search.first(candidates, seed)
    look = search.closer(look, candidates, shifted_seed(seed, 1), time.perf_counter() - begun > 0.35 * left)
    about = 1 << 16 if seconds is None else int(np.clip(0.02 * left / search.pace.path, 1 << 12, 1 << 16))
    specs = specs_over(scene, look.choice.measured.grid)
    pace = measure_pace(scene, tracer, specs, look.choice.paths, look.bounces, seed, about)
    walls = walls_for(scene, tracer, levels, look.bounces, error, seed) if error and texels is None else None
    if walls is not None:
        fine = wall_queries(finer_texels(scene, walls.finer), levels)
        goal = replace(goal, texels=sum(len(queries) for queries in fine))
    pilot = time.perf_counter() - begun
    choice = choose(look.tried, pace, replace(goal, seconds=left - pilot))
    why = reasons(scene, choice, look.bounces, walls)
    said = outlook(look.tried, pace, replace(goal, seconds=np.inf if seconds is None else seconds), choice, pilot)
    ahead = search.ahead[choice.measured.grid] if choice.measured.looked else None
    return Plan(
        choice.measured.grid, choice.paths, None if ahead and bounces is None else look.bounces, choice.error,
        choice.seconds, choice.measured.nodes * (choice.measured.pace or pace).node, choice.met, why,
        1.0 if walls is None else walls.finer, ahead is not None, said,
    ), ahead  # fmt: skip


def outlook(tried: Sequence[Measured], pace: Pace, goal: Goal, choice: Choice, pilot: float) -> str:
    """What a user should know before the light is computed; empty if the run is short and as good as asked.

    Times that another goal would take include the seconds of the pilot, as those of `goal` do.
    """
    if goal.error is None:
        if choice.met and choice.error <= CRUDE:
            return ""
        better = choose(tried, pace, replace(goal, error=CRUDE, seconds=np.inf))
        cost = f"; {CRUDE:.0%} takes about {_time(pilot + better.seconds)}" if better.met else ""
        return (
            f"{goal.seconds:g} seconds are too short for this scene: an error of about {choice.error:.0%} is predicted"
            f"{cost}; --error chooses the time"
        )
    if not choice.met:
        return (
            f"an error of {goal.error:.1%} is out of reach: {choice.error:.1%} is predicted, in {_time(choice.seconds)}"
        )
    if choice.seconds <= LONG:
        return ""
    soon = choose(tried, pace, replace(goal, error=None, seconds=LONG))
    least = f"; --seconds {LONG:g} reaches about {soon.error:.1%}" if soon.met else ""
    return f"an error of {goal.error:.1%} is predicted to take {_time(choice.seconds)}{least}"


def _time(seconds: float) -> str:
    if seconds >= 90:
        return f"{seconds / 60:.0f} minutes"
    return f"{seconds:.0f} seconds" if seconds >= 9.5 else f"{seconds:.2g} seconds"


def reasons(scene: Scene, choice: Choice, bounces: int, walls: Walls | None = None) -> tuple[str, ...]:
    """What was chosen, why, and what was left out, in sentences."""
    m, part = choice.measured, choice.measured.parts
    still, noise = np.sqrt(max(0.0, part.grid + part.uncovered)), np.sqrt(max(0.0, m.squared(choice.paths) - m.floor))
    if m.looked:
        return (
            f"a first look at {m.grid} nodes along the longest axis chose {m.nodes} to light: interpolation between "
            f"them is off by {still:.1%}",
            f"{choice.paths} paths: noise of {noise:.1%} after interpolation",
        )
    nodes = sum(int(np.prod(spec.shape)) for spec in specs_over(scene, m.grid))
    on_walls = []
    if walls is not None:
        longest = max(n for quad in finer_texels(scene, walls.finer).quads for n in quad.texels)
        on_walls = [f"{longest} texels along walls: between them and rows of the sweep light is off by {walls.off:.1%}"]
    return (
        f"{m.grid} nodes along the longest axis: interpolation between them is off by {still:.1%}",
        f"{choice.paths} paths: noise of {noise:.1%} after interpolation",
        f"{bounces} bounces: further ones would add {np.sqrt(part.bounces):.1%}",
        f"{nodes - m.nodes} of {nodes} nodes are omitted: no isosurface of the range is near them",
        *on_walls,
    )
