"""Parts of arrays, selected during reading: a box of voxels, and means over blocks of them.

The rest is skipped in the file, or unpacked and dropped; memory holds only the part, and a slab of the file.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from illumgrid.io.readers.paged import resident
from illumgrid.io.readers.source import read_array, skip

SLAB = 1 << 16
"""Least number of values that are read at once."""


@dataclass(frozen=True)
class Span:
    """The selection along one axis: `first` up to, not including, `last`, in means over `block` at a time."""

    first: int
    last: int
    block: int = 1

    @property
    def count(self) -> int:
        """Number of values that remain."""
        return (self.last - self.first) // self.block


def single(number: int) -> Span:
    """A single index."""
    return Span(number, number + 1)


def need(dtype: DTypeLike, shape: Sequence[int], spans: Sequence[Span]) -> int:
    """Bytes of memory that `read_part` takes."""
    kept, width = math.prod(span.count for span in spans), np.dtype(dtype).itemsize
    if all(span == Span(0, n) for span, n in zip(spans, shape)):
        return resident(kept * width)
    averaged = any(span.block > 1 for span in spans)
    return kept * (12 if averaged else width) + (2 * SLAB + max(shape[0] * shape[-1], 1)) * (8 + width)


def take(values: NDArray[Any], spans: Sequence[Span]) -> NDArray[Any]:
    """The selected part of an array."""
    if all(span.block == 1 for span in spans):
        return values[tuple(slice(span.first, span.last) for span in spans)]
    return means(sums(values, spans), spans, values.dtype)


def sums(values: NDArray[Any], spans: Sequence[Span]) -> NDArray[np.float64]:
    """The selected part of an array, summed over its blocks."""
    part = values[tuple(slice(span.first, span.first + span.count * span.block) for span in spans)]
    total = np.zeros([span.count for span in spans])
    for offset in np.ndindex(*(span.block for span in spans)):
        total += part[tuple(slice(o, None, span.block) for o, span in zip(offset, spans))]
    return total


def means(total: NDArray[np.float64], spans: Sequence[Span], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Means from sums over blocks, for values of a type: in single precision unless the type is double."""
    total /= math.prod(span.block for span in spans)
    return total if dtype.kind == "f" and dtype.itemsize == 8 else total.astype(np.float32)


def read_part(
    stream: IO[bytes], dtype: DTypeLike, shape: Sequence[int], spans: Sequence[Span], order: Literal["C", "F"] = "F"
) -> NDArray[Any]:
    """The selected part of the next array in a stream, which is then behind the whole array.

    Call `check_size` first, with the memory that `need` says.
    """
    if all(span == Span(0, n) for span, n in zip(spans, shape)):
        return read_array(stream, dtype, shape, order)
    if order == "C":
        return read_part(stream, dtype, shape[::-1], spans[::-1]).transpose()
    kind, averaged = np.dtype(dtype), any(span.block > 1 for span in spans)
    inner = next((n for n in range(1, len(shape)) if math.prod(shape[:n]) >= SLAB), len(shape) - 1)
    slab, outer = tuple(shape[:inner]), tuple(shape[inner:])
    fast, slow = spans[:inner], spans[inner:]
    out = np.zeros([span.count for span in spans], float if averaged else kind, order="F")
    width, at = math.prod(slab) * kind.itemsize, 0
    for number in _wanted(outer, slow):
        skip(stream, (number - at) * width)
        values = read_array(stream, kind, slab)
        at = number + 1
        index = np.unravel_index(number, outer, order="F")
        place: Any = tuple((int(k) - span.first) // span.block for k, span in zip(index, slow))
        if averaged:
            out[(..., *place)] += sums(values, fast)
        else:
            out[(..., *place)] = take(values, fast)
    skip(stream, (math.prod(outer) - at) * width)
    return means(out, spans, kind) if averaged else out


def _wanted(shape: Sequence[int], spans: Sequence[Span]) -> list[int]:
    """Numbers of the selected slabs, in the order of the file."""
    marks = [
        (np.arange(n) >= span.first) & (np.arange(n) < span.first + span.count * span.block)
        for n, span in zip(shape, spans)
    ]
    kept = np.ones(1, bool)
    for mark in marks:
        kept = np.logical_and.outer(mark, kept).ravel()
    return [int(number) for number in np.flatnonzero(kept)]


def join(plane: Callable[[int], NDArray[Any]], span: Span) -> NDArray[Any]:
    """Stack the selected planes, by number, along the last axis."""
    out: NDArray[Any] | None = None
    for number in range(span.first, span.first + span.count * span.block):
        one = plane(number)
        if out is None:
            kind = one.dtype if span.block == 1 else np.dtype(float)
            out = np.zeros((*one.shape, span.count), kind, order="F")
        out[..., (number - span.first) // span.block] += one
    assert out is not None
    return out if span.block == 1 else means(out, [span], one.dtype)
