"""The race and what is made of it."""

import csv
import importlib.machinery
import itertools
import json
import sys
import types
import warnings
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from illumgrid import registry, run
from illumgrid.accuracy import chart as benches
from illumgrid.accuracy import probe, reference
from illumgrid.accuracy.chart import _references, _remarks, _show_default, _thinned, _tracer_of, bench, contestants
from illumgrid.accuracy.chart import race as races
from illumgrid.accuracy.chart import sizes as sizes_of
from illumgrid.accuracy.chart.contestants import COUNTS, Method, methods, tracers
from illumgrid.accuracy.chart.race import Point, Race, Run, front
from illumgrid.accuracy.points import unseen_on_level_sets
from illumgrid.accuracy.reference import begin, errors
from illumgrid.backends.numba_ import Numba
from illumgrid.bake.around import look_up
from illumgrid.cli import report
from illumgrid.cli.report import table
from illumgrid.field.lattice import specs_over
from illumgrid.field.scene import Field, Scene
from illumgrid.field.volume import Volume, world_to_index
from illumgrid.grid.nodes import reachable
from illumgrid.interpolators.bilateral import Bilateral
from illumgrid.interpolators.nearest import Nearest
from illumgrid.interpolators.rbf import Rbf
from illumgrid.interpolators.splat import Splat
from illumgrid.samplers.direct import Direct
from illumgrid.samplers.uniform import Uniform
from illumgrid.show import chart
from illumgrid.transport.samples import Samples
from illumgrid.transport.stages import capabilities
from illumgrid.transport.tracer import prepare
from shapes import ball, refused, sky

pytestmark = pytest.mark.judged

BACKEND = Numba()
SCENE = replace(Scene.sky(ball(14), range=(0.4, 0.9)), quads=Scene.floor(ball(14), range=(0.4, 0.9)).quads)
TRACER = prepare(BACKEND, SCENE)


def method(sampler, denser=None):
    return Method(sampler, BACKEND, TRACER, "levelset", (Nearest(),), denser)


METHOD = method(Direct())


class Clocked:
    """A tracer that takes a second for each path, on a clock of its own."""

    def __init__(self, tracer):
        self.tracer, self.seconds = tracer, 0.0

    def solve(self, queries, *, paths, **how):
        self.seconds += len(queries) * len(paths)
        return self.tracer.solve(queries, paths=paths, **how)


@pytest.fixture
def clocked(monkeypatch):
    """`METHOD` in a race whose clock counts its paths."""
    tracer = Clocked(TRACER)
    monkeypatch.setattr(races, "time", SimpleNamespace(perf_counter=lambda: tracer.seconds))
    return replace(METHOD, tracer=tracer)


@pytest.fixture(scope="module")
def truth():
    return SCENE, begin(TRACER, unseen_on_level_sets(SCENE, 8, 200, 0), 8, 0, 256)


def point(truth, seconds, off, grid=8, paths=4, way=METHOD, seeds=3):
    made = Point(way, way.interpolators[0], grid, paths, 100, np.ones(len(truth), bool), grid)
    made.seconds = [seconds] * seeds
    made.light = [truth.light + np.hypot(off, truth.error) * truth.mean] * seeds
    return made


def parts_of(nodes, paths, noise, grid=0.0):
    parts = {"noise": noise**2, "grid": grid**2, "uncovered": 0.0, "bounces": 1e-6}
    return {"nodes": nodes, "paths": paths, **parts, "cross": 0.0, "uncertain": 1e-6, "total": sum(parts.values())}


PARTS = parts_of(8, 16, 0.05, 0.02), parts_of(8, 64, 0.01, 0.02), parts_of(16, 16, 0.04)


def test_the_front_is_what_nothing_dominates(truth):
    _, exact = truth
    points = [point(exact, s, e) for s, e in ((1, 0.1), (2, 0.05), (3, 0.07), (4, 0.02), (0.5, 0.3), (4.1, 0.02))]
    assert [p.seconds[0] for p in front(points, {"levelset": exact})] == [0.5, 1, 2, 4]


