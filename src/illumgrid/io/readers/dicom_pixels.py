"""Pixels of DICOM files: unpacked by pydicom, scaled slice by slice, put onto the even lattice of their stack."""

import mmap
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from numpy.typing import NDArray
from pydicom.pixels.decoders.base import get_decoder
from pydicom.pixels.utils import get_expected_length, iter_pixels, pixel_array

from illumgrid.errors import BadInput
from illumgrid.io.readers.dicom_frames import Kind
from illumgrid.io.readers.dicom_stack import Stack
from illumgrid.io.readers.limits import AS_FLOAT, check_memory, check_size
from illumgrid.io.readers.source import AGAIN, Source, opened, seekable
from illumgrid.io.readers.stored import Note, Wanted, pick
from illumgrid.io.readers.windows import Span, means, sums, take

MOST_PACKED = 1 << 14
"""Times its file that a compressed image can unpack to: an empty slice of JPEG-LS takes some hundred bytes."""

DEFLATED = "1.2.840.10008.1.2.1.99"


@contextmanager
def quiet() -> Iterator[list[Any]]:
    """Collect pydicom's warnings: irrelevant about headers here, relevant about pixels."""
    with warnings.catch_warnings(record=True) as collected:
        warnings.simplefilter("always")
        yield collected


@contextmanager
def _bytes(source: Source) -> Iterator[Any]:
    """The file as a seekable object that never returns more bytes than it has, whatever length is requested."""
    if source.packed:
        with seekable(source) as stream:
            yield stream
        return
    with opened(source) as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        yield mapped


@contextmanager
def understood(part: str) -> Iterator[None]:
    """Turn exceptions of pydicom on damaged bytes, immediate or at the access of a value, into a message."""
    try:
        yield
    except (BadInput, MemoryError):
        raise
    except Exception as problem:
        said = "".join(c if c.isprintable() else " " for c in str(problem))
        what = " ".join(said.split())[:120].replace(". ", ", ").rstrip(".") or type(problem).__name__
        raise BadInput(f"{part} cannot be read ({what}); {AGAIN}") from None


def dataset(source: Source, header_only: bool) -> Any:
    """Read the data set of a file, with or without its pixels."""
    with quiet(), _bytes(source) as stream, understood("its DICOM header"):
        _check_deflated(stream, source)
        # force: for files without preamble; others were refused by their first bytes
        return pydicom.dcmread(stream, stop_before_pixels=header_only, force=True)


def _check_deflated(stream: Any, source: Source) -> None:
    """Measure what a deflated data set unpacks to, before pydicom unpacks it whole."""
    if DEFLATED.encode() not in source.head:
        return
    stream.seek(144 + int.from_bytes(source.head[140:144], "little"))  # behind the group of the file's own header
    unpack, done, packed = zlib.decompressobj(-zlib.MAX_WBITS), 0, stream.read()
    while not unpack.eof:
        out = unpack.decompress(packed, 1 << 20)
        done += len(out)
        check_memory(3 * done)
        packed = unpack.unconsumed_tail
        if not out and not packed:
            raise BadInput(f"its packed data end too early; {AGAIN}")
    stream.seek(0)


