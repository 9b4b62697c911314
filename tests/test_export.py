"""Arrays in files for other programs: VTK, SimpleITK, OpenEXR and NumPy find the light at its world position."""

import numpy as np
import OpenEXR
import pytest
import pyvista as pv
import SimpleITK as sitk  # noqa: N813

from illumgrid.field.levelset import isosurface
from illumgrid.field.volume import index_to_world, interpolate, world_to_index
from illumgrid.io import exports
from illumgrid.io.readers import read_volume
from lights import lopsided_light
from shapes import DIRECTIONS, refused

ARRAYS = ["irradiance", "error", "support", "field", "color"]
EVERYWHERE = [(name, on) for name in DIRECTIONS for on in ("grid", "field")]


def expected(light, world, number=0):
    """The arrays at world points, as computed by the package in Python."""
    field = light.scene.fields[number]
    h = interpolate(field.volume, world_to_index(field.volume, world))
    return {
        "irradiance": light.grid(field.name).lookup(world),
        "field": h.astype(np.float32),
        "color": light.color(world, field=field.name),
        **dict(zip(("error", "support"), light.grids[number].certainty(world))),
    }


def vtk_points(image):
    """Positions of the points of an image, computed by VTK."""
    return np.array([image.GetPoint(k) for k in range(image.n_points)])


@pytest.mark.parametrize(("name", "on"), EVERYWHERE)
def test_vtk_finds_every_array_where_it_is_in_the_world(tmp_path, name, on):
    light = lopsided_light(DIRECTIONS[name])
    exports.write(light, tmp_path / "a.vti", on=on)
    image = pv.read(tmp_path / "a.vti")
    lattice = light.scene.fields[0].volume if on == "field" else light.grids[0].spec
    assert image.dimensions == lattice.shape and isinstance(image, pv.ImageData)
    assert image.point_data.keys() == ARRAYS and image.active_scalars_name == "field"
    there = expected(light, vtk_points(image))
    for array in ARRAYS:
        assert image[array].dtype == (np.uint8 if array == "color" else np.float32)
        assert not np.isnan(image[array].astype(float)).any()
        assert np.allclose(image[array], there[array], rtol=1e-5, atol=1e-6), array
    assert image.field_data["exposure"] == light.exposure
    assert np.array_equal(image.field_data["albedo"], light.scene.fields[0].material.albedo)


@pytest.mark.parametrize("name", DIRECTIONS)
def test_a_contour_in_vtk_is_the_isosurface_with_its_light(tmp_path, name):
    light = lopsided_light(DIRECTIONS[name], nodes=9)
    volume = light.scene.fields[0].volume
    exports.write(light, tmp_path / "a.vti")
    # As a structured grid: VTK's contour of an image forgets the direction of its axes.
    contour = pv.read(tmp_path / "a.vti").cast_to_structured_grid().contour([0.7])
    assert np.abs(interpolate(volume, world_to_index(volume, contour.points)) - 0.7).max() < 1e-5
    assert np.abs(contour["irradiance"] - light.grid("egg").lookup(contour.points)).max() < 1e-4
    ours = isosurface(volume, 0.7)
    assert np.allclose(np.reshape(contour.bounds, (3, 2)).T, ours.bounds, atol=1e-4)


