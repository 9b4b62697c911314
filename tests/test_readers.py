"""Volumes of every format are read back with the values and the placement that were written."""

import struct
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
import tifffile

from illumgrid.field.storing import NATIVE
from illumgrid.field.volume import index_to_world
from illumgrid.io.readers import read_volume, volume_name
from volume_files import (
    ORIGIN,
    SPACING,
    TURN,
    meta_head,
    nrrd_head,
    refused,
    values,
    vtk_head,
    write,
    zipped,
)

VOLUMES = Path(__file__).parents[2] / "shared" / "volumes"
CORNERS = [(0, 0, 0), (4, 0, 0), (0, 5, 0), (0, 0, 6), (3, 2, 5)]


# Round trips

FORMATS = [
    *[(e, d) for e in ("nrrd", "nhdr", "nii", "hdr", "mha", "mhd") for d in ("int8", "uint16", "int64", "float64")],
    *[(e, d) for e in ("mrc", "vtk", "tif") for d in ("uint8", "int16", "float32")],
    *[("gipl", "int16"), ("h5", "float32")],
]


@pytest.mark.filterwarnings("ignore:spacing")  # a TIFF does not state the distance between its slices
@pytest.mark.parametrize(("ending", "dtype"), FORMATS)
@pytest.mark.parametrize("how", ["plain", "compressed", "gz"])
def test_round_trip(tmp_path, ending, dtype, how):
    if ending in ("nhdr", "hdr", "mhd") and how == "gz":
        how = "plain"  # header and data are two files: one .gz cannot hold both
    turned = ending in ("nrrd", "nhdr", "nii", "hdr", "mha", "mhd", "h5")
    file = tmp_path / f"a.{ending}"
    picture = write(file, values(dtype), TURN if turned else np.eye(3), how == "compressed" and ending != "hdr")
    volume = read_volume(zipped(file) if how == "gz" else file)
    assert volume.values.dtype == (dtype if np.dtype(dtype) in NATIVE else np.float32)
    assert np.array_equal(volume.values, values(dtype).astype(np.float32))
    assert volume.values[3, 2, 5] == picture.GetPixel(3, 2, 5)
    if ending == "tif":  # keeps neither origin nor the distance of slices
        assert np.allclose(volume.spacing, (0.5, 1.25, 1.0))
        return
    there = [picture.TransformIndexToPhysicalPoint(corner) for corner in CORNERS]
    assert np.allclose(index_to_world(volume, CORNERS), there, atol=1e-5)
    assert np.allclose(volume.spacing, SPACING, rtol=1e-6) and np.allclose(volume.origin, ORIGIN)


@pytest.mark.filterwarnings("ignore:spacing")
@pytest.mark.parametrize("ending", ["nrrd", "nii", "mha", "mrc", "vtk", "tif", "npy", "nii.gz", "mha.gz"])
def test_endings_may_be_in_capitals(tmp_path, ending):
    if ending == "npy":
        np.save(tmp_path / "a.npy", values("int16"))
    else:
        write(tmp_path / f"a.{ending.removesuffix('.gz')}", values("int16"))
    file = zipped(tmp_path / f"a.{ending[:-3]}") if ending.endswith(".gz") else tmp_path / f"a.{ending}"
    loud = file.rename(tmp_path / f"SCAN.{ending.upper()}")
    assert np.array_equal(read_volume(loud).values, values("int16")) and volume_name(loud) == "SCAN"


DTYPES = ["?", "i1", "<i2", ">i2", "u4", ">i8", "u8", "<f2", ">f2", ">f4", "<f4", ">f8", "<f8", "g"]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy(tmp_path, dtype, order):
    array = values("i8").astype(dtype, order=order)
    file = tmp_path / "a.npy"
    np.save(file, array)
    for path in (file, zipped(file), str(file)):
        volume = read_volume(path)
        assert np.array_equal(volume.values, array.astype(np.float32))
        assert np.array_equal(volume.spacing, np.ones(3)) and np.array_equal(volume.origin, np.zeros(3))


def test_npy_of_other_versions(tmp_path):
    file = tmp_path / "a.npy"
    with open(file, "wb") as stream:
        np.lib.format.write_array(stream, values(), version=(2, 0))
    assert np.array_equal(read_volume(file).values, values())
    text = b"{'descr': '|u1', 'fortran_order': False, 'shape': (5L, 6L, 7L)}\n"  # Python 2
    file.write_bytes(b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + values().tobytes())
    assert np.array_equal(read_volume(file).values, values())


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz(tmp_path, save):
    file = tmp_path / "a.npz"
    save(file, anything=values("f4"), table=np.zeros((3, 2)))
    assert np.array_equal(read_volume(file).values, values())
    save(file, values=values(), other=values("f4") + 1, origin=ORIGIN, spacing=np.float32(SPACING), direction=TURN)
    for path in (file, zipped(file)):
        volume = read_volume(path)
        assert np.array_equal(volume.values, values())
        assert np.array_equal(volume.origin, ORIGIN) and np.array_equal(volume.spacing, SPACING)
        assert np.allclose(volume.direction, TURN, atol=1e-15)


def slabs(folder):
    for k in range(7):
        (folder / f"s{k}.raw").write_bytes(values()[:, :, k].T.tobytes())


