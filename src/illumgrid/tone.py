"""Exposure, tone curve and sRGB: from linear light to display values, the only place where light is clamped."""

import numpy as np
from numpy.typing import NDArray

WHITE = 0.8
"""Display radiance up to which the tone curve changes nothing; sRGB 231 of 255."""
DIRECTED = 0.66
"""Radiance of highlights under light from one side: sRGB 212 leaves the forms on the lit side their shades. In default
previews of 13 volumes the 95th percentile of the object's pixels then lies at 195 to 213."""
BRIGHT = 0.1
"""Share of the nodes, or under light from one side of the light, above highlights."""


def automatic_exposure(irradiance: NDArray[np.floating], albedo: NDArray[np.floating]) -> float:
    """Factor on albedo/π · irradiance, (n, 3) each, under which a picture is neither dark nor burnt out.

    Under the median light a colour given as albedo comes out as that colour, unless the highlights would then exceed
    the radiance `WHITE`: see `exposure_under`. 1 if all is dark.
    """
    if not len(irradiance):
        return 1.0
    return exposure_under(np.median(irradiance.mean(axis=1)), (irradiance * albedo).max(axis=1))


def exposure_under(median: float, brightest: NDArray[np.floating], directed: bool = False) -> float:
    """As `automatic_exposure`, from the median irradiance and the brightest channels (n,) of albedo · it, sorted here.

    Highlights are above the light that a tenth of the nodes exceed. Under light from one side (`directed`), whose
    brightness has a bound, they start at `DIRECTED` and are the brightest tenth of all light: nodes hidden in folds and
    noise, which nobody sees, are dark and many, but hold little of it.
    """
    brightest.sort()
    if directed:
        total = np.cumsum(brightest, dtype=float)
        bright = brightest[np.searchsorted(total, (1.0 - BRIGHT) * total[-1])]
    else:
        bright = np.quantile(brightest, 1.0 - BRIGHT)
    targets = (1.0, float(median) / np.pi), (DIRECTED if directed else WHITE, float(bright) / np.pi)
    return min((target / value for target, value in targets if 0 < value < np.inf), default=1.0)


def curve(linear: NDArray[np.floating]) -> NDArray[np.floating]:
    """Display values (..., 3), below 1, of exposed radiance (..., 3): highlights roll off and keep their hue.

    The curve of Khronos PBR Neutral [1]_ without its offset, which corrects for a specular layer that a diffuse surface
    does not have: values up to `WHITE` stay as they are, and shadows with them. Above, the brightest channel approaches
    1 as 1 - d²/(peak + 2d - 1), d = 1 - `WHITE`, the others keep their ratio to it, and the very bright fades to white.

    References
    ----------
    .. [1] Khronos Group, "Khronos PBR Neutral Tone Mapper", specification of 2024.
    """
    light = np.maximum(linear, 0.0)
    peak = light.max(axis=-1, keepdims=True)
    if not (peak > WHITE).any():
        return np.asarray(light)
    room = 1.0 - WHITE
    excess = np.minimum(np.maximum(peak - WHITE, 0.0), 1e30)
    rolled = 1.0 - room * room / (excess + room)
    faded = 1.0 - 1.0 / (0.15 * np.maximum(peak - rolled, 0.0) + 1.0)
    share = np.divide(light, peak, out=np.ones_like(light), where=np.isfinite(peak) & (peak > 0))
    return np.asarray(np.where(peak > WHITE, rolled * (share + (1.0 - share) * faded), light), dtype=linear.dtype)


def luminance(linear: NDArray[np.floating]) -> NDArray[np.float32]:
    """Luminance (...,) of linear RGB (..., 3), by the weights of Rec. 709, which are those of sRGB."""
    return np.asarray(linear @ np.array([0.2126, 0.7152, 0.0722]), np.float32)


def srgb_curve(linear: NDArray[np.floating]) -> NDArray[np.floating]:
    """Sample values of sRGB, 0 to 1, of linear display values, clamped to 0 .. 1 (IEC 61966-2-1)."""
    c = np.clip(linear, 0.0, 1.0)
    return np.asarray(np.where(c <= 0.0031308, 12.92 * c, 1.055 * np.power(np.maximum(c, 1e-9), 1 / 2.4) - 0.055))


def encode_srgb(linear: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Eight-bit sRGB of linear display values, clamped to 0 .. 1."""
    return np.asarray(np.round(255.0 * srgb_curve(linear)), dtype=np.uint8)


def encode_rgba(linear: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Eight-bit sRGB with coverage (..., 4) of linear display values (..., 4) that are multiplied by their coverage."""
    coverage = linear[..., 3:]
    color = np.divide(linear[..., :3], coverage, out=np.zeros_like(linear[..., :3]), where=coverage > 0)
    return np.concatenate([encode_srgb(color), np.round(255.0 * coverage).astype(np.uint8)], axis=-1)


_byte = np.arange(256) / 255
_LINEAR = np.where(_byte <= 0.04045, _byte / 12.92, ((_byte + 0.055) / 1.055) ** 2.4).astype(np.float32)


def decode_srgb(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Linear display values of eight-bit sRGB."""
    return np.asarray(_LINEAR[picture])
