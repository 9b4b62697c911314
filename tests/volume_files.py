"""Writes volumes of every kind for the tests of the readers."""

import gzip
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813

from illumgrid.errors import BadInput
from illumgrid.io.readers import read_volume

ORIGIN, SPACING = (-3.0, 4.0, 10.5), (0.5, 1.25, 2.0)
TURN = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, -1]])  # oblique, and mirrored


def values(dtype="uint8", shape=(5, 6, 7)):
    return np.arange(np.prod(shape)).reshape(shape).astype(dtype)


def image(array, direction=TURN):
    picture = sitk.GetImageFromArray(array.T)
    picture.SetOrigin(ORIGIN)
    picture.SetSpacing(SPACING)
    picture.SetDirection(direction.ravel())
    return picture


def write(path, array=None, direction=TURN, compress=False):
    picture = image(values() if array is None else array, direction)
    sitk.WriteImage(picture, str(path), useCompression=compress)
    return picture


def zipped(path):
    packed = path.with_name(path.name + ".gz")
    packed.write_bytes(gzip.compress(path.read_bytes()))
    return packed


def refused(path, *words):
    """Reading is refused in one sentence that names the file and contains `words`."""
    with pytest.raises(BadInput) as caught:
        read_volume(path)
    text = str(caught.value)
    assert text.startswith(Path(path).name + ": ") and "\n" not in text and ". " not in text and "expected" in text
    for word in words:
        assert word in text
    return text.lower()


def refused_lightly(path, *words):
    """Refused before any large allocation, and not because the machine ran out of memory."""
    text = refused(path, *words)
    assert "memory" not in text and "alloc" not in text


def nrrd_head(encoding, more="", kind="uint8"):
    start = f"NRRD0004\ntype: {kind}\ndimension: 3\nsizes: 5 6 7\nspacings: 1 1 1\n"
    return f"{start}endian: little\nencoding: {encoding}\n{more}".encode()


def meta_head(data, more="", size="5 6 7"):
    start = f"ObjectType = Image\nNDims = 3\nDimSize = {size}\nElementSpacing = 1 1 1\n"
    start += "ElementType = MET_UCHAR\n"
    return f"{start}{more}ElementDataFile = {data}\n".encode()


def vtk_head(form, count=210):
    grid = "DATASET STRUCTURED_POINTS\nDIMENSIONS 5 6 7\nSPACING 1 1 1\nORIGIN 0 0 0\n"
    data = f"POINT_DATA {count}\nSCALARS s int 1\nLOOKUP_TABLE default\n"
    return f"# vtk DataFile Version 3.0\nx\n{form}\n{grid}{data}".encode()


def write_series(folder, array, uid="1.2.3", drop=()):
    """Write slices of array (x, y, z) in a wrong order of names, as SimpleITK's example does."""
    folder.mkdir(exist_ok=True)
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    axes = TURN * [1, 1, -1]
    for k in set(range(array.shape[2])) - set(drop):
        picture = sitk.GetImageFromArray(array[:, :, k].T)
        picture.SetSpacing(SPACING[:2])
        tags = {
            "0008|0060": "CT",
            "0008|0021": "20200101",
            "0008|0031": "120000",
            "0008|0008": "DERIVED\\SECONDARY",
            "0020|000e": uid,
            "0020|000d": "1.2",
            "0020|0013": str(k),
            "0020|0032": "\\".join(str(x) for x in ORIGIN + axes[:, 2] * SPACING[2] * k),
            "0020|0037": "\\".join(str(x) for x in axes.T[:2].ravel()),
        }
        for key, value in tags.items():
            picture.SetMetaData(key, value)
        writer.SetFileName(str(folder / f"{uid}-{9 - k}.dcm"))
        writer.Execute(picture)
