"""TIFF stacks by tifffile: series, channels, time steps, many slices in one directory, folders of single slices."""

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.io.readers.limits import check_axes, check_memory, check_size
from illumgrid.io.readers.reports import captured, plain
from illumgrid.io.readers.source import AGAIN, Source, find_source, seekable
from illumgrid.io.readers.stored import Note, Stored, Wanted, pick
from illumgrid.io.readers.tiff_spacing import calibrated, channel_names
from illumgrid.io.readers.windows import Span, join, need, single, take

CODECS = {1, 5, 7, 8, 32773, 32946, 33003, 33005, 34712, 34925, 50000}
"""None, LZW, JPEG, deflate, packbits, deflate by its old number, JPEG 2000 by three numbers, LZMA, zstd."""

BOUNDED = {1: 1, 5: 4096, 8: 1032, 32773: 128, 32946: 1032}
"""Times its size that data of these codecs unpack to at most."""


LARGEST_TILE = 1 << 26
"""Bytes of a tile that may be larger than its page."""


def read(source: Source, wanted: Wanted) -> Stored:
    """Read one volume of a TIFF: series (array), channel and time step are chosen by the user."""
    with _opened_tiff(source) as (tiff, reports):
        number = _series(tiff, wanted)
        _refuse_damaged(reports)
        series, names = tiff.series[number], channel_names(tiff, number)
        order, chosen, notes = _three_axes(series.shape, series.axes, wanted, names)
        whole = tuple(series.shape[axis] for axis in order)
        check_axes(whole)
        kept = wanted.spans(whole)
        spans = [kept[order.index(axis)] if axis in order else single(chosen[axis]) for axis in range(series.ndim)]
        check_pages(tiff, series, spans)
        values = _part(series, spans)
        spacing, unit, more = calibrated(tiff, number)
        notes = (*notes, *more, *_serious(reports))
    rest = tuple(axis for axis in range(values.ndim) if axis not in order)
    values = values.transpose([*order, *rest]).reshape([span.count for span in kept])
    return Stored(values, np.zeros(3), np.diag(spacing), unit=unit, notes=notes, whole=whole)


def _part(series: Any, spans: Sequence[Span]) -> NDArray[Any]:
    """The selection from a series, page by page, where each page is one of its planes."""
    plane = series.keyframe.shape
    outer = series.ndim - len(plane)
    paged = outer > 0 and series.shape[outer:] == plane and len(series.pages) == math.prod(series.shape[:outer])
    if not paged or all(span == Span(0, n) for span, n in zip(spans, series.shape)):
        return take(real(series.asarray(maxworkers=1)), spans)

    def page(number: int) -> NDArray[Any]:
        return take(real(series.pages[number].asarray(maxworkers=1)), spans[outer:])

    def planes(axis: int, number: int) -> NDArray[Any]:
        """The part of all pages whose indices along the axes before `axis` are those of `number`."""
        if axis == outer:
            return page(number)
        return np.moveaxis(join(lambda k: planes(axis + 1, number * series.shape[axis] + k), spans[axis]), -1, 0)

    return planes(0, 0)


def read_folder(files: Sequence[Path], wanted: Wanted) -> Stored:
    """Stack single TIFF slices, in the order of the numbers in their names; those outside a crop are not opened."""
    ordered = sorted(files, key=lambda f: [(int(w), "") if w.isdecimal() else (-1, w) for w in _parts(f.name)])
    with _slice(ordered[0]) as (tiff, series):
        (rows, columns), dtype = series.shape, series.dtype
        spacing, unit, notes = calibrated(tiff, 0)
    if len(ordered) < 2:
        raise BadInput("holds one TIFF slice; expected at least 2; give the folder of the whole stack")
    whole = (columns, rows, len(ordered))
    check_axes(whole)
    across, down, along = spans = wanted.spans(whole)
    each = dtype.itemsize if along.block == 1 else 12
    check_memory(math.prod(span.count for span in spans) * each + 3 * rows * columns * dtype.itemsize)

    def plane(number: int) -> NDArray[Any]:
        with _slice(ordered[number]) as (tiff, series):
            if (series.shape, series.dtype) != ((rows, columns), dtype):
                raise BadInput("differs in size or type from the first slice; expected equal slices; move it elsewhere")
            check_pages(tiff, series)
            return take(real(series.asarray(maxworkers=1)), (down, across))

    values, notes = join(plane, along).transpose(1, 0, 2), (*notes, *_gaps(ordered))
    return Stored(values, np.zeros(3), np.diag(spacing), unit=unit, notes=notes, whole=whole)


