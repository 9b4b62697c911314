"""MRC and CCP4 maps: mrcfile's names and types of the header; cell angles, starts, axis order and stacks of volumes.

References
----------
.. [1] A. Cheng et al., "MRC2014: Extensions to the MRC format header for electron cryo-microscopy and tomography",
       J. Struct. Biol. 192(2), 2015. https://www.ccpem.ac.uk/mrc-format/mrc2014/
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats
from illumgrid.io.readers.limits import check_axes, check_size
from illumgrid.io.readers.source import AGAIN, Source, finish, opened, skip
from illumgrid.io.readers.stored import Note, Stored, Wanted, following, pick
from illumgrid.io.readers.windows import need, read_part

HEADER = 1024


def read(source: Source, wanted: Wanted) -> Stored:
    """Read one volume; of a stack of volumes the user chooses (array)."""
    with opened(source) as stream:
        block = stream.read(HEADER)
        if len(block) < HEADER:
            raise BadInput(f"ends within its header; {AGAIN}")
        header = _header(block)
        dtype = _dtype(header)
        columns, rows, sections = (int(header[name]) for name in ("nx", "ny", "nz"))
        shape, notes = (columns, rows, sections), _axis_notes(header)
        count = _volumes(header, sections)
        number = pick(wanted.array, "array", [f"volume {n}" for n in range(count)] if count > 1 else [""])
        if min(shape) < 1:
            raise BadInput(
                f"its header promises {'x'.join(map(str, shape))} voxels; expected positive numbers; {AGAIN}"
            )
        check_axes((columns, rows, sections // count))
        order = _order(header)
        start = HEADER + max(0, int(header["nsymbt"]))
        size = math.prod(shape) * dtype.itemsize
        depth = sections // count
        kept = wanted.spans([(columns, rows, depth)[axis] for axis in order])
        spans = [kept[order.index(axis)] for axis in range(3)]
        spans[2] = replace(spans[2], first=spans[2].first + number * depth, last=spans[2].last + number * depth)
        check_size(start + size, source.most, need(dtype, shape, spans))
        skip(stream, start - HEADER)
        values = read_part(stream, dtype, shape, spans)
        more = finish(stream)
    origin, steps, starts, placed = _place(header, order)
    whole = tuple((columns, rows, depth)[axis] for axis in order)
    return Stored(
        values.transpose(order),
        origin,
        steps,
        unit="Å",
        notes=(*notes, *following(more), *placed),
        whole=whole,
        start=starts,
    )


def _header(block: bytes) -> Any:
    """The header in the byte order in which it is valid: the machine stamp of old files is unreliable."""
    from mrcfile.dtypes import HEADER_DTYPE

    for order in "<>":
        header = np.frombuffer(block, HEADER_DTYPE.newbyteorder(order))[0]
        if 0 <= header["mode"] <= 255 and 0 < header["nx"] < 1 << 24 and 0 < header["ny"] < 1 << 24:
            return header
    raise BadInput(f"does not begin like an MRC file; expected a mode and sizes; {AGAIN}")


def _dtype(header: Any) -> np.dtype[Any]:
    """Type of the numbers; mode 0 is signed, by the standard, unless the header's own extremes contradict."""
    from mrcfile.utils import dtype_from_mode

    mode = int(header["mode"])
    if mode in (3, 4):
        raise BadInput(f"holds complex numbers (mode {mode}, a Fourier transform); expected a map; save that")
    try:
        dtype = np.dtype(dtype_from_mode(mode))
    except ValueError:
        raise BadInput(f"its mode is {mode}; expected 0, 1, 2, 6 or 12; save it as one of those") from None
    if mode == 0 and header["dmin"] >= 0 and header["dmax"] > 127:
        dtype = np.dtype("u1")
    placed: np.dtype[Any] = dtype.newbyteorder(header.dtype["nx"].byteorder)
    return placed


def _volumes(header: Any, sections: int) -> int:
    """How many volumes lie end to end: space group 401 and beyond."""
    depth = int(header["mz"])
    if int(header["ispg"]) < 401:
        return 1
    if depth < 1 or sections % depth:
        raise BadInput(f"a stack of {sections} sections in volumes of {depth}; expected a multiple; correct its header")
    return sections // depth


def _order(header: Any) -> tuple[int, int, int]:
    """Which axis of the file (column, row, section) is x, y and z."""
    stored = tuple(int(header[name]) for name in ("mapc", "mapr", "maps"))
    if stored == (0, 0, 0):
        stored = (1, 2, 3)
    if sorted(stored) != [1, 2, 3]:
        raise BadInput(f"its axes are stored in the order {stored}; expected each of 1, 2, 3; correct its header")
    x, y, z = (stored.index(axis) for axis in (1, 2, 3))
    return x, y, z


def _axis_notes(header: Any) -> tuple[Note, ...]:
    if int(header["mapc"]) == int(header["mapr"]) == int(header["maps"]) == 0:
        return (
            ("placement", "does not state the order of its axes; columns, rows, sections were assumed to be x, y, z"),
        )
    if int(header["ispg"]) == 0 and int(header["mz"]) == 1 and int(header["nz"]) > 1:
        return (("file", "calls itself a stack of images; they were read as slices of a volume"),)
    return ()


def _place(header: Any, order: tuple[int, int, int]) -> tuple[Floats, Floats, Floats | None, tuple[Note, ...]]:
    """Origin, steps and starts: the cell over its sampling; the origin in the header, or else by the starts."""
    notes: tuple[Note, ...] = ()
    cell, angles = (
        np.array([float(header[name][k]) for k in keys])
        for name, keys in (("cella", "xyz"), ("cellb", ("alpha", "beta", "gamma")))
    )
    sampling = np.array([int(header[name]) for name in ("mx", "my", "mz")], float)
    held = np.array([int(header[name]) for name in ("nx", "ny", "nz")], float)[list(order)]
    sampling = np.where(sampling > 0, sampling, held)
    spacing = cell / sampling
    if not (np.isfinite(spacing).all() and (spacing > 0).all()):
        notes = (("spacing", "does not state the size of its cell; 1, 1, 1 was assumed; give --spacing"),)
        spacing = np.ones(3)
    if not np.isfinite(angles).all() or not ((angles > 0) & (angles < 180)).all():
        if np.any(angles):
            said = ", ".join(f"{a:g}" for a in angles)
            notes = (*notes, ("placement", f"its cell angles are {said} degrees; right angles were assumed"))
        angles = np.full(3, 90.0)
    steps = _cell(angles) * spacing
    starts = np.array([int(header[name]) for name in ("nxstart", "nystart", "nzstart")], float)[list(order)]
    origin = np.array([float(header["origin"][axis]) for axis in "xyz"])
    by_starts = steps @ starts
    if not origin.any():
        return by_starts, steps, starts, notes
    if starts.any() and np.abs(origin - by_starts).max() > 0.5 * spacing.max():
        notes = (*notes, ("placement", "its origin and its starts differ; the origin was used"))
    return origin, steps, None, notes


def _cell(angles: Floats) -> NDArray[np.float64]:
    """Unit vectors of a cell: the first along x, the second in the plane of x and y (the convention of CCP4)."""
    alpha, beta, gamma = (0.0 if angle == 90 else math.cos(math.radians(angle)) for angle in angles)
    sine = math.sqrt(1 - gamma**2)
    y = (alpha - beta * gamma) / sine
    return np.array([[1, gamma, beta], [0, sine, y], [0, 0, math.sqrt(max(0.0, 1 - beta**2 - y**2))]])
