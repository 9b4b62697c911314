"""NRRD (.nrrd, .nhdr), read strictly: header, raw, text, hex, gzip and bzip2 data, attached or in files beside it.

pynrrd, which the tests read and write with, opens data files anywhere, unpacks without a bound, and takes what the
header promises.

References
----------
.. [1] https://teem.sourceforge.net/nrrd/format.html
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

_TYPES = {
    "i1": ("signed char", "int8", "int8_t"),
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
    "i8": ("longlong", "long long", "long long int", "signed long long", "signed long long int", "int64", "int64_t"),
    "u8": ("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"),
    "f4": ("float",),
    "f8": ("double",),
}
TYPES = {name: kind for kind, names in _TYPES.items() for name in names}

PACKINGS: dict[str, Packing] = {"raw": "raw", "gzip": "gzip", "gz": "gzip", "bzip2": "bzip2", "bz2": "bzip2"}

TO_LPS = {
    "right-anterior-superior": (-1, -1, 1),
    "ras": (-1, -1, 1),
    "left-anterior-superior": (1, -1, 1),
    "las": (1, -1, 1),
    "left-posterior-superior": (1, 1, 1),
    "lps": (1, 1, 1),
}
"""Signs that turn a medical space into LPS; other spaces are kept as they are."""

LENGTHS = {"um": "µm", "micron": "µm", "microns": "µm", "micrometer": "µm", "angstrom": "Å", "millimeter": "mm"}

LONGEST = 1 << 16
"""Bytes of the longest line of a header."""

Fields = Mapping[str, str]


def read(source: Source, wanted: Wanted) -> Stored:
    """Read one volume of a NRRD; along axes other than those of space, the user chooses."""
    with opened(source) as stream:
        fields, names = _header(stream)
        axes = _whole(fields, "dimension", 1)[0]
        if not 1 <= axes <= 16:
            raise BadInput(f"its dimension is {axes}; expected three axes of space, and few others; correct its header")
        sizes = _whole(fields, "sizes", axes)
        kind = fields.get("type", "").lower()
        if kind not in TYPES:
            raise BadInput(
                f"its type is {kind[:40]!r}; expected a number such as uint8 or float; save it as one of those"
            )
        directions = _directions(fields, axes)
        spatial, chosen = _choose(fields, sizes, directions, wanted)
        check_axes([sizes[axis] for axis in spatial])
        place, notes = _place(fields, spatial, directions, sizes)
        order = ">" if fields.get("endian", "little").lower() == "big" else "<"
        kept = wanted.spans([sizes[axis] for axis in spatial])
        spans = [single(chosen[axis]) if axis in chosen else kept[spatial.index(axis)] for axis in range(axes)]
        values, more = _data(source, stream, fields, names, np.dtype(order + TYPES[kind]), sizes, spans, wanted.follow)
    units = re.findall(r'"([^"]*)"', fields.get("space units", fields.get("units", "")))
    unit = next((LENGTHS.get(unit.lower(), unit) for unit in units if unit), None)
    medical = fields.get("space", "").lower().removesuffix("-time") in TO_LPS
    values = values.reshape([span.count for span in kept], order="F")
    whole = tuple(sizes[axis] for axis in spatial)
    return Stored(
        values, *place, unit=unit or ("mm" if medical else None), notes=(*notes, *following(more)), whole=whole
    )


def _header(stream: IO[bytes]) -> tuple[Fields, list[str]]:
    """Fields in lower case, and the names of the data files if they are listed."""
    fields: dict[str, str] = {}
    names: list[str] = []
    stream.readline(LONGEST)
    while (line := stream.readline(LONGEST)).strip():
        text = line.decode("utf-8", "surrogateescape").strip()
        key, colon, value = text.partition(":")
        if len(line) == LONGEST or len(fields) > 1000:
            raise BadInput("its header has a line that is too long, or too many lines; expected a NRRD header")
        if text.startswith("#") or value.startswith("="):
            continue
        if not colon:
            raise BadInput(f"its header has the line {text[:40]!r}; expected 'field: value'; correct its header")
        name = {"datafile": "data file", "lineskip": "line skip", "byteskip": "byte skip"}.get(key.lower(), key.lower())
        fields[{"centerings": "centers", "axismins": "axis mins", "axismaxs": "axis maxs"}.get(name, name)] = (
            value.strip()
        )
        if name == "data file" and value.split()[:1] == ["LIST"]:
            if value.split()[1:]:
                raise BadInput(
                    "its data files hold more than a slice each; expected one slice in each; save it as one file"
                )
            names = [os.fsdecode(line.strip()) for line in stream.read(CHUNK).splitlines() if line.strip()]
            break
    return fields, names


def _whole(fields: Fields, key: str, count: int) -> tuple[int, ...]:
    words = fields.get(key, "").split()
    if len(words) != count or not all(re.fullmatch(r"\d{1,18}", word) for word in words):
        raise BadInput(
            f"its field {key!r} is {fields.get(key, 'missing')[:60]!r}; expected {count} whole numbers; correct it"
        )
    return tuple(int(word) for word in words)


def _vector(text: str) -> NDArray[np.float64]:
    """The numbers of "(1,0,0)"; NaN where it is "none"."""
    try:
        return np.array([float(word) for word in text.strip("() \t").split(",")])
    except ValueError:
        raise BadInput(f"its header has the vector {text[:40]!r}; expected numbers like (1,0,0); correct it") from None


def _directions(fields: Fields, axes: int) -> list[NDArray[np.float64] | None] | None:
    """World step along each axis, None for an axis that is not of space; None where the header has no directions."""
    text = fields.get("space directions")
    if text is None:
        return None
    vectors = re.findall(r"\([^)]*\)|none|nan", text, re.IGNORECASE)
    if len(vectors) != axes:
        raise BadInput(f"its space directions are {text[:60]!r}; expected {axes} vectors; correct its header")
    found = [_vector(v) if v.startswith("(") else None for v in vectors]
    return [None if v is None or np.isnan(v).all() else v for v in found]


def _choose(
    fields: Fields, sizes: Sequence[int], directions: list[NDArray[np.float64] | None] | None, wanted: Wanted
) -> tuple[list[int], dict[int, int]]:
    """Numbers of the three axes of space; and of each other axis the index that the user wants."""
    axes = len(sizes)
    kinds = [word.lower() for word in fields.get("kinds", "").split()]
    kinds = kinds if len(kinds) == axes else ["???"] * axes
    if "complex" in kinds and sizes[kinds.index("complex")] > 1:
        raise BadInput("each voxel is a complex number; expected one real number; save the magnitude")
    if directions is not None:
        spatial = [axis for axis in range(axes) if directions[axis] is not None]
    else:
        spatial = [axis for axis in range(axes) if kinds[axis] in ("domain", "space", "???", "none")]
    if len(spatial) > 3:  # of what is not said to be something else, single ones do not count
        spatial = [axis for axis in spatial if sizes[axis] > 1] if sum(n > 1 for n in sizes) == 3 else spatial[:3]
    if len(spatial) < 3:
        check_axes([sizes[axis] for axis in spatial])
    others = [axis for axis in range(axes) if axis not in spatial]
    many = [axis for axis in others if sizes[axis] > 1]
    if len(many) > 2:
        check_axes(sizes)
    index: dict[int, int] = {}
    asked = {"time": wanted.time, "channel": wanted.channel}
    late = [axis for axis in others if axis > max(spatial) and kinds[axis] not in _CHANNELS]
    options = {axis: "time" if kinds[axis] == "time" or axis in late else "channel" for axis in others}
    if len(many) == 2 and options[many[0]] == options[many[1]]:
        options.update({many[0]: "channel", many[1]: "time"})
    for axis in others:
        given = asked[options[axis]] if axis in many else None
        index[axis] = pick(given, options[axis], [""] * sizes[axis])
    for option, given in asked.items():
        if given is not None and option not in [options[axis] for axis in many]:
            pick(given, option, [""])
    return spatial, index


_CHANNELS = {"list", "vector", "point", "covariant-vector", "normal", "scalar", "stub", "rgb-color", "rgba-color",
             "hsv-color", "xyz-color", "2-vector", "3-vector", "4-vector", "3-color", "4-color", "3-gradient",
             "3-normal", "quaternion", "2d-matrix", "3d-matrix"}  # fmt: skip


def _place(
    fields: Fields, spatial: list[int], directions: list[NDArray[np.float64] | None] | None, sizes: Sequence[int]
) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], tuple[Note, ...]]:
    space = fields.get("space", "").lower().removesuffix("-time")
    signs = np.array(TO_LPS.get(space, (1, 1, 1)), float)
    if directions is not None:
        vectors = [v for axis in spatial if (v := directions[axis]) is not None]
        if any(len(v) not in (3, 4) for v in vectors):
            raise BadInput(
                f"its space directions are {fields['space directions'][:60]!r}; expected vectors of 3; correct it"
            )
        steps = np.stack([v[:3] for v in vectors], axis=1)
        text = fields.get("space origin")
        origin = np.zeros(3) if text is None or "none" in text else _vector(text)[:3]
        if len(origin) != 3:
            raise BadInput(f"its space origin is {text!r}; expected a vector of 3; correct its header")
        return (signs * origin, signs[:, None] * steps), ()
    spacing, low = _spacing(fields, spatial, sizes)
    notes: tuple[Note, ...] = ()
    if np.isnan(spacing).any():
        taken = np.where(np.isnan(spacing), 1.0, spacing)
        said = ", ".join(f"{s:g}" for s in taken)
        notes = (("spacing", f"does not state the distance between its voxels; {said} was assumed; give --spacing"),)
        spacing = taken
    return (signs * np.where(np.isnan(low), 0.0, low), np.diag(signs * spacing)), notes


def _per_axis(fields: Fields, key: str, axes: int) -> NDArray[np.float64]:
    words = fields.get(key, "").split()
    if not words:
        return np.full(axes, np.nan)
    try:
        found = np.array([float("nan" if word.lower() in ("none", "???") else word) for word in words])
    except ValueError:
        found = np.zeros(0)
    if len(found) != axes:
        raise BadInput(f"its field {key!r} is {fields[key][:60]!r}; expected {axes} numbers; correct its header")
    return found


def _spacing(
    fields: Fields, spatial: list[int], sizes: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Spacing and first position along the axes of space, NaN where the header does not say."""
    axes = len(sizes)
    spacing, low, high = (_per_axis(fields, key, axes)[spatial] for key in ("spacings", "axis mins", "axis maxs"))
    count = np.array([sizes[axis] for axis in spatial], float)
    words = fields.get("centers", "").lower().split()
    node = np.array([word == "node" for word in words] if len(words) == axes else [False] * axes)[spatial]
    spacing = np.where(np.isnan(spacing), (high - low) / (count - node), spacing)
    return np.abs(spacing), low + np.where(node, 0, 0.5 * spacing)


