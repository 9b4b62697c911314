"""``illumgrid export``: its files, and its refusals in one sentence."""

import numpy as np
import pytest

from illumgrid import chain as illumination
from lights import lopsided_light
from shapes import DIRECTIONS

ENDINGS = ["vti", "nrrd", "exr", "npz", "glb", "ply"]


@pytest.fixture
def run(tmp_path):
    """A finished run in the folder ``run``."""
    light = lopsided_light(DIRECTIONS["oblique"])
    light.save(tmp_path / "run", preview=False)
    return light


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_kind_is_written_and_reported(call, run, tmp_path, ending):
    (tmp_path / f"x.{ending}").write_text("an older file is replaced, as preview does")
    said = call("export", "run", f"x.{ending}")
    assert said.startswith(f"wrote x.{ending}: ") and said.count("\n") == 1
    assert (tmp_path / f"x.{ending}").stat().st_size > 500
    assert sorted(p.name for p in tmp_path.iterdir() if p.suffix != ".npy") == ["run", f"x.{ending}"]
    call("export", "run", f"some/where/x.{ending.upper()}")
    assert (tmp_path / f"some/where/x.{ending.upper()}").is_file()


def test_options_reach_the_file(call, run, tmp_path):
    said = call("export", "run", "a.npz", "--field", "shell", "--on", "field")
    with np.load(tmp_path / "a.npz") as pack:
        assert np.array_equal(pack["field"], run.scene.fields[1].volume.values)
    assert "'shell' at 9 x 7 x 6 voxels" in said
    assert "support of 'egg'" in call("export", "run", "a.nrrd", "--array", "support")
    assert "isosurface 0.6 " in call("export", "run", "a.ply", "--isovalue", "0.6")
    assert "isosurface -0.7 of 'shell'" in call("export", "run", "a.glb", "--field", "shell")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["x.nope"], ["'x.nope'", ".vti, .nrrd, .exr, .npz", ".glb, .ply"]),
        (["x"], ["'x'", "ends in"]),
        (["x.vti", "--isovalue", "0.7"], ["isovalue", "every isovalue", ".glb or .ply"]),
        (["x.glb", "--isovalue", "nan"], ["nan", "finite"]),
        (["x.glb", "--isovalue", "5"], ["5", "0.55 to 0.85"]),
        (["x.glb", "--on", "grid"], ["'on'", "isosurface"]),
        (["x.vti", "--onto", "m.ply"], ["x.vti", "lattice", ".glb or .ply"]),
        (["x.glb", "--onto", "m.ply"], ["m.ply", "no such file"]),
        (["x.vti", "--on", "mesh"], ["'mesh'", "grid or field"]),
        (["x.vti", "--array", "error"], ["only a .nrrd"]),
        (["x.nrrd", "--array", "albedo"], ["'albedo'", "irradiance, error, support, field, color"]),
        (["x.vti", "--field", "yolk"], ["'yolk'", "egg, shell"]),
        (["run/illumination.exr"], ["the run itself"]),
        (["v.npy/x.vti"], ["could not be written"]),
        (["folder.vti"], ["is a folder"]),
    ],
)
def test_what_cannot_be_is_refused(refuse, run, tmp_path, options, words):
    (tmp_path / "folder.vti").mkdir()
    before = (tmp_path / "run" / "illumination.exr").read_bytes()
    refuse("export", "run", *options, words=words)
    assert (tmp_path / "run" / "illumination.exr").read_bytes() == before


def test_a_folder_that_is_no_run_is_refused(refuse):
    refuse("export", "nowhere", "x.vti", words=["nowhere", "missing"])


def test_a_file_that_fails_leaves_the_older_one(call, run, tmp_path, monkeypatch):
    call("export", "run", "x.npz")
    before = (tmp_path / "x.npz").read_bytes()

    def full(file, head):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array_header_1_0", full)
    assert "No space left" in call("export", "run", "x.npz", code=2)
    assert (tmp_path / "x.npz").read_bytes() == before and not list(tmp_path.glob(".x*"))


def test_a_loaded_run_exports_as_the_light_that_was_saved(call, run, tmp_path):
    call("export", "run", "x.npz")
    light = illumination.load(tmp_path / "run")
    with np.load(tmp_path / "x.npz") as pack:
        assert np.array_equal(pack["irradiance"], run.grids[0].values) and pack["exposure"] == light.exposure
