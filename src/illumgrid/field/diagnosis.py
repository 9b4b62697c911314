"""What will go wrong with a field, seen before any light is computed: each finding has a name, a place and a remedy.

Critical isovalues are not findings: light jumps there in nature, too.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from illumgrid.constants import DENSITY
from illumgrid.errors import shown, shown_range
from illumgrid.field.labels import labels_in
from illumgrid.field.lattice import GridSpec
from illumgrid.field.scene import Field
from illumgrid.field.volume import Floats, Volume, index_to_world, interpolate, outward_normals, smooth

_PLATEAU = 27  # flat cells that hang together: fewer are what integers do at every maximum
_LEVELS = 64  # isovalues at which components, cavities and tunnels are counted
_COUNTED = ("components", "tunnels", "cavities")
_SIDE = 64  # voxels along the longest axis of the field on which they are counted


_ROUGH = 0.5  # normals that turn this much from voxel to voxel are rough (see `turning`)
_BLURS = (1.0, 1.5, 2.0, 3.0, 4.0)  # voxels; the first that leaves no rough normals is advised
_SOOTHED = 0.8  # ... and if a blur by one voxel brings them to this share, it is noise and not shape
_FLOOR = 0.12  # over turning²; within a factor of two on raw and blurred volumes of ten kinds (docs/stability.md)
_FALLS = 0.7  # the power of nodes per voxel with which that falls; 0.5 to 0.8 on most (docs/speed_and_accuracy.md)
_THIN = 0.25  # share of the surface of what is thinner than two nodes
_FEW = 4  # voxels on the smaller side of a level set that hardly is one
_TOUCHED = 1e-3  # share of the border's voxels that are solid
_ANISOTROPY = 3.0


@dataclass(frozen=True)
class Finding:
    """What will go wrong, reported before the light is computed.

    Parameters
    ----------
    name : str
        One of `illumgrid.errors.WARNINGS`.
    sentence : str
        What was found and where, and what to do.
    options : str
        Of ``illumgrid run``, such as ``--smooth 1``, if they are what to do.
    """

    name: str
    sentence: str
    options: str = ""


def plateaus(volume: Volume) -> list[tuple[float, float, Floats]]:
    """Values on which the field is flat over `_PLATEAU` cells or more that hang together, lowest first.

    Returns
    -------
    list of (value, share, place)
        Share of all cells, and the world position (3,) of a cell of the largest piece.
    """
    from scipy.ndimage import label

    v = volume.values
    x, y, z = v[1:] == v[:-1], v[:, 1:] == v[:, :-1], v[:, :, 1:] == v[:, :, :-1]
    flat = z[:-1, :-1] & z[1:, :-1] & z[:-1, 1:] & z[1:, 1:] & y[:-1, :, :-1] & y[1:, :, :-1] & x[:, :-1, :-1]
    if np.count_nonzero(flat) < _PLATEAU:
        return []
    del x, y, z
    piece, _ = label(flat)
    cells = np.flatnonzero(flat)
    number = piece.reshape(-1)[cells]
    size = np.bincount(number)
    large = np.flatnonzero(size >= _PLATEAU)
    first = cells[np.unique(number, return_index=True)[1]]  # by number of the piece, from 1 on
    place = np.stack(np.unravel_index(first[large - 1], flat.shape), axis=1)
    value = volume.in_units(v[tuple(place.T)].astype(float))
    found = []
    for level in np.unique(value):
        own = value == level
        at = index_to_world(volume, place[own][np.argmax(size[large[own]])][None] + 0.5)[0]
        found.append((float(level), float(size[large[own]].sum() / flat.size), at))
    return found


def turning(volume: Volume, low: float, high: float) -> float:
    """How much the normal turns from voxel to voxel on level sets of a range of stored values: its RMS, 2 sin(angle/2).

    It is what a grid of one node per voxel has to resolve: 0.1 on smooth fields, 0.8 on raw magnetic resonance images,
    1.4 where neighbouring normals have nothing to do with each other. 0 where the range has no voxels.
    """
    v = volume.values
    near = (v >= low) & (v <= high)
    total, pairs = 0.0, 0
    # Slabs along x, overlapping by a voxel: bounds the memory.
    for first in range(0, v.shape[0], 32):
        slab = slice(max(first - 1, 0), first + 34)
        if not near[slab].any():
            continue
        slopes = [np.gradient(v[slab], np.float32(step), axis=axis) for axis, step in enumerate(volume.spacing)]
        gradient = np.stack(slopes, axis=-1)
        length = np.linalg.norm(gradient, axis=-1)
        on = near[slab] & (length > 0)
        gradient /= np.where(length > 0, length, 1)[..., None]
        start = first - slab.start
        for axis in range(3):
            one, other = [slice(start, start + 32), slice(None), slice(None)], [slice(None)] * 3
            other[0] = slice(start, start + 32)
            if axis == 0:
                other[0] = slice(start + 1, start + 33)
            else:
                one[axis], other[axis] = slice(0, -1), slice(1, None)
            a, b = gradient[tuple(one)], gradient[tuple(other)]
            both = on[tuple(one)][: len(b)] & on[tuple(other)]
            total += float(np.square(a[: len(b)][both] - b[both], dtype=np.float64).sum())
            pairs += int(both.sum())
    return float(np.sqrt(total / pairs)) if pairs else 0.0


def _reduced(volume: Volume, longest: int) -> Volume:
    """The field on fewer voxels, blurred before so that nothing folds over; as it is where it is small."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    spec = GridSpec.over(volume, min(longest, max(volume.shape)))
    if spec.shape == volume.shape:
        return volume
    step = spec.spacing / volume.spacing
    soft = gaussian_filter(volume.values, 0.5 * np.sqrt(np.maximum(step**2 - 1, 0)), mode="nearest")
    index = np.meshgrid(*(np.arange(n) * s for n, s in zip(spec.shape, step)), indexing="ij")
    return Volume(map_coordinates(soft, index, order=1, mode="nearest"), spec.origin, spec.spacing, spec.direction)


