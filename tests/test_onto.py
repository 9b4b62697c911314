"""Meshes that came from elsewhere, lit at their vertices."""

import numpy as np
import pytest
import trimesh

from illumgrid.field.levelset import isosurface
from illumgrid.field.onto import onto_levels
from illumgrid.field.scene import Field, Material
from illumgrid.field.volume import Volume, index_to_world, interpolate, world_to_index
from illumgrid.io import exports
from illumgrid.io.readers.mesh import ENDINGS, read_mesh
from lights import SPACING, lopsided_light
from shapes import DIRECTIONS, refused


@pytest.fixture(scope="module")
def light():
    return lopsided_light(DIRECTIONS["oblique"])


def levels(light, points, field=0):
    volume = light.scene.fields[field].volume
    return interpolate(volume, world_to_index(volume, points))


def test_an_isosurface_baked_is_the_lookup(light):
    mesh = isosurface(light.scene.fields[0].volume, 0.7)
    lit = light.bake(mesh)
    assert np.array_equal(lit.visual.vertex_colors[:, :3], light.color(mesh.vertices))
    assert np.array_equal(lit.vertices, mesh.vertices) and np.array_equal(lit.faces, mesh.faces)
    assert not mesh.visual.defined and "light" not in mesh.vertex_attributes  # the given mesh stays as it is


def test_an_isosurface_of_noise_written_in_single_precision_lies_on_its_level():
    """Newton steps would leave, or not arrive, at planes of voxels, where slopes turn over."""
    noise = np.random.default_rng(0).integers(0, 9, (16, 16, 16)).astype(np.float32)
    volume = Volume(noise, spacing=(1.1, 0.9, 1.0))
    written = isosurface(volume, 4.3).vertices.astype(np.float32).astype(float)
    found = onto_levels(Field("noise", volume, Material((0.8,) * 3), (3.0, 5.0)), written, 4.3)
    index = world_to_index(volume, written)
    on_edges = (np.abs(index - np.round(index)) < 1e-4).sum(axis=1) >= 2  # others are middles of cells
    assert on_edges.mean() > 0.9 and np.abs(found - written)[on_edges].max() < 1e-4


def test_shade_is_the_luminance_of_white_and_own_colors_stay():
    light = lopsided_light(DIRECTIONS["oblique"])
    light.__dict__["exposure"] = 0.4  # dark enough for the tone curve to change nothing
    mesh = isosurface(light.scene.fields[0].volume, 0.7)
    own = np.random.default_rng(0).integers(0, 256, (len(mesh.vertices), 4), dtype=np.uint8)
    mesh.visual.vertex_colors = own
    lit = light.bake(mesh)
    radiance = light.grid("egg").lookup(mesh.vertices) * 0.4 / np.pi
    assert radiance.max() < 0.8
    assert np.allclose(lit.vertex_attributes["light"], radiance @ [0.2126, 0.7152, 0.0722], rtol=1e-5)  # Rec. 709
    assert np.array_equal(lit.visual.vertex_colors, own)


def test_points_move_onto_the_level_that_is_asked_or_onto_the_nearest_of_the_range(light):
    field = light.scene.fields[0]
    surface = isosurface(field.volume, 0.56).vertices
    index = world_to_index(field.volume, surface)
    inner = ((index > 1) & (index < np.array(field.volume.shape) - 2)).all(axis=1)
    points = surface[inner] - 0.3 * min(SPACING) * np.ones(3) / np.sqrt(3)
    moved = onto_levels(field, points)
    assert (levels(light, points) < 0.55).any()  # some were outside the range 0.55 to 0.85
    assert (levels(light, moved) >= 0.55 - 1e-6).all()
    within = levels(light, points) > 0.55
    assert np.array_equal(moved[within], points[within])
    onto = onto_levels(field, points, 0.56)
    assert np.allclose(levels(light, onto), 0.56, atol=1e-6)
    assert (np.linalg.norm(onto - points, axis=1) < np.linalg.norm(SPACING)).all()


def test_what_lies_too_far_off_is_counted(light):
    field = light.scene.fields[0]
    good = isosurface(field.volume, 0.7).vertices[:10]
    far = index_to_world(field.volume, np.array([[0.2, 0.2, 0.2], [50, 3, 3]]))  # far below the range; outside
    bad = np.concatenate([good, far, [[np.nan, 0, 0]]])
    refused(lambda: onto_levels(field, bad), "3 of 13", "number 10", "'egg'")
    refused(lambda: onto_levels(field, good, 0.84), "of 10 vertices", "0.84")
    refused(lambda: onto_levels(field, good, 0.9), "0.9", "wider range")


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_kind_of_mesh_comes_in_its_place(light, tmp_path, ending):
    surface = isosurface(light.scene.fields[0].volume, 0.7)
    if ending == ".glb":
        exports.write(light, tmp_path / "m.glb", isovalue=0.7)
    else:
        surface.export(tmp_path / f"m{ending}")
    mesh = read_mesh(tmp_path / f"m{ending}")
    assert len(mesh.faces) == len(surface.faces) and np.allclose(mesh.bounds, surface.bounds, atol=1e-4)
    if ending == ".stl":  # which knows no vertices but corners of faces: they are joined
        assert len(mesh.vertices) < 0.3 * 3 * len(mesh.faces)
    else:
        assert np.allclose(mesh.vertices, surface.vertices, atol=1e-4)
    exports.write(light, tmp_path / "out.ply", onto=tmp_path / f"m{ending}")
    out = trimesh.load(tmp_path / "out.ply", process=False)
    shade = out.metadata["_ply_raw"]["vertex"]["data"]["light"]
    assert np.allclose(shade, light.shade(mesh.vertices), atol=1e-3)
    if ending != ".glb":
        assert np.abs(out.visual.vertex_colors[:, :3].astype(int) - light.color(mesh.vertices)).max() <= 1
    else:  # it has colours of its own, linear in a .glb: the light that was exported
        assert np.abs(out.visual.vertex_colors[:, :3].astype(int) - light.color(surface.vertices)).max() <= 8


def test_gltf_carries_the_shade(light, tmp_path):
    isosurface(light.scene.fields[0].volume, 0.7).export(tmp_path / "m.ply")
    exports.write(light, tmp_path / "out.glb", onto=tmp_path / "m.ply", isovalue=0.7)
    out = read_mesh(tmp_path / "out.glb")
    assert np.allclose(out.vertex_attributes["_LIGHT"].ravel(), light.shade(out.vertices), atol=1e-3)


def test_files_that_are_no_meshes_are_refused(light, tmp_path):
    refused(lambda: read_mesh(tmp_path / "m.vtk"), ".vtk", ".ply, .stl")
    refused(lambda: read_mesh(tmp_path / "m.ply"), "no such file")
    for ending in ENDINGS:
        for content in (b"", b"ply\nformat ascii 1.0\n\x00\xff", np.random.default_rng(0).bytes(300)):
            (tmp_path / f"m{ending}").write_bytes(content)
            refused(lambda name=f"m{ending}": read_mesh(tmp_path / name), f"m{ending}")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "m.ply")
    refused(lambda: read_mesh(tmp_path / "m.ply"), "m.ply")
    refused(lambda: exports.write(light, tmp_path / "a.vti", onto=tmp_path / "m.ply"), "a.vti", ".ply")
