"""The properties of each frame in a DICOM header: its place, the meaning of its values, differences from others."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats

MARKS = (
    *("TemporalPositionIdentifier", "TemporalPositionIndex", "NominalCardiacTriggerDelayTime", "TriggerTime"),
    *("NominalPercentageOfCardiacPhase", "FrameReferenceTime", "EchoNumbers", "EffectiveEchoTime", "EchoTime"),
    *("InversionTime", "DiffusionBValue", "DiffusionGradientOrientation", "ComplexImageComponent", "FrameType"),
    *("ImageType", "ReferencedSegmentNumber", "AcquisitionNumber", "FrameAcquisitionDateTime", "AcquisitionTime"),
    *("ContentTime", "KVP", "MonoenergeticEnergyEquivalent"),
)
"""Attributes by which frames at one place may differ, the most telling first (PS3.3 C.7.6.16, C.8)."""

VECTORS = {  # of multi-frame nuclear medicine, PS3.3 C.8.4.8
    "PhaseVector": "phase",
    "TimeSlotVector": "time slot",
    "EnergyWindowVector": "energy window",
    "DetectorVector": "detector",
    "RotationVector": "rotation",
}

UNIFORM = 1e-3
"""Directions whose components differ by less than this are equal."""


@dataclass(frozen=True)
class Kind:
    """The properties that all frames of one volume have in common."""

    series: str
    rows: int
    columns: int
    samples: int
    bits: int
    """Bits allocated for each sample."""
    colours: str
    """Photometric interpretation."""
    what: str
    """Modality and description, for lists."""
    number: int
    segments: bool
    """A segmentation: each frame is the mask of one segment."""
    scout: bool
    """Marked as a localizer."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One plane of a series."""

    file: Path
    index: int
    """Within its file."""
    kind: Kind
    position: Floats | None
    """(3,) LPS millimetres, centre of the first pixel."""
    axes: Floats | None
    """(2, 3): unit vectors along a row (x, from column to column) and along a column (y)."""
    pixel: tuple[float, float] | None
    """Millimetres between columns (x) and between rows (y)."""
    gap: float | None
    """Millimetres between slices, by the header."""
    slope: float
    intercept: float
    order: tuple[float, ...]
    """Place in the series by the numbers of the header, for frames without a position."""
    marks: dict[str, str] = field(default_factory=dict)
    segment: int = 0
    moment: bool = False
    """A frame of a film: frames follow each other in time."""


def numbers(item: Any, keyword: str, count: int | None = None) -> list[float] | None:
    """Value of an attribute as finite numbers; None where it is absent or empty."""
    try:
        value = item.get(keyword) if item is not None else None
        if value is None or value == "":
            return None
        found = [float(v) for v in (value if isinstance(value, Sequence) and not isinstance(value, str) else [value])]
    except (ValueError, TypeError, OverflowError, AttributeError):
        raise BadInput(f"its {keyword} is not a number; expected one; correct its header") from None
    if not found:
        return None
    if count not in (None, len(found)) or not np.isfinite(found).all():
        raise BadInput(f"its {keyword} is {found[:8]}; expected {count or 'some'} finite numbers; correct its header")
    return found


def whole(item: Any, keyword: str, default: int) -> int:
    """Value of an attribute as one whole number."""
    found = numbers(item, keyword, 1)
    return default if found is None else int(found[0])


def text(item: Any, keyword: str) -> str:
    """Value of an attribute as printable text."""
    value = item.get(keyword)
    shown = "" if value is None else "\\".join(map(str, value)) if isinstance(value, list) else str(value)
    return "".join(c for c in shown if c.isprintable()).strip()[:64]


def frames_of(header: Any, file: Path, size: int) -> list[Frame]:
    """The frames of a file of `size` bytes that holds an image; none if it holds no image."""
    if "Rows" not in header or "Columns" not in header:
        return []
    kind = _kind(header)
    count = whole(header, "NumberOfFrames", 1)
    if count < 1 or count * 2 > max(size, 2):
        raise BadInput(f"claims {count} frames in {size} bytes; expected a whole file; copy it again")
    per = header.get("PerFrameFunctionalGroupsSequence")
    if per is None:
        return list(_plain(header, file, kind, count))
    if len(per) < count:
        raise BadInput(f"says where {len(per)} of its {count} frames lie; expected all; the file is not whole")
    shared = header.get("SharedFunctionalGroupsSequence") or [None]
    return [_grouped(header, file, kind, k, per[k], shared[0]) for k in range(count)]


def _kind(header: Any) -> Kind:
    described = text(header, "SeriesDescription") or text(header, "ProtocolName") or text(header, "SeriesInstanceUID")
    types = text(header, "ImageType").upper()
    return Kind(
        series=text(header, "SeriesInstanceUID"),
        rows=whole(header, "Rows", 0),
        columns=whole(header, "Columns", 0),
        samples=whole(header, "SamplesPerPixel", 1),
        bits=whole(header, "BitsAllocated", 16),
        colours=text(header, "PhotometricInterpretation"),
        what=" ".join(filter(None, (text(header, "Modality"), described))),
        number=whole(header, "SeriesNumber", 0),
        segments=text(header, "Modality") == "SEG" and text(header, "SegmentationType") in ("BINARY", ""),
        scout="LOCALIZER" in types or "SCOUT" in types,
    )


