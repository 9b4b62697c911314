"""VTK image data written by VTK is read back with its placement; broken and hostile files are refused."""

import sys

import numpy as np
import pytest
import pyvista as pv
from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

from illumgrid.errors import IllumgridWarning
from illumgrid.field.volume import index_to_world
from illumgrid.io.readers import read_volume, volume_name
from volume_files import ORIGIN, SPACING, TURN, refused, refused_lightly, values, zipped


def vti(path, array=None, extent=None, mode="appended", packer="zlib", **more):
    """Write an array (nx, ny, nz) as VTK does, with more arrays beside it."""
    array = values() if array is None else array
    image = pv.ImageData(dimensions=array.shape, origin=ORIGIN, spacing=SPACING, direction_matrix=TURN)
    image["density"] = array.ravel(order="F")
    for name, other in more.items():
        image[name] = other
    image.set_active_scalars("density")
    if extent:
        image.SetExtent(extent)
    writer = vtkXMLImageDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(image)
    getattr(
        writer, {"ascii": "SetDataModeToAscii", "binary": "SetDataModeToBinary"}.get(mode, "SetDataModeToAppended")
    )()
    writer.SetEncodeAppendedData(mode == "encoded")
    writer.SetCompressorType({"none": 0, "zlib": 1, "lz4": 2, "lzma": 3}[packer])
    writer.Write()
    return image


@pytest.mark.parametrize("mode", ["ascii", "binary", "appended", "encoded"])
@pytest.mark.parametrize("packer", ["none", "zlib", "lz4", "lzma"])
def test_every_way_that_vtk_writes(tmp_path, mode, packer):
    image = vti(tmp_path / "a.vti", mode=mode, packer=packer)
    for file in (tmp_path / "a.vti", zipped(tmp_path / "a.vti")):
        volume = read_volume(file)
        assert np.array_equal(volume.values, values())
        index = np.array([[0, 0, 0], [4, 0, 0], [0, 5, 0], [0, 0, 6], [3, 2, 5]])
        there = [image.GetPoint(int(x + 5 * (y + 6 * z))) for x, y, z in index]
        assert np.allclose(index_to_world(volume, index), there, atol=1e-12)
    assert volume_name(tmp_path / "a.vti") == "a"


@pytest.mark.parametrize(
    "dtype", ["uint8", "int8", "int16", "uint16", "int32", "uint32", "int64", "float32", "float64"]
)
def test_every_kind_of_number(tmp_path, dtype):
    vti(tmp_path / "a.vti", values(dtype))
    assert np.array_equal(read_volume(tmp_path / "a.vti").values, values(dtype).astype(np.float32))


def test_an_extent_that_does_not_begin_at_zero(tmp_path):
    image = vti(tmp_path / "a.vti", extent=(3, 7, -2, 3, 10, 16))
    volume = read_volume(tmp_path / "a.vti")
    assert np.allclose(volume.origin, image.GetPoint(0), atol=1e-12)
    assert np.allclose(index_to_world(volume, [[4, 5, 6]]), image.GetPoint(209), atol=1e-12)
    assert np.array_equal(volume.values, values())


def test_the_scalars_among_many_arrays(tmp_path):
    vti(tmp_path / "a.vti", color=np.zeros((210, 3), np.uint8), other=np.arange(210.0))
    with pytest.warns(IllumgridWarning, match=r"choice: a.vti: its array density .* other \(1\)"):
        assert np.array_equal(read_volume(tmp_path / "a.vti").values, values())
    assert read_volume(tmp_path / "a.vti", array="other").values[4, 5, 6] == 209
    assert not read_volume(tmp_path / "a.vti", array="color", channel=2).values.any()
    text = (tmp_path / "a.vti").read_bytes()
    (tmp_path / "b.vti").write_bytes(text.replace(b'Scalars="density"', b""))
    refused(tmp_path / "b.vti", "density (1), color (3), other (1)", "one component")
    vti(tmp_path / "c.vti", color=np.zeros((210, 3), np.uint8))
    text = (tmp_path / "c.vti").read_bytes()
    (tmp_path / "c.vti").write_bytes(text.replace(b'Scalars="density"', b""))
    with pytest.warns(IllumgridWarning, match="choice"):
        assert np.array_equal(read_volume(tmp_path / "c.vti").values, values())


def test_what_is_no_volume_of_points(tmp_path):
    image = pv.ImageData(dimensions=(3, 4, 5))
    image.save(tmp_path / "a.vti")
    refused(tmp_path / "a.vti", "none", "point data")
    vti(tmp_path / "c.vti", values(shape=(1, 5, 6)))
    refused(tmp_path / "c.vti", "1x5x6", "at least 2")
    pv.Sphere().save(tmp_path / "d.vtp")
    (tmp_path / "d.vtp").rename(tmp_path / "d.vti")
    refused(tmp_path / "d.vti", "begin")
    (tmp_path / "e.vti").write_bytes(b"")
    refused(tmp_path / "e.vti", "empty")


