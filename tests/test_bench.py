"""The race and what is made of it."""

import csv
import json
import warnings
from dataclasses import replace

import numpy as np
import pytest

from illumgrid.accuracy.chart import _remarks, _show_default, _thinned, bench, chart, told
from illumgrid.accuracy.chart import sizes as sizes_of
from illumgrid.accuracy.chart.contestants import COUNTS, Way, ways
from illumgrid.accuracy.chart.race import Point, Race, Run, covered, front
from illumgrid.accuracy.chart.whence import Bar
from illumgrid.accuracy.parts import Split
from illumgrid.accuracy.probe import Pace
from illumgrid.accuracy.truth import Truth, begin, errors, unseen_on_level_sets
from illumgrid.backends.numba_ import Numba
from illumgrid.field.scene import Scene
from illumgrid.interpolators.nearest import Nearest
from illumgrid.interpolators.rbf import Rbf
from illumgrid.interpolators.splat import Splat
from illumgrid.samplers.direct import Direct
from illumgrid.samplers.uniform import Uniform
from shapes import ball, refused, sky

BACKEND = Numba()
WAY = Way(Direct(), BACKEND, "levelset", (Nearest(),))


def scene_of(n=14):
    return Scene.floor(ball(n), range=(0.4, 0.9))


@pytest.fixture(scope="module")
def truth():
    scene = scene_of()
    return scene, begin(scene, BACKEND, unseen_on_level_sets(scene, 8, 200, 0), 8, 0, 256)


def point(truth, seconds, off, grid=8, paths=4, way=WAY, seeds=3):
    made = Point(way, way.interpolators[0], grid, paths, 100, np.ones(len(truth), bool))
    made.seconds = [seconds] * seeds
    made.light = [truth.light + np.hypot(off, truth.error) * truth.mean] * seeds
    return made


def split_of(noise, grid=0.0):
    return Split(noise**2, grid**2, 0.0, 1e-6, 0.0, 1e-6)


BARS = (Bar(8, 16, split_of(0.05, 0.02)), Bar(8, 64, split_of(0.01, 0.02)), Bar(16, 16, split_of(0.04)))


def test_the_front_is_what_nobody_beats(truth):
    _, exact = truth
    points = [point(exact, s, e) for s, e in ((1, 0.1), (2, 0.05), (3, 0.07), (4, 0.02), (0.5, 0.3), (4.1, 0.02))]
    assert [p.seconds[0] for p in front(points, {"levelset": exact})] == [0.5, 1, 2, 4]


def test_the_errors_of_a_point_have_the_truths_variance_subtracted(truth):
    _, exact = truth
    assert point(exact, 1, 0.1).rmse(exact) == pytest.approx(0.1, rel=1e-6)
    assert errors(exact.light, exact).rmse == pytest.approx(exact.error / 3)  # less cannot be told from none


def test_a_race_goes_from_cheap_to_dear_and_keeps_its_seeds(truth):
    scene, exact = truth
    denser = Way(Uniform(32), BACKEND, "levelset", (Nearest(),))
    race = Race(
        scene, {"levelset": exact}, [WAY, Way(Uniform(8), BACKEND, "levelset", (Nearest(),), denser)], [4, 7], 3, 0
    )
    while lane := race.next(np.inf):
        race.step(lane)
        assert len(race.points) < 60
    ways = {"direct, numba (levelset), nearest", "uniform 8, numba (levelset), nearest"}
    assert {p.label for p in race.points} >= ways
    assert {p.grid for p in race.points if p.way is WAY} == {4, 7}
    for p in race.points:
        assert len(p.light) == 1 and p.light[0].shape == (len(exact), 3) and p.seconds[0] > 0
    race.repeat(np.inf, lambda: None)
    best = front(race.points, race.truths)
    assert all(len(p.seconds) == 3 for p in best)
    assert all(not np.array_equal(p.light[0], p.light[1]) for p in best if p.rmse(exact) > 1e-3)


