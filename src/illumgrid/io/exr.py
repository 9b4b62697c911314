"""Arrays as the parts of one OpenEXR file: scan lines, ZIP; written some rows at a time, read by the library.

An array of light (nx, ny, nz) is an image nx wide and ny*nz high, float32. A field keeps its order, row = x*ny + y
and column = z: float32 as channel Y, other types as the bytes of each row, padded to whole words of 32 bits, in the
channel ``bytes``.
"""

import os
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.io import scanlines

LAYOUT = "array (nx, ny, nz) = ({}, {}, {}); row = z*ny + y, column = x"
FIELD = "array (nx, ny, nz) = ({}, {}, {}) of {}; row = x*ny + y, column = z"
BYTES = "bytes"
DEFLATE_AT_MOST = 1032  # bytes out for one byte in: a file that claims more is refused before memory is allocated
_WORD = 4  # bytes of a pixel
_MULTIPART = 1 << 12  # in the version of a file
_LINES = scanlines.LINES
_AT_ONCE = 1 << 22  # bytes that are written together, or so

Image = NDArray[Any]
Parts = dict[str, dict[str, Image]]


@dataclass(frozen=True)
class Planned:
    """What a part holds: an array of this shape in each of these channels."""

    shape: tuple[int, int, int]
    channels: tuple[str, ...]
    kind: str = "float32"
    field: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image."""
        nx, ny, nz = self.shape
        return (-(-nz * np.dtype(self.kind).itemsize // _WORD), nx * ny) if self.field else (nx, ny * nz)

    @property
    def layout(self) -> str:
        """The layout in words."""
        return FIELD.format(*self.shape, self.kind) if self.field else LAYOUT.format(*self.shape)


@dataclass(frozen=True, eq=False)
class Words:
    """The rows of a field as whole words; slices of it are images, made on access."""

    values: NDArray[Any]
    dtype = np.dtype(np.uint32)

    def __getitem__(self, rows: slice) -> Image:
        some = self.values.reshape(-1, self.values.shape[2])[rows]
        spare = -some.shape[1] % (_WORD // some.itemsize)
        return np.ascontiguousarray(np.pad(some, [(0, 0), (0, spare)]) if spare else some).view(np.uint32)


@dataclass(frozen=True, eq=False)
class Turned:
    """An array (nx, ny, nz) as an image nx wide; slices of it are images, made on access."""

    array: NDArray[np.float32]
    dtype = np.dtype(np.float32)

    def __getitem__(self, rows: slice) -> Image:
        nx, ny, _ = self.array.shape
        first, last = rows.start // ny, -(-rows.stop // ny)
        planes = np.ascontiguousarray(self.array[:, :, first:last].swapaxes(0, 2)).reshape(-1, nx)
        return planes[rows.start - first * ny : rows.stop - first * ny]


Rows = Words | Turned | Image


def of_field(values: NDArray[Any]) -> tuple[Planned, dict[str, Rows]]:
    """The part of a field's values, which are not copied."""
    nx, ny, nz = values.shape
    kind = values.dtype.name
    if values.dtype == np.float32:
        return Planned((nx, ny, nz), ("Y",), kind, field=True), {"Y": values.reshape(nx * ny, nz)}
    return Planned((nx, ny, nz), (BYTES,), kind, field=True), {BYTES: Words(values)}


def field_values(part: dict[str, Image], plan: Planned) -> NDArray[Any]:
    """Undo `of_field`."""
    nx, ny, nz = plan.shape
    ((_, image),) = part.items()
    return image.view(plan.kind).reshape(nx, ny, -1)[:, :, :nz]


def array(part: dict[str, Image], names: str | tuple[str, ...], shape: tuple[int, int, int]) -> NDArray[np.float32]:
    """Undo `Turned`: one channel as (nx, ny, nz), without a copy; several as (nx, ny, nz, C)."""
    if isinstance(names, str):
        return part[names].reshape(shape[::-1]).swapaxes(0, 2)
    return np.stack([array(part, name, shape) for name in names], axis=-1)


