"""Volumes from files and folders: one reader for each family of files (`families`), and scenes of volumes.

A header is not trusted: its claims are compared with the size of the file and the free memory before memory is
allocated; every byte is counted, every checksum verified; files that a header names must lie in its folder.
"""

import importlib
import os
import re
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from illumgrid.errors import BadInput, tell
from illumgrid.field.volume import Volume
from illumgrid.io.readers.families import EXPECTED, FAMILIES, SUFFIXES, Family, family_of
from illumgrid.io.readers.scene_file import read_scene
from illumgrid.io.readers.source import AGAIN, find_source
from illumgrid.io.readers.stored import (
    Choice,
    Stored,
    Wanted,
    part,
    place,
    with_spacing,
)

__all__ = ["named", "read_scene", "read_volume", "volume_name"]

UNREADABLE = (
    *(RuntimeError, OSError, EOFError, ValueError, TypeError, OverflowError, SyntaxError, LookupError, ArithmeticError),
    *(
        AttributeError,
        AssertionError,
        NotImplementedError,
        zipfile.BadZipFile,
        zlib.error,
        struct.error,
        tokenize.TokenError,
    ),
)
"""Exceptions that libraries raise on a damaged or unsuitable file."""

EXTRAS = {"SimpleITK": "itk", "h5py": "hdf5"}
"""Optional packages that read whole files, and the extra that brings each."""


def volume_name(path: str | os.PathLike[str]) -> str:
    """Name of a volume as shown to users: the file's name without its known suffixes, or the folder's name."""
    file = Path(os.path.abspath(path))
    # File names are bytes: those that are not UTF-8 cannot be printed, nor written into other files.
    if file.is_dir() and file.suffix.lower() != ".zarr":
        return os.fsencode(file.name).decode("utf-8", "replace")
    file = Path(os.fsencode(file.name).decode("utf-8", "replace"))
    bare = Path(file.stem) if file.suffix.lower() == ".gz" else file
    bare = bare if bare.suffix.lower() not in SUFFIXES else Path(bare.stem)
    return bare.stem if bare.suffix.lower() == ".ome" else bare.name


def read_volume(
    path: str | os.PathLike[str],
    *,
    spacing: Sequence[float] | None = None,
    channel: Choice = None,
    time: Choice = None,
    array: Choice = None,
    label: int | None = None,
    crop: Sequence[int] | None = None,
    downsample: int | None = None,
    follow: bool = False,
    most: int | None = None,
) -> Volume:
    """Read a scalar field from a file, or from a folder of slices.

    Parameters
    ----------
    path : str or path-like
        NRRD, NIfTI, MetaImage, TIFF (also of ImageJ, OME, LSM), MRC/CCP4, DICOM, legacy VTK, `.vti`, Gaussian `.cube`,
        OpenDX `.dx`, `.npy` or `.npz`, each also gzipped (`brain.nrrd.gz`); HDF5 (extra `hdf5`); or a folder: Zarr,
        OME-Zarr, one DICOM series, or TIFF slices.
    spacing : (3,) sequence of float, optional
        Distance between voxels along x, y, z, instead of that of the file.
    channel, time, array : int or str, optional
        Which one of a file that holds several: its number, from 0, or its name.
    label : int, optional
        The file is a label map: read a smooth signed distance from the surface of this label, positive inside.
    crop : (6,) sequence of int, optional
        First voxel and last + 1 along x, y and z.
    downsample : int, optional
        Take means over blocks of so many voxels along each axis.
    follow : bool
        Read data files outside the folder of the header that names them.
    most : int, optional
        Voxels: of an image in several resolutions read the finest that has no more, or else the coarsest. By default
        the finest of all is read.

    Returns
    -------
    volume : Volume
        Axes x, y, z; origin, spacing and direction as in the file (LPS millimetres for medical formats). NumPy's
        arrays are taken as indexed [x, y, z], with unit spacing unless the file says otherwise.

    Raises
    ------
    BadInput
        If there is no such file, or it does not hold one whole real 3D array, or holds several and none is chosen; the
        sentence begins with the file's name.

    Warns
    -----
    IllumgridWarning
        About everything that was assumed or ignored.
    """
    if not os.fspath(path):
        raise BadInput(f"the name of the volume is empty; {EXPECTED}")  # and not the folder one is in
    file = Path(os.path.abspath(path))
    wanted = Wanted(channel, time, array, crop, None if label is not None else downsample, follow, most)
    with named(file, EXPECTED) as shown:
        stored = _read(file, wanted)
        if spacing is not None:
            stored = with_spacing(stored, spacing)
        stored = part(stored, wanted)
        if label is not None:
            from illumgrid.io.readers.labels import distance_to

            stored = part(distance_to(stored, label), Wanted(downsample=downsample))
        volume, notes = place(stored)
    for name, sentence in notes:
        tell(name, f"{shown}: {_printable(sentence)}", stacklevel=2)
    return volume


