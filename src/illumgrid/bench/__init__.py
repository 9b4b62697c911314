"""The speed-accuracy chart: seconds against error, for everything that is registered, on the user's own data."""

import time
from dataclasses import dataclass

import numpy as np

from illumgrid import registry
from illumgrid.bake import Progress, light_left_out
from illumgrid.bench.contestants import ways
from illumgrid.bench.picture import Studio
from illumgrid.bench.race import SEEDS, Point, Race, front
from illumgrid.bench.whence import Bar, bars
from illumgrid.errors import BadInput
from illumgrid.pilot import Pilot
from illumgrid.samples import Queries
from illumgrid.scene import Scene
from illumgrid.stages import Backend
from illumgrid.truth import Truth, begin, converge, enough, unseen_on_level_sets

TRUTH, PARTS, PICTURE = 0.25, 0.12, 0.05
"""Shares of the budget for the truth, the parts of the error and the converged picture."""

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
    """Grids that take part: 0.3, 0.6, 1.2 and 1.9 nodes for each voxel along the longest axis.

    Not 1 or 2: nodes on voxels are the worst place to ask on noisy data (docs/stability.md).
    """
    longest = max(max(field.volume.shape) for field in scene.fields)
    return sorted({max(4, round(longest * share)) for share in (0.3, 0.6, 1.2, 1.9)})


def _unseen(scene: Scene, budget: float, seed: int) -> Queries:
    """Points of the truth: as many level sets as a small share of the budget allows, of forty to a hundred points."""
    begun = time.perf_counter()
    unseen_on_level_sets(scene, 1, 64, seed)
    one = time.perf_counter() - begun
    levels = int(np.clip(0.05 * budget / one, 8, 48))
    return unseen_on_level_sets(scene, levels, int(np.clip(100 * levels, 1200, 4000)), seed)


def _grown(
    truths: dict[str, Truth], tracers: dict[str, Backend], scene: Scene, seed: int, error: float, left: float
) -> None:
    """The truths with more paths, until their own error is small enough or the time is over."""
    for surface, truth in truths.items():
        spent, begun = 0.0, time.perf_counter()
        until = begun + left / len(truths)
        while truth.error > error and time.perf_counter() + 2 * spent < until and truth.samples.paths[0] < 1 << 15:
            step = time.perf_counter()
            paths = 2 * int(truth.samples.paths[0])
            truth = converge(truth, scene, tracers[surface], seed, 0.0, paths)
            spent = time.perf_counter() - step
        truths[surface] = Truth(truth.samples, truth.bounces, surface)


def bench(
    scene: Scene, budget: float = 120.0, seed: int = 0, progress: Progress = lambda what, done, total: None
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
    light_left_out(scene, auto, 0)  # compiles
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
    tracers = {way.surface: way.backend for way in entrants[::-1]}
    tracing = time.perf_counter()
    truths = {surface: begin(scene, tracer, asked, most, seed) for surface, tracer in tracers.items()}
    pace = (time.perf_counter() - tracing) / (64 * len(asked) * len(tracers))
    truths = {surface: Truth(truth.samples, most, surface) for surface, truth in truths.items() if len(truth)}
    _grown(truths, tracers, scene, seed, 0.002, 0.5 * TRUTH * budget)
    main = "levelset" if "levelset" in truths else next(iter(truths))
    studio = Studio.open(scene, tracers[main], truths[main], seed, PICTURE * budget / pace)
    race = Race(scene, truths, [way for way in entrants if way.surface in truths], sizes(scene), bounces, seed)
    racing = (1 - 0.5 * TRUTH - PARTS) * budget
    while lane := race.next(racing - (time.perf_counter() - begun)):
        race.step(lane)
        tell()
    if not race.points:
        raise BadInput("no contestant could finish; " + "; ".join(notes + race.notes))
    race.repeat(begun + racing, tell, studio)
    smallest = min(p.rmse(truths[p.way.surface]) for p in race.points)
    _grown(truths, tracers, scene, seed, smallest / 5, budget * (1 - PARTS) - (time.perf_counter() - begun))
    parts = bars(scene, auto, sizes(scene), bounces, seed, budget - (time.perf_counter() - begun))
    best = tuple(front(race.points, truths))
    return Report(
        tuple(race.points), best, truths, tuple(parts), bounces, (*notes, *race.notes, *_remarks(best, truths)),
        time.perf_counter() - begun,
    )  # fmt: skip


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
