"""No more than a scene needs: nodes, paths and bounces for an asked error or time, from a short pilot."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from illumgrid.accuracy.probe import FEWEST, MOST, Measured, Pace, Pilot, specs_of, timed
from illumgrid.accuracy.truth import begin, enough, errors, look_up, unseen_in_volume
from illumgrid.bake import texel_paths, wall_queries
from illumgrid.field.scene import Levels, Scene
from illumgrid.field.volume import smooth
from illumgrid.grid import IlluminationGrid
from illumgrid.stages import Backend

SHARE = 0.25  # of the asked error that the bounces left out may be
JUDGED = 0.95  # of the asked seconds: the rest is for the judgement at the end
PATHS = 16  # from each node, with which grids are tried
TRUTH = 4  # what its paths take, over others: they are walked twice, with more bounces and with fewer
SOON = 5.0  # seconds that a look at more points may take even before a shorter run
MOST_NODES = 40_000_000  # a grid of about 2 GB with all that belongs to it


@dataclass(frozen=True)
class Plan:
    """What the pilot chose, and why.

    Parameters
    ----------
    grid, paths, bounces : int
    error : float
        Predicted relative error.
    seconds : float
        Predicted time of the run.
    fill : float
        Seconds of those that go into queries and grids, not into paths.
    pilot : float
        Seconds that the pilot took.
    met : bool
        Whether the asked error, or time, is predicted to be kept.
    why : tuple of str
        Sentences for the user.
    """

    grid: int
    paths: int
    bounces: int
    error: float
    seconds: float
    fill: float
    pilot: float
    met: bool
    why: tuple[str, ...]


def sizes(scene: Scene) -> list[int]:
    """Grid sizes worth trying, in steps of about √2, up to two nodes for each voxel's side."""
    longest = max(max(field.volume.shape) for field in scene.fields)
    return [max(4, round(longest * 2.0 ** (k / 2))) for k in range(-8, 3) if longest * 2.0 ** (k / 2) > 5]


@dataclass(frozen=True)
class Choice:
    """A size and a number of paths, with the predicted relative error and seconds of the run."""

    measured: Measured
    paths: int
    error: float
    seconds: float
    met: bool


def choose(
    tried: Sequence[Measured], pace: Pace, walls: int, error: float | None, seconds: float, paths: int | None
) -> Choice:
    """The least time for an error, or else the least error for a time; if neither can be had, what comes nearest."""

    def work(m: Measured) -> int:
        return m.nodes + walls * texel_paths(m.nodes, walls)

    def choice(m: Measured, count: int, met: bool) -> Choice:
        return Choice(m, count, float(np.sqrt(m.squared(count))), pace.seconds(work(m), count), met)

    if error is not None:
        kept = []
        for m in tried:
            count = paths or m.paths_for(error**2)
            if count and m.squared(count) <= 1.001 * error**2:
                kept.append(choice(m, count, True))
        if kept:
            return min(kept, key=lambda c: c.seconds)
        least = min(m.floor for m in tried)
        best = min((m for m in tried if m.floor <= 1.2 * least), key=lambda m: m.nodes)  # a tenth off, no more
        return choice(best, paths or best.paths_for(1.25 * best.floor) or 64, False)
    counts = [paths or min(MOST, pace.paths_in(seconds, work(m))) for m in tried]
    kept = [choice(m, n, True) for m, n in zip(tried, counts) if n >= FEWEST]
    if kept:
        return min(kept, key=lambda c: c.error)
    return choice(min(tried, key=lambda m: m.nodes), paths or FEWEST, False)


def _ladder(
    pilot: Pilot, candidates: Sequence[int], bounces: int, pace: Pace, error: float | None, seconds: float
) -> list[Measured]:
    """Measure grids from coarse to fine until finer ones cannot be the choice."""
    fewer, found = pilot.fewer(bounces), []
    for grid in candidates:
        found.append(now := pilot.measure(grid, fewer, bounces, PATHS))
        if pace.seconds(now.nodes, FEWEST) > seconds or now.nodes > MOST_NODES:
            break
        if error is not None:
            choice = choose(found, pace, 0, error, np.inf, None)
            # A finer grid has twice the nodes or more, and needs the paths that the noise alone asks for.
            if choice.met and pace.seconds(2 * now.nodes, now.paths_within(error**2)) >= choice.seconds:
                break
    return found


def reasons(scene: Scene, choice: Choice, bounces: int, left_out: float) -> tuple[str, ...]:
    """What was chosen, why, and what was left out, in sentences."""
    m, part = choice.measured, choice.measured.split
    still, noise = np.sqrt(max(0.0, part.grid + part.uncovered)), np.sqrt(max(0.0, m.squared(choice.paths) - m.floor))
    nodes = sum(int(np.prod(spec.shape)) for spec in specs_of(scene, m.grid))
    return (
        f"{m.grid} nodes along the longest axis: between them the light is off by {still:.1%}",
        f"{choice.paths} paths: their noise, read between nodes, is {noise:.1%}",
        f"{bounces} bounces: further ones would add {left_out:.1%}",
        f"{nodes - m.nodes} of {nodes} nodes are left out: no isosurface of the range is near them",
    )


