"""Rays from the eye through films and into glossy coats, compiled; they end in the light of grids and walls.

Light paths do not include coats. Like `kernels`, these functions are serial and depend only on their arguments.
"""

import numpy as np

from illumgrid import constants
from illumgrid.backends import cubics, gathering, kernels, lights, march, normals, simd, surfaces
from illumgrid.backends.gathering import gather_cached
from illumgrid.backends.kernels import hit_beyond, hit_normal, lets_through
from illumgrid.backends.lights import (
    about,
    cosine_direction,
    distant_density,
    distant_direction,
    gather,
    gather_asked,
    gather_smooth,
    lamp_density,
    lamp_point,
)
from illumgrid.backends.march import dot
from illumgrid.backends.mesh import cast as mesh_cast
from illumgrid.backends.mesh import traversal
from illumgrid.backends.simd import cached
from illumgrid.constants import BURIED, CAP, MISS, MOST_FILMS, NOWHERE, QUAD, SURFACE
from illumgrid.rng import draw, draw_pair, stream

_SOURCES = kernels, gathering, lights, cubics, march, normals, simd, surfaces, traversal, mesh_cast, constants
jit = cached(*_SOURCES, _nrt=False)  # as in `march`

AT_NORMAL = 0.04
"""Share of the light that a coat reflects at normal incidence: that of a refractive index of 1.5."""

STEEPEST = 1e-3
"""Least cosine at which a coat is seen: smooth normals of surfaces seen edge-on may face away."""


@jit
def reflectance(cosine):
    """Share of the light that a coat reflects at this cosine with its normal.

    C. Schlick, "An inexpensive BRDF model for physically-based rendering", CGF 13(3), 1994.
    """
    return AT_NORMAL + (1.0 - AT_NORMAL) * (1.0 - cosine) ** 5


@jit
def half_vector(alpha, v, u1, u2):
    """A visible normal of a rough coat seen from v; both in a frame whose third axis is its mean normal.

    E. Heitz, "Sampling the GGX distribution of visible normals", JCGT 7(4), 2018.
    """
    x, y, z = alpha * v[0], alpha * v[1], v[2]
    length = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    level = np.sqrt(x * x + y * y)
    ax, ay = (-y / level, x / level) if level > 0.0 else (1.0, 0.0)
    bx, by, bz = -z * ay, z * ax, x * ay - y * ax
    radius, angle = np.sqrt(u1), 2.0 * np.pi * u2
    p, q, s = radius * np.cos(angle), radius * np.sin(angle), 0.5 * (1.0 + z)
    q = (1.0 - s) * np.sqrt(1.0 - p * p) + s * q
    r = np.sqrt(max(0.0, 1.0 - p * p - q * q))
    hx, hy, hz = alpha * (p * ax + q * bx + r * x), alpha * (p * ay + q * by + r * y), max(0.0, q * bz + r * z)
    length = np.sqrt(hx * hx + hy * hy + hz * hz)
    return (hx / length, hy / length, hz / length) if length > 0.0 else (0.0, 0.0, 1.0)


@jit
def shadowing(alpha, cosine):
    """Smith's Λ of GGX: the share 1 / (1 + Λ) of the coat's normals that face a direction is visible from it."""
    return 0.5 * (np.sqrt(1.0 + alpha * alpha * (1.0 / (cosine * cosine) - 1.0)) - 1.0)


@jit
def lobe(alpha, v, n, d):
    """Share of light from d that is reflected to v, times cosine, and the density of d in `direction`.

    `alpha` is the roughness of a coat; below 0 the surface is matte, and sends all on.
    """
    out = dot(n, d)
    if out <= 0.0:
        return 0.0, 0.0
    if alpha < 0.0:
        return out / np.pi, out / np.pi
    into = max(dot(n, v), STEEPEST)
    hx, hy, hz = v[0] + d[0], v[1] + d[1], v[2] + d[2]
    length = np.sqrt(hx * hx + hy * hy + hz * hz)
    if length == 0.0:
        return 0.0, 0.0
    h = (hx / length, hy / length, hz / length)
    up, square = dot(n, h), alpha * alpha
    spread = square / (np.pi * (up * up * (square - 1.0) + 1.0) ** 2)
    hidden_v, hidden_d = shadowing(alpha, into), shadowing(alpha, out)
    value = reflectance(min(max(dot(v, h), 0.0), 1.0)) * spread / (4.0 * into * (1.0 + hidden_v + hidden_d))
    return value, spread / (4.0 * into * (1.0 + hidden_v))


