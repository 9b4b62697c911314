"""Normals of the trilinear level sets that rays march through."""

import numpy as np

from illumgrid import constants
from illumgrid.backends import cubics, march, simd
from illumgrid.backends.cubics import cubic
from illumgrid.backends.march import follow
from illumgrid.backends.simd import cached
from illumgrid.backends.surfaces import solid_normal
from illumgrid.constants import CAP
from illumgrid.field.levelset import Marchable

jit = cached(cubics, march, simd, constants, _nrt=False)  # as in `march`
inlined = cached(cubics, march, simd, constants, _nrt=False, forceinline=True)


@jit
def outward(gx, gy, gz):
    """Unit vector against the gradient of v; 0 on a plateau. Scaled first: the square of a tiny slope underflows."""
    largest = max(abs(gx), abs(gy), abs(gz))
    if largest == 0.0:
        return 0.0, 0.0, 0.0
    gx, gy, gz = gx / largest, gy / largest, gz / largest
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    return -gx / length, -gy / length, -gz / length


@inlined
def cell_at(scene, f, ux, uy, uz):
    """The cell of field f that contains index u, the place in it, 0 to 1, and steps of flat numbers along x and y."""
    last_x, last_y, last_z = scene.shape[f, 0] - 1, scene.shape[f, 1] - 1, scene.shape[f, 2] - 1
    cx, cy = follow(ux, 0.0, 0.0, 0, last_x - 1), follow(uy, 0.0, 0.0, 0, last_y - 1)
    cz = follow(uz, 0.0, 0.0, 0, last_z - 1)
    wx, wy, wz = min(max(ux - cx, 0.0), 1.0), min(max(uy - cy, 0.0), 1.0), min(max(uz - cz, 0.0), 1.0)
    return cx, cy, cz, wx, wy, wz, scene.shape[f, 2] * scene.shape[f, 1], scene.shape[f, 2]


@jit
def cell_normal(scene, f, ux, uy, uz):
    """Outward normal at index u of the trilinear cell of field f that contains it."""
    cx, cy, cz, wx, wy, wz, step_x, step_y = cell_at(scene, f, ux, uy, uz)
    here = scene.start[f] + cx * step_x + cy * step_y + cz
    _, gx, _, _ = cubic(scene.values, scene.sign[f], here, step_x, step_y, 0.0, wx, wy, wz, 1.0, 0.0, 0.0)
    _, gy, _, _ = cubic(scene.values, scene.sign[f], here, step_x, step_y, 0.0, wx, wy, wz, 0.0, 1.0, 0.0)
    _, gz, _, _ = cubic(scene.values, scene.sign[f], here, step_x, step_y, 0.0, wx, wy, wz, 0.0, 0.0, 1.0)
    return outward(gx / scene.spacing[f, 0], gy / scene.spacing[f, 1], gz / scene.spacing[f, 2])


@jit
def gradient_normal(scene, f, ux, uy, uz):
    """Outward normal at index u of field f: central differences (one-sided at the border), interpolated trilinearly.

    Where they cancel, that of the trilinear cell.
    """
    cx, cy, cz, wx, wy, wz, step_x, step_y = cell_at(scene, f, ux, uy, uz)
    last_x, last_y, last_z = scene.shape[f, 0] - 1, scene.shape[f, 1] - 1, scene.shape[f, 2] - 1
    v, start = scene.values, scene.start[f]
    gx, gy, gz = 0.0, 0.0, 0.0
    for corner in range(8):
        i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
        weight = (wx if i else 1.0 - wx) * (wy if j else 1.0 - wy) * (wz if k else 1.0 - wz)
        here = start + (cx + i) * step_x + (cy + j) * step_y + cz + k
        after, before = int(cx + i < last_x), int(cx + i > 0)
        gx += weight * (np.float64(v[here + after * step_x]) - v[here - before * step_x]) / (after + before)
        after, before = int(cy + j < last_y), int(cy + j > 0)
        gy += weight * (np.float64(v[here + after * step_y]) - v[here - before * step_y]) / (after + before)
        after, before = int(cz + k < last_z), int(cz + k > 0)
        gz += weight * (np.float64(v[here + after]) - v[here - before]) / (after + before)
    if gx == 0.0 and gy == 0.0 and gz == 0.0:
        return cell_normal(scene, f, ux, uy, uz)
    sign = scene.sign[f]
    gx, gy, gz = sign * gx + 0.0, sign * gy + 0.0, sign * gz + 0.0  # no -0: its sign would change a frame
    return outward(gx / scene.spacing[f, 0], gy / scene.spacing[f, 1], gz / scene.spacing[f, 2])


@jit
def normal_by_field(scene, f, what, face, x, d):
    """Normal where a ray along d met the trilinear solid of field f at x: the gradient normal, or that of the cap."""
    if what == CAP:
        return (
            -np.copysign(1.0, d[0]) if face == 0 else 0.0,
            -np.copysign(1.0, d[1]) if face == 1 else 0.0,
            -np.copysign(1.0, d[2]) if face == 2 else 0.0,
        )
    ux = (x[0] - scene.origin[f, 0]) / scene.spacing[f, 0]
    uy = (x[1] - scene.origin[f, 1]) / scene.spacing[f, 1]
    uz = (x[2] - scene.origin[f, 2]) / scene.spacing[f, 2]
    return gradient_normal(scene, f, ux, uy, uz)


solid_normal.register(Marchable, normal_by_field)
