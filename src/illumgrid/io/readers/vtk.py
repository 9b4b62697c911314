"""Legacy VTK image data (`.vtk`): a strict reader of our own.

VTK itself is a hundred megabytes and crashes on damaged files, meshio knows no images; the format is one page:
https://docs.vtk.org/en/latest/vtk_file_formats/vtk_legacy_file_format.html
"""

import math
import mmap
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats
from illumgrid.io.readers.limits import CHUNK
from illumgrid.io.readers.source import AGAIN, Source, opened, seekable
from illumgrid.io.readers.stored import Stored, Wanted
from illumgrid.io.readers.vtk_arrays import Array, check_need, lattice, the_field

TYPES = {
    "unsigned_char": "u1", "char": "i1", "signed_char": "i1", "unsigned_short": "u2", "short": "i2",
    "unsigned_int": "u4", "int": "i4", "unsigned_long": "u8", "long": "i8", "unsigned_long_long": "u8",
    "long_long": "i8", "float": "f4", "double": "f8", "vtkidtype": "i4", "vtktypeint8": "i1", "vtktypeint16": "i2",
    "vtktypeint32": "i4", "vtktypeint64": "i8", "vtktypeuint8": "u1", "vtktypeuint16": "u2", "vtktypeuint32": "u4",
    "vtktypeuint64": "u8",
}  # fmt: skip
"""NumPy's types by VTK's names; binary data are big-endian."""

COMPONENTS = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6, "GLOBAL_IDS": 1, "PEDIGREE_IDS": 1}

OTHER = "expected image data (STRUCTURED_POINTS); resample it onto an image (in ParaView: Resample To Image)"


@contextmanager
def whole(source: Source) -> Iterator[Any]:
    """The bytes of a file, unpacked."""
    if source.packed:
        with seekable(source) as stream:
            yield stream.read()
        return
    with opened(source) as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        yield mapped


def read(source: Source, wanted: Wanted) -> Stored:
    """Read an array of an image, on points or on cells."""
    with whole(source) as content:
        text = _Text(content)
        text.line(), text.line()  # version, title
        form = text.line().strip().upper()
        if form not in ("ASCII", "BINARY"):
            raise BadInput(f"its third line is {form[:40]!r}; expected ASCII or BINARY; {AGAIN}")
        text.binary = form == "BINARY"
        shape, origin, steps, arrays = _parse(text)
        array, channel, notes = the_field(arrays, wanted)
        size, start = lattice(shape, array, origin, steps)
        check_need(size, array)
        values = text.numbers(array.place, array.dtype, math.prod(size) * array.components, array.scale)
    values = values.reshape(*size[::-1], array.components)[..., channel].transpose(2, 1, 0)
    return Stored(values, start, steps, notes=tuple(notes))


def _parse(text: "_Text") -> tuple[tuple[int, ...], Floats, Floats, list[Array]]:
    """Shape in points, origin, steps, and all arrays with the place of their numbers."""
    shape: tuple[int, ...] = ()
    origin, spacing = np.zeros(3), np.ones(3)
    cells, count = False, 0
    arrays: list[Array] = []
    while words := text.words():
        key = words[0].upper()
        if key == "DATASET":
            if words[1:2] != [] and words[1].upper() not in ("STRUCTURED_POINTS", "RECTILINEAR_GRID"):
                raise BadInput(f"holds a {words[1].upper()[:40]}; {OTHER}")
        elif key == "DIMENSIONS":
            shape = tuple(_int(word) for word in _some(words, 4)[1:])
        elif key == "ORIGIN":
            origin = np.array([_float(word) for word in _some(words, 4)[1:]])
        elif key in ("SPACING", "ASPECT_RATIO"):
            spacing = np.array([_float(word) for word in _some(words, 4)[1:]])
        elif key in ("X_COORDINATES", "Y_COORDINATES", "Z_COORDINATES"):
            axis = "XYZ".index(key[0])
            origin[axis], spacing[axis] = _coordinates(text, words)
        elif key in ("POINT_DATA", "CELL_DATA"):
            cells, count = key == "CELL_DATA", _int(_some(words, 2)[1])
            right = math.prod(max(n - cells, 1) for n in shape) if len(shape) == 3 else -1
            if count != right:
                raise BadInput(f"says {key} {count} for {'x'.join(map(str, shape))} points; expected {right}; {AGAIN}")
        elif key == "METADATA":
            while text.line().strip():
                pass
        elif key == "FIELD":
            arrays += _fields(text, words, cells, count)
        else:
            arrays += _attribute(text, key, words, cells, count, arrays)
    if len(shape) != 3 or min(shape) < 1:
        raise BadInput(f"its dimensions are {' '.join(map(str, shape)) or 'missing'}; {OTHER}")
    if not (np.isfinite(spacing).all() and (spacing > 0).all()):
        raise BadInput(f"its spacing is {spacing.tolist()}; expected three positive numbers; correct its header")
    return shape, origin, np.diag(spacing), arrays