def test_vtk_unpacks_many_blocks_and_a_last_one_that_is_full(tmp_path, monkeypatch):
    light = lopsided_light(DIRECTIONS["oblique"])
    size = light.grids[0].error.nbytes
    for block in (size, size // 4, 7, 10 * size):
        monkeypatch.setattr(exports.vti, "_BLOCK", block)
        exports.write(light, tmp_path / "a.vti")
        image = pv.read(tmp_path / "a.vti")
        assert np.array_equal(image["irradiance"], light.grids[0].lookup(vtk_points(image)))


@pytest.mark.parametrize(("name", "on"), EVERYWHERE)
@pytest.mark.parametrize("array", ARRAYS)
def test_itk_finds_an_array_where_it_is_in_the_world(tmp_path, name, on, array):
    light = lopsided_light(DIRECTIONS[name])
    exports.write(light, tmp_path / "a.nrrd", on=on, array=array)
    image = sitk.ReadImage(str(tmp_path / "a.nrrd"))
    index = [tuple(map(int, k)) for k in np.ndindex(image.GetSize())]
    world = np.array([image.TransformIndexToPhysicalPoint(k) for k in index])
    found = np.array([image.GetPixel(k) for k in index])
    assert np.allclose(found, expected(light, world)[array], rtol=1e-5, atol=1e-6)
    assert image.GetMetaData("NRRD_space") == "left-posterior-superior"
    assert image.GetMetaData("illumgrid field") == "egg"
    assert image.HasMetaDataKey("illumgrid exposure") == (array == "color")


def test_a_nrrd_holds_the_irradiance_and_its_directions_as_numbers_in_the_header(tmp_path):
    light = lopsided_light(DIRECTIONS["mirrored"])
    exports.write(light, tmp_path / "a.nrrd")
    head = (tmp_path / "a.nrrd").read_bytes().split(b"\n\n")[0].decode()
    fields = dict(line.split(": ", 1) for line in head.splitlines() if ": " in line)
    spec = light.grids[0].spec
    assert fields["sizes"] == "3 " + " ".join(map(str, spec.shape)) and fields["type"] == "float"
    first, *columns = fields["space directions"].split(" ")
    assert first == "none"
    numbers = np.array([[float(x) for x in column.strip("()").split(",")] for column in columns])
    assert np.allclose(numbers, (spec.direction * spec.spacing).T, rtol=1e-12)
    assert np.linalg.det(numbers) < 0
    assert np.allclose([float(x) for x in fields["space origin"].strip("()").split(",")], spec.origin, rtol=1e-12)


def test_the_field_of_a_nrrd_is_the_volume_again(tmp_path):
    light = lopsided_light(DIRECTIONS["mirrored"])
    volume = light.scene.fields[0].volume
    exports.write(light, tmp_path / "a.nrrd", on="field", array="field")
    again = read_volume(tmp_path / "a.nrrd")
    assert np.array_equal(again.values, volume.values)
    for place in ("origin", "spacing", "direction"):
        assert np.allclose(getattr(again, place), getattr(volume, place), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("on", ["grid", "field"])
def test_openexr_reads_rgb_and_the_rest_in_slices_below_one_another(tmp_path, on):
    light = lopsided_light(DIRECTIONS["oblique"])
    exports.write(light, tmp_path / "a.exr", on=on)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        header = dict(file.header())  # the file takes its own with it
        strips = {name: channel.pixels for name, channel in file.channels().items()}
    assert sorted(strips) == ["B", "G", "R", "error", "field", "support"]
    lattice = light.scene.fields[0].volume if on == "field" else light.grids[0].spec
    nx, ny, nz = lattice.shape
    for place in ("origin", "spacing", "direction"):
        assert np.array_equal(header[place], getattr(lattice, place))
    assert header["exposure"] == np.float32(light.exposure) and str((nx, ny, nz)) in header["layout"]
    x, y, z = np.indices(lattice.shape).reshape(3, -1)
    there = expected(light, index_to_world(lattice, np.stack([x, y, z], axis=1)))
    there |= dict(zip("RGB", there["irradiance"].T))
    for name, strip in strips.items():
        assert strip.dtype == np.float32 and strip.shape == (nz * ny, nx)
        assert np.allclose(strip[z * ny + y, x], there[name], rtol=1e-5, atol=1e-6), name


def test_numpy_reads_arrays_and_their_place(tmp_path):
    light = lopsided_light(DIRECTIONS["mirrored"])
    exports.write(light, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as pack:
        arrays = dict(pack)
    grid = light.grids[0]
    assert list(arrays)[:5] == ARRAYS
    assert np.array_equal(arrays["irradiance"], grid.values)
    assert np.array_equal(arrays["error"], grid.error) and np.array_equal(arrays["support"], grid.support)
    index = np.array([4, 2, 1])
    world = arrays["origin"] + arrays["direction"] @ (arrays["spacing"] * index)
    assert np.allclose(arrays["irradiance"][tuple(index)], grid.lookup([world]))
    assert arrays["exposure"] == light.exposure and arrays["color"].shape == (*grid.spec.shape, 3)


def test_a_field_is_picked_by_name(tmp_path):
    light = lopsided_light(DIRECTIONS["oblique"])
    sentence = exports.write(light, tmp_path / "a.vti", field="shell")
    image = pv.read(tmp_path / "a.vti")
    there = expected(light, vtk_points(image), number=1)
    assert "'shell'" in sentence and np.array_equal(image["color"], there["color"])
    assert np.array_equal(image["field"], there["field"])
    refused(lambda: exports.write(light, tmp_path / "a.vti", field="yolk"), "'yolk'", "egg, shell")


def test_certainty_is_that_of_the_nodes_that_a_lookup_mixes():
    light = lopsided_light(np.eye(3))
    grid = light.grids[0]
    spec = grid.spec
    on_nodes = grid.certainty(spec.nodes())
    assert np.array_equal(on_nodes[0], grid.error.ravel()) and np.array_equal(on_nodes[1], grid.support.ravel())
    hole, half = np.array([2, 1, 2]), np.array([0.5, 0, 0])
    error, support = grid.certainty(index_to_world(spec, [hole - half, hole - 2 * half, hole - 3 * half]))
    assert np.isinf(error[0]) and support[0] == 0  # between a node and a hole
    assert error[1] == grid.error[1, 1, 2] and support[1] == grid.support[1, 1, 2]  # on the node beside it
    assert np.isclose(error[2], grid.error[:2, 1, 2].mean()) and support[2] == grid.support[:2, 1, 2].min()
    outside = grid.certainty(index_to_world(spec, [[-3, 0, 0], [99, 99, 99]]))
    assert np.array_equal(outside[0], [grid.error[0, 0, 0], grid.error[-1, -1, -1]])


def test_many_points_are_looked_up_in_parts_and_progress_is_reported(tmp_path, monkeypatch):
    light = lopsided_light(DIRECTIONS["oblique"])
    exports.write(light, tmp_path / "a.npz", on="field")
    monkeypatch.setattr(exports.arrays, "_AT_ONCE", 50)
    calls = []
    exports.write(light, tmp_path / "b.npz", on="field", progress=lambda *step: calls.append(step))
    with np.load(tmp_path / "a.npz") as whole, np.load(tmp_path / "b.npz") as parts:
        for name in whole:
            assert np.array_equal(whole[name], parts[name])
    count = 9 * 7 * 6
    total = 5 * count  # one array after the other
    assert calls[0] == ("points", 0, total) and calls[1] == ("points", 50, total)
    assert ("points", count + 50, total) in calls and calls[-1] == ("points", total, total)
