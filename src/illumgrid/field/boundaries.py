"""Boundaries between the classes in the data (air, skin, bone), and the range of isovalues that contains them.

At a boundary the slope is greatest across it: there the second derivative along the gradient vanishes (G. Kindlmann and
J. Durkin, "Semi-automatic generation of transfer functions for direct volume rendering", VolVis 1998; J. Canny, "A
computational approach to edge detection", PAMI 8(6), 1986). The values at such voxels are the isovalues of
interest: those whose surfaces are steep.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from itertools import product

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput, shown
from illumgrid.field.filters import finite
from illumgrid.field.volume import UPWARD, Floats, Side, Volume, histogram, slabs

_VOXELS = 1 << 22  # voxels of a large volume that are examined, in slabs spread over it
_SLAB, _MARGIN = 16, 4  # slices of a slab, and of what the blur needs around it
_SLABBED, _CUBE = 1 << 24, 48  # voxels beyond which cubes of this side are examined
_BLUR = 1.0  # voxels: a blur against noise
_FLAT = 0.003  # of the steepest slope: flatter voxels are not examined
_STEEP = 0.05, 0.15  # of the slope of the steep boundaries: flatter ones are noise, without and with a background
_NOISE = 4.0  # over the slopes of four fifths of the background: steeper voxels are not noise
_RIDGE = 1e-3  # by which a slope exceeds those a voxel ahead and behind, relative
_FEWEST = 64  # boundary voxels from which a range is taken
_OUTER, _INNER = 0.02, 0.8  # shares of the boundaries above which a range begins, and of their slopes, where it ends
_THIN = 0.45  # share of the voxels of a solid whose six neighbours belong to it: in a fibre of six voxels, (1 - 2/6)²
_VALLEY, _FLANK = 0.7, 0.5  # density of boundaries, over that of the lower peak beside it, and of the nearest peak
_BINS = 64  # of the density of the boundaries' values
_INSIDE = 0.05  # of the span of the data, by which a range stays away from their ends
_BALANCED = 0.3  # smaller over larger extreme of a field of both signs
_SMALL = 0.1  # of the smaller extreme: most of the voxels of such a field are nearer to 0
_HAZE, _CLEAR = 0.1, 0.05  # shares of the border that are solid at the middle of a range in haze, and where it clears


def suggest_range(volume: Volume, inside: Side = "above") -> tuple[float, float, str]:
    """Suggest a range of isovalues that contains the boundaries of the data's classes, with the reason.

    Returns
    -------
    low, high : float
        Nearly all boundaries lie above the outer end, and four fifths of their slopes before the inner end. Where the
        middle would be between two boundaries (inside soft tissue, where surfaces are noise), the range is moved until
        its middle is at the deeper one. Boundaries of fibres lie at half of what they reach, from faint to bright: if
        the object at the middle is thin, the middle becomes the geometric mean of the ends, where fibres hang together.
        Fields without boundaries (too small, or of one slope) get Otsu's threshold [1]_ and the median of what lies
        inside it. With `inside` "below" the same is done for -h. Fields of both signs get the range of
        `suggest_magnitudes` on the solid's side of 0: across 0 the solid becomes the whole volume.
    why : str
        The reason, one sentence with the numbers.

    Raises
    ------
    BadInput
        If the values are constant: no level set is a surface.

    References
    ----------
    .. [1] N. Otsu, "A threshold selection method from gray-level histograms", IEEE Trans. SMC 9(1), 1979.
    """
    return _on_one_side(volume, inside) if has_both_signs(volume) else _suggest(volume, inside)


def suggest_magnitudes(volume: Volume) -> tuple[float, float, str]:
    """Suggest a range of c for the surfaces at +c and -c: `suggest_range` of the absolute value of h."""
    return _suggest(_parts(volume, np.abs), "above")


def has_both_signs(volume: Volume) -> bool:
    """Whether the finite values reach about as far below 0 as above, and most are near 0 and peak there.

    Soft tissue in Hounsfield units, between air and bone, is near 0 as well, but peaks at fat or muscle.
    """
    low, high = volume.extremes
    if not low < 0 < high or min(-low, high) < _BALANCED * max(-low, high):
        return False
    ends = volume.to_stored(np.array([-_SMALL, _SMALL]) * min(-low, high))
    counts, _ = histogram(volume, 21, (float(ends.min()), float(ends.max())))
    return bool(counts.sum() > 0.5 * volume.stored.size and abs(int(np.argmax(counts)) - 10) <= 1)


def _parts(volume: Volume, part: Callable[[Floats], Floats]) -> Volume:
    """The volume with a function applied to h, 0 where h is not finite."""
    values = np.empty(volume.shape, np.float32 if volume.plain else np.float64)
    for slab in slabs(volume.shape):
        h = volume.in_units(volume.stored[slab].astype(values.dtype))
        values[slab] = part(np.nan_to_num(h, nan=0.0, posinf=0.0, neginf=0.0))
    return replace(volume, stored=values, slope=1.0, intercept=0.0)


def _on_one_side(volume: Volume, inside: Side) -> tuple[float, float, str]:
    """The range for h >= c > 0, or h <= c < 0, of a field of both signs."""
    sign = UPWARD[inside]
    reach = max(sign * x for x in volume.extremes)
    low, high, why = suggest_magnitudes(volume)
    if high > reach:  # the other side extends farther
        low, high, why = _suggest(_parts(volume, lambda h: np.maximum(sign * h, 0)), "above")
    low, high = sorted((sign * low, sign * high))
    side = "positive" if sign > 0 else "negative"
    return low, high, f"the field has both signs, this is the {side} side; without the sign {why}"


def _suggest(volume: Volume, inside: Side) -> tuple[float, float, str]:
    volume = _varying(volume, inside)
    value, slope = _boundary_voxels(volume, inside)
    if len(value) < _FEWEST:
        return _from_histogram(volume, inside)
    order = np.argsort(value, kind="stable")
    upto = np.cumsum(slope[order])
    steepest = value[order][np.searchsorted(upto, _INNER * upto[-1])]
    ends = np.clip([np.quantile(value, _OUTER), steepest], _INSIDE, 1 - _INSIDE)
    outer, inner = np.clip(_around_a_boundary(_density(value), *ends), _INSIDE, 1 - _INSIDE)
    if _thickness(volume, _in_units(volume, inside, [0.5 * (outer + inner)])[0], inside) < _THIN:
        inner = min(inner, 2 * np.sqrt(outer * inner) - outer)
    begun = outer
    outer, inner = _out_of_haze(volume, inside, value, slope, (outer, inner))
    if inner - outer < _INSIDE:  # a step: its surfaces are the same
        outer, inner = np.clip(0.5 * (outer + inner) + 0.5 * _INSIDE * np.array([-1, 1]), 0, 1)
    peaks = _peaks(_density(value))
    at = [shown(x, volume.extremes, 3) for x in sorted(_in_units(volume, inside, peaks))]
    low, high = sorted(_in_units(volume, inside, [outer, inner]))
    plural = "boundaries between classes of the data lie" if len(at) > 1 else "the boundary of the object lies"
    why = f"{plural} around {', '.join(at)}, where surfaces are steep"
    if min(peaks, default=1.0) < outer:  # a reason that the numbers do not contradict
        why += (
            "; the range begins where the solid has left most of the volume's border"
            if outer > begun
            else f"; the range stays {_INSIDE:.0%} of the span of the data away from their ends"
        )
    return low, high, why


def _out_of_haze(
    volume: Volume, inside: Side, value: Floats, slope: Floats, ends: tuple[float, float]
) -> tuple[float, float]:
    """The range; if the solid at its middle fills much of the border, a range that begins where it leaves it.

    A field of one class that thins out in all directions, as density does around a cluster of galaxies, has most of its
    boundaries in the haze, which the border cuts; what people look for are the bodies within. Fields of several classes
    are left as they are: a crop may cut skin.
    """
    faces = [np.take(volume.stored, end, axis=axis).ravel() for axis in range(3) for end in (0, -1)]
    low, high = (float(x) for x in volume.stored_extremes)
    share = (np.concatenate(faces).astype(float) - low) / (high - low)
    border = share if UPWARD[inside] > 0 else 1 - share
    clear = float(np.quantile(border, 1 - _CLEAR))
    if (border >= 0.5 * sum(ends)).mean() < _HAZE or len(_peaks(_density(value))) > 1 or clear > 1 - 2 * _INSIDE:
        return ends
    within = value > clear
    if within.sum() < _FEWEST:
        return ends
    order = np.argsort(value[within], kind="stable")
    upto = np.cumsum(slope[within][order])
    inner = float(value[within][order][np.searchsorted(upto, _INNER * upto[-1])])
    return clear, min(inner, 1 - _INSIDE)


def boundaries(volume: Volume, inside: Side = "above") -> list[float]:
    """Isovalues at which most surfaces are steep, one for each boundary between classes; lowest first."""
    volume = _varying(volume, inside)
    value, _ = _boundary_voxels(volume, inside)
    return sorted(_in_units(volume, inside, _peaks(_density(value)))) if len(value) >= _FEWEST else []


def otsu_threshold(volume: Volume, inside: Side = "above") -> float:
    """Otsu's isovalue between background and object."""
    counts, depth = _histogram(_varying(volume, inside), inside)
    return float(volume.in_units(UPWARD[inside] * _otsu(counts, depth)))


