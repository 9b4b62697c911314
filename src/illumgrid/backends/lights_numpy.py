"""Directions, lamps and distant light in NumPy: the twin of `lights` for the backend `reference`."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.levelset import Marchable
from illumgrid.field.lights import basis
from illumgrid.field.volume import Floats

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def cosine_direction(u1: Floats, u2: Floats, normal: Floats) -> Floats:
    """Directions (n, 3) of density cosine / π about the normals."""
    radius, angle = np.sqrt(u1), 2 * np.pi * u2
    return about(radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - u1), normal)


def about(x: Floats, y: Floats, z: Floats, normal: Floats) -> Floats:
    """Directions (n, 3) with these coordinates about normals; the frame by Duff et al., JCGT 6(1), 2017."""
    nx, ny, nz = normal.T
    sign = np.where(nz >= -1e-6, 1.0, -1.0)
    a = -1 / (sign + nz)
    b = nx * ny * a
    tangent = np.stack([1 + sign * nx * nx * a, sign * b, -sign * nx], axis=1)
    bitangent = np.stack([b, sign + ny * ny * a, -ny], axis=1)
    local = np.stack([x, y, z])[:, :, None]
    return np.asarray(local[0] * tangent + local[1] * bitangent + local[2] * normal)


def lamp_density(scene: Marchable, q: Ints, distance: Floats, d: Floats) -> Floats:
    """Density per solid angle (n,) with which lamps are sampled at points of quads q, at these distances along d."""
    facing = -np.einsum("ij,ij->i", scene.quad_normal[q], d)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(facing > 0, scene.lamp_density[q] * distance * distance / facing, 0.0)


def image_place(scene: Marchable, d: Floats) -> tuple[Floats, Floats]:
    """Rows and columns (n,), fractions of pixels from their edges, at which the image holds directions (n, 3)."""
    x, y, z = scene.sky_axes @ d.T
    rows, columns = scene.image_density.shape
    return rows * np.arccos(np.clip(z, -1, 1)) / np.pi, columns * (np.arctan2(x, y) / (2 * np.pi) + 0.5)


def distant_direction(scene: Marchable, u: Floats) -> Floats:
    """Directions (n, 3) that sample distant light, from the numbers u (n, 3)."""
    disc = np.minimum(np.searchsorted(scene.asked[2:], u[:, 2], side="right"), len(scene.disc_cosine) - 1)
    result = np.zeros((len(u), 3))
    pictured = u[:, 2] < scene.asked[1]
    if not pictured.all():
        z, angle = 1 - u[:, 0] * (1 - scene.disc_cosine[disc]), 2 * np.pi * u[:, 1]
        radius = np.sqrt(np.maximum(0, 1 - z * z))
        result[:] = about(radius * np.cos(angle), radius * np.sin(angle), z, scene.disc_axis[disc])
    if pictured.any():
        rows, columns = scene.image_density.shape
        first, second = u[pictured, 0], u[pictured, 1]
        edges = np.concatenate([[0.0], scene.image_rows])
        i = np.searchsorted(scene.image_rows, first, side="right")
        inner = np.column_stack([np.zeros(rows), scene.image_columns])[i]
        j = (inner[:, 1:] <= second[:, None]).sum(axis=1)
        down = (first - edges[i]) / (edges[i + 1] - edges[i])
        low, high = (np.take_along_axis(inner, k[:, None], 1)[:, 0] for k in (j, j + 1))
        top, bottom = np.cos(np.pi * i / rows), np.cos(np.pi * (i + 1) / rows)
        z = top + down * (bottom - top)
        azimuth = 2 * np.pi * ((j + (second - low) / (high - low)) / columns - 0.5)
        level = np.sqrt(np.maximum(0, 1 - z * z))
        result[pictured] = np.stack([level * np.sin(azimuth), level * np.cos(azimuth), z], axis=1) @ scene.sky_axes
    return result


def distant_density(scene: Marchable, d: Floats) -> Floats:
    """Density per solid angle (n,) with which `distant_direction` samples directions (n, 3)."""
    density = ((d @ scene.disc_axis.T >= scene.disc_cosine) * scene.disc_density).sum(axis=1)
    if len(scene.image):
        v, u = image_place(scene, d)
        rows, columns = scene.image_density.shape
        i, j = np.minimum(v.astype(int), rows - 1), np.minimum(u.astype(int), columns - 1)
        density = density + scene.image_density[i, j]
    return np.asarray(density)


def asked_radiance(scene: Marchable, d: Floats) -> Floats:
    """Radiance (n, C) of the image, bilinear, and of the discs along directions (n, 3)."""
    light = (d @ scene.disc_axis.T >= scene.disc_cosine) @ scene.disc_radiance
    if len(scene.image):
        v, u = image_place(scene, d)
        rows, columns = scene.image_density.shape
        v, u = np.clip(v - 0.5, 0, rows - 1), u - 0.5
        i, left = np.minimum(v.astype(int), rows - 2), np.floor(u).astype(int)
        down, across = (v - i)[:, None], (u - left)[:, None]
        ends = left % columns, (left + 1) % columns
        upper, lower = (
            (1 - across) * scene.image[i + k, ends[0]] + across * scene.image[i + k, ends[1]] for k in (0, 1)
        )
        light = light + (1 - down) * upper + down * lower
    return np.asarray(light)


def sky_seen(scene: Marchable, normal: Floats, d: Floats) -> Iterator[tuple[Floats, Floats]]:
    """Light of the sky for rays that escape along d: pairs of a weight (n, 1) and radiance (n, C).

    Distant light that is also sampled directly has the weight of the balance heuristic, all other light 1.
    """
    every = np.ones((len(d), 1))
    yield every, np.tile(scene.background, (len(d), 1))
    if len(scene.harmonics):
        yield every, basis(math.isqrt(len(scene.harmonics)) - 1, d @ scene.sky_axes.T) @ scene.harmonics
    if scene.asked[0] < 1:
        by_cosine, by_light = np.einsum("ij,ij->i", normal, d) / np.pi, distant_density(scene, d)
        yield (by_cosine / (by_cosine + by_light))[:, None], asked_radiance(scene, d)
