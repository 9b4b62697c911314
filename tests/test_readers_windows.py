"""A part is read as a part: what comes out is that of the whole, and the whole is never in memory."""

import gzip
import struct
from types import SimpleNamespace

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
import tifffile

from illumgrid.errors import BadInput
from illumgrid.field.volume import index_to_world
from illumgrid.io.readers import limits, paged, read_volume, windows
from volume_files import image, values, write

BOX, FACTOR = (1, 9, 0, 6, 3, 8), 2
SHAPE = (10, 7, 9)
RANDOM = np.random.default_rng(3).integers(0, 1000, SHAPE).astype("int16")


def mrc(path):
    """Rows, columns and sections along z, x, y; the second of two volumes."""
    stored = np.stack([RANDOM * 0, RANDOM]).transpose(0, 3, 1, 2).reshape(-1, *SHAPE[:2])  # (volume z, x, y)
    head = bytearray(1024)
    # Columns are y, rows x, sections z.
    struct.pack_into("<10i", head, 0, SHAPE[1], SHAPE[0], 2 * SHAPE[2], 1, 0, 0, 0, *SHAPE)
    struct.pack_into("<6f3i3f2i", head, 40, *SHAPE, 90, 90, 90, 2, 1, 3, 0, 999, 1, 401, 0)
    head[208:212], head[212:214] = b"MAP ", b"DD"
    path.write_bytes(bytes(head) + stored.astype("<i2").tobytes())
    return {"array": 1}


def slices(path):
    picture = image(RANDOM)
    sitk.WriteImage(picture, str(path))
    raw = RANDOM.astype("<i2").tobytes(order="F")
    size = len(raw) // SHAPE[2]
    for k in range(SHAPE[2]):
        path.with_name(f"s{k}.raw").write_bytes(raw[k * size : (k + 1) * size])
    text = path.read_text("latin-1")
    path.write_text(text[: text.index("ElementDataFile")] + f"ElementDataFile = s%d.raw 0 {SHAPE[2] - 1} 1\n")


def mgz(path):
    whole = np.stack([RANDOM * 0, RANDOM], axis=3)
    nibabel.MGHImage(whole, np.diag([2, 3, 4, 1])).to_filename(path)
    return {"time": 1}


def nii(path):
    whole = np.stack([RANDOM * 0, RANDOM], axis=3)
    nibabel.Nifti1Image(whole, np.diag([2, 3, 4, 1])).to_filename(path)
    return {"time": 1}


def hyperstack(path):
    z = RANDOM.T
    about = {"axes": "TZCYX", "spacing": 3, "unit": "um"}
    tifffile.imwrite(path, np.stack([np.stack([z * 0, z], 1)] * 2).astype("uint16"), imagej=True, metadata=about)
    return {"channel": 1, "time": 0}


def npy(path, order="C"):
    np.save(path, np.asarray(np.stack([RANDOM * 0, RANDOM]), order=order))
    return {"time": 1}


MADE = {
    "a.nrrd": lambda path: write(path, RANDOM),
    "packed.nrrd": lambda path: write(path, RANDOM, compress=True),
    "a.mha": lambda path: write(path, RANDOM),
    "packed.mha": lambda path: write(path, RANDOM, compress=True),
    "slices.mhd": slices,
    "a.mrc": mrc,
    "a.mgz": mgz,
    "a.nii": nii,
    "a.nii.gz": nii,
    "a.tif": hyperstack,
    "a.npy": npy,
    "fortran.npy": lambda path: npy(path, "F"),
    "a.npz": lambda path: np.savez_compressed(path, values=RANDOM),
}


@pytest.mark.filterwarnings("ignore:Using default TIFF")
@pytest.mark.parametrize("name", list(MADE))
def test_a_part_is_that_of_the_whole(tmp_path, monkeypatch, name):
    monkeypatch.setattr(windows, "SLAB", 20)  # else files so small are read at once
    made = MADE[name](tmp_path / name)
    options = made if isinstance(made, dict) else {}
    whole = read_volume(tmp_path / name, **options)
    assert np.array_equal(whole.values, RANDOM)
    a, b, c, d, e, f = BOX
    part = read_volume(tmp_path / name, **options, crop=BOX)
    assert np.array_equal(part.values, RANDOM[a:b, c:d, e:f])
    assert np.allclose(index_to_world(part, (0, 0, 0)), index_to_world(whole, (a, c, e)))
    coarse = read_volume(tmp_path / name, **options, crop=BOX, downsample=FACTOR)
    blocks = RANDOM[a:b, c:d, e : f - 1].reshape(4, 2, 3, 2, 2, 2)  # the last slice fills no block
    assert np.allclose(coarse.values, blocks.mean(axis=(1, 3, 5)), rtol=1e-6)
    assert np.allclose(index_to_world(coarse, (0, 0, 0)), index_to_world(whole, (a + 0.5, c + 0.5, e + 0.5)))


@pytest.mark.parametrize("kind", ["npy", "nrrd", "gz"])
def test_the_whole_is_never_in_memory(tmp_path, monkeypatch, kind):
    """A file of 8.6 GB, of which the disk holds a page; and one of 268 MB that unpacks to zeros."""
    monkeypatch.setattr(limits, "free_memory", lambda: 100_000_000)
    side, file = (644, tmp_path / "a.nrrd.gz") if kind == "gz" else (2048, tmp_path / f"a.{kind}")
    if kind == "npy":
        np.lib.format.open_memmap(file, "w+", np.uint8, (side,) * 3)[7, 8, 9] = 200
    else:
        head = f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: {side} {side} {side}\nspacings: 1 1 1\nencoding: raw\n\n"
        at = 7 + side * (8 + side * 9)
        if kind == "gz":
            body = bytearray(side**3)
            body[at] = 200
            file.write_bytes(gzip.compress(head.encode() + body, 1))
        else:
            with open(file, "wb") as stream:
                stream.write(head.encode())
                stream.seek(at, 1)
                stream.write(b"\xc8")
                stream.truncate(len(head) + side**3)
    if kind == "npy":  # lies as kernels want it: the file itself is paged
        assert read_volume(file).stored[7, 8, 9] == 200
    monkeypatch.setattr(paged.shutil, "disk_usage", lambda place: SimpleNamespace(free=100_000_000))
    if kind != "npy":
        with pytest.raises(
            BadInput, match=r"needs [\d.]+ GB, more than is free in memory or .* TMPDIR .* --downsample"
        ):
            read_volume(file)
    part = read_volume(file, crop=(4, 12, 4, 12, 4, 12))
    assert part.values[3, 4, 5] == 200 and np.count_nonzero(part.values) == 1
    coarse = read_volume(file, crop=(0, 64, 0, 64, 0, 64), downsample=32)
    assert coarse.values[0, 0, 0] == 200 / 32**3


def test_blocks_of_numbers_that_need_double_precision_keep_it():
    large = 1e6 + values("float64") * 1e-6
    coarse = windows.take(large, [windows.Span(0, 4, 2), windows.Span(0, 6, 2), windows.Span(0, 6, 2)])
    assert coarse.dtype == np.float64
    assert np.allclose(coarse, large[:4, :6, :6].reshape(2, 2, 3, 2, 3, 2).mean(axis=(1, 3, 5)), rtol=1e-15, atol=0)
