"""NIfTI-1, NIfTI-2 and Analyze 7.5: header and placement by nibabel, whose rule for qform and sform is followed."""

import gzip
import math
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.io.readers.limits import check_axes, check_size
from illumgrid.io.readers.reports import captured, plain
from illumgrid.io.readers.source import Source, find_source, finish, opened, skip
from illumgrid.io.readers.stored import Note, Stored, Wanted, following, pick
from illumgrid.io.readers.windows import Span, need, read_part, single

TO_LPS = np.diag([-1.0, -1.0, 1.0])
"""NIfTI's world is RAS."""

UNITS = {"mm": "mm", "micron": "µm", "meter": "m"}

FAR = 0.1
"""Voxels by which qform and sform may place a corner differently without a word."""

SAME = 1e-4
"""Where they differ by less, by rounding, the qform is taken: its axes are orthonormal by construction."""


def read(source: Source, wanted: Wanted) -> Stored:
    """Read one volume: its time step (fourth axis) and its channel (fifth) are chosen by the user."""
    from nibabel.spatialimages import HeaderDataError

    try:
        return _read(source, wanted)
    except HeaderDataError as problem:
        raise BadInput(
            f"its header is not that of a NIfTI file ({problem}); expected a valid one; correct it"
        ) from None


def _read(source: Source, wanted: Wanted) -> Stored:
    head, data = _pair(source)
    with captured("nibabel.global") as reports, opened(head) as stream:
        header = _header(stream)
        alone = data is head
        dtype, shape = header.get_data_dtype(), tuple(int(n) for n in header.get_data_shape())
        if dtype.kind not in "biuf" or dtype.itemsize > 8:
            what = "a complex number" if dtype.kind == "c" else f"of the type {dtype}"
            raise BadInput(f"each voxel is {what}; expected one real number; save the magnitude or one channel")
        if len(shape) < 3 or min(shape) < 1 or math.prod(shape[5:]) != 1:
            check_axes(shape)
        time = pick(wanted.time, "time", [""] * (shape[3] if len(shape) > 3 else 1))
        channel = pick(wanted.channel, "channel", [""] * (shape[4] if len(shape) > 4 else 1))
        check_axes(shape[:3])
        place, notes = _place(header)
        spans = [*wanted.spans(shape[:3]), single(time), single(channel), single(0), single(0)][: len(shape)]
        slope, intercept, more = _scaling(header)
        if alone:
            values, left = _voxels(stream, head, header, header.sizeof_hdr, dtype, shape, spans)
        else:
            with opened(data) as other:
                values, left = _voxels(other, data, header, 0, dtype, shape, spans)
    more = (*more, *(("file", f"nibabel reports: {plain(text)}") for text in reports[:3]))
    unit = UNITS.get(header.get_xyzt_units()[0]) if hasattr(header, "get_xyzt_units") else None
    values = values.reshape(values.shape[:3], order="F")
    spacing = np.array(header.get_zooms()[:3], float)
    return Stored(
        values, *place, slope, intercept, spacing, unit or "mm", (*notes, *more, *following(left)), whole=shape[:3]
    )


def _pair(source: Source) -> tuple[Source, Source]:
    """The header and the data: one file, or .hdr and .img side by side, either of them perhaps gzipped."""
    if source.ending not in (".hdr", ".img"):
        return source, source
    wanted = ".img" if source.ending == ".hdr" else ".hdr"
    stem = Path(source.name).stem.lower()
    for file in sorted(source.file.parent.iterdir()):
        if file.name.lower() in (stem + wanted, f"{stem}{wanted}.gz") and file.is_file():
            other = find_source(file)
            # Raw data may begin like a gzip file by chance: here the name decides.
            other = replace(other, packed=other.packed and file.suffix.lower() == ".gz")
            return (source, other) if wanted == ".img" else (other, source)
    if source.head[344:348] == b"n+1\0":
        return source, source
    raise BadInput(f"its other half, {Path(source.name).stem}{wanted}, is not there; expected both files; copy both")


def _header(stream: IO[bytes]) -> Any:
    """NIfTI-1, NIfTI-2 or Analyze, in either byte order."""
    import nibabel

    kind: Any
    start = stream.read(4)
    sizes = {int.from_bytes(start, order) for order in ("little", "big")}
    if 540 in sizes:
        kind, length = nibabel.Nifti2Header, 540
    elif 348 in sizes:
        kind, length = nibabel.Nifti1Header, 348
    else:
        raise BadInput(
            "does not begin like a NIfTI or Analyze header; expected 348 or 540 as its size; check what it is"
        )
    block = start + stream.read(length - 4)
    if len(block) < length:
        raise BadInput("ends within its header; expected a whole file; copy or write it again")
    if length == 348 and block[344:348] not in (b"n+1\0", b"ni1\0"):
        kind = nibabel.Spm99AnalyzeHeader
    header: Any = kind(block, check=False)
    header.check_fix(error_level=40)
    header.sizeof_hdr = length
    return header


def _scaling(header: Any) -> tuple[float, float, tuple[Note, ...]]:
    """Slope and intercept; a slope of 0 or NaN means none, by the standard."""
    if not hasattr(header, "get_slope_inter"):
        return 1.0, 0.0, ()
    slope, intercept = header.get_slope_inter()
    return (1.0, 0.0, ()) if slope is None else (float(slope), float(intercept or 0.0), ())


def _place(header: Any) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], tuple[Note, ...]]:
    """Origin and steps in LPS, by sform, else qform, else the spacing alone; and where they differ."""
    if not hasattr(header, "get_qform"):
        return in_lps(header.get_best_affine()), (("placement", f"is an Analyze file, {_UNPLACED}"),)
    qform, sform = header.get_qform(coded=True)[0], header.get_sform(coded=True)[0]
    if sform is None and qform is None:
        return in_lps(header.get_base_affine()), (("placement", f"sets neither qform nor sform, {_UNPLACED}"),)
    if sform is None or qform is None:
        return in_lps(qform if sform is None else sform), ()
    corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(header.get_data_shape()[:3]) - 1)
    between = corners @ (sform - qform)[:3, :3].T + (sform - qform)[:3, 3]
    far = float(np.linalg.norm(between, axis=1).max() / min(header.get_zooms()[:3]))
    if far < SAME:
        return in_lps(qform), ()
    text = f"its qform and sform place a voxel up to {far:.3g} voxels differently; the sform was used, as nibabel does"
    return in_lps(sform), ((("placement", text),) if far > FAR else ())


_UNPLACED = (
    "which does not state the orientation of its axes: x to the left and the middle at 0 was assumed, as nibabel does"
)


def in_lps(affine: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Origin and steps in LPS of a matrix that gives RAS."""
    return TO_LPS @ affine[:3, 3] + 0.0, TO_LPS @ affine[:3, :3] + 0.0


def _voxels(
    stream: IO[bytes], data: Source, header: Any, at: int, dtype: np.dtype[Any], shape: tuple[int, ...],
    spans: list[Span],
) -> tuple[NDArray[Any], int]:  # fmt: skip
    """The values from vox_offset on, where `at` bytes have been read, and how many bytes follow them."""
    start = max(int(header["vox_offset"]), at)
    size = math.prod(shape) * dtype.itemsize
    check_size(start + size, data.most, need(dtype, shape, spans))
    try:
        skip(stream, start - at)
        return read_part(stream, dtype, shape, spans), finish(stream)
    except gzip.BadGzipFile as problem:
        raise BadInput(f"its packed data are damaged ({problem}); expected a whole file; copy it again") from None