def _axes(numbers_: list[float] | None) -> Floats | None:
    if numbers_ is None:
        return None
    axes = np.array(numbers_).reshape(2, 3)
    length = np.linalg.norm(axes, axis=1)
    if (np.abs(length - 1) > 1e-2).any() or abs(axes[0] @ axes[1]) > 1e-2:
        raise BadInput(f"its rows and columns run along {axes.tolist()}; expected two unit vectors at right angles")
    x = axes[0] / length[0]
    y = axes[1] - (axes[1] @ x) * x
    return np.stack([x, y / np.linalg.norm(y)])


def _pixel(*items: Any) -> tuple[float, float] | None:
    for item in items:
        for keyword in ("PixelSpacing", "NominalScannedPixelSpacing", "ImagerPixelSpacing"):
            if (found := numbers(item, keyword, 2)) is not None:
                if min(found) <= 0:
                    raise BadInput(f"its {keyword} is {found}; expected two positive numbers; correct its header")
                return found[1], found[0]  # the standard names the distance between rows first
    return None


def _gap(item: Any) -> float | None:
    for keyword in ("SpacingBetweenSlices", "SliceThickness"):
        found = numbers(item, keyword, 1)
        if found is not None and found[0] != 0:  # some writers count the spacing downwards
            return abs(found[0])
    return None


def _array(values: list[float] | None) -> Floats | None:
    return None if values is None else np.array(values)


def _plain(header: Any, file: Path, kind: Kind, count: int) -> Iterator[Frame]:
    """Frames of a file without functional groups: one slice, a dose, nuclear medicine, a film."""
    place = header
    if "ImagePositionPatient" not in header and header.get("DetectorInformationSequence"):
        place = header.DetectorInformationSequence[0]
    position = _array(numbers(place, "ImagePositionPatient", 3))
    axes = _axes(numbers(place, "ImageOrientationPatient", 6))
    gap = _gap(header)
    offsets = _offsets(header, count, position, axes, gap)
    scale = numbers(header, "DoseGridScaling", 1) or numbers(header, "RescaleSlope", 1) or [1.0]
    shift = numbers(header, "RescaleIntercept", 1) or [0.0]
    vectors = {what: numbers(header, keyword, count) for keyword, what in VECTORS.items()} if count > 1 else {}
    slices = numbers(header, "SliceVector", count) if count > 1 else None
    film = count > 1 and offsets is None and slices is None and _is_film(header)
    start = numbers(header, "InstanceNumber", 1) or [0.0]
    for k in range(count):
        there = position
        if count > 1 and position is not None and axes is not None:
            ahead = offsets[k] if offsets is not None else (slices[k] - 1 if slices else k) * (gap or 1.0)
            there = position + ahead * np.cross(axes[0], axes[1])
        marks = {what: f"{found[k]:g}" for what, found in vectors.items() if found}
        yield Frame(
            file, k, kind, there, axes, _pixel(header), gap, scale[0], shift[0], (start[0], float(k)),
            {**marks, **_marks([header])}, moment=film,
        )  # fmt: skip


def _offsets(
    header: Any, count: int, position: Floats | None, axes: Floats | None, gap: float | None
) -> list[float] | None:
    """Millimetres of each frame along the normal, from the first."""
    found = numbers(header, "GridFrameOffsetVector", count) if count > 1 else None
    if found is None or position is None or axes is None:
        return None
    # Either relative to the first frame, or the coordinate of each along the patient (PS3.3 C.8.8.3.2).
    return [f - found[0] for f in found]


def _is_film(header: Any) -> bool:
    pointer = str(header.get("FrameIncrementPointer", ""))
    timed = any(tag in pointer.replace(" ", "") for tag in ("(0018,1063)", "(0018,1065)"))
    return timed or "FrameTime" in header or "FrameTimeVector" in header or "CineRate" in header


def _grouped(header: Any, file: Path, kind: Kind, index: int, own: Any, shared: Any) -> Frame:
    """A frame of an enhanced multi-frame object: its own functional groups first, then those of all frames."""

    def group(name: str) -> Any:
        for item in (own, shared):
            if item is not None and item.get(name):
                return item.get(name)[0]
        return {}

    measures = group("PixelMeasuresSequence")
    values = group("PixelValueTransformationSequence")
    content = group("FrameContentSequence")
    slope = numbers(values, "RescaleSlope", 1) or numbers(header, "RescaleSlope", 1) or [1.0]
    shift = numbers(values, "RescaleIntercept", 1) or numbers(header, "RescaleIntercept", 1) or [0.0]
    number = numbers(content, "InStackPositionNumber", 1) or [0.0]
    stack = text(content, "StackID") if content else ""
    inner = [element.value[0] for element in own if element.VR == "SQ" and len(element.value) == 1]
    segment = group("SegmentIdentificationSequence")
    return Frame(
        file, index, kind,
        _array(numbers(group("PlanePositionSequence"), "ImagePositionPatient", 3)),
        _axes(numbers(group("PlaneOrientationSequence"), "ImageOrientationPatient", 6)),
        _pixel(measures, header), _gap(measures), slope[0], shift[0], (number[0], float(index)),
        {**_marks(inner), **({"StackID": stack} if stack else {})},
        segment=whole(segment, "ReferencedSegmentNumber", 0) if segment else 0,
    )  # fmt: skip


def _marks(items: Sequence[Any]) -> dict[str, str]:
    return {mark: found for item in items for mark in MARKS if mark in item and (found := text(item, mark))}
