"""VTK image data (`.vti`): a strict reader of our own.

VTK itself is a hundred megabytes and crashes on damaged files; the format is XML around arrays in six encodings:
https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html
"""

import base64
import binascii
import lzma
import math
import re
import zlib
from dataclasses import dataclass, field
from typing import Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats
from illumgrid.io.readers.limits import DEFLATE, check_size
from illumgrid.io.readers.source import AGAIN, Source
from illumgrid.io.readers.stored import Stored, Wanted
from illumgrid.io.readers.vtk import whole
from illumgrid.io.readers.vtk_arrays import Array, check_need, lattice, the_field

TYPES = {
    **{f"{'U' * u}Int{8 * n}": f"{'u' if u else 'i'}{n}" for u in (0, 1) for n in (1, 2, 4, 8)},
    "Float32": "f4",
    "Float64": "f8",
}

MOST_LZMA = 8000
"""Times its size that LZMA unpacks to at most."""


@dataclass
class _Image:
    """The content of the XML."""

    attributes: dict[str, str]
    """Of VTKFile and ImageData."""
    pieces: list["_Piece"] = field(default_factory=list)


@dataclass
class _Piece:
    extent: tuple[int, ...]
    arrays: list[Array] = field(default_factory=list)


@dataclass(frozen=True)
class _Data:
    """How the numbers of an array are written: inline text, or an offset into the appended data."""

    form: str
    offset: int | None
    inline: list[str]


def read(source: Source, wanted: Wanted) -> Stored:
    """Read an array of an image, on points or on cells."""
    with whole(source) as content:
        start = content.find(b"<AppendedData")
        head = bytes(content[: start if start >= 0 else len(content)])
        image = _parse(head, appended=start >= 0)
        if b"</VTKFile>" not in bytes(content[max(0, len(content) - 256) :]):
            raise BadInput(f"does not end like a .vti file; {AGAIN}")
        extent, origin, steps = _placement(image.attributes)
        shape = tuple(b - a + 1 for a, b in zip(extent[::2], extent[1::2]))
        array, channel, notes = the_field(image.pieces[0].arrays, wanted)
        size, start_at = lattice(shape, array, origin + steps @ np.array(extent[::2]), steps)
        _check_promise(image, size, array, source)
        check_need(size, array)
        values = _joined(image, array, extent, size, _appended(content, start))
    return Stored(values[channel], start_at, steps, notes=tuple(notes))


def _parse(head: bytes, appended: bool) -> _Image:
    """Pieces and arrays, from the XML before the appended data; entities are refused."""
    if not head.lstrip().startswith((b"<?xml", b"<VTKFile")):
        raise BadInput("does not begin like a .vti file; expected VTK image data; save the volume as that")
    image = _Image({})
    state: dict[str, Any] = {"where": None, "marked": None}
    parser = expat.ParserCreate()

    def opens(tag: str, attributes: dict[str, str]) -> None:
        if tag == "VTKFile" and attributes.get("type") != "ImageData":
            what = attributes.get("type", "nothing")[:40]
            raise BadInput(
                f"does not begin like a .vti file of image data: it holds {what}; expected ImageData; save the volume "
                "as that (in ParaView: Resample To Image)"
            )
        if tag in ("VTKFile", "ImageData"):
            image.attributes.update(attributes)
        elif tag == "Piece":
            image.pieces.append(_Piece(_whole(attributes.get("Extent", ""), 6, "Extent")))
        elif tag in ("PointData", "CellData"):
            state["where"], state["marked"] = tag, attributes.get("Scalars")
        elif tag == "DataArray" and state["where"] and image.pieces:
            state["inline"] = _array(image.pieces[-1], attributes, state["where"] == "CellData", state["marked"])

    def closes(tag: str) -> None:
        if tag in ("PointData", "CellData"):
            state["where"] = None
        elif tag == "DataArray":
            state["inline"] = None

    def says(text: str) -> None:
        if state.get("inline") is not None:
            state["inline"].append(text)

    def doctype(*_: Any) -> None:
        raise BadInput(f"declares a document type, which no .vti file does; {AGAIN}")

    parser.StartElementHandler, parser.EndElementHandler = opens, closes
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = says, doctype
    parser.buffer_text = True
    try:
        parser.Parse(head, not appended)
    except expat.ExpatError as problem:
        raise BadInput(f"its XML cannot be read ({problem}); {AGAIN}") from None
    if not image.pieces:
        raise BadInput(f"its XML ends before the data; {AGAIN}")
    return image


def _array(piece: _Piece, attributes: dict[str, str], cells: bool, marked: str | None) -> list[str] | None:
    """Note an array; the list that its inline text goes to."""
    name, kind = attributes.get("Name", ""), attributes.get("type", "")
    if kind not in TYPES:
        return None  # texts and bits are no fields
    offset = attributes.get("offset")
    inline: list[str] = []
    data = _Data(attributes.get("format", "ascii"), _whole(offset, 1, "offset")[0] if offset else None, inline)
    components = _whole(attributes.get("NumberOfComponents", "1") or "1", 1, "NumberOfComponents")[0]
    piece.arrays.append(Array(name, cells, components, np.dtype(TYPES[kind]), name == marked, data))
    return inline


