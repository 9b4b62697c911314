"""Broken, hostile and foreign files are refused in one sentence, without a large allocation."""

import gzip
import io
import os
import resource
import struct
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
import tifffile

from illumgrid.errors import IllumgridWarning
from illumgrid.io.readers import limits, read_volume
from volume_files import meta_head, nrrd_head, refused, refused_lightly, values, vtk_head, write, zipped

WRITERS = ["nrrd", "nii", "mha", "mrc", "vtk", "gipl", "tif", "dcm", "h5", "npy", "npz"]

# Bad input


@pytest.mark.parametrize("ending", ["nrrd", "nii", "mha", "npy", "npz"])
def test_wrong_number_of_axes(tmp_path, ending):
    many = ("4 axes (4x5x6x3)",) if ending in ("npy", "npz") else ("3 time steps: 0, 1, 2",)
    for shape, words in [((4, 5), ("2 axes (4x5)", "stack")), ((4, 5, 6, 3), (*many, "--time N"))]:
        file = tmp_path / f"a.{ending}"
        array = values("float32", shape)
        if ending == "npy":
            np.save(file, array)
        elif ending == "npz":
            np.savez(file, values=array)
        else:
            sitk.WriteImage(sitk.GetImageFromArray(array.T, isVector=False), str(file))
        refused(file, *words)


@pytest.mark.parametrize("ending", ["nrrd", "nii", "mha", "tif"])
def test_wrong_voxels(tmp_path, ending):
    file = tmp_path / f"a.{ending}"
    sitk.WriteImage(sitk.GetImageFromArray(values(shape=(3, 4, 5, 3)), isVector=True), str(file))
    refused(file, "holds 3 channels: 0", "--channel N")
    if ending != "tif":
        sitk.WriteImage(sitk.GetImageFromArray(values("complex64").T), str(file))
        refused(file, "2 channels" if ending == "mha" else "magnitude")  # a MetaImage does not say what they are
    if ending in ("nrrd", "mha"):  # the others drop a last axis of 1
        sitk.WriteImage(sitk.GetImageFromArray(values(shape=(1, 4, 5))), str(file))
        refused(file, "expected at least 2")


@pytest.mark.parametrize(
    ("array", "word"),
    [
        (values("complex64"), "complex64"),
        (values("O"), "object"),
        (values("U3"), "<U3"),
        (np.zeros((3, 3, 3), [("a", "f4")]), "('a', '<f4')"),
        (np.zeros((3, 0, 3)), "3x0x3"),
        (np.full((3, 3, 3), np.nan), "NaN"),
    ],
)
def test_wrong_arrays(tmp_path, array, word):
    np.save(tmp_path / "a.npy", array)
    refused(tmp_path / "a.npy", word)
    np.savez(tmp_path / "a.npz", values=array)
    refused(tmp_path / "a.npz", word)


def test_wrong_npz(tmp_path):
    file = tmp_path / "a.npz"
    np.savez(file, a=values(), b=values())
    refused(file, "0 a 5x6x7, 1 b 5x6x7", "--array")
    np.savez(file, a=np.zeros(3))
    refused(file, "a (3,)")
    np.savez(file)
    refused(file, "none")
    np.savez(file, values=values(), spacing=np.ones(2))
    refused(file, "spacing.npy", "(2,)")
    np.savez(file, values=values(), spacing=np.array([1, 0, 1]))
    refused(file, "spacing is [1.0, 0.0, 1.0]")
    np.savez(file, values=np.full((2, 2, 2), np.inf))
    refused(file, "infinite")


def test_no_volume(tmp_path):
    refused(tmp_path / "missing.nii.gz", "no such file")
    refused(tmp_path / "nul\0.nii", "no such file")
    for name in ("empty.nrrd", "empty.npy", "empty.nii.gz"):
        (tmp_path / name).touch()
        refused(tmp_path / name, "empty")
    for ending in ["", ".xyz", ".hdr", ".nii.gz", *(f".{ending}" for ending in WRITERS)]:
        name = f"a{ending}"
        (tmp_path / name).write_bytes(b"\x93 Not at all what the name says\n" * 9)
        refused(tmp_path / name, "expected")
    os.mkfifo(tmp_path / "pipe.npy")
    refused(tmp_path / "pipe.npy", "neither")
    points = b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 1 int\n0 0 0\n"
    (tmp_path / "a.vtk").write_bytes(points)
    refused(tmp_path / "a.vtk")


