"""The command line with surroundings, scene files and built-in scenes."""

import json

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.field import builtin as demo
from shapes import ball

QUICK = ("--grid", "6", "--paths", "2", "--isovalues", "2", "--no-preview")

CORNER = """
[[field]]
name = "near"
volume = "v.npy"
range = [0.3, 0.9]

[[field]]
name = "far"
volume = "w.npz"
albedo = [0.1, 0.2, 0.3]
range = [0.3, 0.9]

[[quad]]
name = "lamp"
corner = [-5, -5, -2]
edge_u = [20, 0, 0]
edge_v = [0, 20, 0]
albedo = [0, 0, 0]
emission = [1, 2, 4]
texels = [2, 3]
"""


@pytest.fixture
def corner(tmp_path):
    """A scene file and its second volume in one folder; the first volume is in the working directory."""
    (tmp_path / "in").mkdir()
    np.savez(tmp_path / "in" / "w.npz", values=ball(8).values, origin=(12, 0, 0))
    file = tmp_path / "in" / "corner.toml"
    file.write_text(CORNER.replace("v.npy", "../v.npy"))
    return file


def recipe(folder):
    return json.loads((folder / "run.json").read_text("utf-8"))["recipe"]


@pytest.mark.parametrize("name", ["sky", "floor", "box"])
def test_a_volume_gets_the_surroundings_asked_for(call, tmp_path, name):
    said = call("run", "v.npy", "--scene", name, "--range", "0.3", "0.9", *QUICK, "--bounces", "2", "-o", "out")
    made, expected = ig.load(tmp_path / "out").scene, getattr(ig.Scene, name)(ball(10))
    assert [q.name for q in made.quads] == [q.name for q in expected.quads]
    assert np.array_equal(made.background, expected.background) and "v: 10 x 10 x 10" in said


def test_a_scene_file_is_lit_and_described(call, tmp_path, corner):
    said = call("run", "in/corner.toml", *QUICK, "--bounces", "1")
    assert "near: 10 x 10 x 10" in said and "far: 8 x 8 x 8" in said and "wrote corner-light" in said
    light = ig.load(tmp_path / "corner-light")
    assert [len(light.grids), len(light.walls)] == [2, 1] and recipe(tmp_path / "corner-light")["input"] == str(
        corner.relative_to(tmp_path)
    )
    same = ig.run(ig.read_scene(corner), grid=6, paths=2, isovalues=2, bounces=1)
    assert np.array_equal(light.grid("far").values, same.grid("far").values) and light.grid("far").values.max() > 0
    said = call("info", "corner-light")
    for words in ("lamp (wall)", "-5, -5, -2", "20, 0, 0; 0, 20, 0", "albedo           0, 0, 0, emission 1, 2, 4"):
        assert words in said
    assert "2 x 3 texels, 2 isovalues" in said and "bounces beyond 1 would add" in said


def test_every_field_of_a_scene_file_is_smoothed(call, tmp_path, corner):
    call("run", corner, *QUICK, "--bounces", "0", "--smooth", "1.5", "-o", "out")
    for field, sharp in zip(ig.load(tmp_path / "out").scene.fields, ig.read_scene(corner).fields):
        assert field.volume.values.max() < sharp.volume.values.max() - 0.01
    assert recipe(tmp_path / "out")["smooth"] == 1.5


@pytest.mark.parametrize("option", ["--range 0 1", "--inside above", "--albedo 1 1 1", "--scene sky"])
def test_options_of_a_volume_do_not_go_with_a_scene_file(refuse, corner, option):
    name = option.split()[0]
    refuse("run", "in/corner.toml", *option.split(), words=[name, "scene file 'in/corner.toml'", "into the file"])
    refuse("run", "missing.toml", *option.split(), words=[name, "scene file 'missing.toml'"])


def test_a_scene_file_that_is_wrong_is_refused(refuse, corner):
    refuse("run", "missing.toml", words=["missing.toml", "no such file"])
    corner.write_text(CORNER)
    refuse("run", "in/corner.toml", words=["corner.toml: [[field]] 1 'near': volume: v.npy"])
    corner.write_text(CORNER.replace("[0, 20, 0]", "[20, 0, 0]"))
    refuse("run", "in/corner.toml", words=["corner.toml: [[quad]] 1 'lamp'", "edges"])


def test_bounces_follow_the_scene_and_what_they_leave_out_is_reported(call, tmp_path):
    options = ("run", "v.npy", "--range", "0.3", "0.9", "--albedo", "0.3", "0.3", "0.3", *QUICK)
    assert "bounces beyond 8 would add" in call(*options, "-o", "open")
    said = call(*options, "--scene", "box", "-o", "closed")
    made = recipe(tmp_path / "closed")
    assert made["bounces"] >= 8 and 0 <= made["left_out"] < 0.01
    assert f"bounces beyond {made['bounces']} would add about {made['left_out']:.1%}" in said
    said = call(*options, "--scene", "box", "--bounces", "0", "-o", "straight")
    made = recipe(tmp_path / "straight")
    assert made["bounces"] == 0 and made["left_out"] > 0.1 and f"about {made['left_out']:.1%}" in said


def test_a_built_in_scene_has_options_of_its_own_unless_they_are_given(call, tmp_path, monkeypatch):
    small = demo.Preset(demo.nucleus, grid=5, paths=1, isovalues=3)
    monkeypatch.setitem(demo.SCENES, "nucleus", small)
    call("run", "--no-preview", "--bounces", "0")
    made = recipe(tmp_path / "nucleus-light")
    assert {k: made[k] for k in ("grid", "paths", "isovalues")} == {"grid": 5, "paths": 1, "isovalues": 3}
    call("run", "--no-preview", "--bounces", "0", "--isovalues", "2", "--paths", "2", "--grid", "4", "-o", "own")
    made = recipe(tmp_path / "own")
    assert {k: made[k] for k in ("grid", "paths", "isovalues")} == {"grid": 4, "paths": 2, "isovalues": 2}
    assert "lamp (wall)" in call("info", "own")