def planes_of(
    stack: Stack, sources: dict[Path, Source], wanted: Wanted, spans: Sequence[Span]
) -> tuple[NDArray[Any], float, float, list[Note]]:
    """A part of the frames of a stack, in its order: values (n, rows, columns), slope, intercept, and notes.

    Values are as stored where all frames have one slope and intercept, else as these make them. `spans` are along x, y
    and z; frames outside are not unpacked, those of other files not opened.
    """
    across, down, along = spans
    frames, kind = stack.frames[along.first : along.first + along.count * along.block], stack.frames[0].kind
    files = list(dict.fromkeys(frame.file for frame in frames))
    held, plane_size = sum(sources[file].most for file in files), kind.rows * kind.columns
    each = max(8, kind.bits) // 8 * 2 + AS_FLOAT if along.block == 1 else 12
    need = across.count * down.count * along.count * each + 16 * plane_size
    check_size(len(frames) * plane_size * kind.samples * kind.bits // 8, held * MOST_PACKED, need)
    _check_colours(kind.samples, kind.colours, wanted)
    scales = [(frame.slope, frame.intercept) for frame in frames]
    alike, averaged = len(set(scales)) == 1, along.block > 1
    out: NDArray[Any] | None = None
    notes: list[Note] = []
    for file in files:
        slots = {frame.index: k for k, frame in enumerate(frames) if frame.file == file}
        for index, plane in decoded(sources[file], sorted(slots), kind, notes):
            if kind.samples > 1:
                plane = plane[..., pick(wanted.channel, "channel", ["red", "green", "blue"][: kind.samples])]
            if plane.shape != (kind.rows, kind.columns):
                expected = (kind.rows, kind.columns)
                raise BadInput(f"{file.name} unpacks to {plane.shape} pixels; expected {expected}; {AGAIN}")
            slope, intercept = scales[slots[index]]
            wide = np.dtype(np.float32 if plane.itemsize <= 2 else np.float64)  # for slices that are scaled each
            kept = plane.dtype if alike else wide
            plane = plane if alike else plane * slope + intercept
            part = sums(plane, (down, across)) if averaged else take(plane, (down, across))
            if out is None:
                out = np.zeros((along.count, *part.shape), float if averaged else kept)
            elif not averaged and kept != out.dtype:
                out = out.astype(np.result_type(out.dtype, kept))
            out[slots[index] // along.block] += part.astype(out.dtype, copy=False)
    assert out is not None
    values = means(out, spans, kept) if averaged else out
    return (values, *(scales[0] if alike else (1.0, 0.0)), notes)


def _check_colours(samples: int, colours: str, wanted: Wanted) -> None:
    if colours == "PALETTE COLOR":
        raise BadInput("its values are numbers of colours in a palette; expected measured values; there are none in it")
    if samples > 1 and wanted.channel is None:
        raise BadInput(
            f"holds colours ({samples} samples a pixel, {colours}); expected one value at each voxel; choose one with "
            "--channel N (channel=N)"
        )


def decoded(
    source: Source, indices: Sequence[int], kind: Kind, notes: list[Note]
) -> Iterator[tuple[int, NDArray[Any]]]:
    """The frames `indices` of a file, unpacked."""
    name = source.file.name
    data = dataset(source, header_only=False)
    with quiet() as collected, understood(f"the pixels of {name}"):
        _complete(data)
        if not any(word in data for word in ("PixelData", "FloatPixelData", "DoubleFloatPixelData")):
            raise BadInput(f"{name} ends before its pixels; {AGAIN}")
        _check_packed(data, name)
        if kind.bits == 1:  # frames need not begin at a whole byte, as iter_pixels requires
            bits = pixel_array(data).reshape(-1, kind.rows, kind.columns)
            yield from ((index, bits[index]) for index in indices)
            return
        # The decoder of runs in Rust that pydicom would take, where it is there, panics on damaged data.
        plugin = "pydicom" if data.file_meta.TransferSyntaxUID == pydicom.uid.RLELossless else ""
        for index, plane in zip(indices, iter_pixels(data, indices=indices, decoding_plugin=plugin)):
            yield index, _real(plane, data)
    said = {" ".join(str(one.message).split()) for one in collected if "pixel data" in str(one.message).lower()}
    odd = [sentence for sentence in said if "excess padding" not in sentence]  # zeros at the end are usual
    if odd and len(notes) < 4:
        notes.append(("dicom", f"{name}: {odd[0][:200]}"))


def _complete(data: Any) -> None:
    """Say how a file without a group of its own is written."""
    meta = getattr(data, "file_meta", None)
    if meta is None or not meta.get("TransferSyntaxUID"):
        data.file_meta = meta = meta if meta is not None else pydicom.dataset.FileMetaDataset()
        implicit, little = data.original_encoding
        uids = pydicom.uid
        explicit = uids.ExplicitVRLittleEndian if little else uids.ExplicitVRBigEndian
        meta.TransferSyntaxUID = uids.ImplicitVRLittleEndian if implicit else explicit


def _check_packed(data: Any, name: str) -> None:
    """Say which package unpacks a compressed file, if none is there; refuse a plain one that is too short."""
    syntax = data.file_meta.TransferSyntaxUID
    shown = "".join(c for c in str(syntax.name) if c.isprintable())[:80]
    try:
        decoder = get_decoder(syntax)
    except NotImplementedError:
        raise BadInput(
            f"its pixels are packed as {shown}, which pydicom does not read; expected JPEG, JPEG-LS, JPEG 2000, "
            "RLE or plain pixels; unpack it elsewhere (gdcmconv --raw)"
        ) from None
    if not decoder.is_available:
        raise BadInput(
            f"its pixels are packed as {shown}, which needs packages that are not installed; expected them "
            "to be installed: pip install illumgrid[dicom]"
        )
    if not syntax.is_encapsulated and "PixelData" in data:
        promised, held = get_expected_length(data), len(data.PixelData)
        if held < promised:
            raise BadInput(f"{name} ends after {held} of {promised} bytes of pixels; {AGAIN}")


def _real(plane: NDArray[Any], data: Any) -> NDArray[Any]:
    """Values of a plane before slope and intercept: through the table of the modality, where there is one."""
    if data.get("ModalityLUTSequence"):
        from pydicom.pixels.processing import apply_modality_lut

        return np.asarray(apply_modality_lut(plane, data))
    return plane


def on_lattice(planes: NDArray[Any], stack: Stack) -> NDArray[Any]:
    """Slices at every place of the even lattice: those that are there, others between their neighbours."""
    at = stack.at
    check_memory(stack.count * planes[0].size * planes.itemsize)
    out = np.empty((stack.count, *planes.shape[1:]), planes.dtype)
    for k in range(stack.count):
        near = int(np.argmin(np.abs(at - k)))
        if abs(at[near] - k) < 1e-3:
            out[k] = planes[near]
            continue
        after = min(max(int(np.searchsorted(at, k)), 1), len(at) - 1)
        share = min(max((k - at[after - 1]) / (at[after] - at[after - 1]), 0.0), 1.0)
        mixed = planes[after - 1] * (1 - share) + planes[after] * share
        out[k] = np.round(mixed) if planes.dtype.kind in "iu" else mixed
    return out
