"""Volumes from files: whatever SimpleITK reads, NumPy arrays, and either of them gzipped; and scenes of volumes.

A header is not believed: what it promises is held against the size of the file before anything that large is allocated.
"""

import gzip
import io
import os
import re
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from tempfile import TemporaryDirectory

from illumgrid.errors import BadInput
from illumgrid.field.volume import Volume
from illumgrid.io.readers.arrays import read_npy, read_npz
from illumgrid.io.readers.scene_file import read_scene
from illumgrid.io.readers.sizes import AGAIN, CHUNK, DEFLATE

__all__ = ["read_scene", "read_volume", "volume_name"]

KNOWN = {
    *(".nrrd", ".nhdr", ".nii", ".hdr", ".img", ".mha", ".mhd", ".tif", ".tiff", ".mrc", ".rec", ".map", ".ccp4"),
    *(".vtk", ".vti", ".dcm", ".ima", ".h5", ".hdf5", ".gipl", ".npy", ".npz"),
}
HEADER_FIRST = {".nrrd", ".nii", ".mha", ".mrc", ".rec", ".map", ".vtk", ".gipl"}
"""Formats that say their size at the beginning; TIFF, HDF5 and zip need not."""

EXPECTED = "expected a NRRD, NIfTI, MetaImage, TIFF, MRC, legacy VTK, .vti, .npy or .npz file or a DICOM folder"

UNREADABLE = (
    *(RuntimeError, OSError, EOFError, ValueError, TypeError, OverflowError, SyntaxError),
    *(zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError),
)
"""What ITK, NumPy and the unpackers raise on a file that is not what it should be."""


def volume_name(path: str | os.PathLike[str]) -> str:
    """Name of a volume as shown to users: the file's name without its known suffixes, or the folder's name."""
    file = Path(os.path.abspath(path))
    if file.is_dir():
        return file.name
    bare = Path(file.stem) if file.suffix.lower() == ".gz" else file
    return bare.stem if bare.suffix.lower() in KNOWN else bare.name


def read_volume(path: str | os.PathLike[str]) -> Volume:
    """Read a scalar field from a file or a DICOM folder.

    Parameters
    ----------
    path : str or path-like
        NRRD, NIfTI, MetaImage, multi-page TIFF, MRC, legacy VTK or anything else that SimpleITK reads; a folder with
        one DICOM series; `.vti` (with the package `vtk`: its scalars, at the points); `.npy`; `.npz` with one 3D array,
        or one named `values`, and optional `origin` (3,), `spacing` (3,) and `direction` (3, 3). Each file also gzipped
        (`brain.nrrd.gz`).

    Returns
    -------
    volume : Volume
        Axes x, y, z; origin, spacing and direction as in the file (LPS millimetres for medical formats). NumPy's
        arrays are taken as indexed [x, y, z], with unit spacing unless the file says otherwise.

    Raises
    ------
    BadInput
        If there is no such file, or it is not one whole real 3D array; the sentence begins with the file's name.

    Warns
    -----
    IllumgridWarning
        If DICOM slices are missing, damaged or unevenly spaced.
    """
    if not os.fspath(path):
        raise BadInput(f"the name of the volume is empty; {EXPECTED}")  # and not the folder one is in
    file = Path(os.path.abspath(path))
    try:
        return _read(file)
    except BadInput as problem:
        raise BadInput(f"{file.name}: {problem}") from None
    except MemoryError as problem:
        raise BadInput(f"{file.name}: too large for the memory of this machine; expected less; coarsen it") from problem
    except UNREADABLE as problem:
        raise BadInput(
            f"{file.name}: cannot be read ({_reason(problem)}); {EXPECTED}; check that it is whole and rightly named"
        ) from problem


def _reason(problem: BaseException) -> str:
    """Say what an exception says, in one line: ITK tells its source file and an address first."""
    # MetaImage gives a reason that is none (what errno happens to be); folders may be temporary.
    text = re.sub(r"(?s).*(sitk::|ITK )ERROR:|\w+\(0x[0-9a-f]+\): |\. Reason: .*|/\S+/", "", str(problem))
    return re.sub(r"[.!?:]+ ", ", ", " ".join(text.split())).rstrip(".!")[-200:] or type(problem).__name__


def _read(file: Path) -> Volume:
    if file.is_dir():
        from illumgrid.io.readers.itk import read_dicom

        return read_dicom(file)
    if not file.exists():
        raise BadInput(f"there is no such file; {EXPECTED}; check the path")
    if not file.is_file():
        raise BadInput(f"neither a file nor a folder; {EXPECTED}; copy the data into a file")
    size = file.stat().st_size
    if size == 0:
        raise BadInput(f"the file is empty; {EXPECTED}; fetch or write it again")
    if file.suffix.lower() != ".gz":
        return _read_unpacked(file, size)
    if file.stem.lower().endswith(".npy"):
        with gzip.open(file) as unpacked:
            return Volume(read_npy(io.BufferedReader(unpacked), size * DEFLATE))
    with TemporaryDirectory(prefix="illumgrid-") as folder:
        inner = Path(folder) / file.stem
        _unpack(file, inner, size * DEFLATE)
        return _read_unpacked(inner, size)


def _read_unpacked(file: Path, size: int) -> Volume:
    """Read a file that is not gzipped; `size` is that of the file it came from: a bomb within a bomb gains nothing."""
    ending = file.suffix.lower()
    if ending == ".npz":
        return read_npz(file, size * DEFLATE)
    if ending == ".npy":
        with open(file, "rb") as stream:
            return Volume(read_npy(stream, size))
    if ending == ".vti":
        from illumgrid.io.readers.vti import read_vti

        return read_vti(file, size * DEFLATE)
    from illumgrid.io.readers.itk import read_image

    return read_image(file, size * DEFLATE)


def _unpack(file: Path, inner: Path, most: int) -> None:
    """Decompress `file` into `inner`: not more than `most` bytes, nor than its own header asks for."""
    from illumgrid.io.readers.itk import unpacked_bytes

    with gzip.open(file) as packed, open(inner, "wb") as out:
        done = out.write(packed.read(CHUNK))
        out.flush()
        if done == CHUNK and inner.suffix.lower() in HEADER_FIRST:
            most = min(most, unpacked_bytes(inner))
        while chunk := packed.read(CHUNK):
            done += out.write(chunk)
            if done > most:
                raise BadInput(f"unpacks to more than the {most} bytes that its header promises; {AGAIN}")
