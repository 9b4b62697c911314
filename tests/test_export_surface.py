"""A lit isosurface in files for other programs: glTF and PLY."""

import json
import struct

import numpy as np
import pytest
import trimesh

from illumgrid.field.levelset import isosurface
from illumgrid.field.volume import interpolate, world_to_index
from illumgrid.io import exports
from illumgrid.tone import curve, encode_srgb
from lights import lopsided_light
from shapes import DIRECTIONS, refused


def read_glb(path):
    """JSON and accessor arrays of a .glb, read according to the standard without a library."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack("<4s4I", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), 0x4E4F534A)
    tree = json.loads(data[20 : 20 + size])
    size_of_rest, kind = struct.unpack("<2I", data[20 + size : 28 + size])
    assert kind == 0x004E4942 and size_of_rest == tree["buffers"][0]["byteLength"] and size % 4 == 0
    binary = data[28 + size :]
    arrays = []
    for accessor in tree["accessors"]:
        view = tree["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        dtype, width = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]], {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
        array = np.frombuffer(binary, dtype, accessor["count"] * width, start).reshape(-1, width)
        assert np.allclose(array.min(axis=0), accessor["min"]) and np.allclose(array.max(axis=0), accessor["max"])
        arrays.append(array)
    return tree, arrays


def placed(tree, positions):
    """Positions as placed by a viewer: with the column-major matrix of the only node."""
    matrix = np.reshape(tree["nodes"][0]["matrix"], (4, 4)).T
    return positions @ matrix[:3, :3].T + matrix[:3, 3]


def to_world(points):
    """From glTF's y up to the world's z up."""
    x, y, z = np.asarray(points).T
    return np.stack([x, -z, y], axis=1)


@pytest.mark.parametrize("name", DIRECTIONS)
def test_gltf_has_unlit_linear_colors_at_the_right_places(tmp_path, name):
    light = lopsided_light(DIRECTIONS[name])
    light.__dict__["exposure"] = 2.5  # enough to be clamped at some vertices
    exports.write(light, tmp_path / "a.glb", isovalue=0.7)
    tree, arrays = read_glb(tmp_path / "a.glb")
    (mesh,), (material,) = tree["meshes"], tree["materials"]
    (primitive,) = mesh["primitives"]
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"]
    assert material["extensions"] == {"KHR_materials_unlit": {}} and primitive["material"] == 0
    assert mesh["extras"] == {
        "field": "egg", "isovalue": 0.7, "exposure": light.exposure, "colors": "albedo/pi * irradiance * exposure",
    }  # fmt: skip
    assert primitive["attributes"].keys() == {"POSITION", "COLOR_0"} and primitive.get("mode", 4) == 4
    world = to_world(placed(tree, arrays[primitive["attributes"]["POSITION"]]))
    volume = light.scene.fields[0].volume
    assert np.abs(interpolate(volume, world_to_index(volume, world)) - 0.7).max() < 1e-5
    linear = light.grid("egg").lookup(world) * light.scene.fields[0].material.albedo / np.pi * light.exposure
    color = arrays[primitive["attributes"]["COLOR_0"]]
    assert (linear > 1).any() and color.dtype == np.float32
    assert np.allclose(color, curve(linear), atol=1e-4)
    ours = trimesh.Trimesh(world, arrays[primitive["indices"]].reshape(-1, 3), process=False)
    assert np.isclose(ours.volume, isosurface(volume, 0.7).volume, rtol=1e-4) and ours.volume > 0  # faces look outward


def test_trimesh_reads_the_gltf_upright(tmp_path):
    light = lopsided_light(DIRECTIONS["oblique"])
    exports.write(light, tmp_path / "a.glb", isovalue=0.7)
    mesh = trimesh.load(tmp_path / "a.glb").to_mesh()
    assert np.allclose(to_world(mesh.vertices), isosurface(light.scene.fields[0].volume, 0.7).vertices, atol=1e-4)


def test_gltf_keeps_its_digits_far_from_the_origin(tmp_path):
    far = (1e7, -2e7, 5e6)
    light = lopsided_light(DIRECTIONS["oblique"], origin=far)
    exports.write(light, tmp_path / "a.glb", isovalue=0.7)
    tree, arrays = read_glb(tmp_path / "a.glb")
    positions = arrays[tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]].astype(float)
    ours = isosurface(light.scene.fields[0].volume, 0.7).vertices
    assert np.abs(to_world(placed(tree, positions)) - ours).max() < 1e-5  # single precision there: 1


@pytest.mark.parametrize("name", DIRECTIONS)
def test_trimesh_reads_the_ply_in_the_world_with_srgb_bytes(tmp_path, name):
    light = lopsided_light(DIRECTIONS[name])
    sentence = exports.write(light, tmp_path / "a.ply", field="shell", isovalue=-0.7)
    mesh = trimesh.load(tmp_path / "a.ply", process=False)
    ours = isosurface(light.scene.fields[1].volume, -0.7, "below")
    assert np.allclose(mesh.vertices, ours.vertices, rtol=1e-6) and np.array_equal(mesh.faces, ours.faces)
    assert np.array_equal(mesh.visual.vertex_colors[:, :3], light.color(ours.vertices, field="shell"))
    head = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0].decode("ascii")
    comments = dict(
        line.split(" ", 2)[1:] for line in head.splitlines() if line.startswith("comment ") and line.count(" ") > 1
    )
    assert comments["field"] == "shell" and comments["isovalue"] == "-0.7" and comments["encoding"] == "sRGB"
    assert float(comments["exposure"]) == light.exposure and f"{light.exposure:.4g}" in sentence


def test_both_files_show_the_same_color(tmp_path):
    light = lopsided_light(DIRECTIONS["straight"])
    for ending in ("glb", "ply"):
        exports.write(light, tmp_path / f"a.{ending}")
    tree, arrays = read_glb(tmp_path / "a.glb")
    linear = arrays[tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert tree["meshes"][0]["extras"]["isovalue"] == pytest.approx(0.7)  # the middle of the range
    assert np.array_equal(
        encode_srgb(linear), trimesh.load(tmp_path / "a.ply", process=False).visual.vertex_colors[:, :3]
    )


def test_names_in_other_alphabets(tmp_path):
    light = lopsided_light(np.eye(3))
    object.__setattr__(light.scene.fields[0], "name", "Kalb & <Größe>")
    for ending in ("glb", "ply", "vti", "nrrd", "npz", "exr"):
        assert "Größe" in exports.write(light, tmp_path / f"a.{ending}")
    assert read_glb(tmp_path / "a.glb")[0]["meshes"][0]["extras"]["field"] == "Kalb & <Größe>"
    assert len(trimesh.load(tmp_path / "a.ply", process=False).faces)


def test_an_isovalue_without_light_or_surface_is_refused(tmp_path):
    light = lopsided_light(np.eye(3))
    write = exports.write
    refused(lambda: write(light, tmp_path / "a.glb", isovalue=0.9), "0.9", "'egg'", "0.55 to 0.85", "wider range")
    refused(lambda: write(light, tmp_path / "a.glb", isovalue=np.nan), "nan", "finite")
    object.__setattr__(light.scene.fields[0], "range", np.array([2.0, 3.0]))
    refused(lambda: write(light, tmp_path / "a.ply"), "no surface at isovalue 2.5", "between")
    assert not list(tmp_path.iterdir())
