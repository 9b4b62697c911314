"""The lookup, compiled: trilinear values of a lattice at world points. Imported where it is first used.

Nodes are held in blocks, whose `layout` every kernel takes as `illumgrid.grid.blocks.Layout` has it; x, y, z are
fractional indices of the finest lattice.
"""

import numpy as np

from illumgrid.compiled import njit

FAR = 1e300  # the largest coordinate, in place of an infinite one
inlined = njit(_nrt=False, forceinline=True)


@njit(_nrt=False)
def finite(x):
    """A coordinate that keeps arithmetic finite; 0 for NaN."""
    return min(max(x, -FAR), FAR) if x == x else 0.0


@inlined
def snapped(u, snap):
    """A fraction of a cell, moved to the end of the cell if it is within rounding of it."""
    return 0.0 if u < snap else 1.0 if u > 1.0 - snap else u


@inlined
def locate(shape, side, corner, step, slot, snap, x, y, z):
    """The block that is read, its cell, the fractions within it, and whether the block contains the place.

    Beyond the border, the border is read; outside all blocks, the border of the nearest one.
    """
    x = min(max(x, 0.0), shape[0] - 1.0)
    y = min(max(y, 0.0), shape[1] - 1.0)
    z = min(max(z, 0.0), shape[2] - 1.0)
    found = slot[
        min(int(x) // side[0], slot.shape[0] - 1), min(int(y) // side[1], slot.shape[1] - 1),
        min(int(z) // side[2], slot.shape[2] - 1),
    ]  # fmt: skip
    s = found if found >= 0 else ~found
    u = min(max((x - corner[s, 0]) / step[s], 0.0), float(side[0]))
    v = min(max((y - corner[s, 1]) / step[s], 0.0), float(side[1]))
    w = min(max((z - corner[s, 2]) / step[s], 0.0), float(side[2]))
    a, b, c = min(int(u), side[0] - 1), min(int(v), side[1] - 1), min(int(w), side[2] - 1)
    return s, a, b, c, snapped(u - a, snap), snapped(v - b, snap), snapped(w - c, snap), found >= 0


@njit(_nrt=False)
def read(values, shape, side, corner, step, slot, origin, direction, spacing, snap, points, result):
    """Fill `result` (n, m) from `values` (blocks, bx, by, bz, m) at world points (n, 3); node 0 lies at `origin`.

    Within `snap` spacings of a node the point is on it. In double precision, as one sum over the eight nodes about the
    point.
    """
    for i in range(points.shape[0]):
        x = finite(points[i, 0]) - origin[0]
        y = finite(points[i, 1]) - origin[1]
        z = finite(points[i, 2]) - origin[2]
        u = (x * direction[0, 0] + y * direction[1, 0] + z * direction[2, 0]) / spacing[0]
        v = (x * direction[0, 1] + y * direction[1, 1] + z * direction[2, 1]) / spacing[1]
        w = (x * direction[0, 2] + y * direction[1, 2] + z * direction[2, 2]) / spacing[2]
        s, a, b, c, u, v, w, _ = locate(shape, side, corner, step, slot, snap, u, v, w)
        w00, w01, w10, w11 = (1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v
        t = 1.0 - w
        for k in range(values.shape[4]):
            near = (
                w00 * values[s, a, b, c, k] + w01 * values[s, a, b + 1, c, k]
                + w10 * values[s, a + 1, b, c, k] + w11 * values[s, a + 1, b + 1, c, k]
            )  # fmt: skip
            far = (
                w00 * values[s, a, b, c + 1, k] + w01 * values[s, a, b + 1, c + 1, k]
                + w10 * values[s, a + 1, b, c + 1, k] + w11 * values[s, a + 1, b + 1, c + 1, k]
            )  # fmt: skip
            result[i, k] = t * near + w * far


@njit(_nrt=False)
def answer(light, error, support, shape, side, corner, step, slot, snap, index, out, bars, counts):
    """Fill light (n, m), error (n,) and support (n,) at fractional indices (n, 3).

    The error is the weighted mean of the nodes' errors, infinite if one is unknown; the support is the smallest.
    Outside all blocks the error is infinite and the support 0.
    """
    for i in range(index.shape[0]):
        x, y, z = finite(index[i, 0]), finite(index[i, 1]), finite(index[i, 2])
        s, a, b, c, u, v, w, held = locate(shape, side, corner, step, slot, snap, x, y, z)
        bar, least = 0.0, np.inf
        for k in range(light.shape[4]):
            out[i, k] = 0.0
        for bits in range(8):
            p, q, r = bits >> 2, (bits >> 1) & 1, bits & 1
            weight = (u if p else 1.0 - u) * (v if q else 1.0 - v) * (w if r else 1.0 - w)
            if weight > 0.0:
                for k in range(light.shape[4]):
                    out[i, k] += weight * light[s, a + p, b + q, c + r, k]
                bar += weight * error[s, a + p, b + q, c + r]
                least = min(least, support[s, a + p, b + q, c + r])
        bars[i] = bar if held else np.inf
        counts[i] = least if held else 0.0
