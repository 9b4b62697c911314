"""Image files and DICOM folders, read by SimpleITK.

It takes long to import: import this module only where it is needed.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any

import numpy as np
import SimpleITK as sitk  # noqa: N813  (its usual name)

from illumgrid.errors import BadInput, tell
from illumgrid.io.readers.heads import check_head
from illumgrid.io.readers.sizes import CHUNK, DEFLATE, check_axes, check_size, check_tiff, check_words, on_disk
from illumgrid.io.readers.source import Source, opened
from illumgrid.io.readers.stored import Stored, Wanted


def read(source: Source, wanted: Wanted) -> Stored:
    """Read what SimpleITK reads; a gzipped file is unpacked first."""
    if not source.packed:
        return read_image(source.file, source.size * DEFLATE)
    with TemporaryDirectory(prefix="illumgrid-") as folder, opened(source) as packed:
        inner = Path(folder) / source.name
        _unpack(packed, inner, source.most)
        return read_image(inner, source.size * DEFLATE)


def _unpack(packed: IO[bytes], inner: Path, most: int) -> None:
    """Decompress into `inner`: not more than `most` bytes, nor than its own header asks for."""
    with open(inner, "wb") as out:
        done = out.write(packed.read(CHUNK))
        out.flush()
        if done == CHUNK and inner.suffix.lower() in HEADER_FIRST:
            most = min(most, unpacked_bytes(inner))
        while chunk := packed.read(CHUNK):
            done += out.write(chunk)
            if done > most:
                raise BadInput(
                    f"unpacks to more than the {most} bytes of its header; expected a whole file; write it again"
                )


HEADER_FIRST = {".nrrd", ".nii", ".mha", ".mrc", ".rec", ".map", ".vtk", ".gipl"}
"""Formats that say their size at the beginning; TIFF, HDF5 and zip need not."""


def read_image(file: Path, most: int) -> Stored:
    """Read an image file; if it is packed, its data unpack to at most `most` bytes."""
    with _quiet():
        check_tiff(file)
        reader, width = _header(file)
        check_axes(reader.GetSize())
        voxels = math.prod(reader.GetSize())
        disk = on_disk(file, reader, width)
        check_size(disk.promised(voxels), disk.held(file, most), voxels * (width + 4))
        if disk.form == "text" and disk.start:  # VTK; ITK tells of the others
            check_words(file, disk.start, voxels)
        return _volume(reader.Execute())


def unpacked_bytes(file: Path) -> int:
    """How long a file can be at most, of which only the beginning is here."""
    with _quiet():
        reader, width = _header(file)
    disk = on_disk(file, reader, width)
    # As text a number takes up to 32 characters; what cannot be packed grows a little.
    voxels: int = math.prod(reader.GetSize())
    return CHUNK + disk.start + voxels * (32 if disk.form == "text" else disk.width + 1)


def read_folder(folder: Path, wanted: Wanted) -> Stored:
    """Read the one series of a folder that is a stack of slices."""
    with _quiet():
        find = sitk.ImageSeriesReader
        series = {uid: find.GetGDCMSeriesFileNames(str(folder), uid) for uid in find.GetGDCMSeriesIDs(str(folder))}
        stacks = [files for files in series.values() if len(files) > 1 or _frames(files[0]) > 1]
        if len(stacks) != 1:
            found = ", ".join(f"{uid} ({len(files)} files)" for uid, files in series.items()) or "none"
            raise BadInput(f"its DICOM series are: {found}; expected one stack of slices; give a folder with only that")
        _warn_of_damaged(folder, {Path(name).name for names in series.values() for name in names})
        files = [Path(name) for name in stacks[0]]
        size = sum(file.stat().st_size for file in files)
        if len(files) == 1:
            return read_image(files[0], size * DEFLATE)
        header, width = _header(files[0])
        shape = (*header.GetSize()[:2], len(files))
        check_axes(shape)
        check_size(math.prod(shape) * width, size * DEFLATE, math.prod(shape) * (width + 4))
        reader = sitk.ImageSeriesReader()
        reader.SetFileNames(stacks[0])
        image = reader.Execute()
    if image.HasMetaDataKey("ITK_non_uniform_sampling_deviation"):
        _warn(f"{folder.name}: slices are missing or unevenly spaced; with their mean distance shapes are distorted")
    return _volume(image)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep ITK's warnings off stderr."""
    shown = sitk.ProcessObject.GetGlobalWarningDisplay()
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        yield
    finally:
        sitk.ProcessObject.SetGlobalWarningDisplay(shown)


def _open(file: str) -> Any:
    reader = sitk.ImageFileReader()
    reader.SetFileName(file)
    reader.ReadImageInformation()
    return reader


def _header(file: Path) -> tuple[Any, int]:
    """SimpleITK's reader after it read the header of a file of real voxels, and their width in bytes."""
    check_head(file)
    reader = _open(str(file))
    kind = sitk.GetPixelIDValueAsString(reader.GetPixelID())  # "16-bit signed integer", "vector of ..."
    if not kind[0].isdigit():
        raise BadInput(f"each voxel is a {kind}; expected one real number; save the magnitude or one channel")
    return reader, int(kind.split("-")[0]) // 8


def _frames(file: str) -> int:
    return int((*_open(file).GetSize(), 1)[2])


def _volume(image: Any) -> Stored:
    values = sitk.GetArrayFromImage(image).T  # ITK's arrays are z, y, x
    steps = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    return Stored(values, np.array(image.GetOrigin()), steps)


def _warn_of_damaged(folder: Path, used: set[str]) -> None:
    """ITK leaves out a slice that is cut, without a word."""
    lost = []
    for file in sorted(folder.iterdir()):
        if file.is_file() and file.name not in used and file.name != "DICOMDIR":
            with open(file, "rb") as stream:
                if stream.read(132)[128:] == b"DICM":
                    lost.append(file.name)
    if lost:
        _warn(f"{folder.name}: {len(lost)} DICOM files hold no readable image and are left out: {', '.join(lost[:5])}")


def _warn(message: str) -> None:
    tell("dicom", message, stacklevel=4)
