"""From frames to one stack: which belong together, which repeat the same places, and where each slice lies."""

import itertools
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats
from illumgrid.io.readers.dicom_frames import UNIFORM, Frame
from illumgrid.io.readers.stored import Note

ON_PLACE = 0.02
"""A slice this near to its place on the even lattice, in slices, counts as on it: positions have few digits."""

ASIDE = "first pixel in the plane at"
"""Attribute that distinguishes adjacent fields of view."""

REPEAT = "repeat"
"""Attribute that distinguishes volumes at the same places if no other does."""

LONGEST_GAP = 3
"""Slices: gaps up to this many are interpolated, longer ones refused."""


@dataclass(frozen=True)
class Stack:
    """Frames in order along their normal, each with its place on an even lattice of slices."""

    frames: tuple[Frame, ...]
    at: Floats
    """(n,) number of the slice where each frame lies; not whole where slices are uneven."""
    count: int
    origin: Floats
    steps: Floats
    """(3, 3): column i is the world vector from a voxel to its neighbour along axis i; a gantry tilt shears it."""
    notes: tuple[Note, ...]

    @property
    def even(self) -> bool:
        """Whether there is one frame at each place of the lattice."""
        return len(self.at) == self.count and bool(np.abs(self.at - np.arange(self.count)).max() < 1e-3)


def stacks(frames: Sequence[Frame]) -> list[list[Frame]]:
    """Frames that one volume could hold: of one series, size and orientation; in the order of series numbers."""
    groups: list[list[Frame]] = []
    by_kind: dict[object, list[list[Frame]]] = defaultdict(list)
    for frame in frames:
        k = frame.kind
        key = (k.series, k.rows, k.columns, k.samples, k.bits, k.scout, frame.pixel, frame.marks.get("StackID"))
        for group in by_kind[key]:
            if _parallel(group[0], frame):
                group.append(frame)
                break
        else:
            by_kind[key].append([frame])
            groups.append(by_kind[key][-1])
    return sorted(groups, key=lambda group: (group[0].kind.number, group[0].kind.series, -len(group)))


def _parallel(a: Frame, b: Frame) -> bool:
    if a.axes is None or b.axes is None:
        return a.axes is b.axes
    return bool(np.abs(a.axes - b.axes).max() < UNIFORM)


def depths(frames: Sequence[Frame]) -> Floats:
    """Position of each frame along the normal (n,), millimetres."""
    first = frames[0]
    assert first.axes is not None
    normal = np.cross(first.axes[0], first.axes[1])
    return np.array([frame.position @ normal for frame in frames if frame.position is not None])


def placed(frames: Sequence[Frame]) -> bool:
    """Whether each frame states its position."""
    return all(frame.position is not None and frame.axes is not None for frame in frames)


def phases(frames: Sequence[Frame]) -> list[tuple[str, list[Frame]]]:
    """Parts of a stack that each contain every place once, with the attributes that distinguish them."""
    if not placed(frames) or len(frames) < 2:
        return [("", list(frames))]
    depth = depths(frames)
    same = max(1e-3, ON_PLACE * (frames[0].gap or 0.0))
    places = np.zeros(len(frames), int)
    order = np.argsort(depth, kind="stable")
    places[order[1:]] = np.cumsum(np.diff(depth[order]) > same)
    most = max(Counter(places.tolist()).values())
    if most == 1:
        return _interleaved(frames, depth) or [("", list(frames))]
    frames = [replace(frame, marks={**frame.marks, ASIDE: _aside(frame)}) for frame in frames]
    for marks in _tellers(frames):
        parts = _by(frames, marks)
        sizes = [Counter(places[members].tolist()) for members in parts.values()]
        if len(parts) == most and all(max(size.values()) == 1 for size in sizes):
            return [(name, [frames[k] for k in members]) for name, members in parts.items()]
    # The headers distinguish them only by their order.
    seen: Counter[int] = Counter()
    ranked: dict[int, list[Frame]] = defaultdict(list)
    for k in sorted(range(len(frames)), key=lambda k: (frames[k].order, frames[k].file.name, frames[k].index)):
        ranked[seen[int(places[k])]].append(frames[k])
        seen[int(places[k])] += 1
    return [(f"{REPEAT} {rank + 1} of each place", part) for rank, part in ranked.items()]


