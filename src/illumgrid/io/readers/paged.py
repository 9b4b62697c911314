"""Arrays larger than a quarter of the free memory: a raw file itself, or a file without a name, paged by the system."""

import io
import math
import os
import shutil
from collections.abc import Sequence
from tempfile import TemporaryFile, gettempdir
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from illumgrid.errors import BadInput
from illumgrid.io.readers import limits

SHARE = 4
"""An array is kept in memory if it takes up to this fraction of the free memory (one part in so many)."""

TURNED = 1 << 28
"""Bytes of an array that are transposed at a time."""


def resident(size: int) -> int:
    """Bytes of memory that an array of this size takes: a paged one takes none that others could not have."""
    return size if size <= limits.free_memory() // SHARE else min(size, limits.CHUNK)


def room(shape: Sequence[int], dtype: DTypeLike, order: Literal["C", "F"] = "C") -> NDArray[Any]:
    """Zeros; a large array lies in a nameless file in the folder for temporary files, and disappears with the process.

    Raises
    ------
    BadInput
        If neither memory nor disk have room for it.
    """
    size = math.prod(map(int, shape)) * np.dtype(dtype).itemsize
    if size <= limits.free_memory() // SHARE:
        return np.zeros(tuple(shape), dtype, order)
    place = gettempdir()
    if size > shutil.disk_usage(place).free:
        raise BadInput(
            f"needs {limits.gigabytes(size)}, more than is free in memory or in {place}; expected less; set "
            "TMPDIR to a larger disk, or read a part with --crop or means over voxels with --downsample"
        )
    with TemporaryFile(prefix="illumgrid-") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)  # otherwise a disk that fills up later would end the process
        else:
            file.truncate(size)
        return np.asarray(np.memmap(file, dtype, "r+", shape=tuple(shape), order=order))


def mapped(stream: IO[bytes], dtype: DTypeLike, count: int) -> NDArray[Any] | None:
    """The next numbers of a raw file, (count,), read-only, which the system reads on access.

    None if that is not possible, or if they fit into memory: they are then read once, in case others change the file.
    The stream is behind them afterwards.
    """
    kind = np.dtype(dtype)
    plain = isinstance(stream, io.BufferedReader) and isinstance(stream.raw, io.FileIO)
    if not plain or not kind.isnative or count * kind.itemsize <= limits.free_memory() // SHARE:
        return None
    first = stream.tell()
    if first % kind.itemsize or first + count * kind.itemsize > os.fstat(stream.fileno()).st_size:
        return None
    found = np.memmap(stream, kind, "r", first, (count,))
    stream.seek(first + count * kind.itemsize)
    return np.asarray(found)


def settled(values: NDArray[Any]) -> NDArray[Any]:
    """The same values in C order and in the byte order of this machine; a large array is transposed in parts.

    An array that fits into memory is returned unchanged: callers transpose it.
    """
    native = values.dtype.newbyteorder("=")
    if (values.flags.c_contiguous and values.dtype.isnative) or values.nbytes <= limits.free_memory() // SHARE:
        return values
    out = room(values.shape, native)
    slow = int(np.argmax([abs(step) for step in values.strides]))
    rows = max(1, TURNED // max(1, values.nbytes // values.shape[slow]))
    for first in range(0, values.shape[slow], rows):
        some: Any = tuple(slice(first, first + rows) if axis == slow else slice(None) for axis in range(values.ndim))
        out[some] = values[some]
    return out
