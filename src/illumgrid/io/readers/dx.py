"""OpenDX scalar fields (`.dx`), as APBS, VMD and Chimera write them: a strict reader of our own.

GridDataFormats, which reads them too, brings a dozen packages for forty lines. https://www.mdanalysis.org/GridDataFormats/
gridData/formats/OpenDX.html describes the part of the format that is in use.
"""

import math
import re
from collections.abc import Iterator
from typing import IO, Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats
from illumgrid.io.readers.limits import AS_FLOAT, check_axes, check_memory, check_size
from illumgrid.io.readers.source import AGAIN, Source, finish, opened, read_array, read_text
from illumgrid.io.readers.stored import Stored, Wanted

TYPES = {"double": "f8", "float": "f4", "int": "i4", "short": "i2", "unsigned byte": "u1", "byte": "u1"}


def read(source: Source, wanted: Wanted) -> Stored:
    """Read the one regular field of a file."""
    shape: tuple[int, ...] = ()
    origin = np.zeros(3)
    steps: list[Floats] = []
    with opened(source) as stream:
        for line in _head(stream):
            words = line.split()
            if "gridpositions" in line:
                shape = tuple(int(n) for n in _numbers(words[-3:], line))
                if "counts" not in line or min(shape) < 1:
                    raise BadInput(f"has the line {line[:60]!r}; expected counts NX NY NZ; {AGAIN}")
            elif words[0] == "origin":
                origin = _numbers(words[1:], line)
            elif words[0] == "delta":
                steps.append(_numbers(words[1:], line))
            elif re.search(r"\bclass\s+array\b", line) and "data follows" in line:
                break
        else:
            raise BadInput(f"ends before its data; {AGAIN}")
        if len(shape) != 3 or len(steps) != 3:
            raise BadInput(
                "does not state the size of its grid; expected gridpositions with three counts and three deltas"
            )
        check_axes(shape)
        count = math.prod(shape)
        dtype = _type(line, count)
        check_memory(count * (8 + AS_FLOAT))
        if dtype is None:
            check_size(count * 2, source.most, 0)  # a number and a space take two bytes at least
            values = read_text(stream, count)[0].reshape(shape)  # further objects describe how the points are connected
        else:
            check_size(count * dtype.itemsize, source.most, 0)
            values = read_array(stream, dtype, shape, "C")
        finish(stream)
    return Stored(values, origin, np.array(steps).T)


def _head(stream: IO[bytes]) -> Iterator[str]:
    """Lines that are neither empty nor comments."""
    for _ in range(10_000):
        line = stream.readline(4096)
        text = line.decode("utf-8", "replace").strip()
        if text and not text.startswith("#"):
            yield text
        if not line:
            return


def _numbers(words: list[str], line: str) -> Floats:
    try:
        found = np.array([float(word) for word in words])
    except ValueError:
        found = np.array([np.nan])
    if found.shape != (3,) or not np.isfinite(found).all():
        raise BadInput(f"has the line {line[:60]!r}; expected three numbers in it; {AGAIN}")
    return found


def _type(line: str, count: int) -> np.dtype[Any] | None:
    """Type of the numbers if they are binary, None if they are text."""
    items = re.search(r"\bitems\s+(\d{1,12})\b", line)
    rank = re.search(r"\brank\s+(\d+)", line)
    shape = re.search(r"\bshape\s+(\d+)", line)
    if items is None or int(items[1]) != count:
        raise BadInput(f"says {items[1] if items else 'nothing'} of the {count} values of its grid; {AGAIN}")
    if rank and int(rank[1]) > 0 and not (shape and int(shape[1]) == 1):
        raise BadInput("holds vectors; expected one number at each point (rank 0); save the magnitude or one component")
    if not re.search(r"\b(binary|ieee)\b", line):
        return None
    kind = re.search(r"\btype\s+(unsigned byte|byte|double|float|int|short)\b", line)
    order = ">" if "msb" in line else "<"
    return np.dtype(order + TYPES[kind[1] if kind else "float"])