@jit
def direction(alpha, v, n, u1, u2):
    """A direction from which light is reflected to v: mirrored at a normal of the coat, or cosine-distributed."""
    if alpha < 0.0:
        return cosine_direction(u1, u2, n[0], n[1], n[2])
    along, across = about(1.0, 0.0, 0.0, n[0], n[1], n[2]), about(0.0, 1.0, 0.0, n[0], n[1], n[2])
    a, b, c = dot(along, v), dot(across, v), max(dot(n, v), STEEPEST)
    h = half_vector(alpha, (a, b, c), u1, u2)
    twice = 2.0 * (a * h[0] + b * h[1] + c * h[2])
    return about(twice * h[0] - a, twice * h[1] - b, twice * h[2] - c, n[0], n[1], n[2])


@jit
def looked_up(scene, cache, place, number, x, throughput, light):
    """Add a share of the radiance that grid or wall `number` has at the frame point x."""
    fields = scene.twin.shape[0]
    if number < fields:
        origin, spacing = cache.origin[number], cache.spacing[number]
        p, q, r = (x[0] - origin[0]) / spacing[0], (x[1] - origin[1]) / spacing[1], (x[2] - origin[2]) / spacing[2]
        gather_cached(cache, number, p, q, r, throughput, light)
        return
    corner = scene.quad_corner[number - fields]
    at = (x[0] - corner[0], x[1] - corner[1], x[2] - corner[2])
    u, v = dot(scene.quad_duals[number - fields, 0], at), dot(scene.quad_duals[number - fields, 1], at)
    rows, nv, nu = cache.shape[number, 0], cache.shape[number, 1], cache.shape[number, 2]
    gather_cached(cache, number, place * (rows - 1.0), v * nv - 0.5, u * nu - 0.5, throughput, light)


@jit
def seen_along(scene, cache, place, cap, level, x, n, d, on, within, value, density, throughput, light):
    """Add `value` times the radiance (3,) from d, through films; light that is also sampled gets its weight.

    `cap` is the radiance of caps of albedo 1.
    """
    fields, weight, start, passed, face = scene.twin.shape[0], value, x, 0.0, np.int64(NOWHERE)
    for _ in range(MOST_FILMS):
        t, number, what, face = hit_beyond(scene, level, start, n, d, on, face, within)
        throughput[:] = weight
        if what == MISS:
            gather(light, throughput, 1.0, scene.background)
            if scene.harmonics.shape[0] > 0:
                gather_smooth(scene, light, throughput, d)
            if scene.asked[0] < 1.0:
                gather_asked(scene, light, throughput, density / (density + distant_density(scene, d)), d)
            return
        if what == BURIED:
            return
        passed += t
        start = (start[0] + t * d[0], start[1] + t * d[1], start[2] + t * d[2])
        if what == QUAD and dot(scene.quad_normal[number - fields], d) >= 0.0:
            return  # its back does not emit
        shared = 1.0
        if what == QUAD:
            shared = density / (density + lamp_density(scene, number - fields, passed, d))
        gather(light, throughput, shared, scene.emission[number])
        share = lets_through(scene, number, what)
        for channel in range(3):
            throughput[channel] *= (1.0 - share) * scene.albedo[number, channel]
        if what == CAP:
            for channel in range(3):
                light[channel] += cap * throughput[channel]
        else:
            looked_up(scene, cache, place, number, start, throughput, light)
        if share == 0.0:
            return
        weight *= share
        within ^= 1 << number
        on = number


@jit
def asked_for(scene, level, x, n, on, within, alpha, v, choice, u1, u2, throughput, light):
    """Add the light of one sampled lamp or sky direction that x reflects to v, weighted against `seen_along`."""
    q = -1
    if choice < scene.asked[0]:
        q, target = lamp_point(scene, choice, u1, u2)
        wx, wy, wz = target[0] - x[0], target[1] - x[1], target[2] - x[2]
        distance = np.sqrt(wx * wx + wy * wy + wz * wz)
        if distance == 0.0:
            return
        d = (wx / distance, wy / distance, wz / distance)
        by_light = lamp_density(scene, q, distance, d)
    else:
        d = distant_direction(scene, choice, u1, u2)
        by_light = distant_density(scene, d)
    value, density = lobe(alpha, v, n, d)
    number = scene.twin.shape[0] + q if q >= 0 else -1
    if value <= 0.0 or by_light <= 0.0 or number == on >= 0:
        return
    weight, start, face = value / (density + by_light), x, np.int64(NOWHERE)
    for _ in range(MOST_FILMS):
        t, met, what, face = hit_beyond(scene, level, start, n, d, on, face, within)
        share = lets_through(scene, met, what)
        if share == 0.0:
            break
        weight *= share
        within ^= 1 << met
        on = met
        start = (start[0] + t * d[0], start[1] + t * d[1], start[2] + t * d[2])
    if met != number:
        return
    throughput[:] = 1.0
    if q >= 0:
        gather(light, throughput, weight, scene.emission[number])
    else:
        gather_asked(scene, light, throughput, weight, d)