def test_a_run_that_goes_on_is_the_run_with_more_paths(truth):
    scene, _ = truth
    halting, straight = Run(scene, WAY, 7, 3, 5), Run(scene, WAY, 7, 3, 5)
    for paths in (4, 16, 64):
        halting.go_on(paths)
    straight.go_on(64)
    one, other = (run.fill(Nearest())[0][0].values for run in (halting, straight))
    np.testing.assert_allclose(one, other, rtol=1e-5)


def test_covered_points_read_only_nodes_with_light(truth):
    scene, exact = truth
    run = Run(scene, WAY, 9, 1, 0)
    run.go_on(4)
    (grid,), _ = run.fill(Nearest())
    asked = exact.queries
    assert covered([replace(grid, support=np.ones_like(grid.support))], asked).all()
    assert not covered([replace(grid, support=np.zeros_like(grid.support))], asked).any()


def test_everything_that_is_registered_takes_part_or_is_told(truth):
    scene, exact = truth
    entrants, notes = ways(scene, exact.queries, 1e6)
    names = {(w.sampler.name, w.backend.name) for w in entrants}
    assert {("direct", "numba"), ("uniform", "numba"), ("direct", "reference")} <= names
    chain = next(w for w in entrants if w.sampler.name == "uniform")
    assert chain.sampler.count == COUNTS[0] and chain.denser.sampler.count == COUNTS[1]
    few, notes = ways(scene, exact.queries, 1e-6)
    assert {w.backend.name for w in few} == {"numba"}  # the fastest is never too slow
    assert any("reference takes no part: 64 queries" in note for note in notes)


def test_the_advice_names_the_fastest_that_is_good_enough_and_what_is_missing(truth):
    _, exact = truth
    truths = {"levelset": exact}
    points = [point(exact, 1, 0.09, 8, 16), point(exact, 4, 0.025, 8, 64)]
    records = [told.record(p, truths, True) for p in points]
    said = told.advice(records, BARS, 5)
    assert said[0].startswith("for 3% use --sampler direct --backend numba --interpolator nearest --grid 8 --paths 64")
    assert said[1].startswith("for 10% use") and "--paths 16 --bounces 5 (1 s, error 9.00%)" in said[1]
    assert "1% was not reached" in said[2] and "the grid's: more nodes" in said[2]
    assert "noise: more paths" in told.advice(records[:1], BARS, 5)[-1]
    paper = told.record(point(exact, 1, 0.2, way=Way(Uniform(8), BACKEND, "levelset", (Nearest(),))), truths, False)
    assert "--isovalues 8 " in told.options(paper, 4)
    table = told.table([*records, paper])
    assert table.index("the front:") < table.index("direct") < table.index("the best of the others:")


def test_remarks_tell_a_blunt_truth_and_missing_seeds(truth):
    _, exact = truth
    one, other = exact.halves
    blunt = Truth((one, replace(other, mean=other.mean + 1)), 8)
    said = _remarks((point(blunt, 1, 0.01, seeds=1),), {"levelset": blunt})
    assert "more than a fifth" in said[0] and "fewer than 3 seeds" in said[1]
    assert not _remarks((point(exact, 1, 0.5),), {"levelset": exact})


def test_the_chart_can_be_drawn_of_one_point_and_of_many(truth):
    _, exact = truth
    records = [
        told.record(point(exact, s, 0.1 / s, seeds=k), {"levelset": exact}, s < 3) for s, k in ((1, 3), (2, 1), (3, 1))
    ]
    for some in (records[:1], records):
        figure = chart.draw(some, BARS, "a ball")
        left, right = figure.axes
        assert left.get_xscale() == left.get_yscale() == "log" and "seconds" in left.get_xlabel()
        assert "direct, numba (levelset), nearest" in [t.get_text() for t in figure.legends[0].get_texts()]
        heights = [sum(bars[k].get_height() for bars in right.containers if hasattr(bars, "patches")) for k in range(3)]
        np.testing.assert_allclose(
            heights, [100 * np.sqrt(sum(vars(b.split).values()) - 1e-6) for b in BARS], rtol=1e-3
        )
    assert chart.image(figure, "png").startswith(b"\x89PNG") and b"<svg" in chart.image(figure, "svg")


