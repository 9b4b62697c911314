"""The speed-accuracy chart: seconds against error, for everything that is registered, on the user's own data."""

import time
from dataclasses import dataclass, replace

import numpy as np

from illumgrid import registry
from illumgrid.accuracy.chart.contestants import ways
from illumgrid.accuracy.chart.picture import Studio
from illumgrid.accuracy.chart.race import SEEDS, Point, Race, front
from illumgrid.accuracy.chart.whence import Bar, bars
from illumgrid.accuracy.probe import Pilot, specs_of, timed
from illumgrid.accuracy.truth import Truth, begin, converge, enough, unseen_on_level_sets
from illumgrid.bake import Progress, light_left_out
from illumgrid.constants import PATHS
from illumgrid.errors import BadInput
from illumgrid.field.lattice import nodes_over
from illumgrid.field.scene import Scene
from illumgrid.samplers.direct import Direct, reachable
from illumgrid.stages import Backend
from illumgrid.transport.samples import Queries
from illumgrid.transport.tracer import prepare

TRUTH, PARTS, PICTURE, OTHER = 0.25, 0.12, 0.05, 0.05
"""Shares of the budget: for the truth, the parts of the error, the converged picture, and to begin another truth."""

DEFAULT, FORESEEN = 0.3, 0.15
"""Shares of the budget, at most, for `run`'s default and, if that is too little, for what of such grids is foreseen."""

GOAL, FEWEST = 0.01, 500
"""Own error of the truth, a fifth of 5 %, for which points are given up where light is rough; so many stay at least."""

LONGEST = 1e7  # seconds of a budget: four months; counts of paths in proportion to it stay whole numbers


@dataclass(frozen=True, eq=False)
class Report:
    """What a race showed.

    Parameters
    ----------
    points : tuple of Point
    front : tuple of Point
        Those that nobody beats in both time and error, from fast to accurate.
    truths : dict of Truth
        By surface.
    bars : tuple of Bar
        Where the error of the direct way comes from, over grids and paths.
    bounces : int
    notes : tuple of str
        Who takes no part, and why; whatever else a reader must know.
    seconds : float
        That all of it took, from warm kernels on.
    """

    points: tuple[Point, ...]
    front: tuple[Point, ...]
    truths: dict[str, Truth]
    bars: tuple[Bar, ...]
    bounces: int
    notes: tuple[str, ...]
    seconds: float


def sizes(scene: Scene) -> list[int]:
    """Grids that take part: a quarter, half, once and 1.6 times the nodes that `run` has by default.

    Nodes on voxels are the worst place to ask on noisy data (docs/stability.md).
    """
    default = default_grid(scene)
    return sorted({max(4, round(default * share)) for share in (0.25, 0.5, 1.0, 1.6)})


def default_grid(scene: Scene) -> int:
    """Nodes along the longest axis, of the field that has most, when `illumgrid.run` is asked for nothing else."""
    return max(max(nodes_over(field.volume).shape) for field in scene.fields)


def _unseen(scene: Scene, budget: float, seed: int) -> Queries:
    """Points of the truth: as many level sets as a small share of the budget allows, of forty to a hundred points."""
    for points in (8, 64):  # the first one loads what extracts surfaces
        begun = time.perf_counter()
        unseen_on_level_sets(scene, 1, points, seed)
        one = time.perf_counter() - begun
    levels = int(np.clip(0.05 * budget / one, 8, 48))
    return unseen_on_level_sets(scene, levels, int(np.clip(100 * levels, 1200, 4000)), seed)


def _thinned(truth: Truth, surface: str, spent: float, left: float, seed: int) -> Truth:
    """As many of a truth's points, which took so many seconds, as can be sharpened to GOAL in the time that is left."""
    takes = spent * (truth.error / GOAL) ** 2
    keep = int(np.clip(len(truth) * left / max(takes, 1e-9), min(FEWEST, len(truth)), len(truth)))
    chosen = np.sort(np.random.default_rng((seed, 4)).permutation(len(truth))[:keep])
    return replace(truth[chosen], surface=surface)


def _grown(
    truths: dict[str, Truth], tracers: dict[str, Backend], scene: Scene, seed: int, error: dict[str, float], left: float
) -> None:
    """The truths with more paths, until their own errors are small enough or the time is over.

    The first, which judges most, comes last: it has what the others leave.
    """
    end = time.perf_counter() + left
    for rest, (surface, truth) in zip(range(len(truths), 0, -1), reversed(list(truths.items()))):
        spent, begun = 0.0, time.perf_counter()
        until = begun + (end - begun) / rest
        while truth.error > error[surface] and time.perf_counter() + 2 * spent < until and truth.paths < 1 << 15:
            step = time.perf_counter()
            truth = converge(truth, scene, tracers[surface], seed, 0.0, 2 * truth.paths)
            spent = time.perf_counter() - step
        truths[surface] = truth


