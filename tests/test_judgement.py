"""What is said of a finished run: its error on its own surface, and never at the price of the run."""

import json
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

import illumgrid as ig
from illumgrid import chain
from illumgrid.accuracy.judge import remedies
from illumgrid.accuracy.probe import Probe
from illumgrid.backends.numba_ import Numba
from illumgrid.field.lattice import specs_over
from shapes import ball, sky

pytestmark = pytest.mark.judged

QUICK = {"grid": 8, "paths": 4, "bounces": 1, "isovalues": 2, "judge": True}


def recipe(folder):
    return json.loads((folder / "run.json").read_text("utf-8"))["recipe"]


def dark():
    return replace(sky(ball(9)), background=np.zeros(3))


# Finished runs are kept.


def test_darkness_is_said_before_the_light_is_computed_and_judged_by_nothing():
    happened = []
    with pytest.warns(ig.IllumgridWarning, match="dark: no background") as caught:
        light = ig.run(dark(), **QUICK, progress=lambda what, *_: happened.append((what, len(caught))))
    assert happened[0][1] == 1  # the warning was there before the first path
    assert light.recipe["reached"] is None and not light.grids[0].values.any()


def test_a_range_that_begins_at_the_end_of_the_data_is_judged_by_nothing():
    light = ig.run(sky(ball(9), (float(ball(9).values.max()), 3.0)), **QUICK)
    assert light.recipe["reached"] is None and light.recipe["reached_uncertain"] is None


def test_the_command_line_keeps_runs_without_light_or_surface(call, tmp_path):
    (tmp_path / "dark.toml").write_text("[[field]]\nname = 'ball'\nvolume = 'v.npy'\nrange = [0.3, 0.9]\n")
    options = ("--grid", 6, "--paths", 2, "--bounces", 1, "--no-preview")
    said = call("run", "dark.toml", *options, "-o", "dark")
    assert "note: dark: " in said and "error reached" not in said and "wrote dark" in said
    assert recipe(tmp_path / "dark")["warnings"][-1].startswith("dark: ")
    end = float(ball(10).values.max())
    assert "wrote end" in call("run", "v.npy", "--range", end, 3, *options, "-o", "end")
    assert ig.load(tmp_path / "end").recipe["reached"] is None


@pytest.mark.parametrize("reason", [ZeroDivisionError("in a judgement"), KeyboardInterrupt()])
def test_a_judgement_that_fails_or_is_stopped_leaves_the_run_whole(call, tmp_path, monkeypatch, reason):
    def fails(*_):
        raise reason

    monkeypatch.setattr(chain, "measure_error", fails)
    said = call("run", "v.npy", "--range", 0.3, 0.9, "--grid", 6, "--paths", 2, "--no-preview", "-o", "out")
    assert "could not be measured" in said or "stopped before the error was measured" in said
    assert ig.load(tmp_path / "out").recipe["reached"] is None


def test_what_was_judged_is_kept_with_the_run(call, tmp_path):
    said = call("run", "v.npy", "--range", 0.3, 0.9, "--grid", 6, "--paths", 4, "--no-preview", "-o", "out")
    kept = ig.load(tmp_path / "out").recipe
    assert f"error reached: {kept['reached']:.2%} +- {kept['reached_uncertain']:.2%} of the mean light" in said
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


# A result is judged on its own surface or not at all.


@dataclass(frozen=True)
class Occlusion:
    """As Numba, but it says that it is no light."""

    name: ClassVar[str] = "occlusion"
    geometry: ClassVar[str] = "levelset"
    transport: ClassVar[bool] = False

    def solve(self, scene, queries, **how):
        return Numba().solve(scene, queries, **how)


@pytest.mark.parametrize("backend", [Numba(surface="mesh"), Occlusion()], ids=["mesh", "occlusion"])
def test_meshes_and_what_is_no_light_are_not_judged(backend):
    stages = {"sampler": ig.sampler("uniform", count=2), "backend": backend}
    assert ig.run(sky(ball(9)), **stages, **QUICK).recipe["reached"] is None


def test_a_library_user_gets_the_error_too():
    made = ig.run(sky(ball(9)), **QUICK).recipe
    assert 0 < made["reached"] < 0.1 and 0 < made["reached_uncertain"] < made["reached"]
    assert ig.run(sky(ball(9)), **{**QUICK, "judge": False}).recipe["reached"] is None


@pytest.mark.parametrize("options", [{"error": 0.2}, {"paths": 4, "grid": 6}], ids=["planned", "plain"])
def test_the_largest_seed_serves_as_well(options):
    assert ig.run(sky(ball(9)), seed=2**64 - 1, judge=True, isovalues=2, **options).recipe["reached"] < 0.3


def test_remedies_are_those_of_the_grids_as_they_are_and_of_the_option_as_it_is_advised(monkeypatch):
    fields = ig.Field("fine", ball(12), range=(0.5, 0.9)), ig.Field("coarse", ball(6, at=(0.5, 0, 0)), range=(0.5, 0.9))
    scene, seen = ig.Scene(fields, background=np.ones(3)), []
    measure = Probe.measure

    def watched(probe, ahead, paths):
        seen.append([spec.shape for spec in ahead.specs])
        return measure(probe, ahead, paths)

    monkeypatch.setattr(Probe, "measure", watched)
    specs = specs_over(scene)
    assert remedies(scene, Numba(), specs, 1, 0).keys() == {"now", "finer", "smooth"}
    assert seen[0] == seen[2] == [spec.shape for spec in specs] == [(14,) * 3, (7,) * 3]
    assert seen[1] == [(28,) * 3, (28,) * 3]  # what --grid 28 makes


# What a run says of its work.


def test_nodes_and_texels_are_counted_apart_with_their_paths_and_only_light_is_timed(call, tmp_path):
    said = call("run", "v.npy", "--range", 0.3, 0.9, "--scene", "floor", "--grid", 9, "--paths", 2, "--bounces", 1,
                "--isovalues", 2, "--no-preview", "-o", "out")  # fmt: skip
    made, light = recipe(tmp_path / "out"), ig.load(tmp_path / "out")
    texels = sum(wall.support.size for wall in light.walls)
    assert made["texels"] == texels and made["texel_paths"] % 2 == 0 and made["texel_paths"] >= 2
    work = f"{made['queries'] - texels} queries x 2 paths and {texels} texels of walls x {made['texel_paths']} paths"
    assert f"{work} in {sum(made['seconds'].values()):.1f} s" in said
    assert "texels" not in call(
        "run", "v.npy", "--range", 0.3, 0.9, "--grid", 4, "--paths", 1, "--no-preview", "-o", "p"
    )


def test_a_run_sets_its_scene_up_once(monkeypatch):
    set_up, prepare = [], chain.prepare
    monkeypatch.setattr(chain, "prepare", lambda backend, scene: set_up.append(backend) or prepare(backend, scene))
    assert ig.run(sky(ball(9)), **{**QUICK, "judge": True}).recipe["reached"] is not None
    assert len(set_up) == 1
