"""Rays against a tree of triangles: one ray at a time descends, and meets eight boxes or triangles at once (`simd`)."""

from typing import Any, NamedTuple

import numba
import numpy as np

from illumgrid.backends import simd
from illumgrid.backends.mesh import bvh
from illumgrid.backends.mesh.bvh import FRAME, IDS, LINKS
from illumgrid.backends.simd import (
    WIDE,
    address,
    bits,
    cached,
    choose,
    lane,
    load,
    load_int,
    lowest,
    mask,
    maximum,
    minimum,
    muladd,
    peek,
    places,
    smallest,
    spread,
    spread_int,
    store,
)

jit = cached(simd, bvh)  # no fastmath: the signs of products must be exact
inlined = numba.njit(nogil=True, error_model="numpy", inline="always")

# All coordinates are within |x| <= 2, where they are wrong by 2^-24 and results by less than
# 2^-20: boxes enlarged by this contain every triangle that the test below reports, wherever it reports it.
PAD = np.float32(2.0**-18)
FLAT = 1e-36  # twice the area, seen along the ray, below which a triangle counts as an edge
ROOM = 2.0  # a ray that begins farther out is first moved near, in double precision
NONE = 0x7FFFFFFF


class View(NamedTuple):
    """A tree as kernels pass it on, without arrays."""

    memory: Any
    x: float
    y: float
    z: float
    scale: float


@jit
def view(tree):
    """View of a tree: made once per chunk of rays."""
    return View(address(tree.memory), tree.centre[0], tree.centre[1], tree.centre[2], tree.scale)


@jit
def approach(x, y, z, ex, ey, ez):
    """Distance at which a ray from outside comes near [-1, 1]³; inf if never."""
    near, far = 0.0, np.inf
    for p, e in ((x, ex), (y, ey), (z, ez)):
        if e == 0.0:
            if abs(p) > 1.5:
                return np.inf
        else:
            near, far = max(near, (-np.copysign(1.5, e) - p) / e), min(far, (np.copysign(1.5, e) - p) / e)
    return near if near <= far else np.inf


@inlined
def slab(o, d, tiny):
    """One axis of the box test: a plane at p is met at t = p i + n, the near one, or p i + f; and which of two is near.

    The pad is inside n and f: Ize, "Robust BVH ray traversal", JCGT 2(2), 2013.
    """
    # A direction of 0 becomes so small that it moves nothing, but has an inverse.
    i = np.float32(1.0) / np.float32(choose(abs(d) < tiny, tiny, d))
    pad = PAD * abs(i)
    return spread(i), spread(-o * i - pad), spread(-o * i + pad), choose(i < 0.0, WIDE, 0)


@inlined
def boxes(memory, node, x, y, z, reach):
    """Eight boxes against a ray: (where it meets them, distances)."""
    (ix, nx, fx, jx), (iy, ny, fy, jy), (iz, nz, fz, jz) = x, y, z
    near = maximum(muladd(load(memory, node + jx), ix, nx), muladd(load(memory, node + 16 + jy), iy, ny))
    near = maximum(near, maximum(muladd(load(memory, node + 32 + jz), iz, nz), spread(0.0)))
    far = minimum(muladd(load(memory, node + 8 - jx), ix, fx), muladd(load(memory, node + 24 - jy), iy, fy))
    far = minimum(far, minimum(muladd(load(memory, node + 40 - jz), iz, fz), reach))
    return near <= far, near


@inlined
def shear(ox, oy, oz, dx, dy, dz):
    """Make the ray an axis, for `meet`: the axes are permuted so that it goes farthest along the last."""
    ax, ay, az = abs(dx), abs(dy), abs(dz)
    first = (ax >= ay) & (ax >= az)
    second = (ay >= az) & (not first)
    kx, ky, kz = choose(second, 16, 0), choose(second, 0, 8), choose(second, 8, 16)
    kx, ky, kz = choose(first, 8, kx), choose(first, 16, ky), choose(first, 0, kz)
    px, py, pz = choose(second, oz, ox), choose(second, ox, oy), choose(second, oy, oz)
    px, py, pz = choose(first, oy, px), choose(first, oz, py), choose(first, ox, pz)
    hx, hy, hz = choose(second, dz, dx), choose(second, dx, dy), choose(second, dy, dz)
    hx, hy, hz = choose(first, dy, hx), choose(first, dz, hy), choose(first, dx, hz)
    pace = 1.0 / hz
    return kx, ky, kz, spread(px), spread(py), spread(pz), spread(hx * pace), spread(hy * pace), spread(pace)


