"""Label maps: recognised among fields, and lit as smooth surfaces that stay where the labels are."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from illumgrid.cli import app
from illumgrid.errors import BadInput
from illumgrid.field.diagnosis import diagnose
from illumgrid.field.labels import labels_in
from illumgrid.field.lattice import nodes_over
from illumgrid.field.levelset import isosurface
from illumgrid.field.scene import Field
from illumgrid.field.volume import Volume
from illumgrid.io.readers import read_volume

VOLUMES = Path(__file__).parents[2] / "shared" / "volumes"


def ball(radius, spacing=(1, 1, 1), room=6):
    """Whether voxels lie in a ball around the world's origin; and the origin of their lattice."""
    shape = [int(2 * (radius + room * max(spacing)) / s) + 1 for s in spacing]
    axes = [(np.arange(n) - (n - 1) / 2 + 0.13 * (k + 1)) * s for k, (n, s) in enumerate(zip(shape, spacing))]
    return sum(a * a for a in np.meshgrid(*axes, indexing="ij")) <= radius**2, [a[0] for a in axes]


def surface(tmp_path, mask, origin, spacing):
    np.savez(tmp_path / "a.npz", values=3 * mask.astype(np.uint8), origin=origin, spacing=np.array(spacing, float))
    volume = read_volume(tmp_path / "a.npz", label=3)
    return volume, isosurface(volume, 0.0)


@pytest.mark.parametrize("radius", [6, 12, 20])
def test_a_ball_keeps_its_radius_and_loses_its_steps(tmp_path, radius):
    mask, origin = ball(radius)
    mesh = surface(tmp_path, mask, origin, (1, 1, 1))[1]
    off = np.linalg.norm(mesh.vertices, axis=1) - radius
    steps = np.linalg.norm(isosurface(Volume(mask.astype(float), origin), 0.5).vertices, axis=1) - radius
    assert abs(off.mean()) < 0.03 and off.std() < 0.35 * steps.std()
    turned = (mesh.face_normals * mesh.triangles_center).sum(axis=1) / np.linalg.norm(mesh.triangles_center, axis=1)
    assert np.degrees(np.arccos(np.clip(turned, -1, 1))) @ mesh.area_faces / mesh.area < 5  # 21 for the mask


@pytest.mark.parametrize("spacing", [(1, 1, 1), (0.5, 0.5, 2)])
def test_each_centre_of_a_voxel_stays_on_its_side(tmp_path, spacing):
    chance = np.random.default_rng(3)
    mask = chance.random((20, 21, 22)) < 0.3  # single voxels, sheets, holes
    volume, _ = surface(tmp_path, mask, (0, 0, 0), spacing)
    assert np.array_equal(volume.values > 0, mask)


def test_distances_are_in_world_units(tmp_path):
    mask = np.zeros((30, 30, 30), bool)
    mask[15:] = True
    volume, _ = surface(tmp_path, mask, (0, 0, 0), (2, 1, 1))
    assert np.allclose(np.diff(volume.values[8:22, 15, 15]), 2, atol=0.35)
    assert volume.values[14, 15, 15] == pytest.approx(-volume.values[15, 15, 15], rel=1e-3)


def test_a_label_that_is_not_there(tmp_path):
    np.save(tmp_path / "a.npy", np.arange(27, dtype=np.uint8).reshape(3, 3, 3) % 3)
    with pytest.raises(BadInput, match="--label is 7; expected one of the labels of the file, which are 0, 1, 2"):
        read_volume(tmp_path / "a.npy", label=7)


def test_label_maps_are_recognised():
    mask, _ = ball(6)
    assert labels_in(Volume(mask)) == [1]
    many = np.zeros((40, 40, 40), np.int16)
    for k, corner in enumerate(np.random.default_rng(0).integers(0, 32, (60, 3))):
        many[tuple(slice(c, c + 8) for c in corner)] = 1000 + 7 * (k * 37 % 60)
    assert len(labels_in(Volume(many))) > 30
    nested = sum(ball(r, room=16 - r)[0].astype(int) for r in (4, 8, 12))
    assert labels_in(Volume(nested)) == [1, 2, 3]


def test_only_a_map_of_several_labels_is_advised_to_light_several():
    mask = ball(6)[0].astype(np.uint8)
    for values, several in ((mask, False), (mask + np.roll(mask, 3, axis=0), True)):
        field = Field("map", Volume(values), range=(0.2, 0.8))
        found = {one.name: one.sentence for one in diagnose(field, nodes_over(field.volume), flat=[])}
        assert ("several" in found["labels"]) is several


def test_fields_are_not_taken_for_label_maps():
    x = np.linspace(-1, 1, 60)
    smooth = np.exp(-3 * sum(a * a for a in np.meshgrid(x, x, x, indexing="ij")))
    assert not labels_in(Volume(smooth))
    assert not labels_in(Volume((255 * smooth).astype(np.uint8)))
    assert not labels_in(Volume((25 * smooth).astype(np.uint8)))
    assert not labels_in(Volume(np.random.default_rng(0).integers(0, 20, (30, 30, 30))))
    for file in VOLUMES.glob("*.nrrd") if VOLUMES.exists() else ():
        assert not labels_in(read_volume(file)), file.name


def test_run_of_one_and_of_several_labels(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one, _ = ball(6)
    maps = np.zeros((30, *one.shape[1:]), np.uint8)
    maps[: one.shape[0]][one] = 1
    maps[-one.shape[0] :][one] = 3
    np.save("a.npy", maps)
    fast = ["--grid", "12", "--paths", "2", "--bounces", "1", "--no-preview"]
    done = CliRunner().invoke(app, ["run", "a.npy", *fast])
    assert "labels: " in done.output and "--label 1,3" in done.output
    done = CliRunner().invoke(app, ["run", "a.npy", "--label", "1,3", "-o", "two", *fast])
    assert done.exit_code == 0 and "labels: " not in done.output and "plateau" not in done.output
    from illumgrid import load

    first, second = load("two").scene.fields
    assert (first.name, second.name) == ("a 1", "a 3") and first.range.tolist() == [-1, 1]
    assert np.abs(first.material.albedo - second.material.albedo).max() > 0.3
    done = CliRunner().invoke(app, ["info", "a.npy", "--label", "3"])
    assert done.exit_code == 0 and "-1 to 1: a voxel outside" in done.output
    with pytest.raises(BadInput, match="different whole numbers"):
        CliRunner().invoke(app, ["info", "a.npy", "--label", "x"], catch_exceptions=False)
    for command in (["info", "a.npy"], ["run", "a.npy", "-o", "below"]):
        with pytest.raises(BadInput, match="--inside and --label came together"):
            CliRunner().invoke(app, [*command, "--label", "3", "--inside", "below"], catch_exceptions=False)
