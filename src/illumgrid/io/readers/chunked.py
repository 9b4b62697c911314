"""Arrays that are stored in chunks: a box of three of their axes, read some chunks at a time."""

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.io.readers.limits import check_axes, check_memory
from illumgrid.io.readers.paged import room
from illumgrid.io.readers.stored import Wanted, pick
from illumgrid.io.readers.windows import Span, take

AT_ONCE = 1 << 26
"""Bytes, or one chunk, that are read at a time."""

UNITS = {
    "micrometer": "µm", "micron": "µm", "microns": "µm", "um": "µm", "µm": "µm", "millimeter": "mm", "mm": "mm",
    "nanometer": "nm", "nm": "nm", "angstrom": "Å", "meter": "m", "centimeter": "cm",
}  # fmt: skip


def axes_of(names: Sequence[str | None]) -> list[int] | None:
    """Which axes are x, y and z by their names; None where they do not say."""
    found = [str(name).lower() for name in names]
    return [found.index(axis) for axis in "xyz"] if all(found.count(axis) == 1 for axis in "xyz") else None


def by_name(names: Sequence[str], shape: Sequence[int], wanted: Wanted) -> dict[int, int]:
    """The index along axes that are not of space: one time step, one channel, and the only place of others."""
    chosen = {}
    for axis, (name, count) in enumerate(zip(names, shape)):
        if name in ("x", "y", "z"):
            continue
        option = {"t": "time", "time": "time", "c": "channel", "channel": "channel"}.get(name)
        if option is None and count > 1:
            raise BadInput(f"its axis {name!r} has {count} places; expected x, y, z, and t or c; cut out one volume")
        chosen[axis] = 0 if option is None else pick(getattr(wanted, option), option, [""] * count)
    for option in ("time", "channel"):
        known = [{"t": "time", "c": "channel"}.get(name, name) for name in names]
        if getattr(wanted, option) is not None and option not in known:
            pick(getattr(wanted, option), option, [""])
    return chosen


def read_box(
    array: Any, chunks: Sequence[int], axes: Sequence[int], chosen: Mapping[int, int], spans: Sequence[Span]
) -> NDArray[Any]:
    """A part of a stored array as (nx, ny, nz), in C order.

    Parameters
    ----------
    array
        Has a shape and a dtype, and gives arrays for slices.
    chunks : sequence of int
        Shape of what is stored as a whole.
    axes : (3,) sequence of int
        Axes of the array that are x, y and z.
    chosen : mapping
        For each other axis the number that is taken.
    spans : (3,) sequence of Span
        What is kept of x, y and z.
    """
    kind = np.dtype(array.dtype)
    if kind.kind not in "biuf":
        raise BadInput(f"the values have dtype {kind}; expected real numbers; save the magnitude or one component")
    check_axes([array.shape[axis] for axis in axes])
    check_memory(2 * math.prod(chunks) * kind.itemsize + min(AT_ONCE, math.prod(array.shape) * kind.itemsize))
    averaged = any(span.block > 1 for span in spans)
    mean = np.dtype(float if kind == np.float64 else np.float32)
    out = room([span.count for span in spans], mean if averaged else kind.newbyteorder("="))
    tile = [max(1, chunks[axis] // span.block) for axis, span in zip(axes, spans)]  # in voxels of the result
    size = kind.itemsize * math.prod(n * span.block for n, span in zip(tile, spans))
    for k in sorted(range(3), key=lambda k: -axes[k]):  # the axis that is contiguous in the file grows first
        grown = min(spans[k].count, tile[k] * max(1, AT_ONCE // size))
        size, tile[k] = size // tile[k] * grown, grown
    starts = [range(0, span.count, n) for span, n in zip(spans, tile)]
    for corner in product(*starts):
        here = [range(a, min(a + n, span.count)) for a, n, span in zip(corner, tile, spans)]
        index: list[Any] = [chosen.get(axis, 0) for axis in range(len(array.shape))]
        for axis, span, part in zip(axes, spans, here):
            index[axis] = slice(span.first + part.start * span.block, span.first + part.stop * span.block)
        block = np.asarray(array[tuple(index)])
        block = block.transpose(np.argsort(np.argsort(axes)).tolist()) if list(axes) != sorted(axes) else block
        means = [Span(0, len(part) * span.block, span.block) for part, span in zip(here, spans)]
        out[tuple(slice(part.start, part.stop) for part in here)] = take(block, means)
    return out