def _aside(frame: Frame) -> str:
    """Where the first pixel of a frame lies in its plane, millimetres along rows and columns."""
    assert frame.axes is not None and frame.position is not None
    return " ".join(f"{x:.0f}" for x in frame.axes @ frame.position + 0.0)


def _tellers(frames: Sequence[Frame]) -> list[tuple[str, ...]]:
    """Attributes that differ among frames, alone and in pairs and triples."""
    names = list(dict.fromkeys(name for frame in frames for name in frame.marks))
    differ = [name for name in names if len({frame.marks.get(name) for frame in frames}) > 1][:12]
    return [marks for size in (1, 2, 3) for marks in itertools.combinations(differ, size)]


def _by(frames: Sequence[Frame], marks: tuple[str, ...]) -> dict[str, list[int]]:
    parts: dict[str, list[int]] = defaultdict(list)
    for k, frame in enumerate(frames):
        parts[", ".join(f"{mark} {frame.marks.get(mark, 'none')}" for mark in marks)].append(k)
    return parts


def _interleaved(frames: Sequence[Frame], depth: Floats) -> list[tuple[str, list[Frame]]] | None:
    """Acquisitions of one region whose slices lie between each other's: uneven together, even each for itself."""
    if _even(np.sort(depth)):
        return None
    for marks in _tellers(frames):
        parts = _by(frames, marks)
        if len(parts) > 8 or min(map(len, parts.values())) < 3:
            continue
        spans = [np.sort(depth[members]) for members in parts.values()]
        shared = min(s[-1] for s in spans) - max(s[0] for s in spans)
        if shared > 0.5 * (max(s[-1] for s in spans) - min(s[0] for s in spans)) and all(map(_even, spans)):
            return [(name, [frames[k] for k in members]) for name, members in parts.items()]
    return None


def _even(depth: Floats) -> bool:
    lattice = np.linspace(depth[0], depth[-1], len(depth))
    return bool(np.abs(depth - lattice).max() <= ON_PLACE * (lattice[1] - lattice[0]))


def arranged(frames: Sequence[Frame]) -> Stack:
    """Order slices along their normal onto an even lattice, with notes about missing, uneven or tilted ones."""
    if not placed(frames):
        return _unplaced(frames)
    depth = depths(frames)
    order = np.argsort(depth, kind="stable")
    frames, depth = [frames[k] for k in order], depth[order]
    at, count, step, notes = _lattice(depth, frames[0].gap)
    axes, pixel = frames[0].axes, frames[0].pixel
    assert axes is not None and frames[0].position is not None
    if pixel is None:
        pixel = (1.0, 1.0)
        notes = [*notes, ("spacing", "does not state the size of its pixels; 1 mm was assumed; give --spacing X Y Z")]
    positions = np.array([frame.position for frame in frames])
    drift, more = _drift((positions - positions[0]) @ axes.T, depth - depth[0], step, np.array(pixel))
    along = step * np.cross(axes[0], axes[1]) + drift @ axes
    steps = np.stack([pixel[0] * axes[0], pixel[1] * axes[1], along], axis=1)
    return Stack(tuple(frames), at, count, positions[0], steps, (*notes, *more))


def _unplaced(frames: Sequence[Frame]) -> Stack:
    """Frames without a position: in the order of their numbers."""
    frames = sorted(frames, key=lambda frame: (frame.order, frame.file.name))
    first = frames[0]
    axes = np.eye(3)[:2] if first.axes is None else first.axes
    pixel, gap = first.pixel or (1.0, 1.0), first.gap
    assumed = "slices lie in the order of their numbers"
    if first.pixel is None or gap is None:
        step = gap or (first.pixel[0] if first.pixel else 1.0)
        assumed += f", {step:g} mm from slice to slice and {pixel[0]:g} x {pixel[1]:g} mm in the plane"
        gap = step
    steps = np.stack([pixel[0] * axes[0], pixel[1] * axes[1], gap * np.cross(axes[0], axes[1])], axis=1)
    note = (
        "dicom",
        f"its header does not state the position of its slices (no ImagePositionPatient); assumed: {assumed}",
    )
    return Stack(tuple(frames), np.arange(len(frames), dtype=float), len(frames), np.zeros(3), steps, (note,))


