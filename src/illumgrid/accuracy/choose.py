"""Choose nodes, paths and bounces for a requested error or time, from a short pilot measurement."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from illumgrid.accuracy.probe import FEWEST_PATHS, Measured, Probe
from illumgrid.accuracy.texels import Walls, walls_for
from illumgrid.bake.ahead import Ahead, lattice, looked
from illumgrid.bake.bounces import enough_bounces
from illumgrid.bake.walls import texel_paths, wall_queries
from illumgrid.field.lattice import specs_over
from illumgrid.field.scene import Levels, Scene, finer_texels
from illumgrid.rng import shifted_seed
from illumgrid.transport.tracer import Tracer

SHARE = 0.25  # fraction of the requested error that omitted bounces may cause
FOR_A_TIME = 0.02  # the error that a reference must resolve if a time is requested
JUDGED = 0.95  # fraction of the requested seconds: the rest is for measuring the error at the end
TRIAL_PATHS = 16  # per node, to measure runs on lattices
LOOKED_PATHS = 4  # per node, if a first look chose the nodes
MORE = 4  # factor on the points from round to round
IN_TIME, OF_LATTICES, OF_LOOKS = (64, 256, 1024, 4096), (384, 1536, 6144), (1536, 6144)  # points; last 2: for an error
SOON = 5.0  # seconds that a further round for an error may always take
CRUDE, LONG = 0.1, 60.0  # relative error, and seconds, beyond which a warning names an alternative
MOST_NODES = 40_000_000  # a grid of about 2 GB, with everything that belongs to it


@dataclass(frozen=True)
class Goal:
    """The error or time that a run should reach, and the settings that are given."""

    error: float | None = None  # relative root mean square error; None: the least one in `seconds`
    seconds: float = np.inf
    texels: int = 0  # of the walls, which take time as well
    paths: int | None = None
    bounces: int | None = None

    def work(self, nodes: int) -> int:
        """Number of nodes that take as long as `nodes` nodes and the texels."""
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
    """The settings that the pilot chose, and the reasons."""

    grid: int
    paths: int
    bounces: int | None  # None: those of a default run, whose paths end in the light of the first look
    error: float  # predicted, relative
    seconds: float  # predicted, of the run
    fill: float  # those of these seconds that go into queries and grids, not into paths
    met: bool  # whether the prediction keeps to the requested error or time
    why: tuple[str, ...]  # sentences for the user
    finer: float = 1.0  # factor on the scene's number of texels along each edge of a wall
    looked: bool = False  # whether a first look at a lattice of `grid` nodes chooses the nodes to light
    outlook: str = ""  # warning before the light is computed: too short a time, or an error out of reach or slow


def sizes(scene: Scene) -> list[int]:
    """Nodes along the longest axis of the grids to try: in steps of about √2, up to two nodes per voxel."""
    longest = max(max(field.volume.shape) for field in scene.fields)
    return [max(4, round(longest * 2.0 ** (k / 2))) for k in range(-8, 3) if longest * 2.0 ** (k / 2) > 5]


def choose(tried: Sequence[Measured], goal: Goal) -> Choice:
    """Choose the least time for an error, or the least error for a time; if no run keeps to it, the closest one."""

    def choice(m: Measured, count: int, met: bool) -> Choice:
        return Choice(m, count, float(np.sqrt(m.squared(count))), m.seconds(goal.work(m.nodes), count), met)

    if goal.error is not None:
        square = goal.error**2
        counts = [goal.paths or m.paths_for(square) for m in tried]
        kept = [choice(m, n, True) for m, n in zip(tried, counts) if n and m.squared(n) <= 1.001 * square]
        if kept:
            return min(kept, key=lambda c: c.seconds)
        least = min(m.floor for m in tried)
        best = min((m for m in tried if m.floor <= 1.2 * least), key=lambda m: m.nodes)  # at most a tenth more error
        return choice(best, goal.paths or best.paths_for(1.25 * best.floor) or 64, False)
    able = [goal.paths or m.paths_in(goal.seconds, goal.work(m.nodes)) for m in tried]
    kept = [choice(m, n, True) for m, n in zip(tried, able) if n >= FEWEST_PATHS]
    if kept:
        return min(kept, key=lambda c: c.error)
    return choice(min(tried, key=lambda m: m.nodes), goal.paths or FEWEST_PATHS, False)


@dataclass(frozen=True, eq=False)
class Pilot:
    """Measures runs of increasing size at ever more points: on lattices, or on nodes that first looks choose."""

    scene: Scene
    tracer: Tracer
    goal: Goal
    looking: bool  # whether a first look chooses the nodes
    followed: int  # bounces on lattices, where paths end in no cache
    seed: int  # of the run
    until: float  # of `time.perf_counter`: when the run should end
    ahead: dict[int, Ahead] = field(default_factory=dict)  # by size, those measured so far

    def tried(self, sizes: Sequence[int]) -> list[Measured]:
        """Measure runs of the sizes that may be chosen, at more points from round to round while this pays.

        For a time, a further round may take up to a sixth of the run. For an error, runs are measured at many points in
        any case, since at few a coarse run may seem to suffice by chance; finer runs follow in turn until one suffices,
        and further points while the estimate is uncertain. First looks begin with many points, whose nodes soon repeat.
        """
        goal, near = self.goal, sizes
        counts = IN_TIME if goal.error is None else OF_LOOKS if self.looking else OF_LATTICES
        for again, points in enumerate(counts):
            found, took = self.look(near, points, shifted_seed(self.seed, again))
            choice = choose(found, goal)
            near = [n for n in sizes if 0.6 < n / choice.measured.grid < (np.inf if goal.error else 1.7)]
            if goal.error is None:
                near = [n for n in near if n in took]
                if MORE * sum(took[n] for n in near) > choice.seconds / 6:
                    break
            elif points > OF_LATTICES[0]:
                sure = choice.measured.parts.uncertain <= 0.05 * goal.error**2
                if sure or MORE * sum(took.values()) > max(SOON, choice.seconds):
                    break
        return found

    def look(self, sizes: Sequence[int], points: int, seed: int) -> tuple[list[Measured], dict[int, float]]:
        """Measure runs at some points, from coarse to fine, until finer ones cannot be the choice.

        Also returns the seconds that each took, without its first look, which is taken only once.
        """
        probe = Probe.start(self.scene, self.tracer, points, self.goal.error or FOR_A_TIME, seed)
        found, took, last = list[Measured](), dict[int, float](), 0.0
        for left, size in zip(range(len(sizes), 0, -1), sizes):
            if found and self._enough(found, left, size, last if len(found) > 1 else 0.0):  # 1st loads kernels
                break
            begun = time.perf_counter()
            if size not in self.ahead:
                self.ahead[size] = (
                    looked(self.scene, self.tracer, size, self.goal.bounces, self.seed)
                    if self.looking
                    else lattice(specs_over(self.scene, size), self.tracer, self.followed)
                )
            lit = time.perf_counter()
            found.append(probe.measure(self.ahead[size], LOOKED_PATHS if self.looking else TRIAL_PATHS))
            last, took[size] = time.perf_counter() - begun, time.perf_counter() - lit
        return found, took

    def _enough(self, found: Sequence[Measured], left: int, size: int, took: float) -> bool:
        """Whether the `left` remaining sizes, from `size` on, cannot be the choice or take too long to measure."""
        goal, now = replace(self.goal, texels=0), found[-1]
        times: float = (size / now.grid) ** 3
        takes = times**0.75 * took  # part of the time does not depend on the size
        if now.nodes > MOST_NODES:
            return True
        if goal.error is None:
            return bool(time.perf_counter() + takes + times * now.seconds(now.nodes, FEWEST_PATHS) > self.until)
        best = choose(found, replace(goal, paths=None))
        if not best.met:  # each finer size at best halves the error
            return now.floor > (2.0**left * goal.error) ** 2 or takes > LONG
        # A finer run has at least twice the nodes, and at least the paths that the noise alone requires.
        least = now.seconds(2 * now.nodes, now.paths_within(goal.error**2))
        return bool(max(least, takes) >= best.seconds)


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
    """Choose those of nodes, paths and bounces that are not given, for a run with `Direct` and `Nearest`.

    The run takes the least time for a relative root mean square `error`, or has the least error in `seconds`, with this
    pilot and the light of walls at `levels` included. The tracer marches level sets. For an error, the texels of walls
    are chosen, too, at least the scene's. If `looking`, a first look chooses the nodes, and is returned as well.
    """
    begun = time.perf_counter()
    left = np.inf if seconds is None else JUDGED * seconds
    goal = Goal(error, left, sum(len(queries) for queries in wall_queries(scene, levels)), paths, bounces)
    followed = enough_bounces(scene, tracer, seed, SHARE * (error or FOR_A_TIME))[0] if bounces is None else bounces
    pilot = Pilot(scene, tracer, goal, looking, followed, seed, begun + left)
    tried = pilot.tried(sizes(scene) if grid is None else [grid])
    walls = walls_for(scene, tracer, levels, followed, error, seed) if error and texels is None else None
    if walls is not None:
        fine = wall_queries(finer_texels(scene, walls.finer), levels)
        goal = replace(goal, texels=sum(len(queries) for queries in fine))
    spent = time.perf_counter() - begun
    choice = choose(tried, replace(goal, seconds=left - spent))
    said = outlook(tried, replace(goal, seconds=np.inf if seconds is None else seconds), choice, spent)
    m = choice.measured
    return Plan(
        m.grid, choice.paths, bounces if looking else followed, choice.error, choice.seconds, m.nodes * m.node,
        choice.met, reasons(scene, choice, None if looking else followed, walls),
        1.0 if walls is None else walls.finer, looking, said,
    ), pilot.ahead[m.grid] if looking else None  # fmt: skip


def outlook(tried: Sequence[Measured], goal: Goal, choice: Choice, pilot: float) -> str:
    """Warning for the user before the light is computed; empty if the run is short and accurate enough.

    The time of another goal includes the seconds of the `pilot`, as the time of `goal` does.
    """
    if goal.error is None:
        if choice.met and choice.error <= CRUDE:
            return ""
        better = choose(tried, replace(goal, error=CRUDE, seconds=np.inf))
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
    soon = choose(tried, replace(goal, error=None, seconds=LONG))
    least = f"; --seconds {LONG:g} reaches about {soon.error:.1%}" if soon.met else ""
    return f"an error of {goal.error:.1%} is predicted to take {_time(choice.seconds)}{least}"


def _time(seconds: float) -> str:
    if seconds >= 90:
        return f"{seconds / 60:.0f} minutes"
    return f"{seconds:.0f} seconds" if seconds >= 9.5 else f"{seconds:.2g} seconds"


def reasons(scene: Scene, choice: Choice, bounces: int | None, walls: Walls | None = None) -> tuple[str, ...]:
    """Each choice with its reason, and what is omitted, in sentences; `bounces` is None if a first look has its own."""
    m, part = choice.measured, choice.measured.parts
    still, noise = np.sqrt(max(0.0, part.grid + part.uncovered)), np.sqrt(max(0.0, m.squared(choice.paths) - m.floor))
    longest = f"{m.grid} nodes along the longest axis"
    paths = f"{choice.paths} paths: noise of {noise:.1%} after interpolation"
    if bounces is None:
        chosen = f"a first look at {longest} chose {m.nodes} to light"
        return f"{chosen}: interpolation between them has an error of {still:.1%}", paths
    nodes = sum(int(np.prod(spec.shape)) for spec in specs_over(scene, m.grid))
    said = (
        f"{longest}: interpolation between them has an error of {still:.1%}",
        paths,
        f"{bounces} bounces: further ones would add {np.sqrt(part.bounces):.1%}",
        f"{nodes - m.nodes} of {nodes} nodes are omitted: no isosurface of the range is near them",
    )
    if walls is None:
        return said
    texels = max(n for quad in finer_texels(scene, walls.finer).quads for n in quad.texels)
    return *said, f"{texels} texels along walls: interpolation there and in the sweep has an error of {walls.off:.1%}"
