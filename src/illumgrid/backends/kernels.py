"""The path loop, compiled: rays among quads and level sets, lamps, and the moments of what the paths bring.

Numba's disk cache does not notice edits in other files: `simd.cached` lists all files whose functions end up in this
code; anything else that is imported is frozen. Kernels are serial, release the GIL and depend only on their arguments;
the caller starts threads. The surface that represents a level set is reached through `surfaces`.
"""

import numpy as np
from numba.extending import register_jitable

from illumgrid import constants
from illumgrid.backends import cubics, gathering, lights, march, normals, simd, surfaces
from illumgrid.backends.gathering import ends_in_cache, place_in_sweep
from illumgrid.backends.lights import (
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
from illumgrid.backends.surfaces import begin, inside, meet_solid, solid_normal
from illumgrid.constants import BURIED, CAP, LOST, MISS, MOST_FILMS, NOWHERE, ON_A_WALL, QUAD, SURFACE, UNSEEN
from illumgrid.rng import draw, draw_pair, mix, net_size, pascal, reverse, sharing, stream, upward

for _function in (mix, stream, draw, reverse, pascal, upward, draw_pair, net_size, sharing):
    register_jitable(_function)

_SOURCES = gathering, lights, cubics, march, normals, simd, surfaces, traversal, mesh_cast, constants
jit = cached(*_SOURCES, _nrt=False)  # as in `march`
inlined = cached(*_SOURCES, _nrt=False, forceinline=True)

# Sizes 128, 512, ... of nets whose boxes of four paths are no squares: two shapes come near one. Fewer paths than that
# take a third shape, too, or their differences would be too few.
NOT_SQUARE = 0x2AAAAA80


@inlined
def meet_quad(scene, q, x, d):
    """Distance t at which the frame ray x + t d meets quad q; inf if it does not.

    A point on the quad up to a rounding error, as at an edge that two walls share or on a floor, counts as in front of
    it: a ray that leaves towards the back meets it at once, one that leaves towards the front does not.
    """
    normal = scene.quad_normal[q]
    approach = dot(normal, d)
    if approach == 0.0:
        return np.inf
    ox, oy, oz = x[0] - scene.quad_corner[q, 0], x[1] - scene.quad_corner[q, 1], x[2] - scene.quad_corner[q, 2]
    height = normal[0] * ox + normal[1] * oy + normal[2] * oz
    on_it = ON_A_WALL * (abs(ox) + abs(oy) + abs(oz) + scene.quad_size[q])
    if (height < -on_it) != (approach > 0.0):
        return np.inf
    t = max(-height / approach, 0.0)
    at = (ox + t * d[0], oy + t * d[1], oz + t * d[2])
    u, v = dot(scene.quad_duals[q, 0], at), dot(scene.quad_duals[q, 1], at)
    if -ON_A_WALL <= u <= 1.0 + ON_A_WALL and -ON_A_WALL <= v <= 1.0 + ON_A_WALL:
        return t
    return np.inf


@jit
def leave_shell(scene, f, level, x, n, d, own, face, limit):
    """First meeting of the frame ray x + t d, which starts within the shell of field f, with its inner side.

    Like `meet_solid`; at the border of the volume the shell is closed by caps.
    """
    t, what, _ = meet_solid(scene, scene.twin[f], -level, x, n, d, own and face < 0, np.int64(NOWHERE), limit)
    if what != MISS:
        return t, SURFACE, NOWHERE
    t, axis = np.inf, NOWHERE
    for a in range(3):
        if d[a] != 0.0:
            end = scene.origin[f, a] + (scene.spacing[f, a] * (scene.shape[f, a] - 1) if d[a] > 0.0 else 0.0)
            if (end - x[a]) / d[a] < t:
                t, axis = (end - x[a]) / d[a], a
    return (max(t, 0.0), CAP, axis) if t < limit else (np.inf, MISS, NOWHERE)


@inlined
def nearest_hit(scene, level, x, n, d, on, on_face, within):
    """First surface along the frame ray x + t d, from surface number `on` (-1: from nowhere): (t, number, what, face).

    The ray starts on a surface of normal n, 0 if on none, within the shells of the fields whose bits `within` has.

    `face` is the axis of a cap, or of a mesh the face; `on_face` is that of the start. Fields count from 0, quads
    follow. A quad cannot be met again; the level set itself can.
    """
    fields = scene.twin.shape[0]
    best, number, what, face = np.inf, -1, MISS, NOWHERE
    for q in range(scene.quad_corner.shape[0]):
        if fields + q != on:
            t = meet_quad(scene, q, x, d)
            if t < best:
                best, number, what, face = t, fields + q, QUAD, NOWHERE
    for f in range(fields):
        if within >> f & 1:
            t, hit, at = leave_shell(scene, f, level[f], x, n, d, f == on, on_face, best)
        else:
            t, hit, at = meet_solid(scene, f, level[f], x, n, d, f == on, on_face, best)
        if hit != MISS and t < best:
            best, number, what, face = t, f, hit, at
    return best, number, what, face


@jit
def hit_beyond(scene, level, x, n, d, on, on_face, within):
    """`nearest_hit`, compiled once more, for all that comes behind films."""
    return nearest_hit(scene, level, x, n, d, on, on_face, within)


@jit
def lets_through(scene, number, what):
    """Share of the light that passes straight through the surface that a ray met."""
    if number < 0 or number >= scene.transmission.shape[0] or (what != SURFACE and what != CAP):
        return 0.0
    return scene.transmission[number]


@jit
def followed(scene, key, path, segment, level, x, n, d, on, on_face, within):
    """Like `nearest_hit`, beyond the films that the path passes by chance: (t, number, what, face, within)."""
    t, number, what, face = hit_beyond(scene, level, x, n, d, on, on_face, within)
    for film in range(MOST_FILMS):
        share = lets_through(scene, number, what)
        if share == 0.0 or draw(mix(key + np.uint64(film + 1)), path, np.uint64(segment)) >= share:
            break
        within ^= 1 << number
        start = (x[0] + t * d[0], x[1] + t * d[1], x[2] + t * d[2])
        more, number, what, face = hit_beyond(scene, level, start, n, d, number, face, within)
        t += more
    return t, number, what, face, within


@jit
def hit_normal(scene, number, what, face, x, d):
    """Normal where a ray met a surface: that of the solid, or of the side of the quad it came to."""
    if what == QUAD:
        normal = scene.quad_normal[number - scene.twin.shape[0]]
        side = -np.copysign(1.0, dot(normal, d))
        return side * normal[0], side * normal[1], side * normal[2]
    return solid_normal(scene, number, what, face, x, d)


@jit
def shells_around(scene, level, x, n, own):
    """Bits of the fields other than `own` whose shells the frame point x lies within, on a surface of normal n.

    -1 if it lies inside a solid.
    """
    within = np.int64(0)
    for f in range(scene.twin.shape[0]):
        if f != own and inside(scene, f, level[f], x, n):
            if scene.twin[f] < 0:
                return np.int64(-1)
            within |= np.int64(1) << f
    return within


@jit
def light_asked(scene, choice, u, v, level, on, on_face, x, n, within):
    """Sample one light at x: (weight, quad, direction); the quad is -1 for distant light.

    The weight, of a lamp's emission or of the radiance from that direction, is that of the balance heuristic: cosine
    density over the sum of both densities (Veach & Guibas 1995).
    """
    q, number = -1, -1
    if choice < scene.asked[0]:
        q, target = lamp_point(scene, choice, u, v)
        wx, wy, wz = target[0] - x[0], target[1] - x[1], target[2] - x[2]
        distance = np.sqrt(wx * wx + wy * wy + wz * wz)
        if distance == 0.0:
            return 0.0, q, n
        d = (wx / distance, wy / distance, wz / distance)
        number, by_light = scene.twin.shape[0] + q, lamp_density(scene, q, distance, d)
    else:
        d = distant_direction(scene, choice, u, v)
        by_light = distant_density(scene, d)
    by_cosine = dot(n, d) / np.pi
    if by_cosine <= 0.0 or by_light <= 0.0 or (q >= 0 and number == on):
        return 0.0, q, d
    # The ray may meet only this lamp, or nothing, and films before it, which let a share through.
    weight, start = by_cosine / (by_cosine + by_light), x
    t, met, what, face = nearest_hit(scene, level, x, n, d, on, on_face, within)
    for _ in range(MOST_FILMS):
        share = lets_through(scene, met, what)
        if share == 0.0:
            break
        weight *= share
        within ^= 1 << met
        start = (start[0] + t * d[0], start[1] + t * d[1], start[2] + t * d[2])
        t, met, what, face = hit_beyond(scene, level, start, n, d, met, face, within)
    return (weight if met == number else 0.0), q, d


@jit
def walk(scene, cache, place, key, path, bounces, level, own, own_face, x, n, within, throughput, worth):
    """One path from the frame point x, with normal n, on `own_face` of surface `own`: fills its `worth` (C,).

    The irradiance there is π times the mean over the paths. `throughput` (C,) is scratch memory for the product of the
    albedos along the path. `place` is the position of its levels in the sweep of the cache; `within` has the bits of
    the fields whose shells it starts in.
    """
    throughput[:], worth[:] = 1.0, 0.0
    on, on_face, fields = own, own_face, scene.twin.shape[0]
    for segment in range(bounces + 1):
        # Sample a lamp or the sky, weighted against the chance that the ray below finds it. One pair of numbers
        # serves both: each keeps its mean, and their shared boxes keep the error bars short.
        u1, u2 = draw_pair(key, path, np.uint64(segment))
        if scene.lamps.shape[0] > 0 or scene.asked[0] < 1.0:
            choice = draw(key, path, np.uint64(segment))
            weight, q, d = light_asked(scene, choice, u1, u2, level, on, on_face, x, n, within)
            if q >= 0:
                gather(worth, throughput, weight, scene.emission[fields + q])
            elif weight > 0.0:
                gather_asked(scene, worth, throughput, weight, d)

        # Choose a direction, cosine-distributed about the normal.
        d = cosine_direction(u1, u2, n[0], n[1], n[2])

        # Follow the ray to the nearest surface, through films by chance; one that dips under its own meets it at once.
        if scene.transmission.shape[0] == 0:
            t, number, what, face = nearest_hit(scene, level, x, n, d, on, on_face, within)
        else:
            t, number, what, face, within = followed(scene, key, path, segment, level, x, n, d, on, on_face, within)

        # A path that escapes sees the sky and ends.
        if what == MISS:
            gather(worth, throughput, 1.0, scene.background)
            if scene.harmonics.shape[0] > 0:
                gather_smooth(scene, worth, throughput, d)
            if scene.asked[0] < 1.0:
                by_cosine, by_light = dot(n, d) / np.pi, distant_density(scene, d)
                gather_asked(scene, worth, throughput, by_cosine / (by_cosine + by_light), d)
            break

        # A path inside a solid carries no light.
        if what == BURIED:
            break

        # Account for what the surface emits: a quad on its front only, weighted if it is a lamp.
        weight = 1.0
        if what == QUAD:
            by_cosine, by_lamp = dot(n, d) / np.pi, lamp_density(scene, number - fields, t, d)
            front = dot(scene.quad_normal[number - fields], d) < 0.0
            weight = by_cosine / (by_cosine + by_lamp) if front else 0.0
        gather(worth, throughput, weight, scene.emission[number])

        # Reflect: multiply by the albedo, and continue from the hit.
        for channel in range(worth.shape[0]):
            throughput[channel] *= scene.albedo[number, channel]
        on, on_face = number, face
        if t > 0.0 or what == QUAD:
            x = (x[0] + t * d[0], x[1] + t * d[1], x[2] + t * d[2])
            # End where the cache is trusted: on the outer side.
            inner = number < fields and (within >> number) & 1 == 1
            if (
                cache.after <= segment < bounces
                and not inner
                and ends_in_cache(scene, cache, place, number, what, t, x, d, throughput, worth)
            ):
                break
            n = hit_normal(scene, number, what, face, x, d)
            if inner and what == SURFACE:
                n = (-n[0], -n[1], -n[2])
            if n[0] == 0.0 and n[1] == 0.0 and n[2] == 0.0:
                break


@jit
def mixed_differences(worth, at, size, channel, many):
    """Variance of a path from the mixed differences of four paths in one box, of which two share either half.

    (one - two - three + four)² / 4, over all paths of the net from row `at` on and `many` of the squarest shapes of
    box. What changes along one number alone cancels, as it does in the mean over the net.
    """
    last = 0  # shapes: boxes of 2^-a by 2^-b with a + b = last
    while 8 << last <= size:
        last += 1
    total, shapes, squarest = 0.0, 0, (last + 1) // 2
    for a in range(max(0, squarest - 1), min(last, squarest - 2 + many) + 1):
        first, second = sharing(a + 1, last - a), sharing(a, last - a + 1)
        for i in range(at, at + size // 4):
            j = i - at
            off = worth[i, channel] - worth[at + (j ^ first), channel]
            off += worth[at + (j ^ first ^ second), channel] - worth[at + (j ^ second), channel]
            total += off * off
        shapes += 1
    return total / (shapes * size)


@jit
def net_variance(worth, at, size, channel):
    """Variance of a path with which independent paths would have the error of the net from row `at` on.

    Extrapolates how the differences shrank from nets of a quarter of the size: by half at most, as at edges of light.
    """
    if size == 2:
        return 0.5 * (worth[at, channel] - worth[at + 1, channel]) ** 2
    many = 2 if size & NOT_SQUARE else 3
    fine, coarse, quarter = mixed_differences(worth, at, size, channel, many), 0.0, size // 4
    if quarter < 4:
        return fine
    for k in range(4):
        coarse += 0.25 * mixed_differences(worth, at + k * quarter, quarter, channel, many)
    return fine if fine >= coarse else max(0.5, fine / coarse) * fine


@jit
def moments(worth, first, sky, lamplight, channel):
    """Mean worth of paths number `first` on, and its m2, so that stderr² = m2 / (count (count - 1)).

    The range is cut into nets. An allowance for light that no path met is added: features too small to be found change
    the light by UNSEEN of the mean contribution of a path, or of the sky; and one more path may be as bright as the
    brightest so far, or as all lamps spread evenly.
    """
    count = worth.shape[0]
    total, known, mean, brightest, at = 0.0, 0, 0.0, 0.0, np.int64(0)
    for i in range(count):
        mean += worth[i, channel] / count
        brightest = max(brightest, worth[i, channel])
    while at < count:
        size = net_size(first + at, count - at)
        if size > 1:
            total += size * net_variance(worth, at, size, channel)
            known += size
        at += size
    if known == 0 and count == 2:
        total, known = (worth[0, channel] - worth[1, channel]) ** 2, 2
    usual = max(mean, sky)
    unseen = (UNSEEN * usual) ** 2 + max(0.0, brightest - usual) ** 2 + lamplight**2
    return mean, (total * count / max(known, 1) + unseen) * (count - 1) / count


@jit
def solve_queries(
    scene, cache, ids, point, normal, level, target, first, bounces, seed, throughput, worth, mean, m2, paths, stop
):  # fmt: skip
    """Irradiance at queries in frame coordinates, from one path per row of `worth`, beginning with number `first`.

    Fills mean (n, C), m2 (n, C) and paths (n,); `throughput` (C,) and `worth` (paths, C) are scratch memory.
    Another thread may set `stop` (1,): no further path begins, and the result is invalid.
    """
    count = worth.shape[0]
    for i in range(ids.shape[0]):
        x, n = (point[i, 0], point[i, 1], point[i, 2]), (normal[i, 0], normal[i, 1], normal[i, 2])
        if n[0] == 0.0 and n[1] == 0.0 and n[2] == 0.0:
            continue
        own = np.int64(target[i])  # one type of number throughout: each additional type is compiled separately
        x, face = begin(scene, own, x, n)
        within = shells_around(scene, level[i], x, n, own)
        if face == LOST or within < 0:
            continue
        key, place = stream(seed, ids[i]), place_in_sweep(cache, level[i])
        for k in range(count):
            if stop[0] != 0:
                return
            at = (level[i], own, face, x, n, within)
            walk(scene, cache, place, key, np.uint64(first + k), bounces, *at, throughput, worth[k])
        for channel in range(worth.shape[1]):
            mean_worth, off = moments(worth, first, scene.usual[channel], scene.lamplight[channel], channel)
            mean[i, channel], m2[i, channel] = np.pi * mean_worth, np.pi**2 * off
        paths[i] = count


@jit
def cast_rays(scene, level, origin, direction, on, t, number, what, normal):
    """First hits of frame rays (n, 3), all under one row of levels; fills t, number, what and normal.

    Rays that start on no surface (`on` is -1) are those of a camera: they see the fronts of quads only.
    """
    fields, none, nowhere, outside = scene.twin.shape[0], (0.0, 0.0, 0.0), np.int64(NOWHERE), np.int64(0)
    for i in range(origin.shape[0]):
        x, d = (origin[i, 0], origin[i, 1], origin[i, 2]), (direction[i, 0], direction[i, 1], direction[i, 2])
        through, start, passed = on, x, 0.0
        t[i], number[i], what[i], face = nearest_hit(scene, level, x, none, d, on, nowhere, outside)
        while on < 0 and what[i] == QUAD and dot(scene.quad_normal[number[i] - fields], d) >= 0.0:
            # Walls are not drawn from behind: continue from there.
            passed += t[i]
            through = number[i]
            start = (x[0] + passed * d[0], x[1] + passed * d[1], x[2] + passed * d[2])
            t[i], number[i], what[i], face = nearest_hit(scene, level, start, none, d, through, nowhere, outside)
        t[i] += passed
        if what[i] != MISS and what[i] != BURIED:
            hit = (x[0] + t[i] * d[0], x[1] + t[i] * d[1], x[2] + t[i] * d[2])
            normal[i, 0], normal[i, 1], normal[i, 2] = hit_normal(scene, number[i], what[i], face, hit, d)
