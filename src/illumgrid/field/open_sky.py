"""Irradiance of a flat face under an unobstructed sky: a sum of closed forms, one for each kind of light."""

from collections.abc import Sequence

import numpy as np

from illumgrid.field.layers import Channel, light_tables, resampled
from illumgrid.field.lights import basis, pixel_directions
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats

COSINE = np.pi * np.array([1, 2 / 3, 1 / 4, 0, -1 / 24])
"""Factors from spherical harmonics of each degree to irradiance (Ramamoorthi and Hanrahan 2001)."""
_ROWS = 512  # of an image, at least: sums over pixels are then within 1e-5 of the integral of what lies between them


def open_irradiance(scene: Scene, channels: Sequence[Channel], normals: Floats) -> Floats:
    """Irradiance (n, C) of faces that look along world unit vectors (n, 3) and see nothing but distant light."""
    tables = light_tables(scene, channels)
    frame = normals @ scene.fields[0].volume.direction
    aloft = frame @ tables["sky_axes"].T
    total = np.pi * np.tile(tables["background"], (len(normals), 1))
    if len(tables["harmonics"]):
        degree = int(np.sqrt(len(tables["harmonics"]))) - 1
        kept = np.repeat(COSINE[: degree + 1], 2 * np.arange(degree + 1) + 1)
        total += basis(degree, aloft) @ (kept[:, None] * tables["harmonics"])
    for axis, cosine, radiance in zip(tables["disc_axis"], tables["disc_cosine"], tables["disc_radiance"]):
        total += of_disc(frame @ axis, float(cosine))[:, None] * radiance
    image = tables["image"]
    if len(image):
        finer = -(-_ROWS // len(image))
        rows, columns = finer * image.shape[0], finer * image.shape[1]
        directions, solid = pixel_directions(rows, columns)
        for d, angle, colors in zip(directions, solid, resampled(image, rows, columns)):
            total += angle * np.maximum(aloft @ d.T, 0.0) @ colors
    return np.asarray(total)


def of_disc(towards: Floats, cosine: float) -> Floats:
    """Irradiance (n,) by a disc of the sky of radiance 1 and half-angle acos(cosine), perhaps partly below the horizon.

    Parameters
    ----------
    towards : (n,) float64
        Cosines between the normals and the direction to the disc's middle.
    cosine : float

    References
    ----------
    .. [1] J. M. Snyder, "Area light sources for real-time graphics", Microsoft Research MSR-TR-96-11, 1996.
    """
    sine = np.sqrt(1.0 - cosine * cosine)
    across = np.sqrt(np.maximum(1.0 - towards * towards, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        edge = np.clip(-cosine * towards / (sine * across), -1.0, 1.0)  # cosine of the azimuth at which it rises
    edge = np.nan_to_num(edge)
    rim = across * np.sqrt(1.0 - edge * edge)
    part = sine * sine * towards * np.arccos(edge) - sine * cosine * rim + np.arctan2(rim * sine, cosine)
    whole = np.pi * sine * sine * towards
    return np.asarray(np.where(towards >= sine, whole, np.where(towards <= -sine, 0.0, part)))
