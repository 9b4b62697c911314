"""Distant light of a scene as emitters of Mitsuba: a constant, an image, or single directions."""

import numpy as np

from illumgrid.field.lights import Distant, Harmonics, Sky, basis
from illumgrid.field.upright import sky_axes

NARROW = 1.0
"""Degrees: a smaller disc, such as the sun, becomes a single direction of the same irradiance."""
ROWS = 512
"""Rows of the image of the sky; it has twice as many columns."""


def emitters(scene):
    """Descriptions of all distant light of a scene, by names."""
    found = {}
    narrow = [light for light in scene.lights if isinstance(light, Distant) and light.angle < NARROW]
    for number, light in enumerate(narrow):
        found[f"direction{number}"] = {
            "type": "directional",
            "direction": (-light.direction).tolist(),
            "irradiance": {"type": "rgb", "value": light.irradiance.tolist()},
        }
    wide = [light for light in scene.lights if light not in narrow]
    constant = scene.background + sum(
        (s.radiance for s in wide if isinstance(s, Sky) and s.radiance.ndim == 1), np.zeros(3)
    )
    varying = [light for light in wide if not (isinstance(light, Sky) and light.radiance.ndim == 1)]
    if varying:
        import mitsuba as mi

        image = picture(scene, constant, varying)
        found["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(image.astype(np.float32)), "mis_compensation": False}
    elif constant.any():
        found["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": constant.tolist()}}
    return found


def texel_directions(rows, columns):
    """World directions (rows, columns, 3) of the texels of an image in Mitsuba: up is y, rows reach the poles."""
    polar = np.pi * np.arange(rows)[:, None] / (rows - 1)
    azimuth = 2 * np.pi * (np.arange(columns) + 0.5)[None, :] / columns
    flat = np.sin(polar)
    return np.stack([flat * np.sin(azimuth), np.cos(polar) + 0 * azimuth, -flat * np.cos(azimuth)], axis=-1)


def picture(scene, constant, lights):
    """Radiance (ROWS, 2 ROWS, 3) of lights that differ with direction, and of a constant."""
    d = texel_directions(ROWS, 2 * ROWS)
    local = d @ sky_axes(scene).T
    total = np.broadcast_to(constant, d.shape).copy()
    solid = np.gradient(-np.cos(np.linspace(0, np.pi, ROWS)))[:, None] * np.pi / ROWS
    for light in lights:
        if isinstance(light, Distant):
            off = np.degrees(np.arccos(np.clip(d @ light.direction, -1, 1)))
            covered = np.clip((light.angle - off) * ROWS / 180 + 0.5, 0, 1)  # of a texel, about
            facing = np.maximum(d @ light.direction, 0)
            total += covered[..., None] * light.irradiance / (covered * facing * solid).sum()
        elif isinstance(light, Harmonics):
            degree = int(np.sqrt(len(light.coefficients))) - 1
            total += np.maximum(basis(degree, local.reshape(-1, 3)).reshape(*d.shape[:2], -1) @ light.coefficients, 0)
        elif light.radiance.ndim == 2:
            share = (local[..., 2:] + 1) / 2
            total += (1 - share) * light.radiance[0] + share * light.radiance[1]
        else:
            total += looked_up(light.radiance, local)
    return total


def looked_up(image, local):
    """An image of the sky, bilinear, along directions (..., 3) to right, back and up."""
    rows, columns, _ = image.shape
    v = np.clip(rows * np.arccos(np.clip(local[..., 2], -1, 1)) / np.pi - 0.5, 0, rows - 1)
    u = columns * (np.arctan2(local[..., 0], local[..., 1]) / (2 * np.pi) + 0.5) - 0.5
    i, j = np.minimum(v.astype(int), rows - 2), np.floor(u).astype(int)
    a, b = (v - i)[..., None], (u - j)[..., None]
    upper = (1 - b) * image[i, j % columns] + b * image[i, (j + 1) % columns]
    lower = (1 - b) * image[i + 1, j % columns] + b * image[i + 1, (j + 1) % columns]
    return (1 - a) * upper + a * lower
