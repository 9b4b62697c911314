"""The speed-accuracy chart: seconds against error of all registered stages, on the user's own data."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from illumgrid import registry, tone
from illumgrid.accuracy.chart.contestants import Method, methods, tracers
from illumgrid.accuracy.chart.race import SEEDS, Flip, Point, Race, front
from illumgrid.accuracy.points import unseen_on_level_sets
from illumgrid.accuracy.probe import Measured, Probe
from illumgrid.accuracy.reference import Reference, begin, converge
from illumgrid.bake.accumulator import Progress
from illumgrid.bake.ahead import BY_NORMAL, by_normal_in, lattice, nodes_to_light, refinable_by
from illumgrid.bake.bounces import enough_bounces, light_left_out
from illumgrid.bake.refined import LOOKED
from illumgrid.constants import BASE, DENSITY, PATHS
from illumgrid.errors import BadInput
from illumgrid.field.lattice import along_longest, specs_over
from illumgrid.field.scene import Scene
from illumgrid.grid import GridSpec
from illumgrid.interpolators.nearest import Nearest
from illumgrid.interpolators.nested import Nested
from illumgrid.rng import shifted_seed
from illumgrid.samplers.direct import Direct
from illumgrid.stages import Interpolator
from illumgrid.transport.samples import Queries
from illumgrid.transport.tracer import Tracer, prepare

# Shares of the budget.
REFERENCES, PARTS, PICTURE = 0.25, 0.12, 0.05  # for the references, the parts of the error, the converged picture
OTHER = 0.05  # to begin the reference of another surface, at most
DEFAULT, PREDICTED = 0.3, 0.15  # for `run`'s default, at most; if that is too little, to predict such grids

GOAL, FEWEST = 0.01, 500  # own error of a reference; points are dropped to reach it, down to `FEWEST`
LONGEST = 1e7  # seconds of a budget, four months: paths in proportion to it stay a finite number
PARTS_PATHS, PARTS_REFERENCE, PARTS_POINTS = (16, 64, 256), 256, (512, 4096)

# Takes scene, tracer, exposure, bounces, seed and paths of a converged picture; returns what compares grids with it.
Studio = Callable[[Scene, Tracer, float, int, int, float], Flip | None]


@dataclass(frozen=True, eq=False)
class Report:
    """Results of a race."""

    points: tuple[Point, ...]
    front: tuple[Point, ...]  # from fast to accurate
    references: dict[str, Reference]  # by surface
    parts: tuple[Measured, ...]  # of the error of `Direct` with `Nearest`, over grids and paths
    bounces: int
    notes: tuple[str, ...]  # which backends do not compete, and why; what else a reader must know
    seconds: float  # of the whole race, after compilation


def sizes(scene: Scene) -> list[int]:
    """Sizes of the grids: a quarter, half, once and 1.6 times the nodes along the longest axis of `run`'s default."""
    default = along_longest(specs_over(scene))
    return sorted({max(4, round(default * share)) for share in (0.25, 0.5, 1.0, 1.6)})


def bench(
    scene: Scene,
    budget: float = 120.0,
    seed: int = 0,
    progress: Progress = lambda what, done, total: None,
    default: tuple[int | None, int | None] = (None, None),
    studio: Studio | None = None,
) -> Report:
    """Race all contestants on a scene for `budget` seconds, after compilation.

    `default` are the nodes and paths that are marked as the default of `run`, None where `run` chooses them; `studio`
    draws pictures to measure the visible difference. A budget that is not positive or above `LONGEST`, or a scene
    without surface or light, raises BadInput.
    """
    if not 0 < budget <= LONGEST:
        raise BadInput(f"got a budget of {budget:g} seconds; expected more than 0 and up to {LONGEST:g}, such as 60")
    auto = prepare(registry.backend("auto"), scene)
    light_left_out(scene, auto, 0)  # compiles
    begun, racing, before_parts = time.perf_counter(), (1 - 0.7 * REFERENCES - PARTS) * budget, (1 - PARTS) * budget

    def report() -> float:
        spent = time.perf_counter() - begun
        progress("race", min(int(spent), int(budget)), int(budget))
        return spent

    asked = _unseen(scene, budget, seed)
    entrants, notes = tracers(scene, asked, budget)
    bounces, _ = enough_bounces(scene, auto, seed, 0.002)
    references, pace = _references(scene, entrants, asked, budget, seed, notes)
    _sharpen(references, dict.fromkeys(references, 4 * GOAL), 0.3 * REFERENCES * budget)
    reference = next(iter(references.values()))
    albedo = np.array([field.material.albedo for field in scene.fields])[reference.queries.target]
    exposure = tone.automatic_exposure(reference.light, albedo)
    paths = PICTURE * budget / pace
    flip = studio(scene, reference.tracer, exposure, reference.bounces, seed, paths) if studio else None
    able = methods([method for method in entrants if method.surface in references])
    race = Race(scene, references, able, sizes(scene), bounces, seed)
    notes += _show_default(race, *default, budget, pace * (bounces + 1) / (reference.bounces + 1))
    while contestant := race.next(racing - report()):
        race.advance(contestant)
    if not race.points:
        raise BadInput("no contestant could finish; " + "; ".join(notes + race.notes))
    race.repeat(begun + racing, report, flip)
    _sharpen(references, {surface: race.least(surface) / 5 for surface in references}, before_parts - report())
    race.repeat(begun + before_parts, report, flip)  # time that the references left over goes to missing seeds
    parts = measure_parts(scene, auto, sizes(scene), bounces, seed, budget - report(), pace)
    shown = tuple(front(race.points, references))
    notes += [*race.notes, *_remarks(race, shown)]
    return Report(tuple(race.points), shown, references, tuple(parts), bounces, tuple(notes), report())


