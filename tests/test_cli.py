"""The command line in process: every command and option, exit codes, and refusals in one sentence."""

import json

import numpy as np
import pytest
from PIL import Image

import illumgrid as ig
from illumgrid.cli.info import BLOCKS, histogram_line
from illumgrid.field.volume import histogram
from shapes import MIRRORED, ball, sampled

QUICK = ("--grid", "8", "--paths", "2", "--bounces", "1")
RANGE = ("--range", "0.3", "0.9")


def shown(path):
    with Image.open(path) as picture:
        return np.asarray(picture)


def recipe(folder):
    return json.loads((folder / "run.json").read_text("utf-8"))["recipe"]


# run


def test_a_run_leaves_light_a_record_and_a_picture(call, tmp_path):
    said = call("run", "v.npy", *RANGE, *QUICK, "-o", "deep/out")
    for words in ("10 x 10 x 10 voxels", "0.3 to 0.9", "wrote deep/out", "queries x 2 paths"):
        assert words in said
    out = tmp_path / "deep" / "out"
    assert sorted(p.name for p in out.iterdir()) == ["illumination.exr", "moments.npz", "preview.png", "run.json"]
    assert shown(out / "preview.png").shape == (48, 64, 3)
    made = recipe(out)
    assert made["input"] == "v.npy" and made["smooth"] == 0 and made["warnings"] == [] and made["exposure"] > 0
    light = ig.load(out)
    scene = ig.Scene.studio(ig.read_volume(tmp_path / "v.npy"), range=(0.3, 0.9), name="v")
    assert np.array_equal(light.grids[0].values, ig.run(scene, grid=8, paths=2, bounces=1).grids[0].values)


def test_without_options_the_folder_is_named_after_the_input_and_the_range_comes_from_the_data(call, tmp_path):
    call("run", "v.npy", *QUICK, "--no-preview")
    assert sorted(p.name for p in (tmp_path / "v-light").iterdir()) == ["illumination.exr", "moments.npz", "run.json"]
    field = ig.load(tmp_path / "v-light").scene.fields[0]
    assert field.name == "v" and field.inside == "above" and field.material.albedo.tolist() == [0.65] * 3
    assert tuple(field.range) == ig.suggest_range(field.volume)[:2]


def test_a_finished_run_is_kept_unless_it_may_be_replaced(call, refuse, tmp_path):
    call("run", "v.npy", *RANGE, *QUICK, "--no-preview", "-o", "out")
    refuse("run", "v.npy", *RANGE, *QUICK, "-o", "out", words=["out", "finished run", "--overwrite"])
    call("run", "v.npy", *RANGE, *QUICK, "--no-preview", "-o", "out", "--overwrite", "--seed", "5")
    assert recipe(tmp_path / "out")["seed"] == 5
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    refuse("run", "v.npy", *QUICK, "-o", "mine", "--overwrite", words=["mine", "thesis.tex", "-o"])


def test_ranges_may_be_negative_and_the_solid_below(call, tmp_path):
    lobes = sampled(lambda x: x[:, 0] * np.exp(-(x**2).sum(axis=1)), (12, 12, 12), (-2, -2, -2), (4 / 11,) * 3)
    np.save(tmp_path / "lobes.npy", lobes.values)
    call("run", "lobes.npy", "--range", "-0.3", "-0.1", "--inside", "below", *QUICK, "--no-preview", "-o", "out")
    light = ig.load(tmp_path / "out")
    assert light.scene.fields[0].range.tolist() == [-0.3, -0.1] and light.scene.fields[0].inside == "below"
    call("preview", "out", "--isovalue", "-0.2", "-o", "lobe.png")
    assert len(np.unique(shown(tmp_path / "lobe.png"))) > 3