@contextmanager
def _slice(file: Path) -> Iterator[tuple[Any, Any]]:
    """A file of a folder and its only series, a grey slice."""
    try:
        with _opened_tiff(find_source(file)) as (tiff, reports):
            series = tiff.series[0]
            _refuse_damaged(reports)
            if len(tiff.series) > 1 or series.ndim != 2:
                raise BadInput("is no single grey slice; expected only those; give it alone if it is a stack")
            yield tiff, series
    except BadInput as problem:
        raise BadInput(f"its slice {file.name} {problem}") from None


def _parts(name: str) -> list[str]:
    return re.split(r"(\d+)", name.lower())


def _gaps(files: Sequence[Path]) -> tuple[Note, ...]:
    """A note about missing slices, by the last numbers in the names."""
    numbers = [int(found[-1]) for file in files if (found := re.findall(r"\d+", file.stem))]
    if len(numbers) != len(files) or len(set(numbers)) < len(numbers):
        return ()
    steps = np.diff(numbers)
    if not len(steps) or (steps == steps[0]).all() or (steps <= 0).any():
        return ()
    at = int(np.argmax(steps))
    said = (
        f"slices are missing between {files[at].name} and {files[at + 1].name}; they are stacked as if there were none"
    )
    return (("file", said),)


@contextmanager
def _opened_tiff(source: Source) -> Iterator[tuple[Any, list[str]]]:
    """The file by tifffile, alone (an OME file may name others), and what tifffile reports."""
    import tifffile

    try:
        # tifffile reads on where pages or tags are lost, and reports it.
        with (
            captured("tifffile") as reports,
            seekable(source) as stream,
            tifffile.TiffFile(stream, name=source.name, _multifile=False) as tiff,
        ):
            _check_directories(tiff)
            yield tiff, reports
    except tifffile.TiffFileError as problem:
        raise BadInput(f"is not a whole TIFF ({plain(str(problem))}); {AGAIN}") from None


def _check_directories(tiff: Any) -> None:
    """Refuse directories that overlap: in a few kilobytes they could hold tags for hours."""
    file, form, total = tiff.filehandle, tiff.tiff, 0

    def number(count: int) -> int:
        return int.from_bytes(file.read(count), "little" if form.byteorder == "<" else "big")

    file.seek(form.offsetsize)
    at = number(form.offsetsize)
    while 0 < at < file.size:
        file.seek(at)
        length = form.tagnosize + number(form.tagnosize) * form.tagsize + form.offsetsize
        total += length
        if total > file.size:
            raise BadInput(f"the pages of this TIFF run in a circle or overlap; {AGAIN}")
        file.seek(at + length - form.offsetsize)
        at = number(form.offsetsize)
    file.seek(0)


def _refuse_damaged(reports: list[str]) -> None:
    for text in reports:
        if "circular" in text:
            raise BadInput(f"the pages of this TIFF run in a circle; {AGAIN}")
        if re.search("invalid page offset|invalid value offset|corrupt", text):
            raise BadInput(f"the TIFF ends before its last page, or is damaged ({plain(text)}); {AGAIN}")


def _serious(reports: list[str]) -> tuple[Note, ...]:
    """Reports of tifffile that a user should see."""
    serious = [text for text in reports if re.search(r"corrupt|invalid|missing|truncated|fail|raised", text)]
    return (("file", f"tifffile reports: {plain(serious[0])}"),) if serious else ()


def _series(tiff: Any, wanted: Wanted) -> int:
    """Number of the series that is the volume; thumbnails and the coarse levels of a pyramid do not count."""
    if not tiff.series:
        raise BadInput("a TIFF without images; expected slices; check how it was written")
    full = [n for n, s in enumerate(tiff.series) if not s.keyframe.is_reduced] or list(range(len(tiff.series)))
    whole = [tiff.series[n] for n in full]
    if tiff.is_imagej and whole[0].kind != "imagej":
        images = (tiff.imagej_metadata or {}).get("images", 0)
        if images > len(tiff.pages):
            raise BadInput(f"ends too early: ImageJ's description promises {images} images; {AGAIN}")
    names = [f"{s.name} {'x'.join(map(str, s.shape[::-1]))}" for s in whole]
    if len(whole) > 1 and wanted.array is None and {s.kind for s in whole} <= {"generic", "uniform"}:
        listed = ", ".join(f"{n} {name}" for n, name in enumerate(names[:8]))
        raise BadInput(f"its pages differ in size or form: {listed}; expected equal slices; choose some with --array N")
    return full[pick(wanted.array, "array", names)]


