"""How a volume stores its values: in their own type if that is small, with a slope and intercept."""

import mmap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

NATIVE = tuple(map(np.dtype, ("uint8", "int8", "uint16", "int16", "float32")))
"""Types of values that are stored as given: single precision represents all their numbers."""

DIGITS = 1e-5
"""Share of the span of a field that rounding to single precision may cost."""


def as_stored(values: NDArray[Any], slope: float, intercept: float) -> tuple[NDArray[Any], float, float]:
    """The same field with values of a `NATIVE` type, unchanged if one represents them well, and a positive slope."""
    values, slope, intercept = _upward(values, slope, intercept)
    native = values.dtype.newbyteorder("=")
    if values.dtype == np.bool_:
        return values.astype(np.uint8), slope, intercept
    if native in NATIVE or native == np.float16:
        values = values.astype(np.float32 if native == np.float16 else native, copy=False)
        return _whole_numbers(values, slope, intercept)
    values, slope, intercept = _for_single_precision(values, slope, intercept)
    with np.errstate(over="ignore"):  # a float64 beyond float32 becomes infinite, which is handled
        return values.astype(np.float32, copy=False), slope, intercept


def _upward(values: NDArray[Any], slope: float, intercept: float) -> tuple[NDArray[Any], float, float]:
    """The same field with a positive slope; integers of 8 or 16 bits are inverted within their type."""
    if slope > 0:
        return values, slope, intercept
    if values.dtype.newbyteorder("=") in NATIVE and values.dtype.kind in "iu":
        ends = np.iinfo(values.dtype)  # ~v = min + max - v
        return ~values, -slope, intercept + slope * (ends.min + ends.max)
    return -values.astype(np.float32 if values.dtype in NATIVE else float), -slope, intercept


def _whole_numbers(values: NDArray[Any], slope: float, intercept: float) -> tuple[NDArray[Any], float, float]:
    """The same field without slope and intercept, if these are whole and h fits into a type of the same size."""
    kind = values.dtype
    plain = (slope, intercept) == (1, 0)
    if kind.kind == "f" or plain or not (slope.is_integer() and intercept.is_integer() and slope < 2**32):
        return values, slope, intercept
    low, high = (int(end) * int(slope) + int(intercept) for end in (values.min(), values.max()))
    for other in (kind, np.dtype(f"u{kind.itemsize}"), np.dtype(f"i{kind.itemsize}")):
        if np.iinfo(other).min <= low and high <= np.iinfo(other).max:
            whole = np.empty(values.shape, other)  # intermediate results may wrap around; the final ones fit
            np.multiply(values, int(slope), out=whole, dtype=np.int64, casting="unsafe")
            np.add(whole, int(intercept), out=whole, dtype=np.int64, casting="unsafe")
            return whole, 1.0, 0.0
    return values, slope, intercept


def single_precision_holds(low: float, high: float) -> bool:
    """Whether rounding to single precision costs values from `low` to `high` at most `DIGITS` of half their span."""
    largest, half = max(abs(low), abs(high)), high / 2 - low / 2  # halves: the whole may overflow
    return largest * float(np.finfo(np.float32).eps) / 4 <= DIGITS * half and 1e-30 <= largest <= 1e30


def _for_single_precision(values: NDArray[Any], slope: float, intercept: float) -> tuple[NDArray[Any], float, float]:
    """The same field with values that single precision represents well, unchanged wherever possible."""
    wide = values.astype(np.float64) if values.dtype != np.float64 else values
    good = np.isfinite(wide)
    if not good.any():
        return values, slope, intercept
    low, high = (float(f(wide, where=good, initial=i)) for f, i in ((np.min, np.inf), (np.max, -np.inf)))
    largest, span = max(abs(low), abs(high)), high / 2 - low / 2  # halves: the whole may overflow
    fits = largest * float(np.finfo(np.float32).eps) / 4 <= DIGITS * span
    if span == 0 or single_precision_holds(low, high):
        return values, slope, intercept
    with np.errstate(over="ignore"):
        if np.array_equal(wide[good].astype(np.float32), wide[good]):
            return values, slope, intercept
    middle = 0.0 if fits else low + span
    scale = float(2.0 ** np.clip(np.frexp(span)[1], -1022, 1022))
    return (wide - middle) / scale, slope * scale, intercept + slope * middle


@contextmanager
def read_at_random(arrays: Sequence[NDArray[Any]]) -> Iterator[None]:
    """While this lasts, the system reads single pages of arrays that are paged from a file, as rays need them.

    Otherwise it reads some megabytes around each page, and has to drop them again if memory is scarce.
    """
    files = [file for file in map(_paged_from, arrays) if file is not None and hasattr(file, "madvise")]
    for file in files:
        file.madvise(mmap.MADV_RANDOM)
    try:
        yield
    finally:
        for file in files:
            file.madvise(mmap.MADV_NORMAL)


def _paged_from(values: Any) -> mmap.mmap | None:
    """The mapped file that an array lies in, if any."""
    while isinstance(values, np.ndarray):
        values = values.base
    return values if isinstance(values, mmap.mmap) else None
