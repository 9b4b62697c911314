"""No more than a scene needs: nodes, paths and bounces for an asked error or time, from a short pilot."""

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

SHARE = 0.25  # of the asked error that the bounces left out may be
FOR_A_TIME = 0.02  # the error that a reference must judge where none is asked
JUDGED = 0.95  # of the asked seconds: the rest is for the judgement at the end
TRIAL_PATHS = 16  # from each node, with which grids are tried
LOOKED_PATHS = 4  # the same where a first look chose the nodes
MORE = 4  # times as many points from look to look
IN_TIME, OF_LATTICES, OF_LOOKS = (64, 256, 1024, 4096), (384, 1536, 6144), (1536, 6144)  # points; two for an error
SOON = 5.0  # seconds that a look at the most points may take even before a shorter run
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
    """What the pilot chose, and why."""

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


def choose(tried: Sequence[Measured], goal: Goal) -> Choice:
    """The least time for an error, or else the least error for a time; if neither can be had, what comes nearest."""

    def choice(m: Measured, count: int, met: bool) -> Choice:
        return Choice(m, count, float(np.sqrt(m.squared(count))), m.seconds(goal.work(m.nodes), count), met)

    if goal.error is not None:
        square = goal.error**2
        counts = [goal.paths or m.paths_for(square) for m in tried]
        kept = [choice(m, n, True) for m, n in zip(tried, counts) if n and m.squared(n) <= 1.001 * square]
        if kept:
            return min(kept, key=lambda c: c.seconds)
        least = min(m.floor for m in tried)
        best = min((m for m in tried if m.floor <= 1.2 * least), key=lambda m: m.nodes)  # a tenth off, no more
        return choice(best, goal.paths or best.paths_for(1.25 * best.floor) or 64, False)
    able = [goal.paths or m.paths_in(goal.seconds, goal.work(m.nodes)) for m in tried]
    kept = [choice(m, n, True) for m, n in zip(tried, able) if n >= FEWEST_PATHS]
    if kept:
        return min(kept, key=lambda c: c.error)
    return choice(min(tried, key=lambda m: m.nodes), goal.paths or FEWEST_PATHS, False)


@dataclass(frozen=True, eq=False)
class Pilot:
    """Tries runs of more and more nodes, at more and more points: of lattices, or of nodes that first looks choose."""

    scene: Scene
    tracer: Tracer
    goal: Goal
    looking: bool  # whether a first look chooses the nodes
    followed: int  # bounces, where no light is known in which paths end
    seed: int  # of the run
    until: float  # of the clock: then the run is to end
    ahead: dict[int, Ahead] = field(default_factory=dict)  # by size, those tried so far

    def tried(self, sizes: Sequence[int]) -> list[Measured]:
        """Runs of the sizes that may be the choice, measured at more and more points as long as they are worth it.

        For a time while a look takes less than a sixth of the run. For an error at many points in any case, for at few
        a run may be good enough by chance, with every finer run in turn until one will do; and at more while they
        differ too much to tell. First looks begin with many: nodes that lookups read are then soon the same.
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
        """Runs measured at some points, from coarse to fine, until finer ones cannot be the choice.

        And the seconds that each took, without its first look, which is taken once.
        """
        probe = Probe.start(self.scene, self.tracer, points, self.goal.error or FOR_A_TIME, seed)
        found, took, last = list[Measured](), dict[int, float](), 0.0
        for left, size in zip(range(len(sizes), 0, -1), sizes):
            if found and self._enough(found, left, size, last if len(found) > 1 else 0.0):  # the first loads kernels
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
        """Whether a run of the next size, and the finer ones `left`, cannot be the choice, or take too long to try."""
        goal, now = replace(self.goal, texels=0), found[-1]
        times: float = (size / now.grid) ** 3
        takes = times**0.75 * took  # part of it is the same for any size
        if now.nodes > MOST_NODES:
            return True
        if goal.error is None:
            return bool(time.perf_counter() + takes + times * now.seconds(now.nodes, FEWEST_PATHS) > self.until)
        best = choose(found, replace(goal, paths=None))
        if not best.met:  # each finer one has at best half the error
            return now.floor > (2.0**left * goal.error) ** 2 or takes > LONG
        # A finer one has twice the nodes or more, and needs the paths that the noise alone asks for.
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
    """Choose nodes, paths and bounces of a run with `Direct` and `Nearest`, as far as they are not given.

    In the least time for a relative root mean square `error`, or the least error in `seconds`, with this choice and the
    light of walls at `levels` included; the tracer marches level sets. For an error, texels as well: of each wall, at
    least as many as it has. If `looking`, a first look chooses the nodes, which comes with the plan.
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
    """What a user should know before the light is computed; empty if the run is short and as good as asked.

    Times that another goal would take include the seconds of the pilot, as those of `goal` do.
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
    """What was chosen, why, and what was left out, in sentences; `bounces` are None where a first look has its own."""
    m, part = choice.measured, choice.measured.parts
    still, noise = np.sqrt(max(0.0, part.grid + part.uncovered)), np.sqrt(max(0.0, m.squared(choice.paths) - m.floor))
    longest = f"{m.grid} nodes along the longest axis"
    paths = f"{choice.paths} paths: noise of {noise:.1%} after interpolation"
    if bounces is None:
        chosen = f"a first look at {longest} chose {m.nodes} to light"
        return f"{chosen}: interpolation between them is off by {still:.1%}", paths
    nodes = sum(int(np.prod(spec.shape)) for spec in specs_over(scene, m.grid))
    said = (
        f"{longest}: interpolation between them is off by {still:.1%}",
        paths,
        f"{bounces} bounces: further ones would add {np.sqrt(part.bounces):.1%}",
        f"{nodes - m.nodes} of {nodes} nodes are omitted: no isosurface of the range is near them",
    )
    if walls is None:
        return said
    texels = max(n for quad in finer_texels(scene, walls.finer).quads for n in quad.texels)
    return *said, f"{texels} texels along walls: between them and rows of the sweep light is off by {walls.off:.1%}"