def test_the_errors_of_a_point_have_the_truths_variance_subtracted(truth):
    _, exact = truth
    assert point(exact, 1, 0.1).rmse(exact) == pytest.approx(0.1, rel=1e-6)
    assert errors(exact.light, exact).rmse == pytest.approx(exact.error / 3)  # less cannot be distinguished from none


def test_a_race_goes_from_cheap_to_expensive_and_keeps_its_seeds(truth):
    scene, exact = truth
    race = Race(scene, {"levelset": exact}, [METHOD, method(Uniform(8), method(Uniform(32)))], [4, 7], 3, 0)
    while contestant := race.next(np.inf):
        race.advance(contestant)
        assert len(race.points) < 60
    ways = {"direct, numba (levelset), nearest", "uniform 8, numba (levelset), nearest"}
    assert {p.method.label(p.interpolator) for p in race.points} >= ways
    assert {p.grid for p in race.points if p.method is METHOD} == {4, 7}
    for p in race.points:
        assert len(p.light) == 1 and p.light[0].shape == (len(exact), 3) and p.seconds[0] > 0
    race.repeat(np.inf, lambda: None)
    best = front(race.points, race.references)
    assert all(len(p.seconds) == 3 for p in best)
    assert all(not np.array_equal(p.light[0], p.light[1]) for p in best if p.rmse(exact) > 1e-3)


def test_a_run_that_goes_on_is_the_run_with_more_paths(truth):
    scene, _ = truth
    halting, straight = Run(scene, METHOD, 7, 3, 5), Run(scene, METHOD, 7, 3, 5)
    for paths in (4, 16, 64):
        halting.go_on(paths)
    straight.go_on(64)
    one, other = (run.fill(Nearest())[0][0].values for run in (halting, straight))
    np.testing.assert_allclose(one, other, rtol=1e-5)


def test_covered_points_read_only_nodes_with_light(truth):
    scene, exact = truth
    run = Run(scene, METHOD, 9, 1, 0)
    run.go_on(4)
    (grid,), _ = run.fill(Nearest())
    asked, random = exact.queries, np.random.default_rng(0)
    support = (random.random(grid.support.shape) < 0.9).astype(np.float32)
    index = world_to_index(grid.spec, asked.point)
    cell = np.floor(index).astype(int)
    expected = [all(support[tuple(low + corner)] for corner in np.ndindex(2, 2, 2)) for low in cell]
    assert 0.2 < np.mean(expected) < 0.8 and (index - cell).min() > 1e-4  # no point for which a corner counts nothing
    np.testing.assert_array_equal(look_up([replace(grid, support=support)], asked)[1], expected)


def test_everything_that_is_registered_takes_part_or_is_reported(truth):
    scene, exact = truth
    entrants, notes = tracers(scene, exact.queries, 1e6)
    ways = methods(entrants)
    names = {(w.sampler.name, w.backend.name) for w in ways}
    assert {("direct", "numba"), ("uniform", "numba"), ("direct", "reference")} <= names
    chain = next(w for w in ways if w.sampler.name == "uniform")
    assert chain.sampler.count == COUNTS[0] and chain.denser.sampler.count == COUNTS[1]
    few, notes = tracers(scene, exact.queries, 1e-6)
    assert {w.backend.name for w in few} == {"numba"}  # the fastest is never too slow
    assert any("reference does not compete: 64 queries" in note for note in notes)