@inlined
def meet(memory, leaf, ray, reach):
    """Eight triangles against a ray: (mask of hits, t, weight of the second corner, of the third).

    The space is sheared so that the ray becomes an axis. A shared edge then gives two triangles the same products with
    opposite sign, and rounding cannot change a sign, only make it 0, which counts as inside: no ray passes between.
    Woop, Benthin & Wald, "Watertight ray/triangle intersection", JCGT 2(1), 2013, without a second precision.
    """
    kx, ky, kz, px, py, pz, hx, hy, pace = ray
    zero, one, flat = spread(0.0), spread(1.0), spread(FLAT)
    z0, z1, z2 = load(memory, leaf + kz) - pz, load(memory, leaf + 24 + kz) - pz, load(memory, leaf + 48 + kz) - pz
    x0, y0 = (load(memory, leaf + kx) - px) - hx * z0, (load(memory, leaf + ky) - py) - hy * z0
    x1, y1 = (load(memory, leaf + 24 + kx) - px) - hx * z1, (load(memory, leaf + 24 + ky) - py) - hy * z1
    x2, y2 = (load(memory, leaf + 48 + kx) - px) - hx * z2, (load(memory, leaf + 48 + ky) - py) - hy * z2
    w0, w1, w2 = x2 * y1 - y2 * x1, x0 * y2 - y0 * x2, x1 * y0 - y1 * x0
    area = (w0 + w1) + w2
    front = (minimum(minimum(w0, w1), w2) >= zero) & (area > flat)
    back = (maximum(maximum(w0, w1), w2) <= zero) & (area < zero - flat)
    over = one / choose(front | back, area, one)
    # No branch before here: no processor can predict whether a ray meets one of eight triangles.
    t = ((w0 * z0 + w1 * z1) + w2 * z2) * over * pace
    return mask((front | back) & (t > zero) & (t <= reach)), t, w1 * over, w2 * over


@jit
def cast(tree, stack, x, y, z, dx, dy, dz, limit, any_hit):
    """First triangle that a ray x + t d, 0 < t < limit, meets: (t, number, u, v); t inf and number -1 if none.

    `tree` is a View, `stack` the address of an array from `stack_for`. With any_hit it is any triangle. The hit lies at
    (1 - u - v) a + u b + v c. If triangles are hit at the same t, the lowest number counts, so that the result does not
    depend on the order in which the tree is visited. d may have any length but 0.
    """
    # In the space of the tree; t is unchanged.
    x, y, z = (x - tree.x) * tree.scale, (y - tree.y) * tree.scale, (z - tree.z) * tree.scale
    dx, dy, dz = dx * tree.scale, dy * tree.scale, dz * tree.scale
    start = 0.0
    if max(abs(x), abs(y), abs(z)) > ROOM:
        start = approach(x, y, z, dx, dy, dz)
        if start == np.inf:
            return np.inf, -1, np.float32(0.0), np.float32(0.0)
        x, y, z = x + start * dx, y + start * dy, z + start * dz
    ox, oy, oz = np.float32(x), np.float32(y), np.float32(z)
    tiny = 1e-12 * max(abs(dx), abs(dy), abs(dz))
    along_x, along_y, along_z = slab(ox, dx, tiny), slab(oy, dy, tiny), slab(oz, dz, tiny)
    ray = shear(ox, oy, oz, dx, dy, dz)

    low, number, none = spread_int(-WIDE), places(), spread_int(NONE)
    best, face, u, v = np.float32(min(limit - start, 3e38)), -1, np.float32(0.0), np.float32(0.0)
    reach = spread(best)
    memory, link, level = tree.memory, 0, 0
    while True:
        if link >= 0:
            met, near = boxes(memory, link, along_x, along_y, along_z, reach)
            these = mask(met)
            if these != 0:
                links = link + LINKS
                if these & (these - 1) == 0:  # most often only one box is met: no sorting, nothing has to wait
                    link = peek(memory, links + lowest(these))
                    continue
                # Distance and lane in one integer: the smallest is the next, and the rest may wait.
                keys = choose(met, (bits(near) & low) | number, none)
                key = smallest(keys)
                store(stack, level, choose(keys == spread_int(key), none, keys))
                store(stack, level + WIDE, np.int32(links))
                level += FRAME
                link = peek(memory, links + (key & 7))
                continue
        else:
            hits, t, second, third = meet(memory, -link, ray, reach)
            while hits != 0:
                k = lowest(hits)
                hits &= hits - 1
                candidate = peek(memory, IDS - link + k)
                if lane(t, k) < best or (lane(t, k) == best and candidate < face):
                    best, face, u, v = lane(t, k), candidate, lane(second, k), lane(third, k)
                    reach = spread(best)
            if any_hit and face >= 0:
                break
        # Back to the nearest waiting box, on the lowest level that has one within reach.
        key = NONE
        while level > 0:
            keys = load_int(stack, level - FRAME)
            key = smallest(keys)
            if key <= bits(best) | 7:
                break
            level -= FRAME
        if level == 0:
            break
        store(stack, level - FRAME, choose(keys == spread_int(key), none, keys))
        link = peek(memory, peek(stack, level - WIDE) + (key & 7))
    if face < 0:
        return np.inf, -1, u, v
    return np.float64(best) + start, face, u, v


@jit
def cast_rays(tree, stack, origin, direction, limit, any_hit, t, face, uv):
    """First (or any) hits of rays (n, 3); t (n,), face (n,) and uv (n, 2) are filled."""
    seen, room = view(tree), address(stack)
    for i in range(origin.shape[0]):
        x, y, z = origin[i]
        dx, dy, dz = direction[i]
        t[i], face[i], uv[i, 0], uv[i, 1] = cast(seen, room, x, y, z, dx, dy, dz, limit, any_hit)
