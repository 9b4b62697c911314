"""From linear light to what a screen shows: the only place where light is clamped."""

import numpy as np
from numpy.typing import NDArray

WHITE = 0.8
"""Display radiance that automatic exposure gives to the brightest surfaces; sRGB 0.91, short of clipping."""


def automatic_exposure(radiance: NDArray[np.floating]) -> float:
    """Factor that brings the 90th percentile of the brightest channel of (n, 3) radiances to `WHITE`; 1 if all is dark.

    The brightest channel, not the luminance: a saturated surface keeps its hue.
    """
    if not len(radiance):
        return 1.0
    bright = float(np.quantile(radiance.max(axis=1), 0.9))
    return WHITE / bright if bright > 0 and np.isfinite(bright) else 1.0


def srgb_curve(linear: NDArray[np.floating]) -> NDArray[np.floating]:
    """Sample values of sRGB, 0 to 1, of linear display values, clamped to 0 .. 1 (IEC 61966-2-1)."""
    c = np.clip(linear, 0.0, 1.0)
    return np.asarray(np.where(c <= 0.0031308, 12.92 * c, 1.055 * np.power(np.maximum(c, 1e-9), 1 / 2.4) - 0.055))


def encode_srgb(linear: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Eight-bit sRGB of linear display values, clamped to 0 .. 1."""
    return np.asarray(np.round(255.0 * srgb_curve(linear)), dtype=np.uint8)


_byte = np.arange(256) / 255
_LINEAR = np.where(_byte <= 0.04045, _byte / 12.92, ((_byte + 0.055) / 1.055) ** 2.4).astype(np.float32)


def decode_srgb(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Linear display values of eight-bit sRGB."""
    return np.asarray(_LINEAR[picture])