def test_the_advice_names_the_fastest_that_is_good_enough_and_what_is_missing(truth):
    _, exact = truth
    truths = {"levelset": exact}
    points = [point(exact, 1, 0.09, 8, 16), point(exact, 4, 0.025, 8, 64)]
    records = [report.record(p, truths, True) for p in points]
    said = report.advice(records, PARTS, 5)
    assert said[0].startswith("for 3% use --sampler direct --backend numba --interpolator nearest --grid 8 --paths 64")
    assert said[1].startswith("for 10% use") and "--paths 16 --bounces 5 (1 s, error 9.00%)" in said[1]
    assert "1% was not reached" in said[2] and "interpolation between nodes; increase --grid" in said[2]
    assert "noise; increase --paths" in report.advice(records[:1], PARTS, 5)[-1]
    paper = report.record(point(exact, 1, 0.2, way=method(Uniform(8))), truths, False)
    assert "--isovalues 8 " in report.options(paper, 4)
    text = table([*records, paper])
    assert text.index("the front:") < text.index("direct") < text.index("the best of the others:")


def test_remarks_name_a_blunt_reference_and_missing_seeds(truth):
    _, exact = truth
    one, other = exact.halves
    answer = replace(other.samples, mean=other.samples.mean + 1)
    blunt = replace(exact, halves=(one, replace(other, answers=(answer,))))

    def said(made, reference):
        return _remarks(Race(SCENE, {"levelset": reference}, [METHOD], [8], 3, 0, [made]), [made])

    blunter, few = said(point(blunt, 1, 0.01, seeds=1), blunt)
    assert "more than a fifth" in blunter and "fewer than 3 seeds" in few
    assert not said(point(exact, 1, 0.5), exact)


def test_the_chart_can_be_drawn_of_one_point_and_of_many(truth):
    _, exact = truth
    records = [
        report.record(point(exact, s, 0.1 / s, seeds=k), {"levelset": exact}, s < 3)
        for s, k in ((1, 3), (2, 1), (3, 1))
    ]
    for some in (records[:1], records):
        figure = chart.draw(some, PARTS, "a ball")
        left, right = figure.axes
        assert left.get_xscale() == left.get_yscale() == "log" and "seconds" in left.get_xlabel()
        assert "direct, numba (levelset), nearest" in [t.get_text() for t in figure.legends[0].get_texts()]
        heights = [sum(bars[k].get_height() for bars in right.containers if hasattr(bars, "patches")) for k in range(3)]
        np.testing.assert_allclose(heights, [100 * np.sqrt(p["total"]) for p in PARTS], rtol=1e-3)
    assert chart.image(figure, "png").startswith(b"\x89PNG") and b"<svg" in chart.image(figure, "svg")


def test_grids_of_a_third_to_twice_the_voxels_but_none_on_them():
    assert sizes_of(sky(ball(20))) == [6, 12, 24, 38]


def test_a_budget_or_a_scene_that_cannot_be_is_refused():
    refused(lambda: bench(sky(), 0.0), "budget of 0 seconds", "such as 60")


@pytest.fixture
def ticking(monkeypatch):
    """A clock that goes on by a fixed step whenever it is read: no machine is too slow for a budget."""
    ticks = itertools.count(step=0.1)
    for module in (benches, contestants, probe, races, reference):
        monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: next(ticks)))


def test_bench_writes_what_it_says_whole_and_once(call, tmp_path, ticking):
    arguments = ("bench", "v.npy", "--range", 0.3, 0.9, "--budget", 3, "--seed", 2**64 - 1, "-o", "b")
    said = call(*arguments)
    assert "the front:" in said and "for 10% use --sampler" in said and "wrote b" in said
    assert sorted(p.name for p in (tmp_path / "b").iterdir()) == ["bench.csv", "bench.json", "chart.png", "chart.svg"]
    found = json.loads((tmp_path / "b" / "bench.json").read_text("utf-8"))
    assert found["truth"]["levelset"]["points"] >= benches.FEWEST and found["truth"]["levelset"]["isovalues"] >= 8
    assert found["parts"] and found["advice"] and found["bounces"] >= 0
    rows = list(csv.DictReader((tmp_path / "b" / "bench.csv").read_text("utf-8").splitlines()))
    assert (
        len(rows) == len(found["points"]) and {"seconds", "rmse", "bias", "p95", "flip", "memory_mb"} <= rows[0].keys()
    )
    assert "new folder" in call(*arguments, code=2)


