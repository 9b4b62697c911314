"""MetaImage (.mha, .mhd): the few fields of its header that a volume needs, read strictly.

ITK's own parser takes the name of the data file for a printf format and believes any number of axes; this one does not.

References
----------
.. [1] https://itk.org/Wiki/ITK/MetaIO/Documentation
"""

import math
import os
import re
from collections.abc import Mapping, Sequence
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.io.readers.limits import CHUNK, check_axes, check_memory, check_size
from illumgrid.io.readers.source import Packing, Source, beside, finish, inflated, opened, read_text, skip
from illumgrid.io.readers.stored import Note, Stored, Wanted, following, pick
from illumgrid.io.readers.windows import Span, join, need, read_part, single, take

TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4",
    "MET_LONG": "i4", "MET_ULONG": "u4", "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
"""NumPy's names of the element types; MetaIO's MET_LONG has 4 bytes."""

LONGEST = 1 << 16
"""Bytes of the longest line of a header."""

Fields = Mapping[str, str]


def read(source: Source, wanted: Wanted) -> Stored:
    """Read one volume of a MetaImage: its time step (fourth axis) and its channel are chosen by the user."""
    with opened(source) as stream:
        fields, names = _header(stream)
        sizes = _whole_numbers(fields, "DimSize", _one(fields, "NDims", 1, 8))
        channels = _one(fields, "ElementNumberOfChannels", 1, 1 << 16, 1)
        if len(sizes) < 3 or min(sizes) < 1 or len(sizes) > 4:
            check_axes(sizes)
        kind = fields.get("ElementType", "")
        if kind not in TYPES:
            raise BadInput(
                f"its ElementType is {kind[:40]!r}; expected one of {', '.join(TYPES)}; save it as one of those"
            )
        order = ">" if _flag(fields, "BinaryDataByteOrderMSB") or _flag(fields, "ElementByteOrderMSB") else "<"
        place, notes = _place(fields, len(sizes))
        time = pick(wanted.time, "time", [""] * (sizes[3] if len(sizes) == 4 else 1))
        channel = pick(wanted.channel, "channel", [""] * channels)
        check_axes(sizes[:3])
        spans = [single(channel), *wanted.spans(sizes[:3]), single(time)][: 1 + len(sizes)]
        values, more = _data(
            source, stream, fields, names, np.dtype(order + TYPES[kind]), (channels, *sizes), spans, wanted.follow
        )
    intensity = [
        float(fields.get(f"ElementToIntensityFunction{part}", none)) for part, none in (("Slope", 1), ("Offset", 0))
    ]
    if intensity != [1, 0]:
        notes = (
            *notes,
            ("file", "its ElementToIntensityFunction is not applied: values are as stored, as ITK has them"),
        )
    values = values[0, ..., 0] if len(sizes) == 4 else values[0]
    return Stored(values, *place, unit="mm", notes=(*notes, *following(more)), whole=sizes[:3])


def _header(stream: IO[bytes]) -> tuple[Fields, list[str]]:
    """Fields up to ElementDataFile, and the names that follow it if it is a list."""
    fields: dict[str, str] = {}
    while "ElementDataFile" not in fields:
        line = stream.readline(LONGEST)
        key, equals, value = line.decode("utf-8", "surrogateescape").partition("=")
        if (not equals and line.strip()) or len(line) == LONGEST or len(fields) > 1000:
            raise BadInput("its header has a line that is not KEY = VALUE; expected a MetaImage header; correct it")
        if not line:
            raise BadInput("its header ends without ElementDataFile; expected where its data are; correct the header")
        if line.strip():
            fields[key.strip()] = value.strip()
    names = []
    if fields["ElementDataFile"].split()[:1] == ["LIST"]:
        if fields["ElementDataFile"].split()[1:] not in ([], ["2"], ["2D"]):
            raise BadInput("its data files hold more than a slice each; expected one slice in each; save it as .nrrd")
        listed = os.fsdecode(stream.read(CHUNK)).splitlines()
        names = [name.strip() for name in listed if name.strip()]
    return fields, names


def _whole_numbers(fields: Fields, key: str, count: int) -> tuple[int, ...]:
    words = fields.get(key, "").split()
    if len(words) != count or not all(re.fullmatch(r"-?\d{1,18}", word) for word in words):
        raise BadInput(
            f"its {key} is {fields.get(key, 'missing')[:60]!r}; expected {count} whole numbers; correct its header"
        )
    return tuple(int(word) for word in words)


def _one(fields: Fields, key: str, low: int, high: int, default: int | None = None) -> int:
    if default is not None and key not in fields:
        return default
    (number,) = _whole_numbers(fields, key, 1)
    if not low <= number <= high:
        raise BadInput(f"its {key} is {number}; expected a number from {low} to {high}; correct its header")
    return number


