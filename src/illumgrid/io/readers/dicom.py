"""DICOM by pydicom: a folder of slices, or one file of many frames.

The series is assembled here, since no header describes it as a whole: frames are sorted along their normal, each has
its own slope and intercept, and whatever does not lie on one even lattice is named.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pydicom

from illumgrid.errors import BadInput
from illumgrid.io.readers.dicom_frames import Frame, frames_of, text
from illumgrid.io.readers.dicom_pixels import dataset, decoded, on_lattice, planes_of, quiet, understood
from illumgrid.io.readers.dicom_stack import REPEAT, arranged, phases, placed, stacks
from illumgrid.io.readers.families import bare_dicom
from illumgrid.io.readers.limits import AS_FLOAT, check_axes, check_memory
from illumgrid.io.readers.source import Source, find_source
from illumgrid.io.readers.stored import Note, Stored, Wanted, pick
from illumgrid.io.readers.windows import Span

MOST_FILES = 200_000
"""Largest number of files of a folder that are examined: no series has more."""

IMAGES = ("Image Storage", "Dose Storage", "Segmentation Storage", "Map Storage")
"""Names of the classes whose objects hold pixels; reports, plans and contours do not."""


def read(source: Source, wanted: Wanted) -> Stored:
    """Read a file that holds a whole volume: enhanced multi-frame, a dose, a segmentation."""
    frames = _frames(source)
    if not frames:
        raise BadInput("DICOM without an image; expected slices; give the folder of the series")
    if len(frames) == 1:
        shape = f"{frames[0].kind.columns}x{frames[0].kind.rows}x1"
        raise BadInput(f"a single DICOM plane ({shape}); expected a volume; give the folder of the whole series")
    return _chosen(frames, wanted, {source.file: source})


def read_folder(folder: Path, wanted: Wanted) -> Stored:
    """Read the series of a folder and its sub-folders."""
    frames: list[Frame] = []
    sources: dict[Path, Source] = {}
    names: dict[str, str] = {}
    notes: list[Note] = []
    for file in _files(folder):
        source = find_source(file)
        if not _is_dicom(source):
            continue
        shown = os.fsencode(file.relative_to(folder)).decode("utf-8", "replace")
        try:
            found = _frames(source, names)
        except BadInput as problem:
            raise BadInput(f"{shown}: {problem}") from None
        if found:
            sources[file] = source
            frames += found
    copies = names.pop("copies", "")
    if not frames:
        raise BadInput("its DICOM series are: none; expected one stack of slices; give a folder with DICOM images")
    if copies:
        notes.append(("dicom", f"files that are copies of others were left out, the last is {copies}"))
    stored = _chosen(frames, wanted, sources)
    return replace(stored, notes=(*notes, *stored.notes))


def _files(folder: Path) -> Iterator[Path]:
    count = 0
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(files):
            file = Path(place) / name
            if not name.startswith(".") and name != "DICOMDIR" and file.is_file():
                count += 1
                if count > MOST_FILES:
                    raise BadInput(f"holds more than {MOST_FILES} files; expected one series; give the folder of that")
                yield file


def _is_dicom(source: Source) -> bool:
    """Whether a file is DICOM: by its mark, or, without the preamble of 128 bytes, by its first element."""
    return source.head[128:132] == b"DICM" or bare_dicom(source.head)


def _frames(source: Source, names: dict[str, str] | None = None) -> list[Frame]:
    """Frames of a file; none if it holds no image, or one whose copy is among `names`."""
    header = dataset(source, header_only=True)
    with quiet(), understood("its DICOM header"):
        meta = getattr(header, "file_meta", None)
        stored = pydicom.uid.UID(text(meta or {}, "MediaStorageSOPClassUID") or text(header, "SOPClassUID"))
        if stored == pydicom.uid.MediaStorageDirectoryStorage:
            if names is not None:
                return []
            raise BadInput("the index of a medium (DICOMDIR), no image; expected slices; give the folder it lies in")
        found = frames_of(header, source.file, source.most)
        uid = text(header, "SOPInstanceUID")
    if not found and not stored:
        raise BadInput("does not state its DICOM class, or ends before that; expected slices; copy it again")
    if not found and any(word in stored.name for word in IMAGES):
        raise BadInput(f"is a {stored.name} without pixels, or ends before them; expected whole slices; copy it again")
    if found and names is not None and uid:
        if uid in names:
            names["copies"] = source.file.name
            return []
        names[uid] = source.file.name
    return found


def _chosen(frames: Sequence[Frame], wanted: Wanted, sources: dict[Path, Source]) -> Stored:
    """The volume that remains after the choice of series (array), phase (time) and colour (channel)."""
    group, notes = _series(frames, wanted)
    if group[0].kind.segments:
        return _label_map(group, sources)
    if any(frame.moment for frame in group):
        raise BadInput(
            f"a film: its {len(group)} frames are moments of one plane; expected slices; there is no volume in it"
        )
    parts = phases(group)
    number = pick(wanted.time, "time", [name for name, _ in parts])
    if parts[number][0].startswith(REPEAT):
        text = f"its headers do not distinguish its {len(parts)} volumes at the same places"
        notes.append(("dicom", f"{text}; slices were counted by their numbers and the names of their files"))
    stack = arranged(parts[number][1])
    kind = stack.frames[0].kind
    shape = (kind.columns, kind.rows, stack.count)
    check_axes(shape)
    spans = wanted.spans(shape) if stack.even else [Span(0, n) for n in (kind.columns, kind.rows, len(stack.frames))]
    planes, slope, intercept, more = planes_of(stack, sources, wanted, spans)
    values = (planes if stack.even else on_lattice(planes, stack)).transpose(2, 1, 0)
    notes, whole = [*notes, *stack.notes, *more], shape if stack.even else None
    return Stored(values, stack.origin, stack.steps, slope, intercept, unit="mm", notes=tuple(notes), whole=whole)


def _series(frames: Sequence[Frame], wanted: Wanted) -> tuple[list[Frame], list[Note]]:
    """The frames of the chosen series; without a choice, single planes and localizers beside one stack are left out."""
    groups = stacks(frames)
    real = [group for group in groups if len(group) > 1 and not group[0].kind.scout]
    if wanted.array is None and len(real) == 1 and len(groups) > 1:
        out = sum(len(group) for group in groups) - len(real[0])
        other = next(group[0] for group in groups if group is not real[0])
        why = "a localizer" if other.kind.scout else "of another series, size or orientation"
        note = f"{out} of {len(frames)} planes {'is' if out == 1 else 'are'} left out ({why}: {other.file.name})"
        return real[0], [("dicom", f"{note}; --array chooses another stack")]
    if not any(len(group) > 1 for group in groups):
        k = frames[0].kind
        uids = ", ".join(sorted({frame.kind.series for frame in frames})[:4])
        count = len(frames)
        what = "a single plane" if count == 1 else f"{count} planes, none of which are parallel and of equal size"
        raise BadInput(
            f"its DICOM series are: {uids}, {what} ({k.columns}x{k.rows}); expected one stack of slices; give a folder "
            "with a whole series"
        )
    choices = sorted(groups, key=lambda group: len(group) < 2)
    return choices[pick(wanted.array, "array", [_named(group) for group in choices])], []


def _named(group: Sequence[Frame]) -> str:
    kind = group[0].kind
    return f"series {kind.number}: {kind.what}, {len(group)} slices of {kind.columns}x{kind.rows}"


def _label_map(group: Sequence[Frame], sources: dict[Path, Source]) -> Stored:
    """A segmentation of masks as one map, each voxel with the number of its segment; 0 where there is none."""
    if not placed(group):
        raise BadInput(
            "a segmentation that does not state the position of its frames; expected positions; correct its header"
        )
    places: dict[float, Frame] = {}
    axes = group[0].axes
    assert axes is not None
    normal = np.cross(axes[0], axes[1])
    key = {id(frame): round(float(np.dot(frame.position, normal)), 3) for frame in group}  # type: ignore[arg-type]
    for frame in group:
        places.setdefault(key[id(frame)], frame)
    stack = arranged(list(places.values()))
    kind = group[0].kind
    check_axes((kind.columns, kind.rows, stack.count))
    most = max(frame.segment for frame in group)
    dtype = np.uint8 if most < 256 else np.uint16
    check_memory(stack.count * kind.rows * kind.columns * (AS_FLOAT + 2))
    out = np.zeros((stack.count, kind.rows, kind.columns), dtype)
    slot = {key[id(frame)]: round(float(k)) for frame, k in zip(stack.frames, stack.at)}
    twice = 0
    notes: list[Note] = []
    for file in dict.fromkeys(frame.file for frame in group):
        masks = {frame.index: frame for frame in group if frame.file == file}
        order = sorted(masks, key=lambda index: masks[index].segment)
        for index, plane in decoded(sources[file], order, kind, notes):
            there = out[slot[key[id(masks[index])]]]
            twice += int(((there > 0) & (plane > 0)).sum())
            there[plane > 0] = max(masks[index].segment, 1)
    if twice:
        notes.append(("dicom", f"segments overlap in {twice} voxels, which have the highest number"))
    kept = tuple(note for note in stack.notes if "missing" not in note[1])  # an empty slice is not stored
    return Stored(out.transpose(2, 1, 0), stack.origin, stack.steps, unit="mm", notes=(*kept, *notes))
