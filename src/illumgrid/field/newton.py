"""Slopes and normals of a trilinear field at points, and Newton's steps onto its level sets, compiled.

Imported where it is first used. Serial, no state. Each sum is in the order of its twin in NumPy
(`illumgrid.field.volume.central_differences`), so that both give the same bits. Slopes are those of stored values.
"""

import numpy as np

from illumgrid.compiled import njit
from illumgrid.constants import ON_A_VOXEL

jit = njit(_nrt=False)

MET = 1e-10  # index steps below this end a projection; the last step is still taken, and convergence is quadratic
STEPS = 24


@jit
def cell_of(u, points):
    """Cell that contains index u along an axis of so many points, and the position within it, 0 to 1."""
    cell = int(min(max(np.floor(u), 0.0), points - 2.0))
    return cell, min(max(u - cell, 0.0), 1.0)


@jit
def value_at(values, x, y, z):
    """Value at an index, like ``scipy.ndimage.map_coordinates`` of order 1: clamped to the border."""
    nx, ny, nz = values.shape
    x, y, z = min(max(x, 0.0), nx - 1.0), min(max(y, 0.0), ny - 1.0), min(max(z, 0.0), nz - 1.0)
    a, b, c = int(x), int(y), int(z)
    u, v, w = 1.0 - (x - a), 1.0 - (y - b), 1.0 - (z - c)
    total = 0.0
    for corner in range(8):
        i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
        here = np.float64(values[min(a + i, nx - 1), min(b + j, ny - 1), min(c + k, nz - 1)])
        total += here * (1.0 - u if i else u) * (1.0 - v if j else v) * (1.0 - w if k else w)
    return total


@jit
def cell_slope(values, x, y, z):
    """Slope per index step of the cell that contains an index."""
    (a, u), (b, v), (c, w) = cell_of(x, values.shape[0]), cell_of(y, values.shape[1]), cell_of(z, values.shape[2])
    gx, gy, gz = 0.0, 0.0, 0.0
    for corner in range(8):
        i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
        p, q, r = (u if i else 1.0 - u), (v if j else 1.0 - v), (w if k else 1.0 - w)
        here = np.float64(values[a + i, b + j, c + k])
        gx += (r * q if i else -(r * q)) * here
        gy += (p * r if j else -(p * r)) * here
        gz += (q * p if k else -(q * p)) * here
    return gx, gy, gz


@jit
def smooth_slope(values, x, y, z):
    """Slope per index step by central differences, one-sided at the border, interpolated trilinearly."""
    nx, ny, nz = values.shape
    (a, u), (b, v), (c, w) = cell_of(x, nx), cell_of(y, ny), cell_of(z, nz)
    gx, gy, gz = 0.0, 0.0, 0.0
    for corner in range(8):
        i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
        weight = (u if i else 1.0 - u) * (v if j else 1.0 - v) * (w if k else 1.0 - w)
        i, j, k = a + i, b + j, c + k
        low, high = max(i - 1, 0), min(i + 1, nx - 1)
        gx += weight * (np.float64(values[high, j, k]) - np.float64(values[low, j, k])) / (high - low)
        low, high = max(j - 1, 0), min(j + 1, ny - 1)
        gy += weight * (np.float64(values[i, high, k]) - np.float64(values[i, low, k])) / (high - low)
        low, high = max(k - 1, 0), min(k + 1, nz - 1)
        gz += weight * (np.float64(values[i, j, high]) - np.float64(values[i, j, low])) / (high - low)
    return gx, gy, gz


@jit
def normals(values, spacing, outside, index, result):
    """Unit gradient normals (n, 3) at indices (n, 3), `outside` (+1 or -1) times the slope; 0 on a plateau."""
    for m in range(len(index)):
        x, y, z = index[m, 0], index[m, 1], index[m, 2]
        gx, gy, gz = smooth_slope(values, x, y, z)
        gx, gy, gz = gx / spacing[0], gy / spacing[1], gz / spacing[2]
        if gx == 0.0 and gy == 0.0 and gz == 0.0:
            gx, gy, gz = cell_slope(values, x, y, z)
            gx, gy, gz = gx / spacing[0], gy / spacing[1], gz / spacing[2]
        gx, gy, gz = outside * gx, outside * gy, outside * gz
        largest = max(abs(gx), abs(gy), abs(gz))  # scaled first: the square of a tiny slope would underflow
        if largest > 0.0:
            gx, gy, gz = gx / largest, gy / largest, gz / largest
            length = np.sqrt(gx * gx + gy * gy + gz * gz)
            gx, gy, gz = gx / length, gy / length, gz / length
        result[m, 0], result[m, 1], result[m, 2] = gx, gy, gz