def test_grids_of_a_third_to_twice_the_voxels_but_none_on_them():
    assert sizes_of(sky(ball(20))) == [6, 12, 24, 38]


def test_a_budget_or_a_scene_that_cannot_be_is_refused():
    refused(lambda: bench(sky(), 0.0), "budget of 0 seconds", "such as 60")


def test_bench_writes_what_it_says_whole_and_once(call, tmp_path):
    arguments = ("bench", "v.npy", "--range", 0.3, 0.9, "--budget", 4, "-o", "b")
    said = call(*arguments)
    assert "the front:" in said and "for 10% use --sampler" in said and "wrote b" in said
    assert sorted(p.name for p in (tmp_path / "b").iterdir()) == ["bench.csv", "bench.json", "chart.png", "chart.svg"]
    found = json.loads((tmp_path / "b" / "bench.json").read_text("utf-8"))
    assert found["truth"]["levelset"]["points"] >= 1000 and found["truth"]["levelset"]["isovalues"] >= 8
    assert found["parts"] and found["advice"] and found["bounces"] >= 0
    rows = list(csv.DictReader((tmp_path / "b" / "bench.csv").read_text("utf-8").splitlines()))
    assert (
        len(rows) == len(found["points"]) and {"seconds", "rmse", "bias", "p95", "flip", "memory_mb"} <= rows[0].keys()
    )
    assert "new folder" in call(*arguments, code=2)


def test_bench_refuses_before_anything_runs(refuse, tmp_path):
    refuse("bench", "nowhere.npy", words=["nowhere.npy"])
    refuse("bench", "v.npy", "--budget", 0, words=["budget"])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    refuse("bench", "v.npy", "-o", "mine", words=["mine", "new folder"])


def test_run_tells_the_error_that_it_reached_and_what_it_chose(call, tmp_path):
    said = call("run", "v.npy", "--range", 0.3, 0.9, "--error", 0.1, "--no-preview", "-o", "e")
    assert "nodes along the longest axis" in said and "error reached" in said and "the pilot said" in said
    recipe = json.loads((tmp_path / "e" / "run.json").read_text("utf-8"))["recipe"]
    assert recipe["plan"]["why"] and recipe["reached"] < 0.13
    assert "error reached" in call("run", "v.npy", "--range", 0.3, 0.9, "--grid", 5, "--no-preview", "-o", "plain")