@pytest.mark.parametrize("ending", ["nhdr", "mhd", "hdr"])
def test_missing_data_file(tmp_path, ending):
    write(tmp_path / f"a.{ending}")
    for file in tmp_path.iterdir():
        if file.suffix != f".{ending}":
            file.unlink()
    refused(tmp_path / f"a.{ending}")


def test_memory_error_is_reported(tmp_path, monkeypatch):
    np.save(tmp_path / "a.npy", values())
    monkeypatch.setattr(limits, "free_memory", lambda: 100)
    refused(tmp_path / "a.npy", "memory")


@pytest.mark.parametrize("ending", WRITERS)
def test_cut_file(tmp_path, ending, capfd):
    file = tmp_path / f"a.{ending}"
    array = np.random.default_rng(1).integers(0, 30000, (20, 21, 22)).astype(np.uint16)
    save = {"npy": np.save, "npz": np.savez_compressed}.get(ending, lambda f, a: write(f, a, np.eye(3)))
    save(file, array)
    whole = file.read_bytes()
    packed = gzip.compress(whole)
    for share in (0.01, 0.5, 0.9, 0.9999):
        file.write_bytes(whole[: int(share * len(whole))])
        refused(file)
        refused(zipped(file))
        inside = tmp_path / f"a.{ending}.gz"
        inside.write_bytes(packed[: int(share * len(packed))])
        refused(inside)
    if ending != "npz":
        refused(inside, "ends too early", "copy or write it again")
    assert "WARNING" not in capfd.readouterr().err


@pytest.mark.parametrize("options", [{"tile": (16, 16)}, {"dtype": "float16"}, {"dtype": "float64"}])
def test_tiff_that_itk_would_spoil(tmp_path, options):
    array = values().T.astype(options.pop("dtype", "uint16"))
    tifffile.imwrite(tmp_path / "a.tif", array, photometric="minisblack", **options)
    with pytest.warns(IllumgridWarning, match="1, 1, 1 was assumed"):
        assert np.array_equal(read_volume(tmp_path / "a.tif").values, values())


def test_tiff_with_pages_that_differ(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        for width in (6, 6, 5, 600):
            writer.write(np.zeros((5, width), np.uint8), photometric="minisblack", metadata=None)
    refused(tmp_path / "a.tif", "differ")


def test_tiff_that_runs_in_a_circle(tmp_path):
    file = tmp_path / "a.tif"
    tifffile.imwrite(file, values().T, photometric="minisblack", metadata=None)
    data = bytearray(file.read_bytes())
    first = struct.unpack("<I", data[4:8])[0]
    entries = struct.unpack("<H", data[first : first + 2])[0]
    at = first + 2 + 12 * entries
    data[at : at + 4] = struct.pack("<I", first)
    file.write_bytes(data)
    refused(file, "circle")


# Hostile input


@pytest.fixture
def lean(tmp_path, monkeypatch):
    """The test must not reserve much memory, nor leave a temporary file."""
    if sys.platform != "linux":
        pytest.skip("only Linux limits the address space and tells how much is in use")
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    write(tmp_path / "warm.nrrd")
    read_volume(tmp_path / "warm.nrrd")
    limits = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text("utf-8").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 300_000_000, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, limits)
    assert not list(folder.iterdir())


def npy_head(shape, descr="<f4"):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue()


def huge(head):
    for old, new in [(b"sizes: 5 6 7", b"sizes: 2000 2000 2000"), (b"DIMENSIONS 5 6 7", b"DIMENSIONS 2000 2000 2000")]:
        head = head.replace(old, new)
    return head


def nii_head(tmp_path, shape):
    write(tmp_path / "b.nii")
    data = bytearray((tmp_path / "b.nii").read_bytes())
    data[40:48] = struct.pack("<4h", 3, *shape)
    return bytes(data)


