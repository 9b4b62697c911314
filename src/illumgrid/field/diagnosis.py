"""Expected problems of a field, found before any light is computed: each finding has a name, a place and a remedy.

Critical isovalues are not findings: the true light is discontinuous there, too.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.constants import DENSITY
from illumgrid.errors import shown, shown_range
from illumgrid.field.coarse import block_means
from illumgrid.field.labels import labels_in
from illumgrid.field.lattice import GridSpec
from illumgrid.field.plateaus import FEWEST, Plateau, plateaus
from illumgrid.field.scene import Field
from illumgrid.field.volume import Floats, Volume, interpolate, outward_normals, slabs

_LEVELS = 64  # isovalues at which components, cavities and tunnels are counted
_COUNTED = ("components", "tunnels", "cavities")
_SIDE = 64  # voxels along the longest axis of the field on which they are counted


_LOOKED_AT = 1 << 24  # voxels of a field that is examined as a whole; of a larger one only parts, where that suffices
_BLOCK = 64  # voxels along a block of those
_ENOUGH = 1 << 20  # pairs of voxels whose normals are compared

_ROUGH = 0.5  # normals that turn this much from voxel to voxel are rough (see `turning`)
_NOISY = 0.7  # `bilateral` pays in the studio from here on: it lost at 0.61 and won at 0.85 (docs/interpolators.md)
_BLURS = (1.0, 1.5, 2.0, 3.0, 4.0)  # voxels; the first blur that leaves no rough normals is recommended
_SOOTHED = 0.8  # ... and if a blur by one voxel reduces the turning to this share, it is noise and not shape
_FLOOR = 0.12  # over turning²; within a factor of two on raw and blurred volumes of ten kinds (docs/stability.md)
_FALLS = 0.7  # the power of nodes per voxel with which that falls; 0.5 to 0.8 on most (docs/speed_and_accuracy.md)
_THIN = 0.25  # share of the surface that bounds parts thinner than two nodes
_FEW = 4  # voxels on the smaller side of a level set that hardly exists
_TOUCHED = 1e-3  # share of the border's voxels that are solid
_ANISOTROPY = 3.0


@dataclass(frozen=True)
class Finding:
    """A problem, reported before the light is computed.

    Parameters
    ----------
    name : str
        One of `illumgrid.errors.WARNINGS`.
    sentence : str
        What was found and where, and what to do.
    options : str
        Options of ``illumgrid run`` that are the remedy, such as ``--smooth 1``; else empty.
    """

    name: str
    sentence: str
    options: str = ""


def turning(volume: Volume, low: float, high: float, blur: float = 0.0) -> float:
    """How much the normal turns from voxel to voxel on level sets of a range of stored values: its RMS, 2 sin(angle/2).

    It is 0.1 on smooth fields, 0.8 on raw magnetic resonance images, 1.4 if neighbouring normals are independent, and 0
    if the range has no voxels. A volume of more than `_LOOKED_AT` voxels is examined in random blocks until they hold
    `_ENOUGH` pairs.

    Parameters
    ----------
    volume : Volume
    low, high : float
        Stored values.
    blur : float
        Standard deviation in voxels of a Gaussian that blurs the field first.
    """
    total, pairs, small = 0.0, 0, volume.stored.size <= _LOOKED_AT
    for block in _slabs_of(volume.shape) if small else _blocks_of(volume.shape):
        more, count = _turning_in(volume, block, low, high, blur)
        total, pairs = total + more, pairs + count
        if pairs >= _ENOUGH and not small:
            break
    return float(np.sqrt(total / pairs)) if pairs else 0.0


def noisy(field: Field) -> bool:
    """Whether the normals of the swept level sets turn so much that `bilateral` is the better interpolator.

    Next to a surface of such data, other nodes have level sets that are noise, with normals and shadows of their own.
    """
    return turning(field.volume, *field.stored_range) >= _NOISY


def _slabs_of(shape: tuple[int, int, int]) -> Iterator[tuple[slice, ...]]:
    for first in range(0, shape[0], 32):
        yield slice(first, min(first + 32, shape[0])), slice(0, shape[1]), slice(0, shape[2])


def _blocks_of(shape: tuple[int, int, int]) -> Iterator[tuple[slice, ...]]:
    """All blocks of `_BLOCK`³ voxels, in a random order that is always the same."""
    many = [-(-n // _BLOCK) for n in shape]
    for number in np.random.default_rng(0).permutation(int(np.prod(many))):
        at = np.unravel_index(number, many)
        yield tuple(slice(int(k) * _BLOCK, min((int(k) + 1) * _BLOCK, n)) for k, n in zip(at, shape))


def _turning_in(volume: Volume, block: tuple[slice, ...], low: float, high: float, blur: float) -> tuple[float, int]:
    """Sum of squared differences of normals between neighbouring voxels of the range in a block, and their number."""
    from scipy.ndimage import gaussian_filter

    v, around = volume.stored, int(4 * blur + 0.5) + 1  # as far as the Gaussian reaches, and a voxel for the slopes
    outer = tuple(slice(max(s.start - around, 0), s.stop + around + 1) for s in block)
    part = v[outer]
    if not blur and not ((part >= low) & (part <= high)).any():
        return 0.0, 0
    part = gaussian_filter(part, blur, output=np.float32, mode="nearest") if blur else part.astype(np.float32)
    near = (part >= low) & (part <= high)
    if not near.any():
        return 0.0, 0
    slopes = [np.gradient(part, np.float32(step), axis=axis) for axis, step in enumerate(volume.spacing)]
    gradient = np.stack(slopes, axis=-1)
    length = np.linalg.norm(gradient, axis=-1)
    on = near & (length > 0)
    gradient /= np.where(length > 0, length, 1)[..., None]
    total, pairs = 0.0, 0
    one = [slice(s.start - o.start, s.stop - o.start) for s, o in zip(block, outer)]
    for axis in range(3):
        other = list(one)
        other[axis] = slice(one[axis].start + 1, one[axis].stop + 1)
        b, found = gradient[tuple(other)], on[tuple(other)]
        a = tuple(slice(s.start, s.start + n) for s, n in zip(one, found.shape))  # one fewer at the border
        both = on[a] & found
        total += float(np.square(gradient[a][both] - b[both], dtype=np.float64).sum())
        pairs += int(both.sum())
    return total, pairs


def _reduced(volume: Volume, longest: int) -> NDArray[Any]:
    """The values on fewer voxels, blurred first against aliasing; unchanged if there are few."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    spec = GridSpec.over(volume, min(longest, max(volume.shape)))
    if spec.shape == volume.shape:
        return volume.stored
    factors = [max(1, n // (4 * m)) for n, m in zip(volume.shape, spec.shape)]
    if volume.stored.size > _LOOKED_AT and max(factors) > 1:
        volume = block_means(replace(volume, slope=1.0, intercept=0.0), factors)
    step = (np.array(volume.shape) - 1) / (np.array(spec.shape) - 1)
    sigma = 0.5 * np.sqrt(np.maximum(step**2 - 1, 0))
    soft = gaussian_filter(volume.stored, sigma, output=np.float32, mode="nearest")
    index = np.meshgrid(*(np.arange(n) * s for n, s in zip(spec.shape, step)), indexing="ij")
    return np.asarray(map_coordinates(soft, index, order=1, mode="nearest"))


def topology(solid: NDArray[np.bool_]) -> tuple[int, int, int]:
    """Components, tunnels and cavities (Betti numbers) of a set of voxels; pieces below 27 voxels are not counted."""
    from scipy.ndimage import label
    from skimage.measure import euler_number

    def without_crumbs(these: NDArray[np.bool_], connected: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], int]:
        piece, _ = label(these, connected)
        keep = np.bincount(piece.reshape(-1)) >= FEWEST
        keep[0] = False
        return keep[piece], int(keep.sum())

    solid, components = without_crumbs(solid, np.ones((3, 3, 3), bool))
    cross = np.abs(np.indices((3, 3, 3)) - 1).sum(axis=0) <= 1
    empty, outer = without_crumbs(np.pad(~solid, 1, constant_values=True), cross)
    cavities = outer - 1
    return components, components + cavities - int(euler_number(~empty, connectivity=3)), cavities


def critical_isovalues(field: Field) -> list[tuple[float, str]]:
    """Isovalues of the range at which the topology of the level set changes, and what changes; light jumps there.

    Counted on a field of at most 64 voxels per side at 64 isovalues; a change counts if the topologies before and after
    it both persist for a thirtieth of the range.
    """
    small = _reduced(field.volume, _SIDE)
    low, high = field.stored_range
    levels = np.linspace(low, high, _LEVELS)
    numbers = [topology(field.solid(small, level)) for level in levels]
    found = []
    for k in range(1, _LEVELS - 2):
        before, after = numbers[k - 1 : k + 1], numbers[k + 1 : k + 3]
        if before[0] == before[1] != after[0] == after[1] and any(after[0]):
            changes = [f"{what} {a} to {b}" for what, a, b in zip(_COUNTED, before[1], after[0]) if a != b]
            found.append((float(field.volume.in_units(0.5 * (levels[k] + levels[k + 1]))), ", ".join(changes)))
    return found


def _below(share: float) -> str:
    return f"{share:.1%}" if share >= 0.001 else "less than 0.1 %"


def _plateau(field: Field, known: list[Plateau] | None) -> Iterator[Finding]:
    low, high = field.range
    known = plateaus(field.volume) if known is None else known
    found = [flat for flat in known if low <= flat[0] <= high]
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
    low, high = field.stored_range
    turn = turning(field.volume, low, high)
    if turn < _ROUGH:
        return
    after = turn
    for sigma in (s for s in _BLURS if s > smoothed):  # of the original data: variances of blurs add up
        more = min(float(np.sqrt(sigma**2 - smoothed**2)), max(field.volume.shape))
        after = turning(field.volume, low, high, more)
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


def _crossings(values: NDArray[Any], isovalue: np.float64, most: int) -> Floats:
    """Index coordinates (n, 3) of at most about `most` points where a level set crosses edges between voxels."""
    parts = [slab for k, slab in enumerate(slabs(values.shape)) if k % max(1, values.size // _LOOKED_AT) == 0]
    counts, found = np.zeros((len(parts), 3), np.int64), []
    for k, slab in enumerate(parts):
        for axis, crossed in enumerate(_crossed_edges(values, slab, isovalue)):
            counts[k, axis] = np.count_nonzero(crossed)
    stride = np.maximum(1, 3 * counts.sum(axis=0) // most)
    for slab, passed in zip(parts, np.cumsum(counts, axis=0) - counts):
        for axis, crossed in enumerate(_crossed_edges(values, slab, isovalue)):
            edges = np.argwhere(np.moveaxis(crossed, axis, 0))[-passed[axis] % stride[axis] :: stride[axis]]
            low = np.insert(edges[:, 1:], axis, edges[:, 0], axis=1)
            low[:, 0] += slab.start
            before, after = values[tuple(low.T)], values[tuple((low + np.eye(3, dtype=int)[axis]).T)]
            share = (isovalue - before) / (after.astype(float) - before)
            found.append(low + np.eye(3)[axis] * share[:, None])
    return np.concatenate(found)


def _crossed_edges(values: NDArray[Any], slab: slice, isovalue: np.float64) -> Iterator[NDArray[np.bool_]]:
    """Along each axis, the edges that begin at the voxels of a slab and that a level set crosses."""
    solid = values[slab.start : slab.stop + 1] >= isovalue
    yield solid[1:] != solid[:-1]
    solid = solid[: slab.stop - slab.start]
    yield solid[:, 1:] != solid[:, :-1]
    yield solid[:, :, 1:] != solid[:, :, :-1]


def _thin(field: Field, spec: GridSpec) -> Iterator[Finding]:
    volume, middle = field.volume, float(np.mean(field.range))
    index = _crossings(volume.stored, np.float64(volume.to_stored(middle)), 3000)
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
            plane = np.take(field.volume.stored, end, axis=axis)
            met = int(np.count_nonzero(field.solid(plane, field.volume.to_stored(field.widest))))
            touched, total = touched + met, total + plane.size
            if met:
                faces.append(f"the {side} {letter}")
    widest = field.widest if field.isovalue is None else field.isovalue
    if touched > _TOUCHED * total:
        todo = "take a larger crop, or a --range farther inside"
        if touched > total / 2:
            todo = f"if the solid is what surrounds the object, use --inside {'below' if field.upward > 0 else 'above'}"
        yield Finding(
            "border",
            f"at {shown(widest, field.range)} the solid of field {field.name!r} meets the volume's border "
            f"({', '.join(faces)} plane, {_below(touched / total)} of the border), where it is cut and closed by a "
            f"flat cap; {todo}",
        )


def _empty(field: Field) -> Iterator[Finding]:
    low, high = field.range
    levels = np.linspace(low, high, _LEVELS)
    below = _below_each(field.volume, field.volume.to_stored(levels))
    smallest = np.minimum(below, field.volume.stored.size - below)
    bare = levels[smallest < _FEW]
    if len(bare):
        yield Finding(
            "empty",
            f"isovalues from {shown(bare.min(), levels)} to {shown(bare.max(), levels)} of field {field.name!r} have "
            f"(nearly) no surface: fewer than {_FEW} voxels lie on one side; choose a --range that leaves them out",
        )


def _below_each(volume: Volume, levels: Floats) -> NDArray[np.int64]:
    """Number of voxels below each of some stored levels, increasing."""
    if volume.stored.dtype.kind != "f":
        values, counts = volume.tally
        return np.concatenate([[0], np.cumsum(counts)])[np.searchsorted(values, levels)]
    upto = np.zeros(len(levels) + 1, np.int64)
    for slab in slabs(volume.shape):
        reached = np.searchsorted(levels, volume.stored[slab].reshape(-1), side="right")
        upto += np.bincount(reached, minlength=len(upto))
    return np.cumsum(upto)[:-1]


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
            f"between two labels lie those of others; --label {labels[0]} lights a smooth surface of one"
            + (f", --label {labels[0]},{labels[-1]} several" if len(labels) > 1 else ""),
        )


def diagnose(field: Field, spec: GridSpec, smoothed: float = 0.0, flat: list[Plateau] | None = None) -> list[Finding]:
    """All findings about a field, its range and its planned grid; `smoothed` voxels of blur were already applied.

    `flat` are its `plateaus`, where they are known already.
    """
    found = [
        *_labels(field),
        *_plateau(field, flat),
        *_noise(field, spec, smoothed),
        *_thin(field, spec),
        *_border(field),
        *_empty(field),
    ]
    return [*found, *_anisotropy(field), *_range(field)]