def _whole(text: str, count: int, what: str) -> tuple[int, ...]:
    words = text.split()
    if len(words) != count or not all(re.fullmatch(r"-?\d{1,10}|\d{1,18}", word) for word in words):
        raise BadInput(f"its {what} is {text[:60]!r}; expected {count} whole numbers; {AGAIN}")
    return tuple(map(int, words))


def _placement(attributes: dict[str, str]) -> tuple[tuple[int, ...], Floats, Floats]:
    def floats(key: str, default: str, count: int) -> Floats:
        words = attributes.get(key, default).split()
        try:
            found = np.array(words, dtype=float)
        except ValueError:
            found = np.full(count, np.nan)
        if found.shape != (count,) or not np.isfinite(found).all():
            raise BadInput(
                f"its {key} is {attributes.get(key, '')[:60]!r}; expected {count} finite numbers; correct it"
            )
        return found

    extent = _whole(attributes.get("WholeExtent", ""), 6, "WholeExtent")
    origin, spacing = floats("Origin", "0 0 0", 3), floats("Spacing", "1 1 1", 3)
    direction = floats("Direction", "1 0 0 0 1 0 0 0 1", 9).reshape(3, 3)
    return extent, origin, direction * spacing


def _check_promise(image: _Image, size: tuple[int, ...], array: Array, source: Source) -> None:
    """Hold the number of voxels against the bytes of the file."""
    count = math.prod(size) * array.components
    packed = image.attributes.get("compressor", "")
    most = source.most * (MOST_LZMA if "LZMA" in packed else DEFLATE if packed else 1)
    width = min(array.dtype.itemsize, 2) if array.place.form == "ascii" else array.dtype.itemsize
    check_size(count * width, source.most if array.place.form == "ascii" else most, 0)


def _appended(content: Any, start: int) -> "_Bytes | None":
    """What is appended, behind its underscore."""
    if start < 0:
        return None
    close = content.find(b">", start)
    tag = bytes(content[start : max(close, start)])
    under = content.find(b"_", close) if close >= 0 else -1
    if under < 0 or bytes(content[close + 1 : under]).strip():
        raise BadInput(f"its appended data do not begin with an underscore; {AGAIN}")
    return _Bytes(content, b"base64" in tag, under + 1)


def _joined(
    image: _Image, array: Array, extent: tuple[int, ...], size: tuple[int, ...], appended: "_Bytes | None"
) -> NDArray[Any]:
    """Values (components, nx, ny, nz) of all pieces."""
    out = np.zeros((array.components, *size), array.dtype)
    covered = np.zeros(size, bool) if len(image.pieces) > 1 else None
    for piece in image.pieces:
        part = next((a for a in piece.arrays if (a.name, a.cells) == (array.name, array.cells)), None)
        low = np.array(piece.extent[::2]) - extent[::2]
        shape = np.array(piece.extent[1::2]) - piece.extent[::2] + 1
        shape = np.maximum(shape - array.cells, 1)
        if (low < 0).any() or (shape < 1).any() or (low + shape > size).any() or part is None:
            raise BadInput(f"a piece of it lies outside of the whole or lacks the array {array.name!r}; {AGAIN}")
        if (part.components, part.dtype) != (array.components, array.dtype):
            raise BadInput(f"its array {array.name!r} differs from piece to piece; {AGAIN}")
        flat = _numbers(image.attributes, part, int(shape.prod()) * part.components, appended)
        box = tuple(slice(int(a), int(a + n)) for a, n in zip(low, shape))
        out[(slice(None), *box)] = flat.reshape(*shape[::-1], part.components).transpose(3, 2, 1, 0)
        if covered is not None:
            covered[box] = True
    if (math.prod(size) != int(shape.prod())) if covered is None else not covered.all():
        raise BadInput(f"its pieces do not cover the whole; {AGAIN}")
    return out