def _attribute(
    text: "_Text", key: str, words: list[str], cells: bool, count: int, before: list[Array]
) -> Iterator[Array]:
    """An array named by a keyword, behind which the text continues."""
    name = unquote(words[1]) if len(words) > 1 else ""
    if key == "SCALARS":
        kind, components = _type(_some(words, 3)[2]), _int(words[3]) if len(words) > 3 else 1
        text.skip_line("LOOKUP_TABLE")
        active = not any(array.active and array.cells == cells for array in before)
        yield Array(name, cells, components, kind, active, text.skip(kind, count * components))
    elif key in ("COLOR_SCALARS", "LOOKUP_TABLE"):
        size = _int(_some(words, 3)[2])
        place = text.skip(np.dtype("u1"), size * 4 if key == "LOOKUP_TABLE" else count * size)
        if key == "COLOR_SCALARS":  # bytes, which are written as text from 0 to 1
            active = not any(array.active and array.cells == cells for array in before)
            yield Array(name, cells, size, np.dtype("u1"), active, place, scale=1.0 if text.binary else 255.0)
    elif key in COMPONENTS or key == "TEXTURE_COORDINATES":
        at = 3 if key == "TEXTURE_COORDINATES" else 2
        kind = _type(_some(words, at + 1)[at])
        components = COMPONENTS[key] if key in COMPONENTS else _int(words[2])
        yield Array(name, cells, components, kind, False, text.skip(kind, count * components))
    else:
        raise BadInput(f"has {key[:40]!r} where a keyword of the format should be; {AGAIN}")


def _fields(text: "_Text", words: list[str], cells: bool, count: int) -> Iterator[Array]:
    """Arrays of a FIELD: those with one tuple at each point (or cell) count, others (times) do not."""
    for _ in range(_int(_some(words, 3)[2])):
        head = text.words()
        if head and head[0].upper() == "METADATA":
            while text.line().strip():
                pass
            head = text.words()
        name, components, tuples = _some(head, 4)[0], _int(head[1]), _int(head[2])
        if head[3].lower() == "string":
            text.skip_strings(components * tuples)
            continue
        kind = _type(head[3])
        place = text.skip(kind, components * tuples)
        if tuples == count and count:
            yield Array(unquote(name), cells, components, kind, False, place)


def _coordinates(text: "_Text", words: list[str]) -> tuple[float, float]:
    """First of the coordinates of a rectilinear grid, and their distance, which must be even."""
    kind, count = _type(_some(words, 3)[2]), _int(words[1])
    place = text.skip(kind, count)
    along = text.numbers(place, kind, count).astype(float)
    if count < 2:
        return (float(along[0]) if count else 0.0), 1.0
    step = (along[-1] - along[0]) / (count - 1)
    if not np.abs(along - (along[0] + step * np.arange(count))).max() <= 0.02 * abs(step):
        raise BadInput(f"the coordinates of its rectilinear grid are unevenly spaced; {OTHER}")
    return float(along[0]), float(step)


def _some(words: list[str], least: int) -> list[str]:
    if len(words) < least:
        raise BadInput(f"has a line {' '.join(words)[:60]!r}; expected {least} words in it; {AGAIN}")
    return words


def _int(word: str) -> int:
    if not word.isdecimal() or len(word) > 12:
        raise BadInput(f"has {word[:40]!r} where a size should be; expected a whole number; {AGAIN}")
    return int(word)