def _varying(volume: Volume, inside: Side) -> Volume:
    volume = finite(volume, inside)
    lowest, highest = volume.stored_extremes
    if lowest == highest:
        raise BadInput(
            f"the values are all {volume.in_units(lowest):g}; expected a field that varies, or there is no isosurface"
        )
    return volume


def _in_units(volume: Volume, inside: Side, depth: Floats | list[float]) -> list[float]:
    """Isovalues at shares of the span of the data, counted inward."""
    low, high = (float(x) for x in volume.stored_extremes)
    share = np.asarray(depth) if UPWARD[inside] > 0 else 1 - np.asarray(depth)
    return [float(x) for x in np.asarray(volume.in_units(low + share * (high - low)))]


def _parts_of(shape: tuple[int, int, int]) -> list[tuple[slice, ...]]:
    """Slabs along x, all or some; beyond `_SLABBED` voxels, a cube in the middle of each of 4³ parts."""
    every = max(1, int(np.ceil(np.prod(shape, dtype=float) / _VOXELS)))
    if np.prod(shape, dtype=float) > _SLABBED:
        middles = [[(2 * k + 1) * n // 8 for k in range(4)] for n in shape]
        return [
            tuple(slice(max(0, m - _CUBE // 2), min(n, m + _CUBE // 2)) for m, n in zip(at, shape))
            for at in product(*middles)
        ]
    whole = slice(0, shape[1]), slice(0, shape[2])
    return [(slice(first, min(first + _SLAB, shape[0])), *whole) for first in range(0, shape[0], _SLAB * every)]


def _blurred(volume: Volume, inside: Side) -> list[tuple[NDArray[np.float32], tuple[slice, ...]]]:
    """Blurred parts of a volume with values from 0 outside to 1 inside, and the slices to be counted."""
    from scipy.ndimage import gaussian_filter

    v = volume.stored
    low, high = (float(x) for x in volume.stored_extremes)
    found = []
    for block in _parts_of(volume.shape):
        outer = tuple(slice(max(0, s.start - _MARGIN), s.stop + _MARGIN) for s in block)
        part = (v[outer].astype(float) - low) / (high - low)
        part = part if UPWARD[inside] > 0 else 1 - part
        counted = tuple(slice(s.start - o.start, s.stop - o.start) for s, o in zip(block, outer))
        found.append((gaussian_filter(part.astype(np.float32), _BLUR, mode="nearest"), counted))
    return found


def _boundary_voxels(volume: Volume, inside: Side) -> tuple[Floats, Floats]:
    """Values, as shares of the span, and slopes (n,) of voxels steeper than their neighbours and than noise."""
    from scipy.ndimage import map_coordinates

    counts, depth = _histogram(volume, inside)
    sign, (low, high) = UPWARD[inside], (float(x) for x in volume.stored_extremes)
    threshold = (_otsu(counts, depth) - min(sign * low, sign * high)) / (high - low)
    ground, value, slope, step = [], [], [], volume.spacing / volume.spacing.min()
    for part, counted in _blurred(volume, inside):
        gradient = np.stack(
            [np.gradient(part, np.float32(s), axis=a) if part.shape[a] > 1 else 0 * part for a, s in enumerate(step)]
        )
        length = np.sqrt(np.square(gradient).sum(axis=0))
        ground.append(length[counted][part[counted] < threshold])
        within = np.zeros(part.shape, bool)
        within[counted] = length[counted] > _FLAT * length.max()
        flat = np.flatnonzero(within)
        index, own = np.array(np.unravel_index(flat, part.shape)), length.ravel()[flat]
        along = gradient.reshape(3, -1).take(flat, axis=1) / step[:, None]
        along /= reduce(np.maximum, np.abs(along))
        ridge = np.arange(len(flat))
        for way in (1, -1):  # only voxels steeper than the one ahead are compared with the one behind
            at = index.take(ridge, axis=1) + way * along.take(ridge, axis=1)
            ridge = ridge[own[ridge] > (1 + _RIDGE) * map_coordinates(length, at, order=1, mode="nearest")]
        value.append(part.ravel()[flat[ridge]])
        slope.append(own[ridge])
    values, slopes, level = (np.concatenate(parts).astype(float) for parts in (value, slope, ground))
    if len(slopes) < _FEWEST:
        return values, slopes
    by_slope = np.sort(slopes)
    upto = np.cumsum(by_slope)
    strong = by_slope[min(np.searchsorted(upto, 0.9 * upto[-1]), len(by_slope) - 1)]
    noise = _NOISE * float(np.quantile(level, 0.8)) if len(level) else 0.0
    steep = slopes > np.clip(noise, _STEEP[0] * strong, _STEEP[1] * strong)
    return values[steep], slopes[steep]


def _density(value: Floats) -> Floats:
    """Density of the boundaries' values in `_BINS` bins of the span; the greatest is 1."""
    from scipy.ndimage import gaussian_filter1d

    counts, _ = np.histogram(value, _BINS, (0, 1))
    smooth = gaussian_filter1d(counts.astype(float), 1.5, mode="constant")
    return np.asarray(smooth / smooth.max())


def _around_a_boundary(density: Floats, outer: float, inner: float) -> tuple[float, float]:
    """The range, or, if its middle is in a valley between two boundaries, one around the deeper of them.

    The new range still begins before the outer boundary.
    """
    here = min(int(0.5 * (outer + inner) * _BINS), _BINS - 1)
    shallow, deeper = density[: here + 1], density[here:]
    if density[here] >= _VALLEY * min(shallow.max(), deeper.max()):
        return outer, inner
    middle = (here + int(np.argmax(deeper >= _FLANK * deeper.max())) + 1) / _BINS
    outer = max(outer, int(np.argmax(shallow >= _FLANK * shallow.max())) / _BINS)
    return outer, max(inner, 2 * middle - outer)


def _peaks(density: Floats) -> list[float]:
    """Shares of the span at which boundaries are densest, each with a valley to the next.

    As by `scipy.signal.find_peaks`, whose import takes half a second of every command that suggests a range.
    """
    padded = np.pad(density, 1)
    begins = np.flatnonzero(np.diff(padded, prepend=-1.0))  # of runs of equal density
    ends, height, found = np.append(begins[1:], len(padded)) - 1, padded[begins], []
    for k in range(1, len(height) - 1):
        top, before, after = height[k], height[: k + 1][::-1], height[k:]
        if top < max(0.1, height[k - 1], height[k + 1]):
            continue
        # How far the density falls on the way to a higher value, or to the end.
        valleys = [side[: np.argmax(side > top) or len(side)].min() for side in (before, after)]
        if top - max(valleys) >= max(0.1, np.nextafter(0.5 * top, 1.0)):
            found.append((int(begins[k] + ends[k]) // 2 - 0.5) / _BINS)
    return found


def _thickness(volume: Volume, isovalue: float, inside: Side) -> float:
    """Share of the solid's voxels whose six neighbours belong to it, too; 1 without any."""
    level, total, deep = volume.to_stored(isovalue), 0, 0
    for part in slabs((volume.shape[0] - 2, *volume.shape[1:])):
        values = volume.stored[part.start : part.stop + 2]
        solid = values >= level if UPWARD[inside] > 0 else values <= level
        within = solid[1:-1, 1:-1, 1:-1].copy()
        total += int(np.count_nonzero(within))
        for axis in range(3):
            for side in (slice(0, -2), slice(2, None)):
                at = [slice(1, -1)] * 3
                at[axis] = side
                within &= solid[tuple(at)]
        deep += int(np.count_nonzero(within))
    return deep / total if total else 1.0


def _histogram(volume: Volume, inside: Side) -> tuple[NDArray[np.int64], Floats]:
    """Counts of voxels and the middles of the bins, upwards."""
    counts, edges = histogram(volume, 1024)
    depth = 0.5 * (edges[1:] + edges[:-1])
    return (counts, depth) if UPWARD[inside] > 0 else (counts[::-1], -depth[::-1])


def _otsu(counts: NDArray[np.int64], depth: Floats) -> float:
    from skimage.filters import threshold_otsu

    return float(threshold_otsu(hist=(counts, depth)))


def _from_histogram(volume: Volume, inside: Side) -> tuple[float, float, str]:
    counts, depth = _histogram(volume, inside)
    threshold = _otsu(counts, depth)
    within = np.where(depth > threshold, counts, 0)
    # The bin that contains the median of the object, at least one bin deeper than the threshold.
    deep = float(
        depth[max(np.searchsorted(np.cumsum(within), 0.5 * within.sum()), np.searchsorted(depth, threshold) + 1)]
    )
    share = within.sum() / counts.sum()
    at, half = (float(volume.in_units(UPWARD[inside] * x)) for x in (threshold, deep))
    low, high = sorted((at, half))
    why = (
        f"Otsu's threshold {shown(at, volume.extremes)} separates object ({share:.1%} of the voxels) and background, "
        f"and half of the object lies {inside} {shown(half, volume.extremes)}"
    )
    return low, high, why