def _data(
    source: Source, stream: IO[bytes], fields: Fields, names: list[str], dtype: np.dtype[Any], sizes: tuple[int, ...],
    wanted: Sequence[Span], follow: bool,
) -> tuple[NDArray[Any], int]:  # fmt: skip
    """The values with the axes of the file, and how many bytes follow them."""
    encoding = fields.get("encoding", "").lower()
    lines, left_out = (int(fields.get(key, 0)) for key in ("line skip", "byte skip"))

    def part(of: Source, stream: IO[bytes], spans: Sequence[Span]) -> tuple[NDArray[Any], int]:
        dims = sizes[: len(spans)]
        count = math.prod(dims)
        for _ in range(min(lines, 1 << 16)):
            stream.readline(CHUNK)
        if encoding in ("ascii", "text", "txt", "hex"):
            stream.read(max(0, min(left_out, CHUNK)))
        if encoding in ("ascii", "text", "txt"):
            check_size(count, of.most, count * (8 + dtype.itemsize))
            flat, behind = read_text(stream, count)
            return take(flat.astype(dtype).reshape(dims, order="F"), spans), finish(stream, behind=behind)
        if encoding == "hex":
            size = count * dtype.itemsize
            check_size(2 * size, of.most, 4 * size)
            raw = bytes.fromhex(stream.read(4 * size).decode("ascii"))
            values = np.frombuffer(raw[:size], dtype).reshape(dims, order="F")
            return take(values, spans), finish(stream, behind=raw[size:].hex().encode())
        if encoding not in PACKINGS:
            raise BadInput(
                f"its encoding is {encoding[:40]!r}; expected raw, gzip, bzip2, text or hex; save it as gzip"
            )
        packing = PACKINGS[encoding]
        check_size(count * dtype.itemsize, of.most_inside(packing), need(dtype, dims, spans))
        if left_out == -1 and packing == "raw" and not of.packed:
            stream.seek(of.size - count * dtype.itemsize)
        with inflated(stream, packing) as unpacked:
            skip(unpacked, left_out)
            return read_part(unpacked, dtype, dims, spans), finish(unpacked)

    named = fields.get("data file")
    if named is None:
        return part(source, stream, wanted)
    names = names or _pattern(named) or [named]
    if len(names) == 1:
        file = beside(source, names[0], follow)
        with opened(file) as data:
            return part(file, data, wanted)
    if len(names) != sizes[-1]:
        raise BadInput(
            f"its data are in {len(names)} files, but it has {sizes[-1]} slices; expected one each; correct it"
        )
    files, more = [beside(source, name, follow) for name in names], [0]
    check_memory(need(dtype, sizes, wanted))

    def slice_of(number: int) -> NDArray[Any]:
        with opened(files[number]) as data:
            values, left = part(files[number], data, wanted[:-1])
        more[0] += left
        return values

    return join(slice_of, wanted[-1]), more[0]


def _pattern(named: str) -> list[str]:
    """Names by a pattern with one number, "slice%03d.raw 1 20 1"; anything else with a % is a name."""
    found = re.fullmatch(r"([^%]*)%(0?\d?)d([^%]*?)\s+(-?\d{1,6})\s+(-?\d{1,6})\s+(-?\d{1,6})(?:\s+\d+)?", named)
    if not found:
        return []
    before, width, after, first, last, step = found.groups()
    stride = int(step) or 1
    numbers = range(int(first), int(last) + (1 if stride > 0 else -1), stride)
    return [f"{before}{format(number, width + 'd')}{after}" for number in numbers]