def test_material_smoothing_seed_and_depth_are_as_given(call, tmp_path):
    options = "--grid 6 --paths 3 --bounces 2 --seed 9 --albedo 0.1 0.2 0.3 --smooth 1.5 --no-preview -o out"
    call("run", "v.npy", *RANGE, *options.split())
    made, light = recipe(tmp_path / "out"), ig.load(tmp_path / "out")
    assert {k: made[k] for k in ("grid", "paths", "bounces", "seed", "smooth")} == {
        "grid": 6, "paths": 3, "bounces": 2, "seed": 9, "smooth": 1.5,
    }  # fmt: skip
    assert light.scene.fields[0].material.albedo.tolist() == [0.1, 0.2, 0.3]
    assert light.scene.fields[0].volume.values.max() < ball(10).values.max() - 0.05  # stored as used


def test_options_of_stages_are_set_one_by_one_and_go_before_those_of_the_run(call, tmp_path):
    options = ("run", "v.npy", *RANGE, *QUICK, "--sampler", "uniform", "--no-preview")
    call(*options, "--isovalues", "4", "--threads", "1", "-o", "a")
    made = recipe(tmp_path / "a")
    assert made["sampler"] == {"name": "uniform", "count": 4, "points": 0} and made["isovalues"] == 4
    assert made["backend"] == {"name": "numba", "threads": 1, "surface": "auto"}
    own = "--set sampler.count=3 --set sampler.points=100 --set backend.threads=2"
    call(*options, "--isovalues", "4", "--threads", "1", *own.split(), "-o", "b")
    made = recipe(tmp_path / "b")
    assert made["sampler"] == {"name": "uniform", "count": 3, "points": 100} and made["isovalues"] == 4
    assert made["backend"]["threads"] == 2 and made["queries"] == 300
    call(*options, "-o", "c")
    assert recipe(tmp_path / "c")["sampler"]["count"] == 32


def test_threads_do_not_change_the_light_and_the_reference_has_none(call, tmp_path):
    options = {"one": "--threads 1", "two": "--threads 2", "plain": "--backend reference --threads 2"}
    for name, more in options.items():
        call("run", "v.npy", *RANGE, *QUICK, "--grid", "5", *more.split(), "--no-preview", "-o", name)
    one, two, plain = (ig.load(tmp_path / name).grids[0].values for name in ("one", "two", "plain"))
    assert np.array_equal(one, two)
    np.testing.assert_allclose(plain, one, rtol=1e-5)
    assert "threads" not in recipe(tmp_path / "plain")["backend"]


def test_a_built_in_scene_needs_no_data(call, tmp_path):
    said = call("run", "--grid", "12", "--paths", "2")
    assert "protons" in said and "neutrons" in said
    assert (tmp_path / "nucleus-light" / "preview.png").exists()
    call("run", "nucleus", "--grid", "6", "--paths", "1", "--smooth", "2", "--no-preview", "-o", "calm")
    assert recipe(tmp_path / "calm")["input"] == "nucleus" and recipe(tmp_path / "calm")["smooth"] == 2
    calm, sharp = (ig.load(tmp_path / name) for name in ("calm", "nucleus-light"))
    assert len(calm.grids) == 2
    assert calm.scene.fields[0].volume.values.max() < sharp.scene.fields[0].volume.values.max()


def test_what_was_noted_during_a_run_is_kept_and_shown_again(call, tmp_path):
    values = ball(10).values.copy()
    values[0, 0, 0] = np.nan
    np.save(tmp_path / "nan.npy", values)
    assert "note: finite: 1 of 1000 voxels" in call("run", "nan.npy", *RANGE, *QUICK, "--no-preview", "-o", "out")
    assert "1 of 1000 voxels" in recipe(tmp_path / "out")["warnings"][0]
    assert "note: finite: 1 of 1000 voxels" in call("info", "out")
    assert "note: finite: 1 of 1000 voxels" in call("info", "nan.npy")


# Refusals