def _float(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BadInput(f"has {word[:40]!r} for its origin or spacing; expected finite numbers; correct its header")
    return value


def _type(word: str) -> np.dtype[Any]:
    if word.lower() == "bit":
        return np.dtype(bool)
    if word.lower() not in TYPES:
        raise BadInput(f"has an array of type {word[:40]!r}; expected numbers, such as float; save it as that")
    return np.dtype(">" + TYPES[word.lower()])


class _Text:
    """The position in the file."""

    def __init__(self, content: Any) -> None:
        self.content, self.at, self.binary = content, 0, False

    def line(self) -> str:
        """The next line; empty at the end of the file."""
        end = self.content.find(b"\n", self.at)
        end = len(self.content) if end < 0 else end
        if end - self.at > 1 << 16:
            raise BadInput(f"has a line of {end - self.at} characters where its header should be; {AGAIN}")
        found = self.content[self.at : end]
        self.at = min(end + 1, len(self.content))
        return bytes(found).decode("utf-8", "replace")

    def words(self) -> list[str]:
        """Words of the next line that has any; none at the end of the file."""
        while self.at < len(self.content):
            if words := self.line().split():
                return words
        return []

    def skip_line(self, key: str) -> None:
        """Skip the next line if it begins with `key`."""
        start = self.at
        if not self.line().strip().upper().startswith(key):
            self.at = start

    def skip(self, kind: np.dtype[Any], count: int) -> int:
        """Skip `count` numbers; returns their position."""
        start = self.at
        if self.binary:
            length = (count + 7) // 8 if kind.kind == "b" else count * kind.itemsize
            if start + length > len(self.content):
                raise BadInput(f"ends after {len(self.content) - start} of {length} bytes of an array; {AGAIN}")
            self.at += length
        else:
            for _ in self._chunks(count):
                pass
        return start

    def skip_strings(self, count: int) -> None:
        """Skip texts: lines, or bytes behind their number."""
        for _ in range(count):
            if self.at >= len(self.content):
                raise BadInput(f"ends within an array of texts; {AGAIN}")
            if not self.binary:
                self.line()
                continue
            first = self.content[self.at]
            width = (8, 4, 2, 1)[first >> 6]
            length = int.from_bytes(self.content[self.at : self.at + width], "big") & ((1 << (8 * width - 2)) - 1)
            self.at += width + length

    def numbers(self, start: int, kind: np.dtype[Any], count: int, scale: float = 1.0) -> NDArray[Any]:
        """The `count` numbers that begin at `start`, those of a text times `scale`."""
        if not self.binary:
            self.at = start
            flat = np.zeros(count)
            done = 0
            for words in self._chunks(count):
                flat[done : done + len(words)] = np.round(words * scale) if scale != 1 else words
                done += len(words)
            native = kind.newbyteorder("=")
            if native.kind in "iu" and np.abs(flat).max(initial=0) >= 2 ** (8 * native.itemsize - (native.kind == "i")):
                raise BadInput(f"has a number beyond its type {native}; {AGAIN}")
            return flat.astype(native)
        if kind.kind == "b":
            packed = np.frombuffer(self.content[start : start + (count + 7) // 8], np.uint8)
            return np.unpackbits(packed, count=count)
        raw = self.content[start : start + count * kind.itemsize]
        return np.frombuffer(raw, kind).astype(kind.newbyteorder("="))

    def _chunks(self, count: int) -> Iterator[NDArray[np.float64]]:
        """The next `count` numbers of a text, some at a time; the place is behind them when all are taken."""
        left = count
        while left > 0:
            chunk = bytes(self.content[self.at : self.at + CHUNK])
            if len(chunk) == CHUNK:
                space = re.search(rb"\s\S*\Z", chunk)
                if space is None:
                    raise BadInput(f"holds something that is not a number; {AGAIN}")
                chunk = chunk[: space.start() + 1]
            words = chunk.split()
            if not words:
                raise BadInput(f"ends after {count - left} of {count} values; {AGAIN}")
            if len(words) > left:
                end = [m.end() for m, _ in zip(re.finditer(rb"\S+", chunk), range(left))][-1]
                self.at += end
                words = words[:left]
            else:
                self.at += len(chunk)
            left -= len(words)
            try:
                yield np.array(words, dtype=float)
            except ValueError:
                raise BadInput(
                    f"ends after too few of {count} values, or holds something that is not a number; {AGAIN}"
                ) from None
