"""What the user says of a volume that its file does not: spacing, which of several, which part."""

import sys
import tempfile

import numpy as np
import pytest

from illumgrid.errors import BadInput, IllumgridWarning
from illumgrid.field.volume import index_to_world
from illumgrid.io.readers import limits, read_scene, read_volume
from illumgrid.io.readers.stored import Stored, pick, place, unsheared
from volume_files import TURN, refused, values, write, zipped


def test_spacing_and_crop_keep_the_voxels_where_they_are(tmp_path):
    write(tmp_path / "a.nrrd")
    whole = read_volume(tmp_path / "a.nrrd", spacing=(1, 2, 3))
    assert np.allclose(whole.spacing, (1, 2, 3))
    part = read_volume(tmp_path / "a.nrrd", spacing=(1, 2, 3), crop=(1, 5, 0, 6, 2, 4))
    assert np.array_equal(part.values, values()[1:5, 0:6, 2:4])
    assert np.allclose(index_to_world(part, (0, 0, 0)), index_to_world(whole, (1, 0, 2)))


def test_downsample_takes_means_at_the_middle_of_their_blocks(tmp_path):
    ramp = sum(np.meshgrid(np.arange(7), 10 * np.arange(6), 100 * np.arange(8), indexing="ij")).astype("int16")
    write(tmp_path / "a.nrrd", ramp)
    fine, coarse = (read_volume(tmp_path / "a.nrrd", downsample=n) for n in (None, 2))
    assert coarse.shape == (3, 3, 4) and np.allclose(coarse.spacing, 2 * fine.spacing)
    # A linear field: the mean of a block is the value at its middle.
    assert np.allclose(index_to_world(coarse, (1, 2, 3)), index_to_world(fine, (2.5, 4.5, 6.5)))
    assert coarse.values[1, 2, 3] == 2.5 + 45 + 650


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"spacing": (1, 0, 1)}, "--spacing is 1 0 1; expected three positive numbers"),
        ({"crop": (0, 5, 0, 6, 0, 8)}, "within 0 5 0 6 0 7"),
        ({"crop": (0, 1, 0, 6, 0, 7)}, "at least 2 voxels"),
        ({"crop": (0, 5, 0, 6, 0)}, "expected first and last"),
        ({"downsample": 3}, "--downsample is 3; expected 1 to 2"),
        ({"array": 1}, "--array came with a NRRD file"),
    ],
)
def test_choices_that_cannot_be(tmp_path, options, words):
    write(tmp_path / "a.nrrd")
    with pytest.raises(BadInput, match=words):
        read_volume(tmp_path / "a.nrrd", **options)


def test_several_are_listed_with_the_option_that_chooses():
    with pytest.raises(BadInput, match="holds 2 channels: 0 DAPI, 1 GFP; expected one; choose it with --channel N"):
        pick(None, "channel", ["DAPI", "GFP"])
    assert pick("GFP", "channel", ["DAPI", "GFP"]) == pick("1", "channel", ["DAPI", "GFP"]) == 1
    with pytest.raises(BadInput, match=r"--time is .2.; expected one of its time steps: 0, 1"):
        pick(2, "time", ["", ""])


def test_npy_of_more_axes(tmp_path):
    many = values("float32", (2, 5, 6, 7, 3))
    np.save(tmp_path / "a.npy", many)
    refused(tmp_path / "a.npy", "5 axes", "--time", "--channel")
    assert np.array_equal(read_volume(tmp_path / "a.npy", time=1, channel=2).values, many[1, ..., 2])
    np.save(tmp_path / "a.npy", many[:1, ..., :1])
    assert np.array_equal(read_volume(tmp_path / "a.npy").values, many[0, ..., 0])


def test_npz_array(tmp_path):
    np.savez(tmp_path / "a.npz", a=values(), b=values() + 1)
    for array in ("b", 1, "1"):
        assert np.array_equal(read_volume(tmp_path / "a.npz", array=array).values, values() + 1)


def test_choices_in_a_scene_file(tmp_path):
    np.savez(tmp_path / "a.npz", a=values(), b=values() + 1)
    field = 'volume = "a.npz"\nrange = [20, 150]\nspacing = [1, 2, 3]\ncrop = [0, 4, 1, 6, 0, 7]\n'
    text = "".join(f'[[field]]\nname = "{name}"\narray = "{name}"\n{field}' for name in "ab")
    (tmp_path / "s.toml").write_text(text, "utf-8")
    one, other = read_scene(tmp_path / "s.toml").fields
    assert np.array_equal(one.volume.values + 1, other.volume.values) and one.volume.shape == (4, 5, 7)
    assert np.array_equal(one.volume.spacing, (1, 2, 3))
    (tmp_path / "s.toml").write_text(text.replace("[0, 4, 1, 6, 0, 7]", "[0, 4]"), "utf-8")
    with pytest.raises(BadInput, match=r"crop is .*; expected six whole numbers"):
        read_scene(tmp_path / "s.toml")


# Placement