def test_bench_reads_as_run_does(refuse, tmp_path):
    np.save(tmp_path / "two.npy", np.stack([ball(8).values] * 2))
    refuse("bench", "two.npy", words=["--time N"])
    for option, words in {
        "--time 5": "expected one of its time steps: 0, 1",
        "--channel 9": "expected one of its channels",
        "--array f": "--array came with a .npy file",
        "--spacing 0 1 1": "--spacing is 0.0 1.0 1.0",
        "--crop 0 9 0 8 0 8": "within 0 8 0 8 0 8",
        "--downsample 5": "--downsample is 5; expected 1 to 4",
        "--label 7": "--label is 7; expected one of the labels",
    }.items():
        refuse("bench", "two.npy", *("--time 0 " * ("--time" not in option) + option).split(), words=[words])


def test_bench_refuses_before_anything_runs(refuse, tmp_path):
    refuse("bench", "nowhere.npy", words=["nowhere.npy"])
    refuse("bench", "v.npy", "--budget", 0, words=["budget"])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    refuse("bench", "v.npy", "-o", "mine", words=["mine", "new folder"])


def test_run_reports_the_error_that_it_reached_and_what_it_chose(call, tmp_path):
    said = call("run", "v.npy", "--range", 0.3, 0.9, "--error", 0.1, "--no-preview", "-o", "e")
    assert "nodes along the longest axis" in said and "error reached" in said and "predicted" in said
    recipe = json.loads((tmp_path / "e" / "run.json").read_text("utf-8"))["recipe"]
    assert recipe["plan"]["why"] and recipe["reached"] < 0.13
    assert "error reached" in call("run", "v.npy", "--range", 0.3, 0.9, "--grid", 5, "--no-preview", "-o", "plain")


