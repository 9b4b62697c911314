"""Legacy VTK as VTK writes it, Gaussian cube and OpenDX as their manuals write them."""

import numpy as np
import pytest
import pyvista as pv
from vtkmodules.vtkIOLegacy import vtkStructuredPointsWriter

from grid_files import NOISE, START, STEP, cube_file, dx_file
from illumgrid.errors import IllumgridWarning
from illumgrid.field.volume import index_to_world
from illumgrid.io.readers import read_volume
from volume_files import refused, refused_lightly, values, vtk_head, zipped


def grid(points=None, cells=None, active=None):
    """An image of 5x6x7 points; arrays by name."""
    image = pv.ImageData(dimensions=(5, 6, 7), origin=START, spacing=STEP)
    for name, array in (points or {}).items():
        image.point_data[name] = array.reshape(-1, *array.shape[3:], order="F") if array.ndim > 2 else array
    for name, array in (cells or {}).items():
        image.cell_data[name] = array.ravel(order="F")
    image.point_data.active_scalars_name = image.cell_data.active_scalars_name = None
    if active:
        where, name = active
        (image.point_data if where == "point" else image.cell_data).active_scalars_name = name
    return image


def legacy(path, image, text):
    writer = vtkStructuredPointsWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(image)
    (writer.SetFileTypeToASCII if text else writer.SetFileTypeToBinary)()
    writer.Write()
    return path


CELLS = np.random.default_rng(6).normal(size=(4, 5, 6))


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    "dtype", ["uint8", "int8", "int16", "uint16", "int32", "uint32", "int64", "float32", "float64"]
)
def test_every_kind_of_number(tmp_path, dtype, text):
    image = grid({"f": (NOISE * 50).astype(dtype)}, active=("point", "f"))
    volume = read_volume(legacy(tmp_path / "a.vtk", image, text))
    there = pv.read(tmp_path / "a.vtk")
    assert np.array_equal(volume.values.ravel(order="F"), there["f"].astype(np.float32))
    index = np.array([[0, 0, 0], [4, 5, 6], [1, 2, 3]])
    assert np.allclose(index_to_world(volume, index), [there.GetPoint(int(x + 5 * (y + 6 * z))) for x, y, z in index])


@pytest.mark.parametrize("text", [False, True])
def test_points_before_cells_and_both_by_name(tmp_path, text):
    image = grid({"p": NOISE, "q": -NOISE}, {"c": CELLS, "p": 2 * CELLS}, ("point", "p"))
    path = legacy(tmp_path / "a.vtk", image, text)
    with pytest.warns(IllumgridWarning, match=r"choice: a.vtk: its array p \(1\) was read"):
        assert np.allclose(read_volume(path).values, NOISE)
    assert np.allclose(read_volume(path, array="q").values, -NOISE)
    assert np.allclose(read_volume(path, array="point:p").values, NOISE)
    volume = read_volume(zipped(path), array="c")
    assert np.allclose(volume.values, CELLS)
    assert np.allclose(volume.origin, np.array(START) + np.array(STEP) / 2)  # the centre of the first cell
    assert np.allclose(read_volume(path, array="cell:p").values, 2 * CELLS)


def test_arrays_of_a_field_are_a_choice(tmp_path):
    vectors = np.stack([NOISE, NOISE + 1, NOISE + 2], axis=3)
    path = legacy(tmp_path / "a.vtk", grid({"a b": NOISE, "v": vectors, "c": -NOISE}), False)
    assert b"FIELD" in path.read_bytes()
    listed = read_listed(path)
    assert {"a b (1)", "v (3)", "c (1)"} <= listed
    assert np.allclose(read_volume(path, array="a b").values, NOISE)
    assert np.allclose(read_volume(path, array="v", channel=2).values, NOISE + 2)
    refused(legacy(tmp_path / "b.vtk", grid({"v": vectors}), True), "v (3)", "one component")


def read_listed(path):
    refused(path, "--array")
    with pytest.raises(ValueError) as caught:
        read_volume(path)
    return {part.strip() for part in str(caught.value).partition("are: ")[2].partition("; expected")[0].split(",")}


def test_only_cells(tmp_path):
    for text in (False, True):
        path = legacy(tmp_path / "a.vtk", grid(cells={"c": CELLS}, active=("cell", "c")), text)
        volume = read_volume(path)
        assert np.allclose(volume.values, CELLS) and np.allclose(volume.origin, np.array(START) + np.array(STEP) / 2)


def test_a_lookup_table_a_time_and_windows_lines(tmp_path):
    head = vtk_head("ASCII").decode().replace("DIMENSIONS", "FIELD FieldData 1\nTIME 1 1 double\n0.5\nDIMENSIONS")
    numbers = "\n".join(map(str, values().ravel(order="F")))
    table = "\nLOOKUP_TABLE t 2\n0 0 0 1\n1 1 1 1\nVECTORS v float\n" + "1 2 3\n" * 210
    (tmp_path / "a.vtk").write_bytes((head + numbers + table).replace("\n", "\r\n").encode())
    with pytest.warns(IllumgridWarning, match="choice"):
        assert np.array_equal(read_volume(tmp_path / "a.vtk").values, values())


@pytest.mark.parametrize("text", [False, True])
def test_a_cut_file(tmp_path, text):
    whole = legacy(tmp_path / "a.vtk", grid({"p": NOISE}, {"c": CELLS}, ("point", "p")), text).read_bytes()
    for share in (0.05, 0.3, 0.6, 0.9, 0.97):
        (tmp_path / "a.vtk").write_bytes(whole[: int(share * len(whole))])
        refused(tmp_path / "a.vtk", "whole")