def _unseen(scene: Scene, budget: float, seed: int) -> Queries:
    """Points of the references: on as many level sets as a small share of the budget allows, 83 to 150 on each."""
    for points in (8, 64):  # the first call loads what extracts surfaces
        begun = time.perf_counter()
        unseen_on_level_sets(scene, 1, points, seed)
        one = time.perf_counter() - begun
    levels = int(np.clip(0.05 * budget / one, 8, 48))
    asked = unseen_on_level_sets(scene, levels, int(np.clip(100 * levels, 1200, 4000)), seed)
    if not len(asked):
        raise BadInput("no isosurface of the range can be lit; expected a range within the data")
    return asked


def _tracer_of(entrants: Sequence[Method], surface: str) -> Tracer:
    """The fastest tracer of a surface, for its reference: a plugin's only if the package has none."""
    own = {m: registry.entry("backend", m.backend.name).package == "illumgrid" for m in entrants}
    return min((m for m in entrants if m.surface == surface), key=lambda m: (not own[m], m.slow)).tracer


def _references(
    scene: Scene, entrants: Sequence[Method], asked: Queries, budget: float, seed: int, notes: list[str]
) -> tuple[dict[str, Reference], float]:
    """References by surface, level sets first, with 64 paths; and the seconds per path of the first."""
    found: dict[str, Reference] = {}
    pace = 0.0
    surfaces, rows = sorted({method.surface for method in entrants}), np.unique(asked.level, axis=0)
    one = asked[(asked.level == rows[len(rows) // 2]).all(axis=1)]
    most, _ = enough_bounces(scene, _tracer_of(entrants, surfaces[0]), seed, 2e-4)
    for surface in surfaces:
        tracer, begun = _tracer_of(entrants, surface), time.perf_counter()
        begin(tracer, one, most, seed)  # building meshes may take longer than tracing: try one level set
        takes = (time.perf_counter() - begun) * len(rows)
        if found and takes > OTHER * budget:
            notes.append(f"backends of the {surface} do not compete: their reference would take {takes:.0f} s")
            continue
        begun = time.perf_counter()
        reference = begin(tracer, asked, most, seed)
        spent = time.perf_counter() - begun
        if len(reference):
            pace = pace or spent / (64 * len(asked))
            found[surface] = _thinned(reference, spent, REFERENCES * budget / len(surfaces), seed)
    return found, pace


def _thinned(reference: Reference, spent: float, left: float, seed: int) -> Reference:
    """As many points of a reference as can reach an error of `GOAL` in the time `left`, if all took `spent` seconds."""
    takes = spent * (reference.error / GOAL) ** 2
    keep = int(np.clip(len(reference) * left / max(takes, 1e-9), min(FEWEST, len(reference)), len(reference)))
    chosen = np.sort(np.random.default_rng((seed, 4)).permutation(len(reference))[:keep])
    return reference[chosen]


def _sharpen(references: dict[str, Reference], error: dict[str, float], left: float) -> None:
    """Trace more paths until the references' own errors are small enough or the time is over, the main one last."""
    end = time.perf_counter() + left
    for rest, surface in zip(range(len(references), 0, -1), reversed(list(references))):
        now = time.perf_counter()
        references[surface] = converge(references[surface], error[surface], 1 << 15, now + (end - now) / rest)


def _show_default(race: Race, grid: int | None, paths: int | None, budget: float, pace: float) -> list[str]:
    """Add `run`'s default to the chart; if it would take too much of the budget, predict it and others, or omit it.

    `pace` is in seconds per path.
    """
    scene, own = race.scene, ("levelset", Direct(), registry.auto_backend())
    able = (m for m in race.methods if (m.surface, m.sampler, m.backend.name) == own and Nearest() in m.interpolators)
    plain = method = next(able, None)
    if method is None or plain is None:
        return []
    filler: Interpolator = Nearest()
    stages = plain.sampler, plain.backend, filler
    looked = grid is None and paths is None and refinable_by(scene, *stages)
    if looked:
        filler = Nested()
    elif grid is None and by_normal_in(scene, *stages):
        filler, usual = BY_NORMAL
        paths = paths or usual
    if filler != Nearest():
        method = replace(plain, interpolators=(filler,), denser=None, looked=looked)

    def seconds(specs: Sequence[GridSpec], count: int) -> float:
        return pace * count * nodes_to_light(scene, lattice(specs, plain.tracer, race.bounces))

    base = specs_over(scene, grid, BASE if looked else DENSITY)
    look = seconds(base, 2 * LOOKED) if looked else 0.0  # it follows twice the bounces
    if look > DEFAULT * budget:
        return [f"run's default does not compete: its first look would take about {look:.0f} s"]
    if not looked:
        paths = paths or PATHS
        if len({max(spec.shape) for spec in base}) == 1:  # else fields differ in size, each with its own default
            grid = along_longest(base)
    # The chosen nodes take as many paths as the look, and longer to fill: together three times the look.
    if (3 * look or seconds(base, paths or PATHS)) <= DEFAULT * budget:
        race.show_default(method, filler, grid, paths)
        return []
    begun = time.perf_counter()
    race.predict(method, filler, grid, paths, default=True)
    more = [(seconds(specs_over(scene, n), count), n, count) for n in race.sizes[1:] for count in (8, 32, 128)]
    for _, size, count in sorted(more if method is plain else ()):
        will = SEEDS * count * pace * 8 * len(race.references["levelset"])
        if (size, count) != (grid, paths) and time.perf_counter() - begun + will < PREDICTED * budget:
            race.predict(plain, filler, size, count)
    return ["~ marks predicted times: only the nodes near reference points were computed"]


def measure_parts(
    scene: Scene, tracer: Tracer, sizes: Sequence[int], bounces: int, seed: int, seconds: float, path: float
) -> list[Measured]:
    """Parts of the error on grids of these sizes, until `seconds` are used; `path` is the measured time per path.

    Uses as many points as half of the time allows: where a few of them carry the error, a small number misses those.
    """
    begun, last = time.perf_counter(), 0.0
    each = path * (2 * 8 * sum(PARTS_PATHS) * len(sizes) + 2 * PARTS_REFERENCE)
    points = int(np.clip(seconds / 2 / each, *PARTS_POINTS))
    probe = Probe.start(scene, tracer, points, 0.004, shifted_seed(seed, 1), PARTS_REFERENCE)
    found = list[Measured]()
    for paths, size in product(PARTS_PATHS, sizes):
        now = time.perf_counter()
        if now - begun + last <= seconds or not found:
            found.append(probe.measure(lattice(specs_over(scene, size), tracer, bounces), paths))
            last = (time.perf_counter() - now) * (4 if size == sizes[-1] else 1.5)
    return sorted(found, key=lambda m: (m.grid, m.paths))


def _remarks(race: Race, best: Sequence[Point]) -> list[str]:
    """Remarks for the reader on the uncertainty of the chart."""
    found = [
        f"the reference of the {surface} has an error of {reference.error:.2%}, more than a fifth of the smallest "
        f"error measured by it, {least:.2%}; its variance is subtracted, and a larger budget reduces it"
        for surface, reference in race.references.items()
        if reference.error > (least := race.least(surface)) / 5
    ]
    if few := sum(len(p.seconds) < SEEDS for p in best):
        found.append(f"{few} points of the front were run with fewer than {SEEDS} seeds: the budget was used up")
    return found