def _numbers(attributes: dict[str, str], array: Array, count: int, appended: "_Bytes | None") -> NDArray[Any]:
    """The numbers of one array."""
    data: _Data = array.place
    if data.form == "ascii":
        try:
            flat = np.array("".join(data.inline).split(), dtype=array.dtype if array.dtype.kind in "iu" else float)
        except (ValueError, OverflowError):
            raise BadInput(
                f"its array {array.name!r} cannot be read: it holds something that is not a number; {AGAIN}"
            ) from None
        if len(flat) != count:
            raise BadInput(f"its array {array.name!r} cannot be read: it has {len(flat)} of {count} values; {AGAIN}")
        return flat.astype(array.dtype)
    if data.form == "appended":
        if appended is None or data.offset is None or data.offset < 0:
            raise BadInput(f"its array {array.name!r} cannot be read: it lies outside of the file; {AGAIN}")
        raw = _Bytes(appended.content, appended.coded, appended.at + data.offset)
    else:
        raw = _Bytes("".join(data.inline).strip().encode(), True)
    big = attributes.get("byte_order") == "BigEndian"
    number = np.dtype((">" if big else "<") + ("u8" if attributes.get("header_type") == "UInt64" else "u4"))
    length = count * array.dtype.itemsize
    packed = attributes.get("compressor", "")
    try:
        content = _unpacked(raw, number, length, packed) if packed else _plain(raw, number, length)
    except (zlib.error, lzma.LZMAError, binascii.Error, EOFError, RuntimeError) as problem:
        raise BadInput(f"its array {array.name!r} cannot be read ({problem}); {AGAIN}") from None
    return np.frombuffer(content, array.dtype.newbyteorder(">" if big else "<")).astype(array.dtype)


class _Bytes:
    """Bytes that may be written in base64, in runs that are encoded separately."""

    def __init__(self, content: Any, coded: bool, at: int = 0) -> None:
        self.content, self.coded, self.at = content, coded, at

    def run(self, length: int) -> bytes:
        """The next `length` bytes, which are a run of their own."""
        taken = (length + 2) // 3 * 4 if self.coded else length
        part = bytes(self.content[self.at : self.at + taken])
        if len(part) < taken:
            raise EOFError("it ends too early")
        self.at += taken
        found = base64.b64decode(part, validate=True)[:length] if self.coded else part
        if len(found) < length:
            raise EOFError("it ends too early")
        return found


def _plain(raw: _Bytes, number: np.dtype[Any], length: int) -> bytes:
    """Data behind their number of bytes: in base64 one run with it, or two."""
    width = number.itemsize
    if raw.coded and b"=" not in bytes(raw.content[raw.at : raw.at + (width + 2) // 3 * 4]):
        both = raw.run(width + length)
        head, data = both[:width], both[width:]
    else:
        head, data = raw.run(width), b""
    if int(np.frombuffer(head, number)[0]) != length:
        raise EOFError(f"it says {int(np.frombuffer(head, number)[0])} bytes where {length} are needed")
    return data or raw.run(length)


def _unpacked(raw: _Bytes, number: np.dtype[Any], length: int, compressor: str) -> bytes:
    """Data in blocks, behind the number of blocks, the size of a block, of the last one, and of each when packed."""
    width = number.itemsize
    start = _Bytes(raw.content, raw.coded, raw.at)
    count = int(np.frombuffer(start.run(3 * width), number)[0])
    if count > len(raw.content):
        raise EOFError("it has more blocks than bytes")
    head = np.frombuffer(raw.run((3 + count) * width), number).astype(np.int64)
    block, last, sizes = int(head[1]), int(head[2]), head[3:]
    lengths = [block] * count
    if count and last:
        lengths[-1] = last
    if sum(lengths) != length or (sizes < 0).any():
        raise EOFError(f"it says {sum(lengths)} bytes where {length} are needed")
    packed = raw.run(int(sizes.sum()))
    out, at = bytearray(length), 0
    done = 0
    for size, size_unpacked in zip(sizes.tolist(), lengths):
        part = _block(packed[at : at + size], size_unpacked, compressor)
        if len(part) != size_unpacked:
            raise EOFError(f"a block unpacks to {len(part)} of {size_unpacked} bytes")
        out[done : done + size_unpacked] = part
        at, done = at + size, done + size_unpacked
    return bytes(out)


def _block(packed: bytes, length: int, compressor: str) -> bytes:
    if compressor == "vtkZLibDataCompressor":
        unpack = zlib.decompressobj()
        out = unpack.decompress(packed, length + 1)
        if len(out) == length:
            unpack.decompress(unpack.unconsumed_tail, 1)  # up to the checksum
        if not unpack.eof:
            raise EOFError("a block ends too early")
        return out
    if compressor == "vtkLZMADataCompressor":
        unlzma = lzma.LZMADecompressor(memlimit=1 << 28)
        out = unlzma.decompress(packed, length + 1)
        if not unlzma.eof and len(out) == length:
            unlzma.decompress(b"", 1)
        if not unlzma.eof:
            raise EOFError("a block ends too early")
        return out
    if compressor == "vtkLZ4DataCompressor":
        try:
            import lz4.block
        except ImportError:
            raise BadInput(
                "is packed by LZ4, which needs the package lz4; expected it to be installed: pip install "
                "illumgrid[lz4]; or save the volume with another compressor"
            ) from None
        return bytes(lz4.block.decompress(packed, uncompressed_size=length))
    raise BadInput(f"is packed by {compressor[:40]!r}; expected zlib, LZMA or LZ4; save it with one of them")