@pytest.mark.parametrize("mode", ["ascii", "binary", "appended"])
def test_a_cut_file(tmp_path, mode, capfd):
    vti(tmp_path / "a.vti", np.random.default_rng(0).normal(size=(20, 21, 22)), mode=mode)
    whole = (tmp_path / "a.vti").read_bytes()
    for share in (0.01, 0.5, 0.9, 0.999):
        (tmp_path / "a.vti").write_bytes(whole[: int(share * len(whole))])
        refused(tmp_path / "a.vti", "whole")
    (tmp_path / "a.vti").write_bytes(whole[: len(whole) // 2] + whole[-60:])  # with an end, but less between
    refused(tmp_path / "a.vti", "cannot be read")
    assert not capfd.readouterr().err  # VTK keeps quiet


@pytest.mark.parametrize("packer", ["none", "zlib"])
def test_a_header_that_promises_more_than_the_file_can_hold(tmp_path, packer):
    vti(tmp_path / "a.vti", packer=packer)
    text = (tmp_path / "a.vti").read_bytes()
    for last in (b"1999", b"2000000000"):
        extent = b" ".join([b"0 " + last] * 3)
        (tmp_path / "b.vti").write_bytes(text.replace(b"0 4 0 5 0 6", extent))
        refused_lightly(tmp_path / "b.vti", "promises" if last == b"1999" else "expected")


def test_entities_that_grow_are_not_followed(tmp_path):
    vti(tmp_path / "a.vti")
    entities = b'<!ENTITY a0 "aaaaaaaaaa">' + b"".join(
        b'<!ENTITY a%d "%s">' % (k, b"&a%d;" % (k - 1) * 10) for k in range(1, 12)
    )
    text = (tmp_path / "a.vti").read_bytes().partition(b"?>")
    bomb = text[0] + text[1] + b"<!DOCTYPE VTKFile [" + entities + b"]>" + text[2].replace(b"density", b"&a11;")
    (tmp_path / "a.vti").write_bytes(bomb)
    refused(tmp_path / "a.vti")


def test_cells_are_voxels_half_a_step_further(tmp_path):
    image = pv.ImageData(dimensions=(4, 5, 6), origin=ORIGIN, spacing=SPACING, direction_matrix=TURN)
    image.cell_data["h"] = np.arange(60.0)
    image.save(tmp_path / "a.vti")
    volume = read_volume(tmp_path / "a.vti")
    centres = image.cell_centers().points.reshape(5, 4, 3, 3).transpose(2, 1, 0, 3)  # as VTK computes them
    assert np.array_equal(volume.values, np.arange(60).reshape(5, 4, 3).T)
    assert np.allclose(index_to_world(volume, [[0, 0, 0], [2, 1, 4]]), [centres[0, 0, 0], centres[2, 1, 4]], atol=1e-5)


def test_pieces_are_joined(tmp_path):
    image = vti(tmp_path / "a.vti")
    text = '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian"><ImageData WholeExtent="0 4 0 5 0 6">'
    for low, high in ((0, 3), (3, 6)):
        numbers = " ".join(map(str, values()[:, :, low : high + 1].ravel(order="F")))
        text += f'<Piece Extent="0 4 0 5 {low} {high}"><PointData Scalars="density"><DataArray type="UInt8" '
        text += f'Name="density" format="ascii">{numbers}</DataArray></PointData></Piece>'
    (tmp_path / "b.vti").write_text(f"{text}</ImageData></VTKFile>")
    there = pv.read(tmp_path / "b.vti")["density"]
    assert np.array_equal(read_volume(tmp_path / "b.vti").values.ravel(order="F"), there)
    assert np.array_equal(there, image["density"])
    (tmp_path / "c.vti").write_text(text.partition('<Piece Extent="0 4 0 5 3 6"')[0] + "</ImageData></VTKFile>")
    refused(tmp_path / "c.vti", "do not cover")


def test_without_lz4_the_command_that_installs_it_is_said(tmp_path, monkeypatch):
    vti(tmp_path / "a.vti", packer="lz4")
    monkeypatch.setitem(sys.modules, "lz4.block", None)
    refused(tmp_path / "a.vti", "pip install illumgrid[lz4]")


def test_a_flipped_bit_in_packed_data_is_seen(tmp_path):
    vti(tmp_path / "a.vti", np.random.default_rng(0).normal(size=(9, 8, 7)))
    whole = bytearray((tmp_path / "a.vti").read_bytes())
    for at in range(whole.index(b"_", whole.index(b"<AppendedData")) + 60, len(whole) - 60, 97):
        whole[at] ^= 4
        (tmp_path / "b.vti").write_bytes(whole)
        refused(tmp_path / "b.vti", "cannot be read")
        whole[at] ^= 4