@contextmanager
def named(file: Path, expected: str) -> Iterator[str]:
    """Begin every message with the name of a file, also for exceptions of libraries. Yields the name to show."""
    shown = _printable(file.name.encode("utf-8", "replace").decode())
    try:
        yield shown
    except BadInput as problem:
        raise BadInput(f"{shown}: {_printable(str(problem))}") from None
    except MemoryError as problem:
        raise BadInput(f"{shown}: too large for the memory of this machine; expected less; coarsen it") from problem
    except EOFError as problem:
        raise BadInput(f"{shown}: ends too early ({_reason(problem)}); {AGAIN}") from problem
    except UNREADABLE as problem:
        raise BadInput(f"{shown}: was not understood ({_reason(problem)}); {expected}") from problem


def _printable(text: str) -> str:
    """Text without control characters: names in headers and of files are not trusted."""
    return "".join(c if c.isprintable() or c == "\0" else "?" for c in text)


def _reason(problem: BaseException) -> str:
    """The text of an exception on one line, without the source file and address of ITK and without folders."""
    text = re.sub(r"(?s).*(sitk::|ITK )ERROR:|\w+\(0x[0-9a-f]+\): |\. Reason: .*|/\S+/", "", str(problem))
    text = "".join(c if c.isprintable() else " " for c in text)
    return re.sub(r"[.!?:]+ ", ", ", " ".join(text.split())).rstrip(".!")[-200:] or type(problem).__name__


def _read(file: Path, wanted: Wanted) -> Stored:
    if file.is_dir():
        return _read_folder(file, wanted)
    if not file.exists():
        raise BadInput(f"there is no such file; {EXPECTED}; check the path")
    if not file.is_file():
        raise BadInput(f"neither a file nor a folder; {EXPECTED}; copy the data into a file")
    source = find_source(file)
    if source.size == 0:
        raise BadInput(f"the file is empty; {EXPECTED}; copy or write it again")
    family = family_of(source)
    _check_choice(family, wanted)
    stored: Stored = _module(family).read(source, wanted)
    return stored


def _read_folder(folder: Path, wanted: Wanted) -> Stored:
    """A folder of Zarr, of DICOM files, or else of TIFF slices."""
    if any((folder / mark).is_file() for mark in ("zarr.json", ".zarray", ".zgroup")):
        zarr = _module(next(f for f in FAMILIES if f.name == "Zarr"))
        found: Stored = zarr.read_folder(folder, wanted)
        return found
    dicom, tiff = (next(f for f in FAMILIES if f.name == name) for name in ("DICOM", "TIFF"))
    slices = sorted(f for f in folder.iterdir() if f.suffix.lower() in (".tif", ".tiff"))
    plain = [f for f in slices if family_of(find_source(f)) is tiff]
    family = tiff if plain and not any(f.suffix.lower() in dicom.endings for f in folder.iterdir()) else dicom
    _check_choice(family, wanted)
    module = _module(family)
    stored: Stored = module.read_folder(plain, wanted) if family is tiff else module.read_folder(folder, wanted)
    return stored


def _module(family: Family) -> Any:
    try:
        return importlib.import_module(f"illumgrid.io.readers.{family.module}")
    except ImportError as problem:
        if problem.name and problem.name.startswith("illumgrid"):
            raise
        package = (problem.name or "").partition(".")[0]
        extra = f"pip install illumgrid[{EXTRAS[package]}]" if package in EXTRAS else f"install {package}"
        raise BadInput(
            f"is read by the package {package}, which is not installed; expected it to be installed: {extra}"
        ) from problem


def _check_choice(family: Family, wanted: Wanted) -> None:
    for option in ("channel", "time", "array"):
        if getattr(wanted, option) is not None and option not in family.chooses:
            known = ", ".join(f"--{name}" for name in family.chooses) or "none of these options"
            raise BadInput(f"--{option} came with a {family.name} file; expected {known}; leave --{option} out")