def planned(
    scene: Scene,
    backend: Backend,
    levels: Levels,
    *,
    error: float | None = None,
    seconds: float | None = None,
    grid: int | None = None,
    paths: int | None = None,
    bounces: int | None = None,
    seed: int = 0,
) -> Plan:
    """Choose nodes, paths and bounces of a run with `Direct` and `Nearest`.

    Parameters
    ----------
    scene : Scene
    backend : Backend
        One that marches level sets.
    levels : Levels
        Rows at which walls are lit, which takes its time too.
    error : float, optional
        Relative root mean square error to reach, in the least time.
    seconds : float, optional
        Time to use, pilot included, for the least error.
    grid, paths, bounces : int, optional
        What is not left to choose.
    seed : int
    """
    begun = time.perf_counter()
    walls = sum(len(queries) for queries in wall_queries(scene, levels))
    candidates = [grid] if grid else sizes(scene)
    closed = not scene.background.any()  # light lives long there
    pace = timed(scene, backend, candidates[len(candidates) // 2], 32, 12 if closed else 4, seed, 1 << 14)
    goal, left, points, most = 0.02 if error is None else error, np.inf, 384, 1024
    first = candidates
    if seconds is not None:  # the first look takes a tenth of the time, and its truth half of that
        left = JUDGED * seconds
        each = 2 * 8 * PATHS * pace.path
        if each * len(candidates) * 96 > 0.1 * left:
            first = candidates[::2]
        points = int(np.clip(0.1 * left / (each * len(first)), 64, 384))
        most = int(np.clip(0.05 * left / (TRUTH * pace.path * points), 64, most))
    pilot = Pilot.start(scene, backend, points, goal, seed, most)
    followed = pilot.bounces_for(SHARE * goal) if bounces is None else bounces
    tried = _ladder(pilot, first, followed, pace, error, left)
    choice = choose(tried, pace, walls, error, left, paths)
    # For an error every finer grid, in turn: the choice may have been so good by chance.
    near = [size for size in candidates if 0.6 < size / choice.measured.grid < (1.7 if error is None else np.inf)]
    # A closer look around it, at more points: for a sixth of the time that the run will take, or with time to spare.
    look = pace.path * (2 * 8 * PATHS * len(near[:3]) + TRUTH * 128)  # seconds a point
    more = int(min(8192.0, choice.seconds / 6 / look))
    if error is not None:
        more = 4096
    elif time.perf_counter() - begun > 0.35 * left:  # the first look was slow: what is left is for the run
        more = 0
    while more > 1.5 * points:
        points, goal = more, choice.error if error is None else error
        if error is None and bounces is None:  # by the few points of the first look: more would take too long
            followed = pilot.bounces_for(SHARE * goal)
        # More points tell more than a sharper truth at each: its variance is subtracted.
        pilot = Pilot.start(scene, backend, points, goal, seed + 1, 128)
        if error is not None and bounces is None:
            followed = pilot.bounces_for(SHARE * goal)
        tried = _ladder(pilot, near, followed, pace, error, left)
        choice, more = choose(tried, pace, walls, error, left, paths), 0
        if error is not None and choice.measured.split.uncertain > 0.05 * error**2:
            # A few points carry the error, as where the field is noisy: many more are needed to tell it.
            more = int(min(4 * points, 16384, max(SOON, choice.seconds) / look))
    about = 1 << 16 if seconds is None else int(np.clip(0.02 * left / pace.path, 1 << 12, 1 << 16))
    pace = timed(scene, backend, choice.measured.grid, choice.paths, followed, seed, about)
    choice = choose(tried, pace, walls, error, left - (time.perf_counter() - begun), paths)
    return Plan(
        choice.measured.grid, choice.paths, followed, choice.error, choice.seconds,
        choice.measured.nodes * pace.node, time.perf_counter() - begun, choice.met,
        reasons(scene, choice, followed, pilot.left_out(followed)),
    )  # fmt: skip


def rounds(plan: Plan, until: float, clock: Callable[[], float] = time.perf_counter) -> Iterator[range]:
    """Paths for a run that is to end at a time: a quarter of the plan's, then as many as their pace leaves time for.

    The pilot times a few thousand paths, which is good enough to choose a grid but, on a machine that does other things
    as well, not to promise a time.
    """
    begun, done, more = clock(), 0, max(FEWEST, 2 * (plan.paths // 8))
    after = plan.fill + (1 - JUDGED) * (until - begun)
    while more >= max(2, done // 16) and done < MOST:
        yield range(done, done + more)
        done += more
        now = clock()
        more = 2 * int((until - after - now) * done / (now - begun) / 2)


def judge(
    scene: Scene, backend: Backend, grids: Sequence[IlluminationGrid], seed: int, queries: int, paths: int, bounces: int
) -> float:
    """Relative RMS error of grids at points that neither they nor the pilot asked for, the truth's own subtracted.

    For a twentieth of the run's work, or what 1024 points take: as many paths as the grids had, which makes the truth
    as sharp as they are, and the more points, for where the light is rough a few of them carry the error. How many is
    settled beforehand: who goes on until the truth is sharper than what he found stops where chance made that large.
    """
    followed = enough(scene, backend, 1e-3, seed)
    work = queries * paths * (bounces + 1) / (20 * (followed + 1))
    points = int(np.clip(work / paths, 1024, 4096))
    many = 2 ** round(np.log2(np.clip(work / points, 32, max(32, paths))))
    truth = begin(scene, backend, unseen_in_volume(scene, points, seed + 2), followed, seed + 2, many)
    return errors(look_up(grids, truth.queries), truth).rmse


def helps(scene: Scene, backend: Backend, grid: int, bounces: int, seed: int) -> dict[str, float]:
    """Relative error without noise of a grid as it is, with twice the nodes, and of a field that is smoothed."""
    soft = replace(scene, fields=tuple(replace(f, volume=smooth(f.volume, 1.0)) for f in scene.fields))
    found = {}
    for what, of, nodes in (("now", scene, grid), ("finer", scene, 2 * grid), ("smooth", soft, grid)):
        pilot = Pilot.start(of, backend, 512, 0.05, seed, most=128)  # a hint: it must not cost more than the run
        part = pilot.measure(nodes, pilot.fewer(bounces), bounces, 32).split
        found[what] = float(np.sqrt(max(0.0, part.total - part.noise)))
    return found