def write(path: Path, parts: Mapping[str, tuple[Planned, Mapping[str, Rows]]]) -> None:
    """Write images by part and channel."""
    sizes = [planned.size for planned, _ in parts.values()]
    window = max(w for w, _ in sizes), max(h for _, h in sizes)  # all parts must share it
    scanlines.write(
        path,
        [
            scanlines.Part(
                planned.size, {channel: rows.dtype for channel, rows in images.items()}, _some(planned.size, images),
                {"layout": planned.layout}, name, window,
            )
            for name, (planned, images) in parts.items()
        ],
    )  # fmt: skip


def _some(size: tuple[int, int], images: Mapping[str, Rows]) -> Iterator[list[Image]]:
    """Rows of all channels, some at a time."""
    width, height = size
    many = max(1, _AT_ONCE // (_WORD * width * len(images) * _LINES)) * _LINES
    for first in range(0, height, many):
        yield [one[slice(first, min(first + many, height))] for one in images.values()]


def read(path: Path, plan: dict[str, Planned]) -> Parts:
    """Images of every part by channel, if the headers agree with the plan, whose parts are in the order of the file."""
    size = path.stat().st_size
    if sum(_WORD * prod(of.size) * len(of.channels) for of in plan.values()) > DEFLATE_AT_MOST * size:
        raise BadInput(f"its {size} bytes cannot hold the arrays that its record describes")
    _opened(path, plan, pixels=False)
    file = _opened(path, plan, pixels=True)
    images = {part.name(): {c: one.pixels for c, one in part.channels.items()} for part in file.parts}
    for name, channels in images.items():
        for channel, one in channels.items():
            if one.dtype != (np.uint32 if channel == BYTES and plan[name].field else np.float32):
                raise BadInput(f"its pixels of {name!r} are {one.dtype}; expected another type")
    return images


def _opened(path: Path, plan: dict[str, Planned], pixels: bool) -> Any:
    kind = OpenEXR.scanlineimage, OpenEXR.ZIP_COMPRESSION
    expected = [
        (name, *kind, [[0, 0], [of.size[0] - 1, of.size[1] - 1]], sorted(of.channels)) for name, of in plan.items()
    ]
    file = OpenEXR.File(os.fsencode(path), separate_channels=True, header_only=not pixels)
    found = []  # the library leaves out a part whose pixels it cannot read; before 3.4.12, all without pixels
    for h in (part.header for part in file.parts):
        window = [np.asarray(corner).tolist() for corner in h["dataWindow"]]
        found.append((h["name"], h["type"], h["compression"], window, sorted(c.name for c in h["channels"])))
    if found != expected and (pixels or found):
        raise BadInput("its parts are not those that its record describes, or cannot be read")
    return file


def check_whole(path: Path, plan: dict[str, Planned]) -> None:
    """Refuse a file of other parts than planned, or one that has no end."""
    _opened(path, plan, pixels=False)
    check_end(path, next(iter(plan.values())).size[1])


def check_end(path: Path, rows: int) -> None:
    """Refuse a file whose last pixels are missing, which the library does not report; `rows` are those of a lone part.

    The tables of offsets, after the headers, say where the last piece begins; it ends with the file. Pixels are not
    read back: they may be as many as fit into memory once.
    """
    with path.open("rb") as file:
        _, flags = struct.unpack("<2i", file.read(8))
        if several := bool(flags & _MULTIPART):
            tables = sum(iter(lambda: _chunks(file), 0))
        else:
            _chunks(file)
            tables = -(-rows // _LINES)
        offsets = struct.unpack(f"<{tables}Q", file.read(8 * tables))
        file.seek(max(offsets) + (4 if several else 0))  # behind the number of the part
        _, length = struct.unpack("<2i", file.read(8))
        ends = file.tell() + length
    if min(offsets) == 0 or ends != path.stat().st_size:
        raise OSError(28, "what was written cannot be read back")


def _chunks(file: IO[bytes]) -> int:
    """How many pieces the part has whose header begins here, 0 behind the last; leaves the file behind that header."""
    found = 0
    while name := _text(file):
        _text(file)  # the type
        (length,) = struct.unpack("<i", file.read(4))
        value = file.read(length)
        if name == b"chunkCount":
            (found,) = struct.unpack("<i", value)
    return found


def _text(file: IO[bytes]) -> bytes:
    return b"".join(iter(lambda: file.read(1).strip(b"\0"), b""))