def test_sheared_axes_are_resampled_onto_right_angles():
    # The third axis leans along x by 0.7 of a voxel: a linear field of the world must come back, exactly.
    steps = np.array([[1.0, 0, 0.7], [0, 2.0, 0], [0, 0, 3.0]])
    turned = TURN @ steps
    world = np.einsum("ij,jxyz->ixyz", turned, np.indices((6, 5, 4))) + np.array([5.0, 6, 7])[:, None, None, None]
    volume, notes = place(Stored(np.tensordot([1.0, 10, 100], world, 1), np.array([5.0, 6, 7]), turned))
    assert notes[0][0] == "placement" and "13.1° off right angles" in notes[0][1]
    assert np.allclose(volume.direction, TURN) and np.allclose(volume.spacing, (1, 2, 3)) and volume.shape == (9, 5, 4)
    index = np.argwhere(np.isfinite(volume.values))
    assert len(index) >= 5 * 5 * 4
    there = index_to_world(volume, index) @ [1, 10, 100]
    assert np.allclose(volume.values[tuple(index.T)], there, rtol=1e-6)


def test_a_sixth_of_a_degree_is_rounded_away_and_reported():
    skewed = np.array([[1, 0.0026, 0], [0, 1, 0], [0, 0, 1]])
    volume, notes = place(Stored(values(), np.zeros(3), skewed))
    assert np.array_equal(volume.values, values()) and "0.15° off right angles" in notes[0][1]


@pytest.mark.parametrize("steps", [np.diag([1, 0, 1]), np.ones((3, 3)), np.full((3, 3), np.nan)])
def test_axes_that_are_none(steps):
    with pytest.raises(BadInput, match="expected"):
        place(Stored(values(), np.zeros(3), steps.astype(float)))


def test_slope_and_intercept_are_applied_in_double_precision():
    volume, _ = place(Stored(values("uint8"), np.zeros(3), np.eye(3), slope=0.1, intercept=-3))
    assert np.array_equal(volume.values, 0.1 * values("float64") - 3) and volume.stored.dtype == np.uint8


@pytest.mark.parametrize(
    ("most", "used", "stat"),
    [
        ("max", "current", "anon 300\nfile 500\ninactive_file 200\nactive_file 250\nshmem 50\n"),
        ("limit_in_bytes", "usage_in_bytes", "inactive_file 1\ntotal_inactive_file 200\ntotal_active_file 250\n"),
    ],
)
def test_pages_of_files_in_a_control_group_are_free(tmp_path, most, used, stat):
    """A field that is paged fills a group, and gives way."""
    (tmp_path / "memory.stat").write_text(stat)
    (tmp_path / f"memory.{used}").write_text("900\n")
    (tmp_path / f"memory.{most}").write_text("1000\n")
    assert limits._left_in(tmp_path, most, used) == [1000 - 900 + 450]
    (tmp_path / f"memory.{most}").write_text("max\n")
    assert limits._left_in(tmp_path, most, used) == []


def test_limits_of_control_groups_count(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "_left_in_groups", lambda: [12345])
    assert limits.free_memory() == 12345
    np.save(tmp_path / "a.npy", values("float64", (20, 20, 20)))
    refused(tmp_path / "a.npy", "needs 6.4e-05 GB of memory", "free")


def test_warnings_name_the_file(tmp_path):
    np.savez(tmp_path / "a.npz", values=values(), direction=[[1, 0.004, 0], [0, 1, 0], [0, 0, 1]])
    with pytest.warns(IllumgridWarning, match=r"^placement: a\.npz: its axes are 0.23° off"):
        read_volume(tmp_path / "a.npz")


def test_a_box_around_axes_that_are_nearly_one_is_refused_before_it_is_made():
    steps = np.eye(3)
    steps[0, 1] = 1e9  # rows move by a billion voxels from one to the next
    with pytest.raises(BadInput, match=r"has .* times its voxels; expected at most 64"):
        unsheared(Stored(values(), np.zeros(3), steps))


def test_a_reader_that_is_not_installed_is_named_with_its_extra(tmp_path, monkeypatch):
    (tmp_path / "a.gipl").write_bytes(bytes(300))
    monkeypatch.delitem(sys.modules, "illumgrid.io.readers.itk", raising=False)
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    refused(tmp_path / "a.gipl", "SimpleITK", "pip install illumgrid[itk]")


def test_what_killed_processes_unpacked_is_swept(tmp_path, monkeypatch):
    """A gzipped GIPL is unpacked into a file for ITK, which is then removed; SIGKILL leaves it."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    left = tmp_path / "temporary" / ".illumgrid-unpacked-k1lled00"
    left.mkdir(parents=True)
    (left / "new.gipl").write_bytes(b"half")
    write(tmp_path / "a.gipl")
    assert np.array_equal(read_volume(zipped(tmp_path / "a.gipl")).values, values())
    assert not any((tmp_path / "temporary").iterdir())
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "nowhere"))
    with pytest.raises(BadInput, match=r"cannot be unpacked into .*nowhere \(No such file or directory\); .* TMPDIR"):
        read_volume(tmp_path / "a.gipl.gz")
