"""NumPy's own files: .npy and .npz. Nothing is unpickled."""

import io
import math
import struct
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.volume import Volume
from illumgrid.io.readers.sizes import AGAIN, CHUNK, DEFLATE, check_axes, check_size


def read_npy(stream: IO[bytes], most: int) -> NDArray[Any]:
    """Read the one array of a .npy stream that holds at most `most` bytes."""
    shape, fortran, dtype, start = _header(stream)
    if dtype.kind not in "biuf":
        raise BadInput(f"the values have dtype {dtype}; expected real numbers; save the magnitude or one component")
    check_axes(shape)
    count = math.prod(shape)
    check_size(start + count * dtype.itemsize, most, count * (dtype.itemsize + 4))
    return _fill(stream, shape, fortran, dtype)


def read_npz(file: Path, most: int) -> Volume:
    """Read the one 3D array of a .npz file, or that named `values`; the file unpacks to at most `most` bytes."""
    with zipfile.ZipFile(file) as pack:
        members = {info.filename[:-4]: info for info in pack.infolist() if info.filename.endswith(".npy")}
        shapes = {name: _shape(pack, info) for name, info in members.items()}
        cubes = ["values"] if "values" in shapes else [name for name, shape in shapes.items() if len(shape) == 3]
        if len(cubes) != 1:
            found = ", ".join(f"{name} {shape}" for name, shape in list(shapes.items())[:8]) or "none"
            raise BadInput(f"its arrays are: {found}; expected one with three axes; name the right one 'values'")
        places = {name: _place(pack, members[name]) for name in ("origin", "spacing", "direction") if name in members}
        info = members[cubes[0]]
        unpacked = info.compress_size * (DEFLATE if info.compress_type == zipfile.ZIP_DEFLATED else 1)
        with pack.open(info) as stream:
            return Volume(read_npy(stream, min(most, info.file_size, unpacked)), **places)


def _shape(pack: zipfile.ZipFile, info: zipfile.ZipInfo) -> tuple[int, ...]:
    with pack.open(info) as stream:
        return _header(stream)[0]


def _place(pack: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    with pack.open(info) as stream:
        shape, fortran, dtype, _ = _header(stream)
        if dtype.kind not in "iuf" or shape not in ((3,), (3, 3)):
            raise BadInput(f"{info.filename} has shape {shape}, dtype {dtype}; expected 3 or 3x3 numbers; leave it out")
        return _fill(stream, shape, fortran, dtype)


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Shape, whether in Fortran order, dtype, and how many bytes come before the data."""
    start = stream.read(12)
    if len(start) < 12 or not start.startswith(b"\x93NUMPY"):
        raise BadInput("does not begin like a .npy array; expected what numpy.save writes; write it again")
    wide = start[6] > 1
    length: int = struct.unpack("<I", start[8:])[0] + 2 if wide else struct.unpack("<H", start[8:10])[0]
    if length > 10_000:  # as NumPy: what is longer could hang the parser
        raise BadInput(f"its .npy header claims {length} bytes; expected at most 10000; write it again")
    text = io.BytesIO(start[8:] + stream.read(length - 2))
    parse = np.lib.format.read_array_header_2_0 if wide else np.lib.format.read_array_header_1_0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Python 2 wrote sizes like 3L, which are as good
        shape, fortran, dtype = parse(text)
    return shape, fortran, dtype, 10 + length


def _fill(stream: IO[bytes], shape: Sequence[int], fortran: bool, dtype: np.dtype[Any]) -> NDArray[Any]:
    flat = np.empty(math.prod(shape), dtype)
    raw = memoryview(flat.view(np.uint8))  # type: ignore[arg-type]
    done = 0
    while done < len(raw):
        got = stream.readinto(raw[done : done + CHUNK])  # type: ignore[attr-defined]
        if not got:
            raise BadInput(f"ends after {done} of {len(raw)} bytes of data; {AGAIN}")
        done += got
    if stream.read(1):
        raise BadInput(f"has more data than its {'x'.join(map(str, shape))} values; expected one array; write it again")
    return flat.reshape(shape, order="F" if fortran else "C")