def _numbers(fields: Fields, keys: tuple[str, ...], count: int) -> NDArray[np.float64] | None:
    for key in keys:
        if key in fields:
            try:
                found = np.array([float(word) for word in fields[key].split()])
            except ValueError:
                found = np.zeros(0)
            if len(found) != count:
                raise BadInput(f"its {key} is {fields[key][:60]!r}; expected {count} numbers; correct its header")
            return found
    return None


def _flag(fields: Fields, key: str) -> bool:
    return fields.get(key, "").lower()[:1] in ("t", "1", "y")


def _place(fields: Fields, axes: int) -> tuple[tuple[NDArray[Any], NDArray[Any]], tuple[Note, ...]]:
    """Origin and steps (the rows of TransformMatrix are the directions of the axes), and what was assumed."""
    notes: tuple[Note, ...] = ()
    spacing = _numbers(fields, ("ElementSpacing", "ElementSize"), axes)
    if spacing is None:
        spacing = np.ones(axes)
        notes = (("spacing", "does not state the distance between its voxels; 1, 1, 1 was assumed; give --spacing"),)
    matrix = _numbers(fields, ("TransformMatrix", "Rotation", "Orientation"), axes * axes)
    turn = np.eye(3) if matrix is None else matrix.reshape(axes, axes)[:3, :3].T
    origin = _numbers(fields, ("Offset", "Position", "Origin"), axes)
    return (np.zeros(3) if origin is None else origin[:3], turn * spacing[:3]), notes


def _data(
    source: Source, stream: IO[bytes], fields: Fields, names: list[str], dtype: np.dtype[Any], shape: tuple[int, ...],
    wanted: Sequence[Span], follow: bool,
) -> tuple[NDArray[Any], int]:  # fmt: skip
    """The values, in the order of the file (channel, x, y, z ...), and how many bytes follow them."""
    named = fields["ElementDataFile"]
    packing: Packing = "zlib" if _flag(fields, "CompressedData") else "raw"
    text = "BinaryData" in fields and not _flag(fields, "BinaryData") and packing == "raw"
    header = _one(fields, "HeaderSize", -1, 1 << 40, 0)

    def part(of: Source, stream: IO[bytes], local: bool, spans: Sequence[Span]) -> tuple[NDArray[Any], int]:
        dims = shape[: len(spans)]
        count, width = math.prod(dims), 1 if text else dtype.itemsize
        check_size(count * width, of.most_inside(packing), count * 16 if text else need(dtype, dims, spans))
        if header and not local:
            skip(stream, of.size - count * dtype.itemsize if header == -1 and not of.packed else header)
        if text:
            flat, behind = read_text(stream, count)
            return take(flat.astype(dtype).reshape(dims, order="F"), spans), finish(stream, behind=behind)
        with inflated(stream, packing) as unpacked:
            return read_part(unpacked, dtype, dims, spans), finish(unpacked)

    if named.upper() == "LOCAL":
        return part(source, stream, True, wanted)
    names = names or _pattern(named) or [named]
    if len(names) > 1 and len(names) != shape[-1]:
        raise BadInput(
            f"its data are in {len(names)} files, but it has {shape[-1]} slices; expected one each; correct it"
        )
    if len(names) == 1:
        file = beside(source, names[0], follow)
        with opened(file) as data:
            return part(file, data, False, wanted)
    files, more = [beside(source, name, follow) for name in names], [0]
    check_memory(need(dtype, shape, wanted))

    def slice_of(number: int) -> NDArray[Any]:
        with opened(files[number]) as data:
            values, left = part(files[number], data, False, wanted[:-1])
        more[0] += left
        return values

    return join(slice_of, wanted[-1]), more[0]


def _pattern(named: str) -> list[str]:
    """Names by a pattern with one number, "slice%03d.raw 1 20 1"; anything else with a % is refused."""
    if "%" not in named:
        return []
    found = re.fullmatch(r"([^%]*)%(0?\d?)d([^%]*?)\s+(\d{1,6})\s+(\d{1,6})(?:\s+(\d{1,6}))?", named)
    if not found:
        raise BadInput(
            f"its ElementDataFile is {named[:60]!r}; expected a name, LIST, or a pattern with one number such as "
            "'slice%03d.raw 1 20 1'; correct its header"
        )
    before, width, after, first, last, step = found.groups(default="1")
    numbers = range(int(first), int(last) + 1, max(1, int(step)))
    return [f"{before}{format(number, width + 'd')}{after}" for number in numbers]