def topology(solid: NDArray[np.bool_]) -> tuple[int, int, int]:
    """Components, tunnels and cavities (the Betti numbers) of a set of voxels; pieces below 27 voxels do not count."""
    from scipy.ndimage import label
    from skimage.measure import euler_number

    def without_crumbs(these: NDArray[np.bool_], connected: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], int]:
        piece, _ = label(these, connected)
        keep = np.bincount(piece.reshape(-1)) >= _PLATEAU
        keep[0] = False
        return keep[piece], int(keep.sum())

    solid, components = without_crumbs(solid, np.ones((3, 3, 3), bool))
    cross = np.abs(np.indices((3, 3, 3)) - 1).sum(axis=0) <= 1
    empty, outer = without_crumbs(np.pad(~solid, 1, constant_values=True), cross)
    cavities = outer - 1
    return components, components + cavities - int(euler_number(~empty, connectivity=3)), cavities


def critical_isovalues(field: Field) -> list[tuple[float, str]]:
    """Isovalues of the range at which the topology of the level set changes, and what changes; light jumps there.

    Counted on a field of at most 64 voxels a side at 64 isovalues; a change counts if what was before it and what
    comes after it both last for a thirtieth of the range.
    """
    small = _reduced(field.volume, _SIDE)
    low, high = field.stored_range
    levels = np.linspace(low, high, _LEVELS)
    numbers = [topology(field.solid(small.values, level)) for level in levels]
    found = []
    for k in range(1, _LEVELS - 2):
        before, after = numbers[k - 1 : k + 1], numbers[k + 1 : k + 3]
        if before[0] == before[1] != after[0] == after[1] and any(after[0]):
            changes = [f"{what} {a} to {b}" for what, a, b in zip(_COUNTED, before[1], after[0]) if a != b]
            found.append((float(field.volume.in_units(0.5 * (levels[k] + levels[k + 1]))), ", ".join(changes)))
    return found


