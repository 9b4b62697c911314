"""The chain as a library user sees it: run, look up, colour, save, load."""

import json
from dataclasses import dataclass
from importlib.metadata import version
from typing import ClassVar

import numpy as np
import pytest
from PIL import Image

import illumgrid as ig
from illumgrid import show as preview
from illumgrid.tone import curve, encode_srgb
from shapes import ball, lit, refused, sky

QUICK = {"grid": 8, "paths": 4, "bounces": 1}


@pytest.fixture(scope="module")
def light():
    """A quick run."""
    return ig.run(sky(ball(12), albedo=(0.9, 0.6, 0.3)), **QUICK)


def test_a_run_lights_every_field_on_a_grid_of_the_size_asked_for(light):
    (grid,) = light.grids
    assert light.grid("field") is grid and grid.spec.shape == (8, 8, 8)
    assert light.levels.table.shape == (32, 1)
    assert grid.values.min() >= 0 and 0 < grid.values[grid.support > 0].mean() <= np.pi * 1.01
    refused(lambda: light.grid("nobody"), "'nobody'", "field")


def test_the_light_of_a_convex_body_under_a_white_sky_is_pi(light):
    way = np.random.default_rng(0).normal(size=(200, 3))
    light_there = light.grids[0].lookup(0.6 * way / np.linalg.norm(way, axis=1, keepdims=True))
    assert np.median(light_there) == pytest.approx(np.pi, rel=0.02)


def test_by_default_six_nodes_are_lit_for_seven_voxels_but_at_most_150_where_light_is_smooth():
    assert ig.run(sky(ball(9)), paths=1, bounces=0).grids[0].spec.shape == (8, 8, 8)
    wide = ball(shape=(3, 3, 200), origin=(-0.01, -0.01, -1), spacing=(0.01, 0.01, 2 / 199))
    light = ig.run(sky(wide, (0.9, 1.0)), paths=1, bounces=0)
    assert light.recipe["refined"]["from"] == 150
    with_stages = ig.run(sky(ball(9)), paths=1, bounces=0, interpolator="splat")
    assert with_stages.grids[0].spec.shape == (11, 11, 11)


def test_the_recipe_says_how_it_was_made(light):
    recipe = light.recipe
    assert recipe["sampler"] == {"name": "direct"} and recipe["interpolator"] == {"name": "nearest"}
    assert recipe["backend"] == {"name": "numba", "threads": 0, "surface": "auto"}
    assert {k: recipe[k] for k in ("grid", "paths", "bounces", "isovalues", "seed")} == {
        "grid": 8, "paths": 4, "bounces": 1, "isovalues": 32, "seed": 0,
    }  # fmt: skip
    assert recipe["queries"] > 100 and recipe["holes"] == [0]
    assert recipe["seconds"].keys() == {"sampler", "backend", "interpolator"}
    grid = light.grids[0]
    known = np.isfinite(grid.error)
    noise = np.sqrt((grid.error[known].astype(float) ** 2).mean()) / grid.values[known].mean()
    assert recipe["relative_error"] == [pytest.approx(noise)]
    missed = 0.2 / 4  # what four paths may not have met
    assert missed <= noise and np.sqrt(noise**2 - missed**2) < 0.05  # few dip under a facet
    assert recipe["versions"] == {name: version(name) for name in ("illumgrid", "numpy", "numba", "scipy")}
    assert json.loads(json.dumps(recipe, allow_nan=False)) == recipe


def test_the_reported_error_is_that_of_the_nodes():
    rough = ig.Volume(np.random.default_rng(0).random((6, 6, 6)))
    light = ig.run(ig.Scene.sky(rough, range=(0.3, 0.7)), paths=16, bounces=1, grid=7)
    known = light.grids[0].support > 0
    expected = np.sqrt((light.grids[0].error[known].astype(float) ** 2).mean()) / light.grids[0].values[known].mean()
    assert light.recipe["relative_error"] == [pytest.approx(expected)] and 0.02 < expected < 0.5


def test_one_path_has_no_error_to_tell():
    light = ig.run(sky(ball(8)), grid=6, paths=1, bounces=0)
    assert light.recipe["relative_error"] == [None]


