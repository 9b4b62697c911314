"""NumPy's own files: .npy and .npz. Nothing is unpickled."""

import io
import struct
import warnings
import zipfile
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.io.readers.limits import DEFLATE, check_axes, check_size
from illumgrid.io.readers.source import Source, finish, opened, read_array, seekable
from illumgrid.io.readers.stored import Choice, Stored, Wanted, pick
from illumgrid.io.readers.windows import Span, need, read_part, single

Header = tuple[tuple[int, ...], bool, np.dtype[Any], int]
"""Shape, whether in Fortran order, dtype, and how many bytes come before the data."""


def read(source: Source, wanted: Wanted) -> Stored:
    """Read a .npy file, or one 3D array of a .npz file: the only one, that named `values`, or that of `--array`."""
    if source.head.startswith(b"PK"):
        with seekable(source) as stream, zipfile.ZipFile(stream) as pack:
            return _read_npz(pack, wanted, source.size * DEFLATE)
    if wanted.array is not None:
        raise BadInput("--array came with a .npy file, which holds one array; leave --array out")
    with opened(source) as stream:
        values, whole = _read_npy(stream, source.most, wanted)
    return Stored(values, np.zeros(3), np.eye(3), whole=whole)


def _read_npz(pack: zipfile.ZipFile, wanted: Wanted, most: int) -> Stored:
    members = {info.filename[:-4]: info for info in pack.infolist() if info.filename.endswith(".npy")}
    heads = {name: _head_of(pack, info) for name, info in members.items()}
    name = _choose({name: head[0] for name, head in heads.items()}, wanted.array)
    places = {key: _place(pack, members[key]) for key in ("origin", "spacing", "direction") if key in members}
    info = members[name]
    unpacked = info.compress_size * (DEFLATE if info.compress_type == zipfile.ZIP_DEFLATED else 1)
    with pack.open(info) as stream:  # zipfile compares the checksum where the member ends
        values, whole = _read_npy(stream, min(most, info.file_size, unpacked), wanted)
    spacing = places.get("spacing", np.ones(3))
    if spacing.shape != (3,) or not np.isfinite(spacing).all() or not (spacing > 0).all():
        raise BadInput(f"spacing is {spacing.tolist()}; expected three positive numbers (a flip belongs in direction)")
    direction = places.get("direction", np.eye(3))
    if direction.shape != (3, 3):
        raise BadInput(f"direction is {direction.tolist()}; expected a 3x3 matrix whose columns are orthonormal")
    return Stored(values, places.get("origin", np.zeros(3)), direction * spacing, whole=whole)


def _choose(shapes: dict[str, tuple[int, ...]], array: Choice) -> str:
    """Name of the array that is the volume."""
    cubes = [name for name, shape in shapes.items() if len(shape) in (3, 4) and min(shape[:2]) > 1 and shape != (3, 3)]
    if array is None and "values" in shapes:
        return "values"
    if not cubes:
        found = ", ".join(f"{name} {shape}" for name, shape in list(shapes.items())[:8]) or "none"
        raise BadInput(f"its arrays are: {found}; expected one with three axes")
    if isinstance(array, str) and array in cubes:
        return array
    labels = [f"{name} {'x'.join(map(str, shapes[name]))}" for name in cubes]
    return cubes[pick(array, "array", labels)]


def _head_of(pack: zipfile.ZipFile, info: zipfile.ZipInfo) -> Header:
    with pack.open(info) as stream:
        return header(stream)


def _place(pack: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[np.float64]:
    with pack.open(info) as stream:
        shape, fortran, dtype, _ = header(stream)
        if dtype.kind not in "iuf" or shape not in ((3,), (3, 3)):
            raise BadInput(f"{info.filename} has shape {shape}, dtype {dtype}; expected 3 or 3x3 numbers; leave it out")
        return read_array(stream, dtype, shape, "F" if fortran else "C").astype(float)


def _read_npy(stream: IO[bytes], most: int, wanted: Wanted) -> tuple[NDArray[Any], tuple[int, ...]]:
    """The selection from the one array of a .npy stream of at most `most` bytes, and the shape of the whole array."""
    shape, fortran, dtype, start = header(stream)
    if dtype.kind not in "biuf":
        raise BadInput(f"the values have dtype {dtype}; expected real numbers; save the magnitude or one component")
    if not 3 <= len(shape) <= 5 or min(shape) < 1:
        check_axes(shape)
    count = int(np.prod([float(n) for n in shape]))
    axes, spans = three_axes(shape, wanted)
    space = tuple(shape[axis] for axis in axes)
    check_axes(space)
    kept = wanted.spans(space)
    for axis, span in zip(axes, kept):
        spans[axis] = span
    check_size(start + count * dtype.itemsize, most, need(dtype, shape, spans))
    values = read_part(stream, dtype, shape, spans, "F" if fortran else "C")
    finish(stream, spare=0)
    return values.reshape([span.count for span in kept]), space


def three_axes(shape: tuple[int, ...], wanted: Wanted) -> tuple[list[int], list[Span]]:
    """Which axes are x, y and z, and the index along each other axis.

    Of more than three axes `--time N` takes [N, ...], `--channel N` [..., N]; axes of length 1 are dropped.
    """
    axes, spans = list(range(len(shape))), [single(0)] * len(shape)
    for option, end in (("time", 0), ("channel", -1)):
        given, many = getattr(wanted, option), len(axes) > 3
        if given is not None:
            number = pick(given, option, [""] * (shape[axes[end]] if many else 1))
            if many:
                spans[axes.pop(end)] = single(number)
    while len(axes) > 3 and 1 in (shape[axes[0]], shape[axes[-1]]):
        axes.pop(0 if shape[axes[0]] == 1 else -1)
    if len(axes) > 3:
        raise BadInput(
            f"has {len(shape)} axes ({'x'.join(map(str, shape))}); expected three, x, y and z; choose one time step "
            "along the first axis with --time N, or one channel along the last with --channel N"
        )
    return axes, spans


def header(stream: IO[bytes]) -> Header:
    """The header of a .npy stream, which is left at its data."""
    start = stream.read(12)
    if len(start) < 12 or not start.startswith(b"\x93NUMPY"):
        raise BadInput("does not begin like a .npy array; expected what numpy.save writes; write it again")
    wide = start[6] > 1
    length: int = struct.unpack("<I", start[8:])[0] + 2 if wide else struct.unpack("<H", start[8:10])[0]
    if length > 10_000:  # as in NumPy: a longer header could block the parser
        raise BadInput(f"its .npy header claims {length} bytes; expected at most 10000; write it again")
    text = io.BytesIO(start[8:] + stream.read(length - 2))
    parse = np.lib.format.read_array_header_2_0 if wide else np.lib.format.read_array_header_1_0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Python 2 wrote sizes like 3L, which are valid, too
        shape, fortran, dtype = parse(text)
    return shape, fortran, dtype, 10 + length