@jit
def reflect_rays(
    scene, cache, place, cap, level, ids, point, normal, view, number, within, alpha, first, seed, throughput, total
):  # fmt: skip
    """Add to `total` (n, 3) the radiance that rays number `first` (n,) to `last` bring from surfaces to the eye.

    From frame points (n, 3) with normals (n, 3), seen from the unit directions `view` (n, 3), all under one row of
    levels; `alpha` (n,) as in `lobe`, `within` (n,) as in `walk`; `first` (2,) the first ray and one beyond the last.
    `throughput` (3,) is scratch memory.
    """
    asks = scene.lamps.shape[0] > 0 or scene.asked[0] < 1.0
    for i in range(ids.shape[0]):
        x, n = (point[i, 0], point[i, 1], point[i, 2]), (normal[i, 0], normal[i, 1], normal[i, 2])
        v, on, key = (view[i, 0], view[i, 1], view[i, 2]), number[i], stream(seed, ids[i])
        if n[0] == 0.0 and n[1] == 0.0 and n[2] == 0.0:
            continue
        for ray in range(first[0], first[1]):
            path = np.uint64(ray)
            u1, u2 = draw_pair(key, path, np.uint64(0))
            d = direction(alpha[i], v, n, u1, u2)
            value, density = lobe(alpha[i], v, n, d)
            if value > 0.0:
                at = (level, x, n, d, on, within[i], value / density, density)
                seen_along(scene, cache, place, cap, *at, throughput, total[i])
            if asks:
                choice = draw(key, path, np.uint64(0))
                u1, u2 = draw_pair(key, path, np.uint64(1))
                asked_for(scene, level, x, n, on, within[i], alpha[i], v, choice, u1, u2, throughput, total[i])


@jit
def cast_layers(scene, level, origin, direction, start, t, number, what, normal, within, weight):
    """Surfaces that frame rays (n, 3) from an eye meet, one behind another through films: L layers, (L, n) each.

    `start` (n,) has the bits of the fields whose shells they start in. Fills t, number, what, normal, the bits `within`
    with which each is met, and the `weight` with which it is seen. Quads are seen from the front only.
    """
    fields, none = scene.twin.shape[0], (0.0, 0.0, 0.0)
    for i in range(origin.shape[0]):
        x, d = (origin[i, 0], origin[i, 1], origin[i, 2]), (direction[i, 0], direction[i, 1], direction[i, 2])
        on, bits, passed, seen, layer, face = np.int64(-1), start[i], 0.0, 1.0, 0, np.int64(NOWHERE)
        while layer < t.shape[0]:
            step, met, kind, face = hit_beyond(scene, level, x, none, d, on, face, bits)
            passed += step
            if kind != MISS:
                x = (x[0] + step * d[0], x[1] + step * d[1], x[2] + step * d[2])
            if kind == QUAD and dot(scene.quad_normal[met - fields], d) >= 0.0:
                on = met  # a wall is not drawn from behind
                continue
            t[layer, i], number[layer, i], what[layer, i] = passed, met, kind
            within[layer, i], weight[layer, i] = bits, seen
            if kind in (MISS, BURIED):
                break
            n = hit_normal(scene, met, kind, face, x, d)
            side = -1.0 if met < fields and kind == SURFACE and (bits >> met) & 1 == 1 else 1.0
            normal[layer, i, 0], normal[layer, i, 1], normal[layer, i, 2] = side * n[0], side * n[1], side * n[2]
            share = lets_through(scene, met, kind)
            if share == 0.0:
                break
            seen *= share
            bits ^= np.int64(1) << met
            on = met
            layer += 1
            weight[layer, i] = seen
