"""Lights for the path loop, compiled: directions in which to sample them, densities, and their radiance.

`illumgrid.field.levelset.Marchable` describes the tables.
"""

import numpy as np

from illumgrid.backends import march, simd
from illumgrid.backends.march import dot
from illumgrid.backends.simd import cached

jit = cached(simd, march, _nrt=False)
inlined = cached(simd, march, _nrt=False, forceinline=True)


@jit
def about(x, y, z, nx, ny, nz):
    """Direction with the coordinates x, y, z in a frame whose third axis is n.

    The frame by Duff et al., "Building an orthonormal basis, revisited", JCGT 6(1), 2017.
    """
    sign = 1.0 if nz >= -1e-6 else -1.0  # 0 is common on voxel data and becomes -1e-17 in a rotated frame
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return (
        x * (1.0 + sign * nx * nx * a) + y * b + z * nx,
        x * sign * b + y * (sign + ny * ny * a) + z * ny,
        -x * sign * nx - y * ny + z * nz,
    )


@jit
def cosine_direction(u1, u2, nx, ny, nz):
    """Direction with density cosine / π about the normal n, from two uniform numbers.

    Malley's method.
    """
    radius, angle = np.sqrt(u1), 2.0 * np.pi * u2
    return about(radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - u1), nx, ny, nz)


@jit
def lamp_point(scene, choice, u, v):
    """A point on a lamp, uniform by area: (quad, position), the lamp chosen in proportion to its power."""
    lamp = 0
    while lamp < scene.lamps.shape[0] - 1 and choice >= scene.lamp_share[lamp]:
        lamp += 1
    q = scene.lamps[lamp]
    corner, along, across = scene.quad_corner[q], scene.quad_edges[q, 0], scene.quad_edges[q, 1]
    return q, (
        corner[0] + u * along[0] + v * across[0],
        corner[1] + u * along[1] + v * across[1],
        corner[2] + u * along[2] + v * across[2],
    )


@jit
def lamp_density(scene, q, distance, d):
    """Density per solid angle with which `lamp_point` samples a point of quad q's front at this distance along d."""
    facing = -dot(scene.quad_normal[q], d)
    return scene.lamp_density[q] * distance * distance / facing if facing > 0.0 else 0.0


@inlined
def gather(worth, throughput, weight, light):
    """Add a share of some light (C,) to the contribution of a path."""
    for channel in range(worth.shape[0]):
        worth[channel] += throughput[channel] * weight * light[channel]


@jit
def distant_direction(scene, choice, u, v):
    """Direction that samples distant light: a pixel of the image by its brightness, or a disc uniformly."""
    if choice < scene.asked[1]:
        rows, columns = scene.image_density.shape
        i = np.searchsorted(scene.image_rows, u, side="right")
        below = scene.image_rows[i - 1] if i > 0 else 0.0
        u = (u - below) / (scene.image_rows[i] - below)
        j = np.searchsorted(scene.image_columns[i], v, side="right")
        below = scene.image_columns[i, j - 1] if j > 0 else 0.0
        v = (v - below) / (scene.image_columns[i, j] - below)
        top, bottom = np.cos(np.pi * i / rows), np.cos(np.pi * (i + 1) / rows)
        z = top + u * (bottom - top)
        azimuth, level = 2.0 * np.pi * ((j + v) / columns - 0.5), np.sqrt(max(0.0, 1.0 - z * z))
        x, y, axes = level * np.sin(azimuth), level * np.cos(azimuth), scene.sky_axes
        return (
            x * axes[0, 0] + y * axes[1, 0] + z * axes[2, 0],
            x * axes[0, 1] + y * axes[1, 1] + z * axes[2, 1],
            x * axes[0, 2] + y * axes[1, 2] + z * axes[2, 2],
        )
    disc = 0
    while disc < scene.disc_cosine.shape[0] - 1 and choice >= scene.asked[2 + disc]:
        disc += 1
    z, angle = 1.0 - u * (1.0 - scene.disc_cosine[disc]), 2.0 * np.pi * v
    radius, axis = np.sqrt(max(0.0, 1.0 - z * z)), scene.disc_axis[disc]
    return about(radius * np.cos(angle), radius * np.sin(angle), z, axis[0], axis[1], axis[2])


