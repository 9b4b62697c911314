"""Changes of the values of a volume before it is lit: gaps are filled, noise is blurred."""

import numpy as np

from illumgrid.errors import BadInput, tell
from illumgrid.field.volume import UPWARD, Side, Volume


def finite(volume: Volume, inside: Side) -> Volume:
    """Replace non-finite values, with a warning: NaN by the value farthest outside, ±inf by the finite extremes."""
    if not volume.gaps:
        return volume
    good = np.isfinite(volume.stored)
    low, high = (float(x) for x in volume.stored_extremes)
    outermost = low if UPWARD[inside] > 0 else high
    lowest, highest = volume.extremes
    farthest = lowest if UPWARD[inside] > 0 else highest
    where = np.unravel_index(int(np.argmin(good)), volume.shape)
    infinite = int(np.count_nonzero(np.isinf(volume.stored)))
    became = [f"NaN became {farthest:g}, the value farthest outside"] if volume.gaps > infinite else []
    became += [f"infinities became {lowest:g} and {highest:g}"] if infinite else []
    tell(
        "finite",
        f"{volume.gaps} of {good.size} voxels are not finite (the first at {tuple(map(int, where))}): "
        + ", ".join(became),
        stacklevel=2,
    )
    return volume.with_stored(np.nan_to_num(volume.stored, nan=outermost, posinf=high, neginf=low))


def smooth(volume: Volume, sigma: float) -> Volume:
    """Blur by a Gaussian with a standard deviation of `sigma` voxels (for noisy data); 0 changes nothing."""
    longest = max(volume.shape)
    if not 0 <= sigma <= longest:  # a larger blur leaves nothing, and its kernel might not fit into memory
        raise BadInput(f"smoothing by {sigma} voxels; expected a number from 0 to {longest}, the longest axis")
    if sigma == 0:
        return volume
    from scipy.ndimage import gaussian_filter

    return volume.with_stored(gaussian_filter(volume.stored, sigma, output=np.float32, mode="nearest"))