def test_run_says_what_would_help_noisy_data(call, tmp_path):
    noise = np.random.default_rng(0).normal(size=(16, 16, 16))
    np.save(tmp_path / "noise.npy", ball(16).values + 0.2 * noise.astype(np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        said = call("run", "noise.npy", "--range", 0.4, 0.7, "--grid", 12, "--no-preview", "-o", "n")
    assert "note: grid: the interpolation error between nodes" in said and "--smooth 1" in said


def test_what_is_foreseen_of_a_grid_is_what_the_grid_will_hold(truth, clocked):
    scene, exact = truth
    race = Race(scene, {"levelset": exact}, [clocked], [9, 21], 3, 5)
    race.predict(clocked, Nearest(), 21, 8, default=True)
    (seen,) = race.points
    assert seen.default and not seen.built and seen.paths == 8
    assert seen.seconds == pytest.approx([8 * seen.queries] * 3)
    asked = exact.queries
    for seed, light in zip((5, 6, 7), seen.light):
        run = Run(scene, clocked, 21, 3, seed)
        run.go_on(8)
        grids = run.fill(Nearest())[0]
        whole = seen.covered & look_up(grids, asked)[1]
        assert whole.mean() > 0.9
        np.testing.assert_allclose(light[whole], grids[0].lookup(asked.point[whole]), rtol=1e-4, atol=1e-5)
    assert seen.queries == sum(map(len, run.bake.answers)) and not race.missing_seeds()  # it needs no more seeds
    race.contestants = [Run(scene, clocked, 21, 3, 5)]
    while contestant := race.next(np.inf):
        race.advance(contestant)
    assert [p.built for p in race.points if p.paths == 8] == [True]  # what is built takes its place


def test_runs_default_is_charted_first_and_goes_on(truth):
    scene, exact = truth
    race = Race(scene, {"levelset": exact}, [METHOD], [5, 11], 3, 0)
    race.show_default(METHOD, Nearest(), 11, 64)
    (default,) = race.points
    assert default.default and default.built and default.paths == 64
    while contestant := race.next(np.inf):
        race.advance(contestant)
    assert {p.paths for p in race.points if p.grid == 11} <= {64, 128, 512, 2048}  # no contestant starts anew beside it
    assert sum(p.paths == 64 for p in race.points) == 1 and {p.grid for p in race.points} == {5, 11}


def test_it_reports_where_runs_default_stands(truth):
    _, exact = truth
    truths = {"levelset": exact}
    quick, own = point(exact, 1, 0.09, 8, 16), point(exact, 14.6, 0.2, 8, 64)
    own.default, own.built = True, False
    records = [report.record(quick, truths, True), report.record(own, truths, False)]
    said = report.advice(records, PARTS, 5)
    assert said[1].startswith("run's default (about 15 s, error 20.00%) is dominated by --sampler direct")
    assert "--paths 16 --bounces 5 (1 s, error 9.00%)" in said[1]
    text = table(records)
    assert text.index("the front:") < text.index("run's default:") < text.index("~14.60")
    records = [report.record(quick, truths, True), report.record(own, truths, True)]
    assert "run's default (about 15 s, error 20.00%) is on the front" in report.advice(records, PARTS, 5)


def test_a_default_that_is_too_costly_is_foreseen_and_so_are_its_neighbours(truth, clocked):
    scene, exact = truth
    race = Race(scene, {"levelset": exact}, [clocked], [5, 11, 22], 3, 0)
    said = _show_default(race, 11, 32, 1e-6, 1e-6)
    assert "~" in said[0] and [(p.grid, p.paths, p.built) for p in race.points] == [(11, 32, False)]
    # A second a path: there is time for three seeds of 8 paths, not of 32.
    race = Race(scene, {"levelset": exact}, [clocked], [5, 11, 22], 3, 0)
    _show_default(race, 22, 32, (3 * 8 * 8 * len(exact) + 1000) / 0.15, 1.0)
    assert {(p.grid, p.paths, p.default) for p in race.points} == {(22, 32, True), (11, 8, False), (22, 8, False)}
    assert not any(p.built for p in race.points)
    shown = {(p.grid, p.paths): p for p in race.points}
    assert shown[22, 32].time == pytest.approx(4 * shown[22, 8].time) == pytest.approx(32 * shown[22, 8].queries)
    race = Race(scene, {"levelset": exact}, [clocked], [5, 11, 22], 3, 0)
    assert not _show_default(race, 11, 32, 1e6, 1e-6)
    assert [(p.grid, p.paths, p.built) for p in race.points] == [(11, 32, True)]


def test_runs_default_under_a_sky_races_with_its_first_look_and_its_command_line_gives_the_same_light():
    scene = Scene.sky(ball(14), range=(0.4, 0.9))
    tracer = prepare(BACKEND, scene)
    exact = begin(tracer, unseen_on_level_sets(scene, 8, 200, 0), 8, 0, 256)
    way = Method(Direct(), BACKEND, tracer, "levelset", (Nearest(),))

    def race():
        return Race(scene, {"levelset": exact}, [way], [6], 3, 5)

    shown = race()
    assert not _show_default(shown, None, None, 1e6, 1e-6)
    (default,) = shown.points
    assert default.default and default.built and default.method.looked
    own = run(scene, isovalues=2, seed=5, judge=False)
    assert default.paths == own.recipe["paths"] and default.queries == own.recipe["queries"]
    np.testing.assert_array_equal(default.light[0], look_up(own.grids, exact.queries)[0])
    while contestant := shown.next(np.inf):
        shown.advance(contestant)
    more = next(p for p in shown.points if p.method.looked and p.paths == 128)
    record = report.record(more, shown.references, True)
    assert report.options(record, 3) == "--backend numba --paths 128" and "first look" in record["contestant"]
    again = run(scene, backend="numba", paths=128, isovalues=2, seed=5, judge=False)
    np.testing.assert_allclose(more.light[0], look_up(again.grids, exact.queries)[0], rtol=1e-5)  # walked in two rounds
    shown.repeat(np.inf, lambda: None)
    assert "nearest was" not in str(report.advice([record | {"rmse": 0.001}], PARTS, 3))
    assert "dominated" not in str(report.advice([record | {"rmse": 0.2}], PARTS, 3))
    predicted, without = race(), race()
    predicted.predict(default.method, default.interpolator, None, None, default=True)
    (seen,) = predicted.points
    assert seen.default and not seen.built and seen.queries == default.queries
    np.testing.assert_allclose(seen.light[0], default.light[0], rtol=1e-4)
    assert "does not compete" in _show_default(without, None, None, 1e-9, 1e-6)[0] and not without.points


def test_runs_default_for_noisy_data_in_the_studio_is_read_by_level_and_normal():
    smooth = ball(14)
    noise = np.random.default_rng(0).normal(0, 0.25, smooth.shape)
    rough = Volume((smooth.values + noise).astype(np.float32), smooth.origin, smooth.spacing)
    scene = Scene.studio(rough, range=(0.3, 0.7))
    tracer = prepare(BACKEND, scene)
    exact = begin(tracer, unseen_on_level_sets(scene, 8, 200, 0), 3, 0)
    way = Method(Direct(), BACKEND, tracer, "levelset", (Nearest(), Bilateral()))
    own = run(scene, bounces=3, isovalues=2, seed=5, judge=False)
    expected = look_up(own.grids, exact.queries)[0]
    for budget in (1e6, 1e-9):
        race = Race(scene, {"levelset": exact}, [way], [6], 3, 5)
        _show_default(race, None, None, budget, 1e-6)
        (default,) = race.points
        assert own.recipe["by_normal"] and default.default and default.built == (budget > 1)
        assert (default.paths, default.queries) == (own.recipe["paths"], own.recipe["queries"]) and default.time > 0
        np.testing.assert_allclose(default.light[0], expected, rtol=1e-4)
        record = report.record(default, race.references, True)
        assert record["contestant"] == "direct, numba (levelset), bilateral 1.0"  # beside that of density 2
        assert report.options(record, 3) == (
            "--sampler direct --backend numba --interpolator bilateral --set interpolator.density=1.0 "
            f"--grid {own.recipe['grid']} --paths 16 --bounces 3"
        )


def test_points_are_given_up_for_a_sharper_truth_where_light_is_rough(truth):
    _, exact = truth
    assert len(_thinned(exact, 1.0, 1e9, 0)) == len(exact)
    many = exact[np.arange(2000) % len(exact)]
    few = _thinned(many, 1.0, 0.6 * (exact.error / 0.01) ** 2, 0)
    assert abs(len(few) - 1200) <= 1
    assert len(_thinned(many, 1.0, 1e-9, 0)) == 500


def test_time_is_kept_for_all_that_another_seed_takes(truth):
    scene, exact = truth
    race = Race(scene, {"levelset": exact}, [METHOD], [8], 3, 0)
    plain, filled, beaten = point(exact, 1.0, 0.2, seeds=1), point(exact, 1.5, 0.1, seeds=1), point(exact, 9.0, 0.3)
    filled.interpolator, beaten.interpolator = Splat(), Rbf()
    plain.filling, filled.filling, beaten.filling = 0.1, 0.6, 8.0
    race.points = [plain, filled, beaten]
    assert race.missing_seeds() == [(pytest.approx(0.9 + 0.1 + 0.6), [plain, filled])]


@dataclass(frozen=True)
class Fake:
    """A plugin's backend: quick, and light or not, as it says."""

    name: ClassVar[str] = "fake"
    geometry: ClassVar[str] = "levelset"
    transport: bool = True

    def solve(self, scene, queries, *, paths, bounces, seed):
        light = np.ones((len(queries), 3), np.float32)
        return Samples(queries, light, 0 * light, np.full(len(queries), len(paths), np.int32))


@pytest.mark.parametrize("transport", [True, False])
def test_the_reference_comes_from_the_packages_own_transport_however_quick_a_plugin_is(truth, monkeypatch, transport):
    scene, exact = truth
    fake = Fake(transport)
    found = [("fake", fake, capabilities(fake)), ("numba", BACKEND, capabilities(BACKEND))]
    packages = {"fake": "illumgrid-fake", "numba": "illumgrid"}
    monkeypatch.setattr(registry, "backends", lambda: iter(found))
    monkeypatch.setattr(registry, "entry", lambda kind, name: SimpleNamespace(package=packages[name]))
    entrants, notes = tracers(scene, exact.queries, 1e6)
    assert {m.backend.name for m in entrants} == ({"fake", "numba"} if transport else {"numba"})
    assert transport or "fake does not compete: it computes no light transport" in notes[0]
    fast = [replace(m, slow=1.0 if m.backend is fake else 9.0) for m in entrants]
    assert _tracer_of(fast, "levelset") is next(m.tracer for m in fast if m.backend is BACKEND)
    references, _ = _references(scene, fast, exact.queries[:50], 1e6, 0, [])
    assert references["levelset"].mean > 1.2  # and not the plugin's 1


def test_a_backend_that_fails_ends_its_own_race_only(truth, monkeypatch):
    class Broken(Fake):
        def solve(self, scene, queries, **how):
            raise RuntimeError("no licence")

    broken = Broken()
    found = [("fake", broken, capabilities(broken)), ("numba", BACKEND, capabilities(BACKEND))]
    monkeypatch.setattr(registry, "backends", lambda: iter(found))
    entrants, notes = tracers(truth[0], truth[1].queries, 1e6)
    assert {m.backend.name for m in entrants} == {"numba"} and notes == ["fake does not compete: no licence"]


def test_of_fields_of_different_size_the_marked_setting_lights_the_nodes_of_each():
    fields = Field("fine", ball(12), range=(0.5, 0.9)), Field("coarse", ball(6, at=(0.5, 0, 0)), range=(0.5, 0.9))
    scene = Scene(fields, background=np.ones(3))
    tracer = prepare(BACKEND, scene)
    exact = begin(tracer, unseen_on_level_sets(scene, 4, 100, 0), 4, 0)
    race = Race(scene, {"levelset": exact}, [replace(METHOD, tracer=tracer)], [7, 14], 3, 0)
    specs = specs_over(scene)
    nodes = sum(len(reachable(field, spec)) for field, spec in zip(fields, specs))
    for budget in (1e6, 1e-6):  # built, and predicted
        race.points = []
        _show_default(race, None, 4, budget, 1e-6)
        assert [p.default for p in race.points] == [True]
        assert race.points[0].queries == nodes and race.points[0].longest == 14
    assert [max(spec.shape) for spec in specs] == [14, 7]


CUT = Scene.studio(ball(14, at=(0.5, 0.0, 0.0)), range=(0.4, 0.9))  # with a cap, and lights in channels of their own


@pytest.mark.parametrize("scene", [SCENE, CUT])
def test_pictures_of_grids_are_compared_with_one_of_traced_light(scene, monkeypatch):
    """FLIP itself is an extra; here the mean difference stands for it."""
    from illumgrid.show import difference

    flip = types.ModuleType("flip_evaluator")
    flip.__spec__ = importlib.machinery.ModuleSpec("flip_evaluator", None)
    flip.evaluate = lambda one, other, *_, **__: (None, float(np.abs(one - other).mean()), None)
    monkeypatch.setitem(sys.modules, "flip_evaluator", flip)
    monkeypatch.setattr(difference, "PATHS", 2)
    paths = 2 * difference.SIDE**2 * 50**2 * (4 / 3) * 0.4  # for a picture of 64 x 48
    compare = difference.studio(scene, prepare(BACKEND, scene), 1.0, 2, 0, paths)
    grids = list(run(scene, grid=12, paths=16, bounces=2).grids)
    dark = [replace(grid, values=np.zeros_like(grid.light)) for grid in grids]
    assert compare(grids) < 0.02 < compare(dark)