@jit
def image_place(scene, d):
    """Rows and columns, fractions of pixels from their edges, at which the image holds the frame direction d."""
    x, y, z = dot(scene.sky_axes[0], d), dot(scene.sky_axes[1], d), dot(scene.sky_axes[2], d)
    rows, columns = scene.image_density.shape
    return rows * np.arccos(min(max(z, -1.0), 1.0)) / np.pi, columns * (np.arctan2(x, y) / (2.0 * np.pi) + 0.5)


@jit
def distant_density(scene, d):
    """Density per solid angle with which `distant_direction` samples the frame direction d."""
    density = 0.0
    if scene.image_density.shape[0] > 0:
        v, u = image_place(scene, d)
        i, j = min(int(v), scene.image_density.shape[0] - 1), min(int(u), scene.image_density.shape[1] - 1)
        density += scene.image_density[i, j]
    for disc in range(scene.disc_cosine.shape[0]):
        if dot(scene.disc_axis[disc], d) >= scene.disc_cosine[disc]:
            density += scene.disc_density[disc]
    return density


@jit
def gather_asked(scene, worth, throughput, weight, d):
    """Add the light of image and discs along the frame direction d to the contribution of a path."""
    for disc in range(scene.disc_cosine.shape[0]):
        if dot(scene.disc_axis[disc], d) >= scene.disc_cosine[disc]:
            gather(worth, throughput, weight, scene.disc_radiance[disc])
    rows, columns = scene.image_density.shape
    if rows > 0:  # bilinear
        v, u = image_place(scene, d)
        v, u = min(max(v - 0.5, 0.0), rows - 1.0), u - 0.5
        i, left = min(int(v), rows - 2), int(np.floor(u))
        down, across = v - i, u - left
        left, right = left % columns, (left + 1) % columns
        gather(worth, throughput, weight * (1.0 - down) * (1.0 - across), scene.image[i, left])
        gather(worth, throughput, weight * (1.0 - down) * across, scene.image[i, right])
        gather(worth, throughput, weight * down * (1.0 - across), scene.image[i + 1, left])
        gather(worth, throughput, weight * down * across, scene.image[i + 1, right])


@jit
def gather_smooth(scene, worth, throughput, d):
    """Add the light of the smooth skies along the frame direction d: see `illumgrid.field.lights.basis`."""
    x, y, z = dot(scene.sky_axes[0], d), dot(scene.sky_axes[1], d), dot(scene.sky_axes[2], d)
    xx, yy, zz = x * x, y * y, z * z
    functions = (
        0.28209479177387814,
        0.4886025119029199 * y, 0.4886025119029199 * z, 0.4886025119029199 * x,
        1.0925484305920792 * x * y, 1.0925484305920792 * y * z, 0.31539156525252005 * (3.0 * zz - 1.0),
        1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
        0.5900435899266435 * y * (3.0 * xx - yy), 2.890611442640554 * x * y * z,
        0.4570457994644658 * y * (5.0 * zz - 1.0), 0.3731763325901154 * z * (5.0 * zz - 3.0),
        0.4570457994644658 * x * (5.0 * zz - 1.0), 1.445305721320277 * z * (xx - yy),
        0.5900435899266435 * x * (xx - 3.0 * yy),
        2.5033429417967046 * x * y * (xx - yy), 1.7701307697799304 * y * z * (3.0 * xx - yy),
        0.9461746957575601 * x * y * (7.0 * zz - 1.0), 0.6690465435572892 * y * z * (7.0 * zz - 3.0),
        0.10578554691520431 * (35.0 * zz * zz - 30.0 * zz + 3.0), 0.6690465435572892 * x * z * (7.0 * zz - 3.0),
        0.47308734787878004 * (xx - yy) * (7.0 * zz - 1.0), 1.7701307697799304 * x * z * (xx - 3.0 * yy),
        0.6258357354491761 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)),
    )  # fmt: skip
    for number in range(scene.harmonics.shape[0]):
        gather(worth, throughput, functions[number], scene.harmonics[number])
