"""VTK image data, ``.vti``: what ParaView, PyVista and VTK read.

The file is made here, in sixty lines of XML and zlib: VTK itself would be a dependency of half a gigabyte, meshio
does not write image data, and pyevtk knows neither compression nor the direction of the axes.
"""

import struct
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.io.exports.arrays import Points, x_fastest

if TYPE_CHECKING:
    from illumgrid.bake import Progress

_BLOCK = 1 << 18
"""Bytes that are packed together."""

_TYPES = {"float32": "Float32", "float64": "Float64", "uint8": "UInt8"}


def write(path: Path, points: Points, progress: "Progress") -> None:
    """Write all arrays as point data, the field as the active scalars: what a contour filter takes by itself.

    Points lie at origin + direction · (spacing · index), which readers from VTK 9.0 on know.
    """
    nx, ny, nz = points.lattice.shape
    extent = f"0 {nx - 1} 0 {ny - 1} 0 {nz - 1}"
    total = sum(array.nbytes for array in points.arrays.values())
    packed: list[bytes] = []
    offset, done, entries = 0, 0, []
    for name, array in points.arrays.items():
        progress("file", done, total)
        packed.append(_packed(array))
        components = 3 if array.ndim == 4 else 1
        entries.append(
            f'<DataArray type="{_TYPES[array.dtype.name]}" Name="{name}" NumberOfComponents="{components}" '
            f'format="appended" offset="{offset}"/>'
        )
        offset += len(packed[-1])
        done += array.nbytes
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
        file.writelines(packed)
        file.write(b"\n</AppendedData>\n</VTKFile>\n")
    progress("file", total, total)


def _light(points: Points) -> str:
    """How colours were made, as field data; nothing where there is no light."""
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


def _packed(array: NDArray[Any]) -> bytes:
    """An array as VTK's zlib blocks: their number, size, size of a last shorter one, packed sizes; then the blocks."""
    flat = x_fastest(array)
    if sys.byteorder == "big":
        flat = flat.byteswap()
    raw = flat.data.cast("B")
    with ThreadPoolExecutor() as pool:  # zlib works without the interpreter's lock
        blocks = list(pool.map(lambda at: zlib.compress(raw[at : at + _BLOCK], 1), range(0, len(raw), _BLOCK)))
    sizes = [len(blocks), _BLOCK, len(raw) % _BLOCK, *map(len, blocks)]
    return struct.pack(f"<{len(sizes)}Q", *sizes) + b"".join(blocks)