def test_what_is_saved_is_what_is_loaded(light, tmp_path):
    light.save(tmp_path / "out", preview=False)
    again = ig.load(tmp_path / "out")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["illumination.exr", "run.json"]
    for name in ("values", "error", "support"):
        assert np.array_equal(getattr(again.grids[0], name), getattr(light.grids[0], name))
    assert np.array_equal(again.levels.table, light.levels.table)
    assert np.array_equal(again.scene.fields[0].volume.values, light.scene.fields[0].volume.values)
    assert again.recipe == {**light.recipe, "exposure": light.exposure}
    assert again.exposure == light.exposure
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    assert np.array_equal(again.color(points), light.color(points))


def test_saving_draws_the_picture_unless_it_must_not_and_replaces_only_when_it_may(light, tmp_path, monkeypatch):
    monkeypatch.setattr(preview.render, "__kwdefaults__", {**preview.render.__kwdefaults__, "width": 80, "height": 60})
    light.save(tmp_path / "out")
    with Image.open(tmp_path / "out" / "preview.png") as picture:
        assert np.array_equal(np.asarray(picture), preview.render(light))
    refused(lambda: light.save(tmp_path / "out"), "finished run", "overwrite=True")
    light.save(tmp_path / "out", preview=False, overwrite=True)
    assert not (tmp_path / "out" / "preview.png").exists()


def test_a_colour_is_albedo_over_pi_times_light_times_exposure_in_srgb(light):
    points = np.random.default_rng(1).uniform(-0.7, 0.7, (30, 3))
    radiance = light.grids[0].lookup(points) * np.array([0.9, 0.6, 0.3]) / np.pi
    for exposure in (None, 0.5, 3.0):
        used = light.exposure if exposure is None else exposure
        color = light.color(points, "field", exposure)
        assert color.dtype == np.uint8 and np.array_equal(color, encode_srgb(curve(radiance * used)))
    assert np.array_equal(light.color(points), light.color(points, "field"))
    refused(lambda: light.color(points, "nobody"), "'nobody'")


def test_one_exposure_serves_all_fields():
    scene = ig.Scene(tuple(ig.Field(n, ball(8), ig.Material(a)) for n, a in (("a", (0.2,) * 3), ("b", (0.8,) * 3))))
    light = lit(scene, 2.0)
    assert light.exposure == pytest.approx(0.8 / (0.8 / np.pi * 2))
    dark = light.color([[0, 0, 0]], "a").tolist()
    assert dark == encode_srgb(np.full((1, 3), 0.2)).tolist() and dark != light.color([[0, 0, 0]], "b").tolist()


@pytest.mark.parametrize(
    "options, words",
    [
        ({"paths": 0}, ["0 paths", "at least 1"]),
        ({"bounces": -1}, ["-1 bounces", "0"]),
        ({"grid": 1}, ["grid of 1 nodes", "at least 2"]),
        ({"isovalues": 1}, ["1 isovalues", "at least 2"]),
        ({"seed": -1}, ["seed", "-1"]),
        ({"seed": 2**64}, ["seed", "2**64"]),
        ({"sampler": "dirct"}, ["no sampler", "'dirct'", "uniform", "did you mean 'direct'?"]),
        ({"backend": "nubma"}, ["no backend", "did you mean 'numba'?"]),
        ({"interpolator": "nearst"}, ["no interpolator", "did you mean 'nearest'?"]),
        ({"interpolator": "zzz"}, ["no interpolator", "'zzz'", "expected one of nearest"]),
    ],
)
def test_options_out_of_range_and_unknown_names_are_refused_in_a_sentence(options, words):
    text = refused(lambda: ig.run(sky(ball(6)), **{**QUICK, **options}), *words)
    assert "did you mean" in " ".join(words) or "did you mean" not in text