@pytest.mark.parametrize(
    ("name", "head"),
    [
        ("a.nhdr", nrrd_head("raw", "data file: LIST\n" + "".join(f"s{k}.raw\n" for k in range(7)))),
        ("a.nhdr", nrrd_head("raw", "data file: s%d.raw 0 6 1\n\n")),
        ("a.mhd", meta_head("LIST\n" + "\n".join(f"s{k}.raw" for k in range(7)))),
        ("a.mhd", meta_head("s%d.raw 0 6 1")),
    ],
)
def test_data_in_many_files(tmp_path, name, head):
    slabs(tmp_path)
    (tmp_path / name).write_bytes(head)
    assert np.array_equal(read_volume(tmp_path / name).values, values())
    for k in range(7):
        (tmp_path / f"s{k}.raw").write_bytes(b"x")
    refused(tmp_path / name)


WORDS = " ".join(map(str, values().T.ravel())).encode()


@pytest.mark.parametrize(
    ("name", "head"),
    [
        ("a.nrrd", nrrd_head("ascii") + b"\n"),
        ("a.mha", meta_head("LOCAL", "BinaryData = False\n")),
        ("a.vtk", vtk_head("ASCII")),
    ],
)
def test_text(tmp_path, name, head):
    file = tmp_path / name
    file.write_bytes(head + WORDS + b"\n")
    assert np.array_equal(read_volume(file).values, values())
    file.write_bytes(head + WORDS[:-9])
    refused(file)


def test_scaled_nifti_is_judged_by_its_width_on_disk(tmp_path):
    file = tmp_path / "a.nii"
    write(file)
    data = bytearray(file.read_bytes())
    data[112:120] = struct.pack("<2f", 0.5, 3)
    file.write_bytes(data)
    assert np.array_equal(read_volume(file).values, 0.5 * values() + 3)


def test_mrc_of_the_other_byte_order_and_with_turned_axes(tmp_path):
    file = tmp_path / "a.mrc"
    write(file, values("float32"), np.eye(3))
    data = file.read_bytes()
    turned = bytearray(data)
    turned[64:76] = struct.pack("<3i", 3, 2, 1)
    file.write_bytes(turned)
    assert np.array_equal(read_volume(file).values, values().T)
    words = np.frombuffer(data, "<u4").byteswap()
    swapped = bytearray(words.tobytes())
    swapped[208:212], swapped[212:216] = b"MAP ", bytes([17, 17, 0, 0])
    file.write_bytes(swapped)
    assert np.array_equal(read_volume(file).values, values())
    file.write_bytes(swapped[:-1])
    refused(file, "promises")


@pytest.mark.filterwarnings("ignore:spacing")
@pytest.mark.parametrize("options", [{}, {"bigtiff": True}, {"byteorder": ">"}, {"compression": "zlib"}])
def test_tiff_by_another_writer(tmp_path, options):
    file = tmp_path / "a.tif"
    tifffile.imwrite(file, values("uint16").T, photometric="minisblack", metadata=None, **options)
    assert np.array_equal(read_volume(file).values, values())
    whole = file.read_bytes()
    for cut in (0.3, 0.6, 0.9, 0.99):
        file.write_bytes(whole[: int(cut * len(whole))])
        refused(file)


# Real volumes

real = pytest.mark.skipif(not VOLUMES.is_dir(), reason=f"the real volumes are not at {VOLUMES}")


def table():
    if not VOLUMES.is_dir():
        return []
    lines = (VOLUMES / "SOURCES.md").read_text("utf-8").splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:]] for line in lines]
    return [row[:5] for row in rows if row and (VOLUMES / row[0]).is_file()]


@real
@pytest.mark.parametrize("row", table(), ids=[row[0] for row in table()])
def test_real_volume(row):
    name, shape, _, spacing, span = row
    volume = read_volume(VOLUMES / name)
    assert "x".join(map(str, volume.shape)) == shape
    assert "x".join(f"{s:.4g}" for s in volume.spacing) == spacing
    assert f"{volume.values.min():.4g} .. {volume.values.max():.4g}" == span


@real
def test_every_real_volume_is_in_the_table():
    assert len(table()) == 13


@real
@pytest.mark.parametrize("name", ["stroke_T1.nii.gz", "heptane.nii.gz"])  # oblique; two axes flipped
def test_real_volume_lies_where_itk_says(name):
    volume = read_volume(VOLUMES / name)
    reader = sitk.ReadImage(str(VOLUMES / name))
    assert np.array_equal(volume.origin, reader.GetOrigin()) and np.array_equal(volume.spacing, reader.GetSpacing())
    assert np.allclose(volume.direction.ravel(), reader.GetDirection(), rtol=0, atol=1e-8)  # made orthonormal
    corners = [(0, 0, 0), (100, 0, 0), (0, 150, 0), (0, 0, 130), (71, 90, 37)]
    there = [reader.TransformIndexToPhysicalPoint(corner) for corner in corners]
    assert np.allclose(index_to_world(volume, corners), there, rtol=0, atol=1e-6)
    assert all(volume.values[corner] == reader.GetPixel(corner) for corner in corners)


# Names


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("x/brain.nii.gz", "brain"),
        ("brain.v2.NRRD", "brain.v2"),
        ("a.tif.gz", "a"),
        ("a.npz", "a"),
        ("scan.7", "scan.7"),
        (Path("a.gz"), "a"),
        ("plain", "plain"),
    ],
)
def test_name(path, name):
    assert volume_name(path) == name


def test_name_of_a_folder(tmp_path, monkeypatch):
    folder = tmp_path / "scan.nii"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert volume_name(folder) == volume_name(".") == volume_name(f"{folder}/") == "scan.nii"