LIES = {
    "a.npy": lambda _: npy_head((10**4, 10**4, 10**4)) + bytes(500),
    "b.npy": lambda _: npy_head((2**40, 2**40, 2**40)) + bytes(500),
    "c.npy": lambda _: npy_head((-2, -2, 10**9)) + bytes(500),
    "d.npy": lambda _: b"\x93NUMPY\2\0" + struct.pack("<I", 2**32 - 1) + b"{" * 500,
    "a.nrrd": lambda _: huge(nrrd_head("raw") + b"\n") + bytes(500),
    "b.nrrd": lambda _: huge(nrrd_head("gzip") + b"\n") + gzip.compress(bytes(500)),
    "c.nrrd": lambda _: huge(nrrd_head("ascii") + b"\n") + b"1 2 3",
    "d.nrrd": lambda _: huge(nrrd_head("raw", "data file: /dev/zero\n") + b"\n"),
    "a.mha": lambda _: meta_head("LOCAL", size="2000 2000 2000") + bytes(500),
    "b.mha": lambda _: meta_head("LOCAL", "CompressedData = True\nCompressedDataSize = 8000000000\n") + bytes(500),
    "a.vtk": lambda _: huge(vtk_head("BINARY", 8 * 10**9)) + bytes(500),
    "b.vtk": lambda _: huge(vtk_head("ASCII", 8 * 10**9)) + bytes(500),
    "a.nii": lambda path: nii_head(path, (2000, 2000, 2000)),
}


@pytest.mark.parametrize("name", LIES)
@pytest.mark.parametrize("packed", [False, True])
def test_lying_header(tmp_path, lean, name, packed):
    file = tmp_path / name
    file.write_bytes(LIES[name](tmp_path))
    refused_lightly(zipped(file) if packed else file)


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA])
def test_lying_npz(tmp_path, lean, method):
    file = tmp_path / "a.npz"
    with zipfile.ZipFile(file, "w", method) as pack:
        pack.writestr("values.npy", npy_head((2000, 2000, 2000)) + bytes(500))
    refused_lightly(file, "promises")
    true = struct.pack("<I", len(npy_head((2000, 2000, 2000))) + 500)  # now the zip lies, too
    data = file.read_bytes().replace(true, struct.pack("<I", 2**32 - 2))
    file.write_bytes(data)
    refused_lightly(file)


BOMB = {
    "a.npy": lambda _: npy_head((5, 6, 7)),
    "a.nrrd": lambda _: nrrd_head("raw") + b"\n",
    "a.nii": lambda path: nii_head(path, (5, 6, 7)),
    "a.xyz": lambda _: b"?",
}


@pytest.mark.parametrize("name", BOMB)
def test_gzip_bomb(tmp_path, lean, name):
    file = tmp_path / f"{name}.gz"
    with gzip.open(file, "wb", compresslevel=1) as stream:
        stream.write(BOMB[name](tmp_path))
        for _ in range(40):
            stream.write(bytes(1 << 20))
    refused_lightly(file)


def test_honest_file_with_something_after_its_data(tmp_path):
    write(tmp_path / "a.nii")
    file = tmp_path / "a.nii"
    file.write_bytes(file.read_bytes() + bytes(100))
    assert np.array_equal(read_volume(zipped(file)).values, values())


@pytest.mark.filterwarnings("ignore:spacing")
def test_large_honest_gzip(tmp_path):
    # Larger than the part that the header is read from.
    array = np.random.default_rng(1).normal(size=(80, 81, 82)).astype(np.float32)
    for ending in ("nrrd", "nii", "mrc", "vtk", "tif"):
        write(tmp_path / f"a.{ending}", array, np.eye(3))
        assert np.array_equal(read_volume(zipped(tmp_path / f"a.{ending}")).values, array)


def test_bomb_in_a_bomb(tmp_path, lean):
    head, zeros = npy_head((400, 1000, 100), "|u1"), bytes(40_000_000)
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as pack:
        pack.writestr("values.npy", head + zeros)
    refused_lightly(zipped(tmp_path / "a.npz"), "promises 40")
    head = nrrd_head("gzip").replace(b"5 6 7", b"400 1000 100")
    (tmp_path / "a.nrrd").write_bytes(head + b"\n" + gzip.compress(zeros))
    refused_lightly(zipped(tmp_path / "a.nrrd"), "promises 40")
