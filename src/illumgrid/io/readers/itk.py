"""GIPL and ITK's HDF5, which only SimpleITK reads: an optional package, imported only here.

Each is opened by the reader of its own format, so that no other parser of ITK ever sees the file.
"""

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import gettempdir

import numpy as np
import SimpleITK as sitk  # noqa: N813  (its usual name)

from illumgrid.errors import BadInput
from illumgrid.io import disk
from illumgrid.io.readers.limits import CHUNK, check_axes, check_memory, check_size
from illumgrid.io.readers.source import AGAIN, Source, opened
from illumgrid.io.readers.stored import Stored, Wanted

GIPL_HEADER = 256


def read(source: Source, wanted: Wanted) -> Stored:
    """Read a GIPL or HDF5 file; a gzipped one is unpacked into a temporary folder first.

    What killed processes left there goes first.
    """
    if not source.packed:
        return _read(source, source.file)
    place = Path(gettempdir())
    with ExitStack() as until_read:
        try:
            inner = until_read.enter_context(disk.beside(place / "illumgrid-unpacked")) / f"new{source.ending}"
            _unpack(source, inner)
        except OSError as reason:
            if reason.errno is None:  # of damaged data
                raise
            raise BadInput(
                f"cannot be unpacked into {place} ({reason.strerror}); expected a folder with room for it; set TMPDIR "
                "to another"
            ) from None
        return _read(source, inner)


def _unpack(source: Source, inner: Path) -> None:
    """Unpack a file, no further than its header promises."""
    most = min(source.most, _promised(source))
    with opened(source) as packed, open(inner, "wb") as out:
        while chunk := packed.read(CHUNK):
            check_memory(out.tell() + len(chunk))
            if out.tell() + len(chunk) > most + CHUNK:
                raise BadInput(f"unpacks to more than its header promises; {AGAIN}")
            out.write(chunk)


def _promised(source: Source) -> int:
    """Bytes that the header allows at most."""
    if source.ending != ".gipl":
        return source.most
    sizes = [int.from_bytes(source.head[2 * k : 2 * k + 2], "big") for k in range(4)]
    return GIPL_HEADER + 8 * math.prod(max(1, n) for n in sizes)


def _read(source: Source, file: Path) -> Stored:
    if source.ending != ".gipl":
        with open(file, "rb") as stream:
            if b"ITKImage" not in stream.read(CHUNK):
                raise BadInput(
                    "an HDF5 file that ITK did not write; expected ITK's layout; save the array as .npy or .nrrd"
                )
    with _quiet():
        reader = sitk.ImageFileReader()
        reader.SetImageIO("GiplImageIO" if source.ending == ".gipl" else "HDF5ImageIO")
        reader.SetFileName(str(file))
        reader.ReadImageInformation()
        kind = sitk.GetPixelIDValueAsString(reader.GetPixelID())  # "16-bit signed integer", "vector of ..."
        if not kind[0].isdigit():
            raise BadInput(f"each voxel is a {kind}; expected one real number; save the magnitude or one channel")
        width = int(kind.split("-")[0]) // 8
        shape = reader.GetSize()
        check_axes(shape)
        size = math.prod(shape) * width
        if source.ending == ".gipl":
            check_size(GIPL_HEADER + size, file.stat().st_size, size)
        else:
            check_size(size, source.most_inside("zlib"), size)
        image = reader.Execute()
    values = sitk.GetArrayFromImage(image).T  # ITK's arrays are z, y, x
    spacing = np.array(image.GetSpacing())
    steps = np.reshape(image.GetDirection(), (3, 3)) * spacing
    return Stored(values, np.array(image.GetOrigin()), steps, spacing=spacing)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep ITK's warnings off stderr."""
    shown = sitk.ProcessObject.GetGlobalWarningDisplay()
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        yield
    finally:
        sitk.ProcessObject.SetGlobalWarningDisplay(shown)