@pytest.mark.parametrize(
    "args, words",
    [
        (("v.npy", "--scene", "cave"), ["--scene", "'cave'", "sky, floor or box"]),
        (("nucleus", "--scene", "sky"), ["--scene", "nucleus", "leave them out"]),
        (("nowhere.nrrd",), ["nowhere.nrrd", "no such file"]),
        (("v.npy", "--range", "5", "1"), ["range", "5.0, 1.0", "isovalue"]),
        (("v.npy", "--range", "7", "9"), ["misses its data"]),
        (("v.npy", "--inside", "left"), ["--inside", "'left'", "above or below"]),
        (("v.npy", "--albedo", "1", "2", "3"), ["albedo", "0 to 1"]),
        (("v.npy", "--sampler", "unifrom"), ["sampler", "did you mean 'uniform'?"]),
        (("v.npy", "--backend", "metal"), ["backend", "'metal'", "numba"]),
        (("v.npy", "--interpolator", "nearst"), ["did you mean 'nearest'?"]),
        (("v.npy", "--set", "sampler.count=3"), ["'direct'", "no option 'count'"]),
        (("v.npy", "--set", "sampler"), ["--set", "'sampler'", "STAGE.OPTION=VALUE"]),
        (("v.npy", "--set", "samplr.count=3"), ["samplr.count=3", "sampler, backend, interpolator"]),
        (("v.npy", "--set", "backend.threads=two"), ["backend.threads", "'two'", "whole number"]),
        (("v.npy", "--sampler", "uniform", "--set", "sampler.count=1"), ["uniform.count is 1", "at least 2"]),
        (("v.npy", "-o", "v.npy"), ["v.npy", "not a folder"]),
        (("nucleus", "--range", "0", "1"), ["--range", "nucleus", "leave them out"]),
        (("--inside", "above"), ["--inside", "nucleus"]),
        (("--albedo", "1", "1", "1"), ["--albedo", "nucleus"]),
        (("nucleus", "--albedo", "1", "1", "1", "--range", "0", "1"), ["--range, --albedo", "nucleus"]),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(refuse, args, words):
    refuse("run", *args, *QUICK, words=words)


@pytest.mark.parametrize(
    "option",
    ["--paths 0", "--paths many", "--bounces -1", "--grid 1", "--isovalues 1", "--seed -1", f"--seed {2**64}",
     "--threads 0", "--smooth -1", "--smooth nan", "--range 1", "--albedo 1 1", "--nonsense"],
)  # fmt: skip
def test_options_out_of_range_are_refused_by_name(call, tmp_path, option):
    said = call("run", "v.npy", *option.split(), code=2)
    assert option.split()[0].strip("-") in said
    assert [p.name for p in tmp_path.iterdir()] == ["v.npy"]


def test_data_without_a_surface_are_refused(refuse, tmp_path):
    (tmp_path / "flat.npy").write_bytes(b"")
    refuse("run", "flat.npy", words=["flat.npy", "empty"])
    np.save(tmp_path / "flat.npy", np.full((4, 4, 4), 3.0))
    refuse("run", "flat.npy", *QUICK, words=["all 3", "varies"])


# preview and info


def test_a_picture_is_drawn_of_the_field_and_isovalue_asked_for(call, tmp_path):
    call("run", "nucleus", "--grid", "8", "--paths", "2", "--no-preview", "-o", "out")
    options = {
        "middle": "", "high": "--isovalue 0.5", "named": "--field neutrons --isovalue 0.5", "local": "--local",
    }  # fmt: skip
    pictures = {}
    for name, more in options.items():
        said = call("preview", "out", *more.split(), "--output", f"new/{name}.png")
        assert f"wrote new/{name}.png" in said and ("exposure" in said) == (name != "local")
        pictures[name] = shown(tmp_path / "new" / f"{name}.png")
    assert np.array_equal(pictures["high"], pictures["named"])  # both fields have one range
    assert not np.array_equal(pictures["middle"], pictures["high"])
    assert not np.array_equal(pictures["middle"], pictures["local"])
    said = call("preview", "out", "--isovalue", "0.9", "-o", "x.png")
    assert "note: the isovalue 0.9 lies outside the range 0.3 to 0.6" in said


def test_pictures_that_cannot_be_drawn_are_refused(call, refuse, tmp_path):
    call("run", "v.npy", *RANGE, *QUICK, "--no-preview", "-o", "out")
    refuse("preview", "out", "-o", "x.jpg", words=["x.jpg", ".png"])
    refuse("preview", "out", "--field", "w", "-o", "x.png", words=["'w'", "v"])
    refuse("preview", "nowhere", "-o", "x.png", words=["nowhere", "missing", "illumgrid run"])
    (tmp_path / "taken.png").mkdir()
    refuse("preview", "out", "-o", "taken.png", words=["taken.png", "folder"])
    assert "output" in call("preview", "out", code=2)
    refuse("preview", "out", "--isovalue", "nan", "-o", "x.png", words=["nan"])


def test_info_describes_a_volume(call, tmp_path):
    np.savez(tmp_path / "w.npz", values=ball(10).values, origin=(1, 2, 3), spacing=(0.5, 1, 2), direction=MIRRORED)
    said = call("info", "w.npz")
    low, high, why = ig.suggest_range(ig.read_volume(tmp_path / "w.npz"))
    for word in ("10 x 10 x 10 voxels", "0.5, 1, 2", "1, 2, 3", "LPS", f"{low:.4g} to {high:.4g}", why):
        assert word in said
    line = said.split("|")[1]
    assert len(line) == 64 and set(line) <= set(BLOCKS) and "█" in line


def test_the_histogram_has_blocks_where_there_are_values():
    values = np.zeros((4, 4, 4))
    values.flat[:3] = 1, 1, 0.5
    line = histogram_line(histogram(ig.Volume(values), 4)[0].tolist())
    assert line[0] == "█" and line[1] == " " and line[2] in "▁▂▃" and line[3] in "▂▃▄▅"


def test_info_takes_values_that_differ_in_their_last_digits_only(call, tmp_path):
    np.save(tmp_path / "far.npy", 1e6 + np.round(4 * ball(10).values) / 4)
    assert "values           999999.5 to 1000001\n" in call("info", "far.npy")
    call("run", "far.npy", *QUICK, "--no-preview", "-o", "out")


def test_a_run_says_once_which_backend_auto_took_and_why(call):
    said = call("run", "v.npy", *RANGE, *QUICK, "--no-preview", "-o", "auto")
    assert said.count("backend: numba (it marches") == 1
    named = call("run", "v.npy", *RANGE, *QUICK, "--backend", "numba", "--no-preview", "-o", "named")
    assert "backend:" not in named


def test_info_describes_a_run(call):
    call("run", "v.npy", *RANGE, *QUICK, "--seed", "4", "--no-preview", "-o", "out")
    said = call("info", "out")
    made = ("sampler direct", "backend numba", "interpolator nearest", "2 paths", "1 bounces", "seed 4")
    for words in ("10 x 10 x 10 voxels", "0.3 to 0.9, inside above", "8 x 8 x 8 nodes", *made):
        assert words in said


# The rest


def test_the_version_and_the_help_are_reported(call):
    assert call("--version").strip() == f"illumgrid {ig.__version__}"
    said = call("run", "--help")
    stages = "--sampler --isovalues --range --inside --backend --paths --bounces --seed --grid --interpolator"
    for option in f"{stages} --scene --albedo --set --smooth --threads --no-preview --overwrite --output".split():
        assert option in said
    assert "--isovalue" in call("preview", "--help") and "VOLUME" in call("info", "--help")
    everything = call("--help")
    assert all(command in everything for command in ("run", "preview", "info"))
    assert "frobnicate" in call("frobnicate", code=2)


def test_the_command_that_smooths_begins_anew(monkeypatch):
    """A finished run that is resumed with another blur is refused."""
    from illumgrid.cli.outcome import again

    monkeypatch.setattr("sys.argv", ["illumgrid", "run", "v.npy", "--smooth", "1", "--paths", "8", "--resume"])
    assert again("--smooth 2") == "illumgrid run v.npy --paths 8 --smooth 2 --overwrite"
