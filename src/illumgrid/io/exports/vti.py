"""VTK image data, ``.vti``, for ParaView, PyVista and VTK.

The file is made here, in sixty lines of XML and zlib: VTK itself would be a dependency of half a gigabyte, meshio
does not write image data, and pyevtk knows neither compression nor the direction of the axes.
"""

import struct
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.io.exports.arrays import Points

if TYPE_CHECKING:
    from illumgrid.bake.accumulator import Progress

_BLOCK = 1 << 18
"""Bytes that are compressed together."""

_TYPES = {"float32": "Float32", "float64": "Float64", "uint8": "UInt8"}


def write(path: Path, points: Points, progress: "Progress") -> None:
    """Write all arrays as point data, with the field as active scalars, which a contour filter uses by default.

    Points lie at origin + direction · (spacing · index), which readers from VTK 9.0 on know.
    """
    nx, ny, nz = points.lattice.shape
    extent = f"0 {nx - 1} 0 {ny - 1} 0 {nz - 1}"
    with ExitStack() as open_files:
        packed = {name: _Packed(open_files.enter_context(TemporaryFile(dir=path.parent))) for name in points.kinds}
        with ThreadPoolExecutor() as pool:  # zlib works without the interpreter's lock
            for part in points.parts(list(points.kinds), True, progress):
                for name, array in part.items():
                    packed[name].add(array, pool)
            for one in packed.values():
                one.finish()
        _assemble(path, points, extent, packed)


def _assemble(path: Path, points: Points, extent: str, packed: dict[str, "_Packed"]) -> None:
    offset, entries = 0, []
    for name, one in packed.items():
        entries.append(
            f'<DataArray type="{_TYPES[points.kinds[name].name]}" Name="{name}" '
            f'NumberOfComponents="{points.components(name)}" format="appended" offset="{offset}"/>'
        )
        offset += one.length
    kind = 'type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64"'
    head = f"""<?xml version="1.0" encoding="utf-8"?>
<!-- illumgrid {version("illumgrid")}; color is sRGB of albedo/pi * irradiance * exposure -->
<VTKFile {kind} compressor="vtkZLibDataCompressor">
<ImageData WholeExtent="{extent}" Origin="{_text(points.lattice.origin)}" Spacing="{_text(points.lattice.spacing)}"
 Direction="{_text(points.lattice.direction)}">
{_light(points)}<Piece Extent="{extent}">
<PointData Scalars="field">
{chr(10).join(entries)}
</PointData>
</Piece>
</ImageData>
<AppendedData encoding="raw">
_"""
    with path.open("wb") as file:
        file.write(head.encode())
        for one in packed.values():
            one.write_to(file)
        file.write(b"\n</AppendedData>\n</VTKFile>\n")


def _light(points: Points) -> str:
    """Field data that describe the colours; nothing without light."""
    if points.albedo is None or points.exposure is None:
        return ""
    return f"""<FieldData>
<DataArray type="Float64" Name="albedo" NumberOfTuples="3" format="ascii">{_text(points.albedo)}</DataArray>
<DataArray type="Float64" Name="exposure" NumberOfTuples="1" format="ascii">{_text(points.exposure)}</DataArray>
</FieldData>
"""


def _text(numbers: ArrayLike) -> str:
    """Numbers with all their digits; a matrix row by row."""
    return " ".join(repr(float(x)) for x in np.ravel(numbers))


class _Packed:
    """An array as VTK's zlib blocks, in a file of its own until their sizes, which come first, are known."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file, self.sizes, self.last, self.rest = file, list[int](), 0, b""

    def add(self, array: NDArray[Any], pool: ThreadPoolExecutor) -> None:
        """Pack as many whole blocks as there are with these numbers."""
        raw = self.rest + (array.byteswap() if sys.byteorder == "big" else array).tobytes()
        whole = len(raw) // _BLOCK * _BLOCK
        self.rest = raw[whole:]
        for block in pool.map(lambda at: zlib.compress(raw[at : at + _BLOCK], 1), range(0, whole, _BLOCK)):
            self._append(block)

    def finish(self) -> None:
        """Pack what is left as the last, shorter block."""
        self.last = len(self.rest)
        if self.rest:
            self._append(zlib.compress(self.rest, 1))

    def _append(self, block: bytes) -> None:
        self.file.write(block)
        self.sizes.append(len(block))

    @property
    def length(self) -> int:
        """Bytes, including the sizes in front."""
        return 8 * (3 + len(self.sizes)) + sum(self.sizes)

    def write_to(self, file: IO[bytes]) -> None:
        """Append to a file: number of blocks, size, size of a last shorter one, packed sizes; then the blocks."""
        head = [len(self.sizes), _BLOCK, self.last, *self.sizes]
        file.write(struct.pack(f"<{len(head)}Q", *head))
        self.file.seek(0)
        copyfileobj(self.file, file)