def _below(share: float) -> str:
    return f"{share:.1%}" if share >= 0.001 else "less than 0.1 %"


def _plateau(field: Field) -> Iterator[Finding]:
    low, high = field.range
    found = [flat for flat in plateaus(field.volume) if low <= flat[0] <= high]
    if not found:
        return
    found.sort(key=lambda flat: -flat[1])
    named = ", ".join(f"{shown(at, field.range, 6)} ({_below(share)} of the cells)" for at, share, _ in found[:4])
    more = f" and {len(found) - 4} more values" if len(found) > 4 else ""
    at = ", ".join(f"{x + 0.0:.4g}" for x in found[0][2])
    yield Finding(
        "plateau",
        f"the field {field.name!r} is flat at {named}{more}, first around ({at}): a level set has no normal there and "
        "no light of its own; choose a --range without plateaus, or --smooth 1",
    )


def floor_of(turn: float, density: float = 1.0) -> float:
    """Relative error of a grid at any number of paths, from `turning` and its nodes per voxel along an axis."""
    return float(_FLOOR * turn**2 / density**_FALLS)


def _noise(field: Field, spec: GridSpec, smoothed: float) -> Iterator[Finding]:
    density = max(spec.shape) / max(field.volume.shape)
    turn = turning(field.volume, *field.stored_range)
    if turn < _ROUGH:
        return
    after = turn
    for sigma in (s for s in _BLURS if s > smoothed):  # of the data as they came: variances of blurs add up
        blurred = smooth(field.volume, min(np.sqrt(sigma**2 - smoothed**2), max(field.volume.shape)))
        after = turning(blurred, *field.stored_range)
        if after < _ROUGH or after >= _SOOTHED * turn:
            break
    if after < _SOOTHED * turn:
        yield Finding(
            "noise",
            f"normals of field {field.name!r} turn by {2 * np.degrees(np.arcsin(min(turn / 2, 1))):.0f} degrees from "
            f"voxel to voxel: on a grid of {max(spec.shape)} nodes the light keeps an error of about "
            f"{floor_of(turn, density):.0%} at any number of paths; --smooth {sigma:g} would reduce it to about "
            f"{floor_of(after, density):.0%}",
            f"--smooth {sigma:g}",
        )