def check_pages(tiff: Any, series: Any, spans: Sequence[Span] | None = None) -> None:
    """Refuse codecs that no volume needs, and pages of which a part is not there or leaves the file."""
    pages = list(series.pages)
    if any(page is None for page in pages):
        lost = sum(page is None for page in pages)
        raise BadInput(f"{lost} of its {len(pages)} planes are in other files; expected one file; save it as one")
    first = series.keyframe
    if first.compression not in CODECS:
        raise BadInput(
            f"packed by {first.compression!r}; expected none, LZW, deflate, zstd or JPEG; save it as one of those"
        )
    tile = math.prod(first.chunks) * first.dtype.itemsize if first.is_tiled else 0
    if tile > max(LARGEST_TILE, 4 * first.nbytes):
        raise BadInput(
            f"its tiles promise {tile} bytes each, its pages {first.nbytes}; expected tiles of a page; {AGAIN}"
        )
    held, size, form = 0, tiff.filehandle.size, tiff.tiff
    for page in pages:
        tiff.filehandle.seek(page.offset)
        tags = int.from_bytes(tiff.filehandle.read(form.tagnosize), "little" if form.byteorder == "<" else "big")
        if page.offset + form.tagnosize + tags * form.tagsize + form.offsetsize > size:
            raise BadInput(f"the TIFF ends before its last page; {AGAIN}")
        if len(page.dataoffsets) != len(page.databytecounts) or len(page.dataoffsets) < math.prod(first.chunked) > 1:
            raise BadInput(f"a page of it lacks some of its strips or tiles; {AGAIN}")
        for at, count in zip(page.dataoffsets, page.databytecounts):
            if count <= 0 or at + count > size:
                raise BadInput(f"the TIFF ends before its last page; {AGAIN}")
            held += count
    if series.dataoffset is not None and len(pages) == 1:
        held = size - series.dataoffset  # one directory for all slices
    most = held * BOUNDED.get(int(first.compression), 1 << 40)
    paged = spans is not None and len(pages) > 1
    memory = need(series.dtype, series.shape, spans) + 2 * first.nbytes if spans and paged else series.nbytes
    check_size(series.nbytes, most, memory)


def real(values: NDArray[Any]) -> NDArray[Any]:
    """The same if they are real numbers."""
    if values.dtype.kind not in "biuf":
        raise BadInput(f"each voxel is of the type {values.dtype}; expected one real number; save the magnitude")
    return values


def _three_axes(
    shape: Sequence[int], axes: str, wanted: Wanted, names: Sequence[str]
) -> tuple[list[int], dict[int, int], tuple[Note, ...]]:
    """Which of the axes, by tifffile's letters, are x, y and z; the index along each other one; what was assumed."""
    notes: tuple[Note, ...] = ()
    if "Z" not in axes:
        # Pages without a meaning, or else what their writer called time steps, are slices.
        stack = next((axis for axis in "IQRT" if axis in axes), "")
        if stack == "T" and wanted.time is None:
            notes = (("file", "its slices are called time steps; they were read as slices along z"),)
        if stack and not (stack == "T" and wanted.time is not None):
            axes = axes.replace(stack, "Z", 1)
    if "S" in axes and "C" not in axes:
        axes = axes.replace("S", "C")
        names = ("red", "green", "blue", "alpha")[: shape[axes.index("C")]]
    chosen = {axis: 0 for axis, letter in enumerate(axes) if letter not in "XYZ" and shape[axis] == 1}
    for option, letter in (("time", "T"), ("channel", "C")):
        given = getattr(wanted, option)
        count = shape[axes.index(letter)] if letter in axes else 1
        known = list(names) if letter == "C" and len(names) == count else [""] * count
        number = pick(given, option, known)
        if letter in axes:
            chosen[axes.index(letter)] = number
    left = [axis for axis in range(len(axes)) if axis not in chosen]
    if sorted(axes[axis] for axis in left) != ["X", "Y", "Z"]:
        check_axes([shape[axis] for axis in left[::-1]])
        said = "".join(axes[axis] for axis in left)
        raise BadInput(
            f"its axes are {said}; expected slices along z, and perhaps channels and time steps; save only those"
        )
    return [axes.index(letter) for letter in "XYZ"], chosen, notes