def test_stages_are_made_by_name_with_options_of_the_right_type():
    assert ig.sampler("uniform", count=5) == ig.sampler("uniform", count="5")
    assert ig.backend("auto") == ig.backend("numba") and ig.backend("numba", threads=2).threads == 2
    assert ig.interpolator("nearest").name == "nearest"
    refused(lambda: ig.sampler("uniform", cuont=5), "'uniform'", "'cuont'", "count, points")
    refused(lambda: ig.sampler("direct", count=5), "'direct'", "no options")
    refused(lambda: ig.sampler("uniform", count="five"), "sampler.count", "'five'", "whole number")
    refused(lambda: ig.backend("numba", threads=-1), "-1 threads", "0 for all")


@pytest.mark.parametrize("isovalues, expected", [(None, 32), (5, 5)])
def test_only_isovalues_that_were_given_set_the_count_of_a_named_sampler(isovalues, expected):
    scene = sky(ball(7))
    light = ig.run(scene, sampler="uniform", isovalues=isovalues, **QUICK)
    assert light.recipe["sampler"]["count"] == expected and light.recipe["isovalues"] == expected
    own = ig.run(scene, sampler=ig.sampler("uniform", count=3, points=200), isovalues=isovalues, **QUICK)
    assert own.recipe["sampler"] == {"name": "uniform", "count": 3, "points": 200} and own.recipe["queries"] == 600
    assert len(own.levels.table) == expected


def test_stage_objects_serve_as_well_as_names(light):
    names = {"sampler": "direct", "backend": "numba", "interpolator": "nearest"}
    stages = {kind: getattr(ig, kind)(name) for kind, name in names.items()}
    again = ig.run(light.scene, **stages, **QUICK)
    assert np.array_equal(again.grids[0].values, light.grids[0].values)


def test_a_sampler_without_a_question_makes_a_grid_of_holes():
    @dataclass(frozen=True)
    class Silent:
        name: ClassVar[str] = "silent"

        def queries(self, scene, specs, seed):
            return []

    with pytest.warns(ig.IllumgridWarning, match="nodes within the range"):
        light = ig.run(sky(ball(8)), sampler=Silent(), **QUICK)
    assert not light.grids[0].support.any() and not light.grids[0].values.any()
    assert light.recipe["queries"] == 0 and light.recipe["relative_error"] == [None] and light.exposure == 1


def test_holes_within_the_range_are_a_warning_that_counts_them():
    with pytest.warns(ig.IllumgridWarning, match=r"\d+ nodes within the range of field 'field' got no light") as caught:
        light = ig.run(sky(ball(16)), sampler=ig.sampler("uniform", count=2, points=4), paths=2, bounces=0)
    assert len(caught) == 1 and str(light.recipe["holes"][0]) in str(caught[0].message)
    assert np.isfinite(light.grids[0].values).all() and light.recipe["holes"][0] > 10


def test_progress_says_what_is_done_of_how_much():
    calls = []
    ig.run(sky(ball(8)), **QUICK, progress=lambda *what: calls.append(what))
    assert calls[0][:2] == ("light", 0) and calls[-1] == ("grid", 1, 1)
    done, total = [t for t in calls if t[0] == "light"][-1][1:]
    assert done == total > 0


def test_two_fields_of_the_built_in_nucleus_light_each_other():
    from illumgrid.field.builtin import SCENES

    scene = SCENES["nucleus"].make()
    light = ig.run(scene, grid=10, paths=4, bounces=2)
    assert [f.name for f in scene.fields] == ["protons", "neutrons"] and len(light.grids) == 2
    protons, neutrons = (light.grid(f.name).values for f in scene.fields)
    assert not np.array_equal(protons, neutrons)
    # protons are red and neutrons blue: each is lit by the colour of the other
    cast = [(g[..., 0] / np.maximum(g[..., 2], 1e-9))[g[..., 2] > 0.1].mean() for g in (protons, neutrons)]
    assert cast[0] != pytest.approx(cast[1], abs=1e-3)


@pytest.mark.parametrize("option", ["paths", "bounces", "seed"])
def test_whole_numbers_of_any_type_are_taken_and_others_refused(option):
    light = ig.run(sky(ball(8)), **{**QUICK, option: np.uint64(2)})
    assert light.recipe[option] == 2 and type(light.recipe[option]) is int
    refused(lambda: ig.run(sky(ball(8)), **{**QUICK, option: 2.5}), "2.5", "expected", "2**")