def _crossings(values: NDArray[np.float32], isovalue: float, most: int) -> Floats:
    """Index coordinates (n, 3) of at most about `most` points where a level set crosses edges between voxels."""
    found = []
    solid = values >= isovalue
    for axis in range(3):
        line = np.moveaxis(solid, axis, 0)
        edges = np.argwhere(line[1:] != line[:-1])
        edges = edges[:: max(1, 3 * len(edges) // most)]
        low = np.insert(edges[:, 1:], axis, edges[:, 0], axis=1)
        before, after = values[tuple(low.T)], values[tuple((low + np.eye(3, dtype=int)[axis]).T)]
        found.append(low + np.eye(3)[axis] * ((isovalue - before) / (after.astype(float) - before))[:, None])
    return np.concatenate(found)


def _thin(field: Field, spec: GridSpec) -> Iterator[Finding]:
    volume, middle = field.volume, float(np.mean(field.range))
    index = _crossings(volume.values, float(volume.to_stored(middle)), 3000)
    if not len(index):
        return
    inward = -outward_normals(volume, index, field.inside)
    # Two nodes deeper a thick solid is still solid.
    deeper = interpolate(volume, index + 2 * spec.spacing.max() * inward / volume.spacing)
    lost = float((~field.solid(deeper, middle)).mean())
    if lost > _THIN:
        longest, enough = max(spec.shape), round(DENSITY * max(volume.shape))  # not one on each voxel: noise is worst
        todo = f"--grid {enough} has {DENSITY} nodes per voxel" if longest < enough else "resample the volume finer"
        yield Finding(
            "thin",
            f"{lost:.0%} of the surface of field {field.name!r} at {shown(middle, field.range)} is that of parts "
            f"thinner than two nodes of a grid of {longest}, so that light of both sides mixes there; {todo}",
        )


def _border(field: Field) -> Iterator[Finding]:
    faces, touched, total = [], 0, 0
    for axis, letter in enumerate("xyz"):
        for end, side in ((0, "first"), (-1, "last")):
            plane = np.take(field.volume.values, end, axis=axis)
            met = int(np.count_nonzero(field.solid(plane, field.volume.to_stored(field.widest))))
            touched, total = touched + met, total + plane.size
            if met:
                faces.append(f"the {side} {letter}")
    if touched > _TOUCHED * total:
        yield Finding(
            "border",
            f"at {shown(field.widest, field.range)} the solid of field {field.name!r} meets the volume's border "
            f"({', '.join(faces)} plane, {_below(touched / total)} of the border), where it is cut and closed by a "
            "plain cap; take a larger crop, or a --range farther inside",
        )


def _empty(field: Field) -> Iterator[Finding]:
    low, high = field.range
    levels = np.linspace(low, high, _LEVELS)
    values = field.volume.values
    counts, _ = np.histogram(values, np.concatenate([[-np.inf], field.volume.to_stored(levels), [np.inf]]))
    below = np.cumsum(counts)[:-1]
    smallest = np.minimum(below, values.size - below)
    bare = levels[smallest < _FEW]
    if len(bare):
        yield Finding(
            "empty",
            f"isovalues from {shown(bare.min(), levels)} to {shown(bare.max(), levels)} of field {field.name!r} have "
            f"(nearly) no surface: fewer than {_FEW} voxels lie on one side; choose a --range that leaves them out",
        )


def _anisotropy(field: Field) -> Iterator[Finding]:
    spacing = field.volume.spacing
    if spacing.max() > _ANISOTROPY * spacing.min():
        yield Finding(
            "anisotropy",
            f"voxels of field {field.name!r} are {spacing.max() / spacing.min():.3g} times longer along "
            f"{'xyz'[int(spacing.argmax())]} than along {'xyz'[int(spacing.argmin())]}: between far slices shapes and "
            "light are a guess; resample the volume to even voxels",
        )


def _range(field: Field) -> Iterator[Finding]:
    ends = (lowest, highest) = field.volume.extremes
    if field.range[0] < lowest or field.range[1] > highest:
        yield Finding(
            "range",
            f"the range {shown(field.range[0], ends)} to {shown(field.range[1], ends)} of field {field.name!r} goes "
            f"beyond its data, which run from {shown_range(ends)}: part of the sweep shows "
            "nothing; choose isovalues between them",
        )


def _labels(field: Field) -> Iterator[Finding]:
    labels = labels_in(field.volume)
    if labels:
        shown = ", ".join(map(str, labels[:8])) + (f", … {labels[-1]}" if len(labels) > 8 else "")
        yield Finding(
            "labels",
            f"field {field.name!r} looks like a map of labels ({shown}): its level sets are the faces of voxels, and "
            f"between two labels lie those of others; --label {labels[0]} lights a smooth surface of one, "
            f"--label {labels[0]},{labels[-1]} several",
        )


def diagnose(field: Field, spec: GridSpec, smoothed: float = 0.0) -> list[Finding]:
    """All that warns of a field under its range and the grid meant for it, which was blurred by `smoothed` voxels."""
    found = [
        *_labels(field),
        *_plateau(field),
        *_noise(field, spec, smoothed),
        *_thin(field, spec),
        *_border(field),
        *_empty(field),
    ]
    return [*found, *_anisotropy(field), *_range(field)]