def test_run_says_what_would_help_noisy_data(call, tmp_path):
    noise = np.random.default_rng(0).normal(size=(16, 16, 16))
    np.save(tmp_path / "noise.npy", ball(16).values + 0.2 * noise.astype(np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        said = call("run", "noise.npy", "--range", 0.4, 0.7, "--grid", 12, "--no-preview", "-o", "n")
    assert "note: grid: between the nodes" in said and "--smooth 1" in said


def test_what_is_foreseen_of_a_grid_is_what_the_grid_will_hold(truth):
    scene, exact = truth
    race = Race(scene, {"levelset": exact}, [WAY], [9, 21], 3, 5)
    race.foresee(WAY, Nearest(), 21, 8, 12.5, default=True)
    (seen,) = race.points
    assert seen.default and not seen.built and seen.seconds == [12.5] * 3 and seen.paths == 8
    asked = exact.queries
    for seed, light in zip((5, 6, 7), seen.light):
        run = Run(scene, WAY, 21, 3, seed)
        run.go_on(8)
        grids = run.fill(Nearest())[0]
        whole = seen.covered & covered(grids, asked)
        assert whole.mean() > 0.9
        np.testing.assert_allclose(light[whole], grids[0].lookup(asked.point[whole]), rtol=1e-4, atol=1e-5)
    assert seen.queries == len(run.answers[0]) and not race.front_ladders()  # it needs no more seeds
    race.lanes[0].run.grid = 21
    while lane := race.next(np.inf):
        race.step(lane)
    assert [p.built for p in race.points if p.paths == 8] == [True]  # what is built takes its place


def test_runs_default_is_charted_first_and_goes_on(truth):
    scene, exact = truth
    race = Race(scene, {"levelset": exact}, [WAY], [5, 11], 3, 0)
    race.show_default(WAY, Nearest(), 11, 64)
    (default,) = race.points
    assert default.default and default.built and default.paths == 64
    while lane := race.next(np.inf):
        race.step(lane)
    assert {p.paths for p in race.points if p.grid == 11} <= {64, 128, 512, 2048}  # no lane starts anew beside it
    assert sum(p.paths == 64 for p in race.points) == 1 and {p.grid for p in race.points} == {5, 11}


def test_it_is_told_where_runs_default_stands(truth):
    _, exact = truth
    truths = {"levelset": exact}
    quick, own = point(exact, 1, 0.09, 8, 16), point(exact, 14.6, 0.2, 8, 64)
    own.default, own.built = True, False
    records = [told.record(quick, truths, True), told.record(own, truths, False)]
    said = told.advice(records, BARS, 5)
    assert said[1].startswith("run's default (about 15 s, error 20.00%) is beaten by --sampler direct")
    assert "--paths 16 --bounces 5 (1 s, error 9.00%)" in said[1]
    table = told.table(records)
    assert table.index("the front:") < table.index("run's default:") < table.index("~14.60")
    records = [told.record(quick, truths, True), told.record(own, truths, True)]
    assert "run's default (about 15 s, error 20.00%) is on the front" in told.advice(records, BARS, 5)


def test_a_default_that_is_too_costly_is_foreseen_and_so_are_its_neighbours(truth, monkeypatch):
    scene, exact = truth
    race = Race(scene, {"levelset": exact}, [WAY], [5, 11, 22], 3, 0)
    said = _show_default(race, 11, 32, 1e-6)
    assert "~" in said[0] and [(p.grid, p.paths, p.built) for p in race.points] == [(11, 32, False)]
    with monkeypatch.context() as patch:  # a second a path: there is time for three seeds of 8 paths, not of 32
        patch.setattr("illumgrid.accuracy.chart.timed", lambda *_: Pace(0.0, 1.0))
        race = Race(scene, {"levelset": exact}, [WAY], [5, 11, 22], 3, 0)
        _show_default(race, 22, 32, (3 * 8 * 8 * len(exact) + 1000) / 0.15)
    assert {(p.grid, p.paths, p.default) for p in race.points} == {(22, 32, True), (11, 8, False), (22, 8, False)}
    assert not any(p.built for p in race.points)
    shown = {(p.grid, p.paths): p for p in race.points}
    assert shown[22, 32].time == 4 * shown[22, 8].time == 32 * shown[22, 8].queries
    race = Race(scene, {"levelset": exact}, [WAY], [5, 11, 22], 3, 0)
    assert not _show_default(race, 11, 32, 1e6)
    assert [(p.grid, p.paths, p.built) for p in race.points] == [(11, 32, True)]


def test_points_are_given_up_for_a_sharper_truth_where_light_is_rough(truth):
    _, exact = truth
    assert len(_thinned(exact, "levelset", 1.0, 1e9, 0)) == len(exact)
    many = exact[np.arange(2000) % len(exact)]
    few = _thinned(many, "mesh", 1.0, 0.6 * (exact.error / 0.01) ** 2, 0)
    assert few.surface == "mesh" and abs(len(few) - 1200) <= 1
    assert len(_thinned(many, "mesh", 1.0, 1e-9, 0)) == 500


def test_time_is_kept_for_all_that_another_seed_takes(truth):
    scene, exact = truth
    race = Race(scene, {"levelset": exact}, [WAY], [8], 3, 0)
    plain, filled, beaten = point(exact, 1.0, 0.2, seeds=1), point(exact, 1.5, 0.1, seeds=1), point(exact, 9.0, 0.3)
    filled.interpolator, beaten.interpolator = Splat(), Rbf()
    plain.filling, filled.filling, beaten.filling = 0.1, 0.6, 8.0
    race.points = [plain, filled, beaten]
    assert race.front_ladders() == {(id(WAY), 8, 4): pytest.approx(0.9 + 0.1 + 0.6)}