def _lattice(depth: Floats, gap: float | None) -> tuple[Floats, int, float, list[Note]]:
    """Place of each slice on an even lattice, number of its slices, their distance, and what is wrong."""
    distances = np.diff(depth)
    if not len(distances):
        return np.zeros(1), 1, gap or 1.0, []
    smallest = float(distances.min())
    if smallest <= 0:
        raise BadInput("two of its slices lie at one place; expected each place once; take one of them away")
    if _even(depth):
        return np.arange(len(depth), dtype=float), len(depth), float(distances.mean()), []
    steps = np.round(distances / np.median(distances[distances < 1.5 * smallest]))
    # The header counts where it says that even the closest slices are not neighbours.
    if gap and smallest > 1.5 * gap and np.abs(distances / gap - np.round(distances / gap)).max() < 0.1:
        steps = np.round(distances / gap)
    at = np.concatenate([[0.0], np.cumsum(steps)])
    step = float((depth[-1] - depth[0]) / at[-1]) if at[-1] else smallest
    far = int(np.argmax(distances))
    if distances[far] > (LONGEST_GAP + 1.5) * min(step, float(np.median(distances))):
        raise BadInput(
            f"there is a gap between its slices {depth[far]:.6g} and {depth[far + 1]:.6g} mm along their normal, "
            f"others are {np.median(distances):.6g} mm from each other; expected one stack without such a gap; give a "
            "folder with only the slices on one side"
        )
    lost = int(at[-1]) + 1 - len(depth)
    if np.abs(depth - depth[0] - at * step).max() <= max(ON_PLACE * step, 1e-3):
        where = ", ".join(f"{depth[k]:.6g} and {depth[k + 1]:.6g}" for k in np.flatnonzero(steps > 1)[:4])
        what = f"{lost} of its {int(at[-1]) + 1} slices {'is' if lost == 1 else 'are'} missing (between {where} mm)"
        return at, int(at[-1]) + 1, step, [("dicom", f"slices are missing: {what}; interpolated from their neighbours")]
    step = float(np.median(distances))
    count = int(np.floor((depth[-1] - depth[0]) / step * (1 + 1e-9) + 1e-6)) + 1
    note = (
        f"slices are unevenly spaced: {smallest:.6g} to {distances.max():.6g} mm from each other; interpolated onto "
        f"{count} slices with a distance of {step:.6g} mm"
    )
    return (depth - depth[0]) / step, count, step, [("dicom", note)]


def _drift(aside: Floats, ahead: Floats, step: float, pixel: Floats) -> tuple[Floats, list[Note]]:
    """Millimetres (2,) that slices move within their plane from one to the next: the tilt of the gantry.

    `aside` (n, 2) and `ahead` (n,) are where slices lie in the plane and along the normal, from the first.
    """
    if len(ahead) < 2:
        return np.zeros(2), []
    slope = (ahead @ aside) / (ahead @ ahead)
    off = np.abs(aside - np.outer(ahead, slope)).max(axis=0)
    if (off > 0.5 * pixel).any():
        raise BadInput(
            f"its slices are shifted against each other by up to {off.max():.3g} mm, unevenly; expected a straight "
            "stack; resample it elsewhere"
        )
    if (np.abs(slope * ahead[-1]) <= 0.1 * pixel).all():  # rounding in the header
        return np.zeros(2), []
    angle = np.degrees(np.arctan(np.linalg.norm(slope)))
    return slope * step, [("dicom", f"its slices are not square to their stack by {angle:.1f}° (gantry tilt)")]