@jit
def slope_to_follow(values, spacing, x, y, z):
    """Slope per index step along which to project: on a plane of voxels, where it jumps, the mean of both cells."""
    gx, gy, gz = cell_slope(values, x, y, z)
    gx, gy, gz = gx / spacing[0], gy / spacing[1], gz / spacing[2]
    if x == np.floor(x) and 0.0 < x < values.shape[0] - 1.0:
        gx = 0.5 * (gx + cell_slope(values, np.nextafter(x, 0.0), y, z)[0] / spacing[0])
    if y == np.floor(y) and 0.0 < y < values.shape[1] - 1.0:
        gy = 0.5 * (gy + cell_slope(values, x, np.nextafter(y, 0.0), z)[1] / spacing[1])
    if z == np.floor(z) and 0.0 < z < values.shape[2] - 1.0:
        gz = 0.5 * (gz + cell_slope(values, x, y, np.nextafter(z, 0.0))[2] / spacing[2])
    if gx == 0.0 and gy == 0.0 and gz == 0.0:  # at the edge of a plateau only the central differences point outwards
        gx, gy, gz = smooth_slope(values, x, y, z)
        gx, gy, gz = gx / spacing[0], gy / spacing[1], gz / spacing[2]
    return gx * spacing[0], gy * spacing[1], gz * spacing[2]


@jit
def onto(values, spacing, level, x, y, z):
    """The point of a level set that Newton steps from index (x, y, z) reach, and whether they converged."""
    top_x, top_y, top_z = values.shape[0] - 1.0, values.shape[1] - 1.0, values.shape[2] - 1.0
    last = np.inf
    for _ in range(STEPS):
        miss = level - value_at(values, x, y, z)
        if miss == 0.0:
            return x, y, z, True
        gx, gy, gz = slope_to_follow(values, spacing, x, y, z)
        largest = max(abs(gx), abs(gy), abs(gz))
        if not largest > 0.0:
            return x, y, z, False
        gx, gy, gz = gx / largest, gy / largest, gz / largest
        far = miss / largest / (gx * gx + gy * gy + gz * gz)
        sx, sy, sz = gx * far, gy * far, gz * far
        length = max(abs(sx), abs(sy), abs(sz))
        # Across a kink between two cells full steps can oscillate: halve those that did not shrink.
        half = 0.5 if length >= last else 1.0
        hold = min(1.0, 0.5 / max(length, 1e-300))
        last = min(last, length)
        x = min(max(x + sx * half * hold, 0.0), top_x)
        y = min(max(y + sy * half * hold, 0.0), top_y)
        z = min(max(z + sz * half * hold, 0.0), top_z)
        if length < MET:
            return x, y, z, True
    return x, y, z, False


@jit
def project(values, spacing, levels, index, at, arrived):
    """Move indices (n, 3) onto the level sets of stored isovalues (n,): fills `at` (n, 3) and `arrived` (n,)."""
    for m in range(len(index)):
        x, y, z = index[m, 0], index[m, 1], index[m, 2]
        within = -ON_A_VOXEL <= x <= values.shape[0] - 1.0 + ON_A_VOXEL
        within &= -ON_A_VOXEL <= y <= values.shape[1] - 1.0 + ON_A_VOXEL
        within &= -ON_A_VOXEL <= z <= values.shape[2] - 1.0 + ON_A_VOXEL
        at[m, 0], at[m, 1], at[m, 2] = x, y, z
        if within:
            a, b, c, met = onto(values, spacing, levels[m], x, y, z)
            at[m, 0], at[m, 1], at[m, 2] = a, b, c
            arrived[m] = met and max(abs(a - x), abs(b - y), abs(c - z)) <= 1.0