def bench(
    scene: Scene,
    budget: float = 120.0,
    seed: int = 0,
    progress: Progress = lambda what, done, total: None,
    default: tuple[int, int] | None = None,
) -> Report:
    """Race all contestants on a scene.

    Parameters
    ----------
    scene : Scene
    budget : float
        Seconds, from warm kernels on.
    seed : int
    progress : callable, optional
        Told (what, done, total).
    default : (int, int), optional
        Nodes and paths that are marked as the default of `run`; by default those of `illumgrid.run`.

    Raises
    ------
    BadInput
        On a budget that is not positive, or a scene without surface or light.
    """
    if not 0 < budget <= LONGEST:
        raise BadInput(
            f"a budget of {budget:g} seconds was asked for; expected a positive number of at most {LONGEST:g}, such as "
            "60"
        )
    auto = registry.backend("auto")
    light_left_out(scene, prepare(auto, scene), 0)  # compiles
    begun = time.perf_counter()
    asked = _unseen(scene, budget, seed)
    if not len(asked):
        raise BadInput("no isosurface of the range can be lit; expected a range within the data")
    entrants, notes = ways(scene, asked, budget)

    def tell(what: str = "race") -> None:
        progress(what, min(int(time.perf_counter() - begun), int(budget)), int(budget))

    pilot = Pilot.start(scene, auto, 256, 0.02, seed, 64)
    bounces = pilot.bounces_for(0.002)
    most = enough(scene, auto, 2e-4, seed)
    tracers: dict[str, Backend] = {}
    for way in sorted(entrants, key=lambda way: (way.surface != "levelset", way.slow)):
        tracers.setdefault(way.surface, way.backend)
    truths: dict[str, Truth] = {}
    pace: dict[str, float] = {}
    for surface, tracer in tracers.items():
        tracing = time.perf_counter()
        if truths:  # meshes may take longer to build than rays to cast: try one level set
            rows = np.unique(asked.level, axis=0)
            begin(scene, tracer, asked[(asked.level == rows[len(rows) // 2]).all(axis=1)], most, seed, 64)
            takes = (time.perf_counter() - tracing) * len(rows)
            if takes > OTHER * budget:
                notes.append(f"what traces the {surface} takes no part: its truth alone would take {takes:.0f} s")
                continue
            tracing = time.perf_counter()
        truth = begin(scene, tracer, asked, most, seed, 64)
        spent = time.perf_counter() - tracing
        if len(truth):
            pace[surface] = spent / (64 * len(asked))
            truths[surface] = _thinned(truth, surface, spent, TRUTH * budget / len(tracers), seed)
    _grown(truths, tracers, scene, seed, dict.fromkeys(truths, 4 * GOAL), 0.3 * TRUTH * budget)
    main = "levelset" if "levelset" in truths else next(iter(truths))
    studio = Studio.open(scene, tracers[main], truths[main], seed, PICTURE * budget / pace[main])
    race = Race(scene, truths, [way for way in entrants if way.surface in truths], sizes(scene), bounces, seed)
    racing = (1 - 0.7 * TRUTH - PARTS) * budget
    notes += _show_default(race, *(default or (default_grid(scene), PATHS)), budget)
    while lane := race.next(racing - (time.perf_counter() - begun)):
        race.step(lane)
        tell()
    if not race.points:
        raise BadInput("no contestant could finish; " + "; ".join(notes + race.notes))
    race.repeat(begun + racing, tell, studio)
    least = {s: min((p.rmse(truths[s]) for p in race.points if p.way.surface == s), default=1.0) for s in truths}
    asked_for = {surface: error / 5 for surface, error in least.items()}
    _grown(truths, tracers, scene, seed, asked_for, budget * (1 - PARTS) - (time.perf_counter() - begun))
    race.repeat(begun + (1 - PARTS) * budget, tell, studio)  # what the truth did not need goes into missing seeds
    parts = bars(scene, auto, sizes(scene), bounces, seed, budget - (time.perf_counter() - begun), pace[main])
    best = tuple(front(race.points, truths))
    return Report(
        tuple(race.points), best, truths, tuple(parts), bounces, (*notes, *race.notes, *_remarks(best, truths)),
        time.perf_counter() - begun,
    )  # fmt: skip


def _show_default(race: Race, grid: int, paths: int, budget: float) -> list[str]:
    """Chart `run`'s default; if it would take too much of the budget, as it is foreseen."""
    own = registry.backend("auto")
    entrants = [lane.run.way for lane in race.lanes if lane.run.way.surface == "levelset"]
    way = next((w for w in entrants if w.sampler == Direct() and w.backend.name == own.name), None)
    nearest = next((i for i in way.interpolators if i.name == "nearest"), None) if way else None
    if way is None or nearest is None:
        return []
    begun, pace = time.perf_counter(), timed(race.scene, own, grid, 16, race.bounces, race.seed)

    def nodes(size: int) -> int:
        return sum(len(reachable(f, spec)) for f, spec in zip(race.scene.fields, specs_of(race.scene, size)))

    takes = pace.seconds(nodes(grid), paths)
    if takes <= DEFAULT * budget:
        race.show_default(way, nearest, grid, paths)
        return []
    race.foresee(way, nearest, grid, paths, takes, default=True)
    lit = {size: nodes(size) for size in race.sizes[1:]}
    more = [(pace.seconds(lit[size], count), size, count) for size in lit for count in (8, 32, 128)]
    for seconds, size, count in sorted(more):
        # As many nodes as those of the default, and as many seeds.
        will = SEEDS * count * pace.path * 8 * len(race.truths["levelset"])
        if (size, count) != (grid, paths) and time.perf_counter() - begun + will < FORESEEN * budget:
            race.foresee(way, nearest, size, count, seconds)
    return ["with ~ is what would take too much of the budget: its seconds are predicted, and of its nodes only those "
            "around the points of the truth were lit"]  # fmt: skip


def _remarks(best: tuple[Point, ...], truths: dict[str, Truth]) -> list[str]:
    """What a reader of the chart must know about how sure it is."""
    told = []
    for surface, truth in truths.items():
        own = [p.rmse(truth) for p in best if p.way.surface == surface]
        if own and truth.error > min(own) / 5:
            told.append(
                f"the truth of the {surface} is itself {truth.error:.2%} off, more than a fifth of the smallest error "
                f"that it judges, {min(own):.2%}; its variance is subtracted, and a larger budget sharpens it"
            )
    if few := sum(len(p.seconds) < SEEDS for p in best):
        told.append(f"{few} points of the front were run with fewer than {SEEDS} seeds: the budget was over")
    return told
