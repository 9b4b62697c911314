"""Runs that refer to their volume file: the same light in a smaller folder, and a sentence where the file changed."""

import json
import shutil

import numpy as np
import OpenEXR
import pytest

import illumgrid as ig
from illumgrid.field.filters import smooth
from illumgrid.field.volume import Volume
from illumgrid.io import store
from illumgrid.io.elsewhere import Source, digest, fields_again, referred
from illumgrid.io.readers import read_volume
from shapes import ball

QUICK = ("--grid", "6", "--paths", "2", "--bounces", "1", "--no-preview")


def parts(folder):
    return [part.name() for part in OpenEXR.File(str(folder / store.EXR), header_only=True).parts]


@pytest.fixture
def bytes_file(tmp_path):
    """A ball in bytes, with a gap below a smoothing."""
    values = np.round(100 * ball(10).values).clip(0).astype(np.uint8)
    np.save(tmp_path / "v.npy", values)
    return tmp_path / "v.npy"


@pytest.mark.parametrize(
    "options",
    [
        ("--range", "40", "90"),
        ("--range", "40", "90", "--smooth", "0.7", "--crop", "0", "9", "1", "10", "0", "10", "--inside", "below"),
        ("--label", "83,101"),
        ("--signed", "--range", "10", "40"),
    ],
    ids=["plain", "read", "labels", "signed"],
)
def test_the_light_and_the_fields_are_those_of_a_run_that_holds_them(call, tmp_path, bytes_file, options):
    if "--signed" in options:
        np.save(bytes_file, (100 * ball(10).values - 50).astype(np.float32))
    call("run", "v.npy", *options, *QUICK, "-o", "whole")
    call("run", "v.npy", *options, *QUICK, "--no-embed", "-o", "bare")
    one, other = (ig.load(tmp_path / name) for name in ("whole", "bare"))
    assert not any("field/" in part for part in parts(tmp_path / "bare")) and "field/" in str(parts(tmp_path / "whole"))
    for a, b, f, g in zip(one.grids, other.grids, one.scene.fields, other.scene.fields):
        assert np.array_equal(a.light, b.light) and np.array_equal(f.volume.values, g.volume.values)
        assert f.volume.values.dtype == g.volume.values.dtype and f.volume.origin.tolist() == g.volume.origin.tolist()
        assert (f.name, f.inside, f.range.tolist()) == (g.name, g.inside, g.range.tolist())


def test_a_file_that_is_gone_or_changed_is_refused_in_a_sentence(call, tmp_path, bytes_file):
    (tmp_path / "here").mkdir()
    bytes_file.rename(tmp_path / "here" / "v.npy")
    call("run", "here/v.npy", "--range", "40", "90", *QUICK, "--no-embed", "-o", "here/out")
    (tmp_path / "here").rename(tmp_path / "there")  # file and run together
    call("preview", "there/out", "--output", "a.png")
    shutil.move(tmp_path / "there" / "v.npy", tmp_path / "aside.npy")
    for command in (("preview", "there/out", "--output", "b.png"), ("view", "there/out", "--export", "b.html")):
        said = call(*command, code=2)
        assert said.count("\n") == 1 and "v.npy (--no-embed), which is gone" in said
    assert "10 x 10 x 10 voxels" in call("info", "there/out")  # needs no pixels
    values = np.load(tmp_path / "aside.npy")
    values[3, 3, 3] += 1
    np.save(tmp_path / "there" / "v.npy", values)
    said = call("preview", "there/out", "--output", "b.png", code=2)
    assert said.count("\n") == 1 and "has changed since it was lit" in said


def test_fields_of_a_scaled_file_that_were_kept_in_single_precision_are_found_again(tmp_path):
    import nibabel

    stored = np.round(100 * ball(10).values).astype(np.int16)
    image = nibabel.Nifti1Image(stored, np.eye(4))
    image.header.set_slope_inter(0.1, -3)
    nibabel.save(image, tmp_path / "v.nii")
    source = Source(str(tmp_path / "v.nii"), {}, [], "above", 0.7)
    place = read_volume(tmp_path / "v.nii")
    units = (stored * float(np.float32(0.1)) - 3).astype(np.float32)
    old = smooth(Volume(units, place.origin, place.spacing, place.direction), 0.7)
    (new,) = source.volumes().values()
    for volume in (old, new):
        (found,) = fields_again(referred(source, tmp_path), tmp_path, [digest(volume)])
        assert np.array_equal(found.values, volume.values) and found.slope == volume.slope
    assert new.slope != 1


def test_a_scene_has_no_file_to_refer_to(refuse, tmp_path, bytes_file):
    (tmp_path / "s.toml").write_text('[[field]]\nname = "a"\nvolume = "v.npy"\n')
    refuse("run", "s.toml", "--no-embed", words=["--no-embed", "volume file"])
    refuse("run", "nucleus", "--no-embed", words=["--no-embed", "volume file"])


@pytest.mark.parametrize("value", [None, {}, "v.npy", {"path": 3, "near": [], "labels": 0}, []], ids=str)
def test_a_source_that_is_none_is_refused(call, tmp_path, bytes_file, value):
    call("run", "v.npy", "--range", "40", "90", *QUICK, "--no-embed", "-o", "out")
    record = json.loads((tmp_path / "out" / store.RUN).read_text())
    refused = 0
    for key in ["whole", *record["source"]]:
        forged = record | {"source": value if key == "whole" else record["source"] | {key: value}}
        forged["checksum"] = store._checksum(forged, tmp_path / "out" / store.EXR)
        (tmp_path / "out" / store.RUN).write_text(json.dumps(forged))
        try:  # what does no harm is taken: no labels, another side of a field without gaps
            assert np.array_equal(store.read(tmp_path / "out").scene.fields[0].volume.values, np.load(bytes_file))
        except ig.BadInput as reason:
            assert "give a folder that" in str(reason)
            refused += 1
    assert refused >= 2
