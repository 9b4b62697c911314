"""Paths that end in a cache, compiled: the light that grids and walls hold where a ray meets a surface.

`illumgrid.grid.cache.Cache` describes the tables.
"""

import numpy as np

from illumgrid import constants
from illumgrid.backends import march, simd
from illumgrid.backends.march import dot
from illumgrid.backends.simd import cached
from illumgrid.constants import OFF_SWEEP, QUAD, SAME_ROW, SURFACE

jit = cached(march, simd, constants, _nrt=False)


@jit
def place_in_sweep(cache, level):
    """Position in the sweep, 0 to 1, of a row of levels; `OFF_SWEEP` if it is not on the sweep, or without a cache."""
    if cache.start.shape[0] == 0:
        return OFF_SWEEP
    place = 0.0
    for f in range(level.shape[0]):
        first, last = cache.sweep[f, 0], cache.sweep[f, 1]
        share = (level[f] - first) / (last - first)
        if f == 0:
            place = share
        if not (abs(share - place) <= SAME_ROW and -SAME_ROW <= share <= 1.0 + SAME_ROW):
            return OFF_SWEEP
    return min(max(place, 0.0), 1.0)


@jit
def gather_cached(cache, lattice, p, q, r, throughput, worth):
    """Add the cached light at index (p, q, r) of a lattice to a path's contribution; whether it may end there."""
    nx, ny, nz = cache.shape[lattice, 0], cache.shape[lattice, 1], cache.shape[lattice, 2]
    p, q, r = min(max(p, 0.0), nx - 1.0), min(max(q, 0.0), ny - 1.0), min(max(r, 0.0), nz - 1.0)
    a, b, c = int(p), int(q), int(r)
    node = cache.start[lattice] + (a * ny + b) * nz + c
    if not cache.trusted[node]:
        return False
    step_x, step_y, step_z = ny * nz if a < nx - 1 else 0, nz if b < ny - 1 else 0, 1 if c < nz - 1 else 0
    p, q, r = p - a, q - b, r - c
    for corner in range(8):
        i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
        weight = (p if i else 1.0 - p) * (q if j else 1.0 - q) * (r if k else 1.0 - r)
        here = node + i * step_x + j * step_y + k * step_z
        for channel in range(worth.shape[0]):
            worth[channel] += throughput[channel] * weight / np.pi * cache.light[here, channel]
    return True


@jit
def ends_in_cache(scene, cache, place, number, what, t, x, d, throughput, worth):
    """Whether a path that met a surface at x after the distance t along d ends there; then adds its cached light.

    `place` is that of its levels in the sweep. It goes on from caps, from the backs of walls, and after rays shorter
    than the lattice's spacing: nodes would light their own neighbours.
    """
    if place == OFF_SWEEP or t < cache.near[number]:
        return False
    if what == SURFACE:
        return gather_cached(
            cache, number,
            (x[0] - cache.origin[number, 0]) / cache.spacing[number, 0],
            (x[1] - cache.origin[number, 1]) / cache.spacing[number, 1],
            (x[2] - cache.origin[number, 2]) / cache.spacing[number, 2], throughput, worth,
        )  # fmt: skip
    if what != QUAD:
        return False
    quad = number - scene.twin.shape[0]
    if dot(scene.quad_normal[quad], d) >= 0.0:
        return False
    corner = scene.quad_corner[quad]
    at = (x[0] - corner[0], x[1] - corner[1], x[2] - corner[2])
    u, v = dot(scene.quad_duals[quad, 0], at), dot(scene.quad_duals[quad, 1], at)
    rows, nv, nu = cache.shape[number, 0], cache.shape[number, 1], cache.shape[number, 2]
    return gather_cached(cache, number, place * (rows - 1.0), v * nv - 0.5, u * nu - 0.5, throughput, worth)