def test_other_data_sets_are_named(tmp_path):
    pv.Sphere().save(tmp_path / "a.vtp")
    pv.Sphere().cast_to_unstructured_grid().save(tmp_path / "b.vtu")
    (tmp_path / "a.vtk").write_text("# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nPOINTS 0 float\n")
    refused(tmp_path / "a.vtk", "POLYDATA", "STRUCTURED_POINTS")
    rectilinear = pv.RectilinearGrid(np.arange(5) * 1.5 + 10, np.arange(6) * 2.0 - 20, np.arange(7) * 3.0 + 30)
    rectilinear["p"] = NOISE.ravel(order="F")
    rectilinear.save(tmp_path / "even.vtk")
    volume = read_volume(tmp_path / "even.vtk")
    assert np.allclose(volume.values, NOISE) and np.allclose(volume.spacing, STEP) and np.allclose(volume.origin, START)
    pv.RectilinearGrid(np.arange(5) ** 2.0, np.arange(6.0), np.arange(7.0)).save(tmp_path / "uneven.vtk")
    refused(tmp_path / "uneven.vtk", "unevenly")


def test_a_legacy_header_that_lies(tmp_path):
    body = b" ".join(b"%d" % n for n in range(210))
    for old, new in (
        (b"5 6 7", b"5000 6000 7000"),
        (b"POINT_DATA 210", b"POINT_DATA 999999999"),
        (b"int 1", b"int 99"),
    ):
        (tmp_path / "a.vtk").write_bytes(vtk_head("ASCII").replace(old, new) + body)
        refused_lightly(tmp_path / "a.vtk")
        (tmp_path / "a.vtk").write_bytes(vtk_head("BINARY").replace(old, new) + bytes(840))
        refused_lightly(tmp_path / "a.vtk")


def test_cube(tmp_path):
    for path in (cube_file(tmp_path / "a.cube"), zipped(tmp_path / "a.cube"), cube_file(tmp_path / "B.CUB", sign=-1)):
        volume = read_volume(path)
        assert np.allclose(volume.values, NOISE, rtol=1e-5)
        assert np.allclose(volume.origin, START) and np.allclose(volume.spacing, STEP)


def test_cube_of_orbitals_and_of_several_fields(tmp_path):
    both = np.stack([NOISE, -NOISE], axis=3)
    cube_file(tmp_path / "a.cube", both, atoms=-2, orbitals=[17, 18])
    refused(tmp_path / "a.cube", "orbital 17", "orbital 18", "--array")
    assert np.allclose(read_volume(tmp_path / "a.cube", array="orbital 18").values, -NOISE, rtol=1e-5)
    cube_file(tmp_path / "b.cube", both, last=" 2")
    assert np.allclose(read_volume(tmp_path / "b.cube", array=1).values, -NOISE, rtol=1e-5)


def test_cube_of_oblique_axes_is_resampled(tmp_path):
    steps = np.array([[1.0, 0, 0], [1.0, 2.0, 0], [0, 0, 1.0]])
    with pytest.warns(IllumgridWarning, match="right angles"):
        volume = read_volume(cube_file(tmp_path / "a.cube", steps=steps))
    points = np.array(START) + np.array([[1, 2, 3], [4, 5, 6], [0, 0, 0]]) @ steps
    index = np.round(np.linalg.solve(volume.direction * volume.spacing, (points - volume.origin).T).T).astype(int)
    assert np.allclose(volume.values[tuple(index.T)], NOISE[[1, 4, 0], [2, 5, 0], [3, 6, 0]], rtol=1e-4)


@pytest.mark.parametrize("name", ["a.cube", "a.dx"])
def test_a_cut_text(tmp_path, name):
    path = cube_file(tmp_path / name) if name == "a.cube" else dx_file(tmp_path / name)
    whole = path.read_bytes()
    for share in (0.01, 0.05, 0.5, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        refused(path, "expected")
    assert b"5 1.5" in whole or b"counts 5" in whole
    for old, new in ((b"5 1.5", b"99999 1.5"), (b"counts 5", b"counts 99999"), (b"items 210", b"items 20790000")):
        path.write_bytes(whole.replace(old, new))
        if path.read_bytes() != whole:
            refused_lightly(path)
    path.write_bytes(whole.replace(b"E", b"x"))
    refused(path, "expected")


@pytest.mark.parametrize("binary", ["", "lsb ieee "])
def test_dx(tmp_path, binary):
    dx_file(tmp_path / "a.dx", binary)
    for path in (tmp_path / "a.dx", zipped(tmp_path / "a.dx")):
        volume = read_volume(path)
        assert np.allclose(volume.values, NOISE, rtol=1e-6)
        assert np.allclose(volume.origin, START) and np.allclose(volume.spacing, STEP)


def test_dx_of_vectors(tmp_path):
    whole = dx_file(tmp_path / "a.dx").read_text()
    (tmp_path / "a.dx").write_text(whole.replace("rank 0", "rank 1 shape 3"))
    refused(tmp_path / "a.dx", "vectors")


def test_escapes_in_names_do_not_reach_the_terminal(tmp_path):
    body = b"\n".join(b"%d" % n for n in range(210))
    field = b"\nFIELD f 1\n\x1b]0;owned\x07 1 210 int\n" + body
    (tmp_path / "a.vtk").write_bytes(vtk_head("ASCII") + body + field)
    with pytest.warns(IllumgridWarning, match=r"choice: .*\?\]0;owned\?") as caught:
        read_volume(tmp_path / "a.vtk")
    assert all(str(one.message).isprintable() for one in caught)
    (tmp_path / "b.vtk").write_bytes(vtk_head("ASCII").replace(b"STRUCTURED_POINTS", b"POLY\x1b[2JDATA"))
    assert refused(tmp_path / "b.vtk", "POLY?[2JDATA").isprintable()
