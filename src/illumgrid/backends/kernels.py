"""The compiled call tree: marching rays through trilinear fields, casting them at meshes, and walking light paths.

It lives in this one file, with `bvh` and `lanes` below it, because Numba's disk cache does not see edits elsewhere
(`lanes.cached` names the two); what else it imports is frozen. Kernels are serial, release the GIL and depend on
nothing but their arguments; threads are the caller's business.

Two surfaces stand for a level set. A scene that is `illumgrid.field.levelset.Marchable` is marched; one that is
`illumgrid.backends.meshes.Meshed` has a closed mesh for each field. The path loop is the same: the four questions that
differ are asked through `either`, and only what a scene's type asks for is compiled.

A field comes as {v >= level}: `Marchable` has turned it so. Index coordinates of field f are (x - origin[f]) /
spacing[f] for x in the frame of the scene; t is world distance throughout.
"""

from typing import Any

import numpy as np
from numba.extending import overload, register_jitable

from illumgrid.backends import bvh, lanes
from illumgrid.backends.bvh import View, cast
from illumgrid.backends.lanes import address, at_least, cached, count_below
from illumgrid.field.levelset import Marchable
from illumgrid.rng import draw, draw_pair, mix, net_size, pascal, reverse, sharing, stream, upward

for _function in (mix, stream, draw, reverse, pascal, upward, draw_pair, net_size, sharing):
    register_jitable(_function)

# No fastmath: a miss is t = inf, and the sign of a coefficient near zero decides the side.
# Nor Numba's reference counts: nothing is allocated here, the caller keeps the arrays alive, and the atomic counts of a
# scene handed from function to function cost a third of the time.
jit = cached(lanes, bvh, _nrt=False)
# A call that hands a scene on moves 200 words: what every ray calls is inlined.
inlined = cached(lanes, bvh, _nrt=False, forceinline=True)

MISS, SURFACE, CAP, BURIED, QUAD = 0, 1, 2, 3, 4  # a ray meets nothing, a level set, a cap, a solid's inside, a quad
BRICK_SHIFT = 2  # bricks of 4 cells a side, as in illumgrid.field.bricks
REACH = (1, 1, 2, 3, 4, 6, 8, 16, 1 << 20)  # bricks to leap, by how many cubes are empty, as in illumgrid.field.bricks
ONE = np.uint64(1)
ON_A_VOXEL = 1e-7  # as in illumgrid.field.volume
ON_A_WALL = 1e-10  # a wall reaches this share of its size farther, so that walls joined at an edge leave no gap
# Sizes 128, 512, ... of nets whose boxes of four paths are no squares: two shapes come near one. Fewer paths than that
# take a third shape, too, or their differences would be too few.
NOT_SQUARE = 0x2AAAAA80
UNSEEN = 0.2  # measured: docs/light_transport.md
NOWHERE, LOST = -1, -2  # instead of a face: a surface that needs none; a query whose mesh is out of reach


def either(marched: Any, meshed: Any) -> Any:
    """One function for both surfaces: chosen by the type of the scene as it is compiled, or called as plain Python."""

    def ask(scene, *rest):
        return (marched if isinstance(scene, Marchable) else meshed)(scene, *rest)

    @overload(ask, jit_options={"nogil": True, "error_model": "numpy", "_nrt": False})  # type: ignore[typeddict-unknown-key]
    def _(scene, *rest):
        chosen = marched if scene.instance_class is Marchable else meshed
        return lambda scene, *rest: chosen(scene, *rest)

    return ask


def _between(axis: int) -> tuple[np.uint64, ...]:
    """Cells of a brick, as bits, from `low` to `high` along an axis, for 4 low + high."""
    cell = np.arange(64) >> (4 - 2 * axis) & 3
    return tuple(
        np.uint64(sum(1 << int(bit) for bit in np.flatnonzero((low <= cell) & (cell <= high))))
        for low in range(4)
        for high in range(4)
    )


BETWEEN = _between(0) + _between(1) + _between(2)


@inlined
def first_cell(u, d, last):
    """Cell along one axis that a ray enters at index coordinate u; outside 0 .. last - 1 it has left the field."""
    cell = int(u)  # without branches: on a voxel the sign of d is a coin toss
    return cell - int((u == cell) & ((d < 0.0) | ((d == 0.0) & (cell == last))))


@inlined
def snap(u):
    """Index coordinate of a node that lies on a voxel."""
    nearest = np.round(u)
    return nearest if abs(u - nearest) < ON_A_VOXEL else u


@inlined
def first_root(q0, q1, q2, q3, end):
    """Smallest t in [0, end] at which q0 + q1 t + q2 t² + q3 t³ reaches 0 from q0 < 0; inf if none."""
    # On [0, 1]: the Bernstein coefficients bound the cubic, and most cells end here.
    a, b, c = q1 * end, q2 * end * end, q3 * end * end * end
    if 3.0 * q0 + a < 0.0 and 3.0 * q0 + 2.0 * a + b < 0.0 and q0 + a + b + c < 0.0:
        return np.inf
    # The roots of the derivative part [0, 1] into monotone pieces.
    low, high = 2.0, 2.0
    half = b * b - 3.0 * a * c
    if half > 0.0:
        q = -(b + np.copysign(np.sqrt(half), b))
        low, high = q / (3.0 * c), a / q
        if low > high:
            low, high = high, low
    left, below = 0.0, q0
    for piece in range(3):
        right = low if piece == 0 else (high if piece == 1 else 1.0)
        if piece < 2 and not (left < right < 1.0):
            continue
        above = q0 + right * (a + right * (b + right * c))
        if above >= 0.0:
            # One root in [left, right], on a rising piece: Newton steps from the chord, bisection where they leave the
            # bracket. A step of 1e-10 leaves an error of its square; at a double root it halves the error.
            s = left - below * (right - left) / (above - below)
            for _ in range(60):
                value = q0 + s * (a + s * (b + s * c))
                if value >= 0.0:
                    right = s
                else:
                    left = s
                after = s - value / (a + s * (2.0 * b + 3.0 * c * s))
                if not (left <= after <= right):
                    after = 0.5 * (left + right)
                step, s = abs(after - s), after
                if step < 1e-10:
                    break
            return s * end
        left, below = right, above
    return np.inf


@inlined
def next_root(q1, q2, q3, end):
    """Smallest t in [0, end] at which t (q1 + q2 t + q3 t²) reaches 0 from below, its root at 0 divided out.

    A ray that starts on the level set: 0 if it dips under the surface at once, inf if it does not come back.
    """
    a, b, c = q1 * end, q2 * end * end, q3 * end * end * end
    if a == 0.0:
        if b > 0.0 or (b == 0.0 and c >= 0.0):  # all zero: the cell is flat, at the level, hence solid
            return 0.0
        return -b / c * end if c > 0.0 and -b <= c else np.inf
    if a > 0.0:
        return 0.0
    if a + 0.5 * b < 0.0 and a + b + c < 0.0:
        return np.inf
    disc = b * b - 4.0 * a * c
    if disc < 0.0:
        return np.inf
    q = -0.5 * (b + np.copysign(np.sqrt(disc), b))
    one, other = q / c, a / q
    best = np.inf
    if 0.0 < one <= 1.0:
        best = one
    if 0.0 < other <= 1.0 and other < best:
        best = other
    return best * end


@inlined
def cubic(values, corner, step_x, step_y, level, ex, ey, ez, dx, dy, dz):
    """Coefficients of v - level along a ray through a trilinear cell, from its entry e in [0, 1]³.

    `corner` is the flat number of the cell's first voxel. Parker et al., "Interactive ray tracing for isosurface
    rendering", IEEE Visualization 1998, with the interpolation nested so that equal values cancel exactly.
    """
    f000 = values[corner] - level
    f001 = values[corner + 1] - level
    f010 = values[corner + step_y] - level
    f011 = values[corner + step_y + 1] - level
    corner += step_x
    x00, x01 = values[corner] - level - f000, values[corner + 1] - level - f001
    x10, x11 = values[corner + step_y] - level - f010, values[corner + step_y + 1] - level - f011
    # Along x: four edges, linear in t.
    a00, a01, a10, a11 = f000 + x00 * ex, f001 + x01 * ex, f010 + x10 * ex, f011 + x11 * ex
    s00, s01, s10, s11 = x00 * dx, x01 * dx, x10 * dx, x11 * dx
    # Along y: two faces, quadratic.
    y0, y1, r0, r1 = a10 - a00, a11 - a01, s10 - s00, s11 - s01
    b0, b1, b2 = a00 + y0 * ey, s00 + r0 * ey + y0 * dy, r0 * dy
    c0, c1, c2 = a01 + y1 * ey, s01 + r1 * ey + y1 * dy, r1 * dy
    # Along z: the cell, cubic.
    z0, z1, z2 = c0 - b0, c1 - b1, c2 - b2
    return b0 + z0 * ez, b1 + z1 * ez + z0 * dz, b2 + z2 * ez + z1 * dz, z2 * dz


@inlined
def rank_of(steps, level):
    """Rank of a level among the steps of a field: see `illumgrid.field.bricks`."""
    low, high = 0, steps.shape[0]
    while low < high:
        middle = (low + high) >> 1
        if steps[middle] <= level:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def follow(u, t, d, low, high):
    """Cell, of those from low to high, at distance t along one axis."""
    return min(max(int(u + t * d), low), high)


@inlined
def march(scene, f, level, ux, uy, uz, dx, dy, dz, on_surface, limit):
    """First meeting of a ray with the solid of field f, in index coordinates u + t d.

    Bytes are compared first: see `field.bricks`. The ray leaps over the largest cube of bricks ahead that ranks
    below the level. A brick that does not is crossed at once too if no cell between the ray's two ends in it ranks high
    enough; else the ray goes from cell to cell (Amanatides & Woo 1987) and asks the cubic in such cells only.
    `on_surface`: the ray starts on the level set itself, outside. Returns (t, what, face), face the axis of a cap.
    """
    last_x, last_y, last_z = scene.shape[f, 0] - 1, scene.shape[f, 1] - 1, scene.shape[f, 2] - 1
    # A plane at index coordinate p is met at t = p i + k; a ray parallel to it never does: i = 0, k = inf.
    # Bricks and cells compute it alike, so that a brick's last cell ends exactly where the brick does.
    ix, iy, iz = 1.0 / dx if dx != 0.0 else 0.0, 1.0 / dy if dy != 0.0 else 0.0, 1.0 / dz if dz != 0.0 else 0.0
    kx = -ux * ix if dx != 0.0 else np.inf
    ky = -uy * iy if dy != 0.0 else np.inf
    kz = -uz * iz if dz != 0.0 else np.inf
    t, face = 0.0, -1
    if not (0.0 <= ux <= last_x and 0.0 <= uy <= last_y and 0.0 <= uz <= last_z):
        # From outside: it enters through the last of three planes.
        if (ix == 0.0 and not 0.0 <= ux <= last_x) or (iy == 0.0 and not 0.0 <= uy <= last_y):
            return np.inf, MISS, -1
        if iz == 0.0 and not 0.0 <= uz <= last_z:
            return np.inf, MISS, -1
        if ix != 0.0 and min(kx, last_x * ix + kx) > t:
            t, face = min(kx, last_x * ix + kx), 0
        if iy != 0.0 and min(ky, last_y * iy + ky) > t:
            t, face = min(ky, last_y * iy + ky), 1
        if iz != 0.0 and min(kz, last_z * iz + kz) > t:
            t, face = min(kz, last_z * iz + kz), 2
    t_out = min(limit, max(kx, last_x * ix + kx), max(ky, last_y * iy + ky), max(kz, last_z * iz + kz))
    if t > t_out:
        return np.inf, MISS, -1
    px = min(max(ux + t * dx, 0.0), last_x) if face != 0 else (0.0 if dx > 0.0 else 1.0 * last_x)
    py = min(max(uy + t * dy, 0.0), last_y) if face != 1 else (0.0 if dy > 0.0 else 1.0 * last_y)
    pz = min(max(uz + t * dz, 0.0), last_z) if face != 2 else (0.0 if dz > 0.0 else 1.0 * last_z)
    cx, cy, cz = first_cell(px, dx, last_x), first_cell(py, dy, last_y), first_cell(pz, dz, last_z)
    if cx < 0 or cy < 0 or cz < 0 or cx >= last_x or cy >= last_y or cz >= last_z:
        return np.inf, MISS, -1
    step_y, start = scene.shape[f, 2], scene.start[f]
    step_x = step_y * scene.shape[f, 1]
    if not on_surface:
        corner = start + cx * step_x + cy * step_y + cz
        q0, _, _, _ = cubic(scene.values, corner, step_x, step_y, level, px - cx, py - cy, pz - cz, dx, dy, dz)
        if q0 >= 0.0:
            return t, (CAP if face >= 0 else BURIED), face

    ahead_x, ahead_y, ahead_z = int(dx > 0.0), int(dy > 0.0), int(dz > 0.0)
    toward_x, toward_y, toward_z = 2 * ahead_x - 1, 2 * ahead_y - 1, 2 * ahead_z - 1
    along_x, along_y, along_z = 1.0 * toward_x, 1.0 * toward_y, 1.0 * toward_z
    many_y, many_z = scene.brick_shape[f, 1], scene.brick_shape[f, 2]
    bricks = address(scene.bricks) + (scene.brick_start[f] << 7)
    octant = 64 + 8 * (4 * ahead_x + 2 * ahead_y + ahead_z)
    hop_x, hop_y, hop_z = (toward_x * many_y * many_z) << 7, (toward_y * many_z) << 7, toward_z << 7
    rank = rank_of(scene.steps[f], level)
    bx, by, bz = cx >> BRICK_SHIFT, cy >> BRICK_SHIFT, cz >> BRICK_SHIFT
    brick = ((bx * many_y + by) * many_z + bz) << 7
    far_x = 1.0 * ((bx + ahead_x) << BRICK_SHIFT)
    far_y = 1.0 * ((by + ahead_y) << BRICK_SHIFT)
    far_z = 1.0 * ((bz + ahead_z) << BRICK_SHIFT)
    beyond = (scene.brick_shape[f, 0] * many_y * many_z) << 7
    started = False
    while 0 <= brick < beyond:  # t_out ends the march before that, but for rounding; what follows reads raw memory
        empty = count_below(bricks, brick + octant, rank)
        if empty <= 1:
            tx, ty, tz = far_x * ix + kx, far_y * iy + ky, far_z * iz + kz
            t_brick = min(tx, ty, tz)
            if empty == 0:
                low_x, low_y, low_z = bx << BRICK_SHIFT, by << BRICK_SHIFT, bz << BRICK_SHIFT
                high_x, high_y, high_z = (
                    min(low_x + 4, last_x) - 1,
                    min(low_y + 4, last_y) - 1,
                    min(low_z + 4, last_z) - 1,
                )
                if started:
                    cx = follow(ux, t, dx, low_x, high_x)
                    cy = follow(uy, t, dy, low_y, high_y)
                    cz = follow(uz, t, dz, low_z, high_z)
                end_x = follow(ux, t_brick, dx, low_x, high_x)
                end_y = follow(uy, t_brick, dy, low_y, high_y)
                end_z = follow(uz, t_brick, dz, low_z, high_z)
                left = at_least(bricks, brick, rank)
                left &= BETWEEN[((min(cx, end_x) & 3) << 2) | (max(cx, end_x) & 3)]
                left &= BETWEEN[16 | ((min(cy, end_y) & 3) << 2) | (max(cy, end_y) & 3)]
                left &= BETWEEN[32 | ((min(cz, end_z) & 3) << 2) | (max(cz, end_z) & 3)]
                t_end = min(t_brick, t_out)
                plane_x, plane_y, plane_z = 1.0 * (cx + ahead_x), 1.0 * (cy + ahead_y), 1.0 * (cz + ahead_z)
                at = ((cx & 3) << 4) | ((cy & 3) << 2) | (cz & 3)
                while left != 0:
                    # Go from cell to cell.
                    sx, sy, sz = plane_x * ix + kx, plane_y * iy + ky, plane_z * iz + kz
                    t_cell = max(t, min(sx, sy, sz))
                    bit = ONE << np.uint64(at)
                    if left & bit != 0:
                        left ^= bit
                        lx, ly, lz = plane_x - ahead_x, plane_y - ahead_y, plane_z - ahead_z
                        corner = start + int(lx) * step_x + int(ly) * step_y + int(lz)
                        ex = min(max(ux + t * dx - lx, 0.0), 1.0)
                        ey = min(max(uy + t * dy - ly, 0.0), 1.0)
                        ez = min(max(uz + t * dz - lz, 0.0), 1.0)
                        q0, q1, q2, q3 = cubic(scene.values, corner, step_x, step_y, level, ex, ey, ez, dx, dy, dz)
                        if on_surface:
                            root = next_root(q1, q2, q3, t_cell - t)
                        elif q0 >= 0.0:
                            root = 0.0
                        else:
                            root = first_root(q0, q1, q2, q3, t_cell - t)
                        if root < np.inf:
                            t += root
                            return (t, SURFACE, -1) if t < limit else (np.inf, MISS, -1)
                    on_surface = False
                    t = t_cell
                    if t >= t_end:
                        break
                    # Without branches: which plane comes first is a coin toss that no processor predicts.
                    on_x, on_y = sx <= sy and sx <= sz, sy < sx and sy <= sz
                    plane_x += along_x if on_x else 0.0
                    plane_y += along_y if on_y else 0.0
                    plane_z += 0.0 if on_x or on_y else along_z
                    at += 16 * toward_x if on_x else (4 * toward_y if on_y else toward_z)
            t, started, on_surface = max(t, t_brick), True, False
            if t >= t_out:
                return np.inf, MISS, -1
            by_x, by_y = tx <= ty and tx <= tz, ty < tx and ty <= tz
            far_x += 4.0 * along_x if by_x else 0.0
            far_y += 4.0 * along_y if by_y else 0.0
            far_z += 0.0 if by_x or by_y else 4.0 * along_z
            bx += toward_x if by_x else 0
            by += toward_y if by_y else 0
            bz += 0 if by_x or by_y else toward_z
            brick += hop_x if by_x else (hop_y if by_y else hop_z)
        else:
            if empty == 8:
                return np.inf, MISS, -1
            hop = REACH[empty] - 1
            up_x, up_y, up_z = hop * toward_x, hop * toward_y, hop * toward_z
            tx = (far_x + 4.0 * up_x) * ix + kx
            ty = (far_y + 4.0 * up_y) * iy + ky
            tz = (far_z + 4.0 * up_z) * iz + kz
            t, started, on_surface = max(t, min(tx, ty, tz)), True, False
            if t >= t_out:
                return np.inf, MISS, -1
            by_x, by_y = tx <= ty and tx <= tz, ty < tx and ty <= tz
            far_end_x, far_end_y, far_end_z = bx + up_x, by + up_y, bz + up_z
            mx = min(max(int(ux + t * dx) >> 2, min(bx, far_end_x)), max(bx, far_end_x))
            my = min(max(int(uy + t * dy) >> 2, min(by, far_end_y)), max(by, far_end_y))
            mz = min(max(int(uz + t * dz) >> 2, min(bz, far_end_z)), max(bz, far_end_z))
            bx = far_end_x + toward_x if by_x else mx
            by = far_end_y + toward_y if by_y else my
            bz = mz if by_x or by_y else far_end_z + toward_z
            brick = ((bx * many_y + by) * many_z + bz) << 7
            far_x = 1.0 * ((bx + ahead_x) << BRICK_SHIFT)
            far_y = 1.0 * ((by + ahead_y) << BRICK_SHIFT)
            far_z = 1.0 * ((bz + ahead_z) << BRICK_SHIFT)
    return np.inf, MISS, -1


@inlined
def dot(a, b):
    """Scalar product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def meet_quad(scene, q, x, d):
    """Distance t at which the frame ray x + t d meets quad q; inf if it does not.

    What lies on the quad but for a rounding error, as at an edge that two walls share or on a floor, is in front of it:
    a ray that leaves for the back meets it at once, one that leaves for the front does not.
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


@inlined
def march_from(scene, f, level, x, n, d, own, face, limit):
    """First meeting of the frame ray x + t d with field f's trilinear solid, t < limit: (t, what, axis of a cap).

    `own`: the ray starts on that solid, at a cap if `face` says so; then the convex box cannot be met again.
    """
    if own and face >= 0:
        return np.inf, MISS, NOWHERE
    sx, sy, sz = scene.spacing[f, 0], scene.spacing[f, 1], scene.spacing[f, 2]
    ux = snap((x[0] - scene.origin[f, 0]) / sx)
    uy = snap((x[1] - scene.origin[f, 1]) / sy)
    uz = snap((x[2] - scene.origin[f, 2]) / sz)
    return march(scene, f, level, ux, uy, uz, d[0] / sx, d[1] / sy, d[2] / sz, own, limit)


@jit
def cast_from(scene, f, x, d, limit):
    """First face of field f's mesh along the frame ray x + t d: (t, number, whether it was met from the front)."""
    tree = View(
        address(scene.memory[scene.tree_start[f] :]),
        scene.centre[f, 0], scene.centre[f, 1], scene.centre[f, 2], scene.scale[f],
    )  # fmt: skip
    t, face, _, _ = cast(tree, address(scene.stack), x[0], x[1], x[2], d[0], d[1], d[2], limit, False)
    if face < 0:
        return np.inf, NOWHERE, False
    face += scene.face_start[f]
    return t, face, dot(scene.facing[face], d) < 0.0


@jit
def mesh_from(scene, f, level, x, n, d, own, face, limit):
    """First meeting of the frame ray x + t d with field f's mesh, t < limit: (t, what, face).

    It starts on a surface of normal n, and if `own` on this mesh, on `face`. If it goes under that face it has met it
    at once; else it starts off by what rounding may do. If it meets a back after that, it went under a neighbour.
    """
    off = scene.off[f]
    if own:
        n = (scene.facing[face, 0], scene.facing[face, 1], scene.facing[face, 2])
        if dot(n, d) <= 0.0:
            return 0.0, SURFACE, face
        if scene.cap[face]:
            return np.inf, MISS, NOWHERE
    x = (x[0] + off * n[0], x[1] + off * n[1], x[2] + off * n[2])
    t, met, front = cast_from(scene, f, x, d, limit)
    if met == NOWHERE:
        return np.inf, MISS, NOWHERE
    if not front:
        return 0.0, (SURFACE if own else BURIED), face
    return t, (CAP if scene.cap[met] else SURFACE), met


meet_solid = either(march_from, mesh_from)


@inlined
def nearest_hit(scene, level, x, n, d, on, on_face):
    """First surface along the frame ray x + t d, from surface number `on` (-1: from nowhere): (t, number, what, face).

    The ray starts on a surface of normal n, 0 if on none.

    `face` is the axis of a cap, or of a mesh the face; `on_face` is that of the start. Fields count from 0, quads
    follow. A quad cannot be met again; the level set itself can.
    """
    fields = scene.start.shape[0]
    best, number, what, face = np.inf, -1, MISS, NOWHERE
    for q in range(scene.quad_corner.shape[0]):
        if fields + q != on:
            t = meet_quad(scene, q, x, d)
            if t < best:
                best, number, what, face = t, fields + q, QUAD, NOWHERE
    for f in range(fields):
        t, hit, at = meet_solid(scene, f, level[f], x, n, d, f == on, on_face, best)
        if hit != MISS and t < best:
            best, number, what, face = t, f, hit, at
    return best, number, what, face


@jit
def outward(gx, gy, gz):
    """Unit vector against the gradient of v; 0 on a plateau. Scaled first: the square of a tiny slope underflows."""
    largest = max(abs(gx), abs(gy), abs(gz))
    if largest == 0.0:
        return 0.0, 0.0, 0.0
    gx, gy, gz = gx / largest, gy / largest, gz / largest
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    return -gx / length, -gy / length, -gz / length


@jit
def cell_normal(scene, f, ux, uy, uz):
    """Outward normal at index u of the trilinear cell of field f that holds it."""
    last_x, last_y, last_z = scene.shape[f, 0] - 1, scene.shape[f, 1] - 1, scene.shape[f, 2] - 1
    cx, cy = follow(ux, 0.0, 0.0, 0, last_x - 1), follow(uy, 0.0, 0.0, 0, last_y - 1)
    cz = follow(uz, 0.0, 0.0, 0, last_z - 1)
    wx, wy, wz = min(max(ux - cx, 0.0), 1.0), min(max(uy - cy, 0.0), 1.0), min(max(uz - cz, 0.0), 1.0)
    step_y = scene.shape[f, 2]
    step_x = step_y * scene.shape[f, 1]
    here = scene.start[f] + cx * step_x + cy * step_y + cz
    _, gx, _, _ = cubic(scene.values, here, step_x, step_y, 0.0, wx, wy, wz, 1.0, 0.0, 0.0)
    _, gy, _, _ = cubic(scene.values, here, step_x, step_y, 0.0, wx, wy, wz, 0.0, 1.0, 0.0)
    _, gz, _, _ = cubic(scene.values, here, step_x, step_y, 0.0, wx, wy, wz, 0.0, 0.0, 1.0)
    return outward(gx / scene.spacing[f, 0], gy / scene.spacing[f, 1], gz / scene.spacing[f, 2])


@jit
def gradient_normal(scene, f, ux, uy, uz):
    """Outward normal at index u of field f: central differences (one-sided at the border), interpolated trilinearly.

    Where they cancel, that of the trilinear cell.
    """
    last_x, last_y, last_z = scene.shape[f, 0] - 1, scene.shape[f, 1] - 1, scene.shape[f, 2] - 1
    cx, cy = follow(ux, 0.0, 0.0, 0, last_x - 1), follow(uy, 0.0, 0.0, 0, last_y - 1)
    cz = follow(uz, 0.0, 0.0, 0, last_z - 1)
    wx, wy, wz = min(max(ux - cx, 0.0), 1.0), min(max(uy - cy, 0.0), 1.0), min(max(uz - cz, 0.0), 1.0)
    step_y = scene.shape[f, 2]
    step_x = step_y * scene.shape[f, 1]
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


@jit
def normal_on_mesh(scene, f, what, face, x, d):
    """Normal where a ray met mesh f at x: the gradient normal; that of the face on a cap, or where there is none."""
    n = normal_by_field(scene, f, SURFACE, NOWHERE, x, d)
    if what == CAP or (n[0] == 0.0 and n[1] == 0.0 and n[2] == 0.0):
        facing = scene.facing[face]
        return facing[0], facing[1], facing[2]
    return n


solid_normal = either(normal_by_field, normal_on_mesh)


@jit
def hit_normal(scene, number, what, face, x, d):
    """Normal where a ray met a surface: that of the solid, or of the side of the quad it came to."""
    if what == QUAD:
        normal = scene.quad_normal[number - scene.start.shape[0]]
        side = -np.copysign(1.0, dot(normal, d))
        return side * normal[0], side * normal[1], side * normal[2]
    return solid_normal(scene, number, what, face, x, d)


@jit
def cosine_direction(u1, u2, nx, ny, nz):
    """Direction with density cosine / π about the normal n, from two uniform numbers.

    Malley's method; the frame by Duff et al., "Building an orthonormal basis, revisited", JCGT 6(1), 2017.
    """
    radius, angle = np.sqrt(u1), 2.0 * np.pi * u2
    x, y, z = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - u1)
    sign = 1.0 if nz >= -1e-6 else -1.0  # 0 is common on voxel data and comes out as -1e-17 in a turned frame
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return (
        x * (1.0 + sign * nx * nx * a) + y * b + z * nx,
        x * sign * b + y * (sign + ny * ny * a) + z * ny,
        -x * sign * nx - y * ny + z * nz,
    )


@jit
def in_solid(scene, f, level, x, n):
    """Whether the frame point x lies in the trilinear solid {v >= level} of field f, its border included."""
    ux = snap((x[0] - scene.origin[f, 0]) / scene.spacing[f, 0])
    uy = snap((x[1] - scene.origin[f, 1]) / scene.spacing[f, 1])
    uz = snap((x[2] - scene.origin[f, 2]) / scene.spacing[f, 2])
    last_x, last_y, last_z = scene.shape[f, 0] - 1, scene.shape[f, 1] - 1, scene.shape[f, 2] - 1
    if not (0.0 <= ux <= last_x and 0.0 <= uy <= last_y and 0.0 <= uz <= last_z):
        return False
    cx, cy, cz = min(int(ux), last_x - 1), min(int(uy), last_y - 1), min(int(uz), last_z - 1)
    step_y = scene.shape[f, 2]
    step_x = step_y * scene.shape[f, 1]
    corner = scene.start[f] + cx * step_x + cy * step_y + cz
    q0, _, _, _ = cubic(scene.values, corner, step_x, step_y, level, ux - cx, uy - cy, uz - cz, 0.0, 0.0, 0.0)
    return q0 >= 0.0


@jit
def in_mesh(scene, f, level, x, n):
    """Whether the frame point x lies inside the mesh of field f, or on it: a ray from beside x along n sees a back."""
    off = scene.off[f]
    x = (x[0] + off * n[0], x[1] + off * n[1], x[2] + off * n[2])
    _, face, front = cast_from(scene, f, x, n, np.inf)
    return face != NOWHERE and not front


inside = either(in_solid, in_mesh)


@jit
def buried(scene, level, x, n, own):
    """Whether the frame point x, on a surface of normal n, lies inside the solid of a field other than `own`."""
    for f in range(scene.start.shape[0]):  # noqa: SIM110
        if f != own and inside(scene, f, level[f], x, n):
            return True
    return False


@jit
def stay(scene, own, x, n):
    """Queries lie on the trilinear set: nothing to do."""
    return x, NOWHERE


@jit
def settle_along(scene, own, x, n):
    """Move the frame point x along n onto mesh `own`: (position, face).

    Against n there must be a front, or along it a back: the nearer one within a cell, no cap. So nothing lies between.
    """
    pace = max(
        abs(n[0]) / scene.spacing[own, 0], abs(n[1]) / scene.spacing[own, 1], abs(n[2]) / scene.spacing[own, 2]
    )  # cells along the axis on which it gains most
    found, shift, face, near = np.inf, 0.0, LOST, 2.0 * scene.off[own]
    for k in range(2):
        along = 2.0 * k - 1.0
        d = (along * n[0], along * n[1], along * n[2])
        start = (x[0] - near * d[0], x[1] - near * d[1], x[2] - near * d[2])
        t, met, front = cast_from(scene, own, start, d, near + 1.0 / pace)
        if met != NOWHERE and front == (k == 0) and not scene.cap[met] and abs(t - near) < found:
            found, shift, face = abs(t - near), along * (t - near), met
    return (x[0] + shift * n[0], x[1] + shift * n[1], x[2] + shift * n[2]), face


@jit
def settle(scene, own, x, n):
    """Move a query onto its own mesh, which lies a little beside the trilinear set: (position, face).

    Along its normal, or where noise turns that aside, along the normal of its cell; LOST if neither leads there.
    """
    if own >= scene.start.shape[0]:
        return x, NOWHERE
    at, face = settle_along(scene, own, x, n)
    if face == LOST:
        ux = (x[0] - scene.origin[own, 0]) / scene.spacing[own, 0]
        uy = (x[1] - scene.origin[own, 1]) / scene.spacing[own, 1]
        uz = (x[2] - scene.origin[own, 2]) / scene.spacing[own, 2]
        steep = cell_normal(scene, own, ux, uy, uz)
        if steep[0] != 0.0 or steep[1] != 0.0 or steep[2] != 0.0:
            at, face = settle_along(scene, own, x, steep)
    return at, face


begin = either(stay, settle)


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
    """Density per solid angle with which `lamp_point` finds a point of quad q's front at this distance along d."""
    facing = -dot(scene.quad_normal[q], d)
    return scene.lamp_density[q] * distance * distance / facing if facing > 0.0 else 0.0


@jit
def light_from_lamps(scene, choice, u, v, level, on, on_face, x, n):
    """Share of a lamp's emission that arrives at x from one point of one lamp, and the lamp: (weight, quad).

    The weight is that of the balance heuristic: cosine density over the sum of both densities (Veach & Guibas 1995).
    """
    q, target = lamp_point(scene, choice, u, v)
    wx, wy, wz = target[0] - x[0], target[1] - x[1], target[2] - x[2]
    distance = np.sqrt(wx * wx + wy * wy + wz * wz)
    if distance == 0.0:
        return 0.0, q
    d = (wx / distance, wy / distance, wz / distance)
    by_cosine, by_lamp = dot(n, d) / np.pi, lamp_density(scene, q, distance, d)
    number = scene.start.shape[0] + q
    if by_cosine <= 0.0 or by_lamp <= 0.0 or number == on:
        return 0.0, q
    # The ray that meets this lamp first has met nothing else before.
    _, met, _, _ = nearest_hit(scene, level, x, n, d, on, on_face)
    return (by_cosine / (by_cosine + by_lamp) if met == number else 0.0), q


@inlined
def gather(worth, throughput, weight, light):
    """Add to what a path is worth the share of some light (C,) that comes back along it."""
    for channel in range(worth.shape[0]):
        worth[channel] += throughput[channel] * weight * light[channel]


@jit
def walk(scene, key, path, bounces, level, own, own_face, x, n, throughput, worth):
    """One path from the frame point x, with normal n, on `own_face` of surface `own`: fills its `worth` (C,).

    The irradiance there is π times the mean over the paths. `throughput` (C,) is room for the share of the light that
    comes back along the path.
    """
    throughput[:], worth[:] = 1.0, 0.0
    on, on_face, fields = own, own_face, scene.start.shape[0]
    for segment in range(bounces + 1):
        # Ask a lamp for its light, weighted against the chance that the ray below finds it. One pair of numbers serves
        # both: each keeps its mean, and their shared boxes keep the error bars short.
        u1, u2 = draw_pair(key, path, np.uint64(segment))
        if scene.lamps.shape[0] > 0:
            choice = draw(key, path, np.uint64(segment))
            weight, q = light_from_lamps(scene, choice, u1, u2, level, on, on_face, x, n)
            gather(worth, throughput, weight, scene.emission[fields + q])

        # Choose a direction by the cosine about the normal.
        d = cosine_direction(u1, u2, n[0], n[1], n[2])

        # Follow the ray to the nearest surface; one that dips under its own has hit it already.
        t, number, what, face = nearest_hit(scene, level, x, n, d, on, on_face)

        # A path that escapes sees the background, and ends.
        if what == MISS:
            gather(worth, throughput, 1.0, scene.background)
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

        # Reflect: the albedo takes its share, and the path goes on from the hit.
        for channel in range(worth.shape[0]):
            throughput[channel] *= scene.albedo[number, channel]
        on, on_face = number, face
        if t > 0.0 or what == QUAD:
            x = (x[0] + t * d[0], x[1] + t * d[1], x[2] + t * d[2])
            n = hit_normal(scene, number, what, face, x, d)
            if n[0] == 0.0 and n[1] == 0.0 and n[2] == 0.0:
                break


@jit
def mixed_differences(worth, at, size, channel, many):
    """Variance of a path as four paths in one box tell it, that share a half of it by twos: in both ways.

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
    """Variance that a path of the net from row `at` on would have if independent paths were as far off as this net is.

    How the differences shrank from nets of a quarter of the size is taken to go on: by half at edges of light, at most.
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

    The range is cut into nets. What no path met is added: features too small to be found change the light by UNSEEN of
    what one path brings in the mean, or from the sky; one more path may be as bright as the brightest that was met, or
    as all lamps spread evenly.
    """
    count = worth.shape[0]
    total, known, mean, brightest, at = 0.0, 0, 0.0, 0.0, 0
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
def solve_queries(scene, ids, point, normal, level, target, first, bounces, seed, throughput, worth, mean, m2, paths):
    """Irradiance at queries in frame coordinates, from a path for each row of `worth`, from number `first` on.

    Fills mean (n, C), m2 (n, C) and paths (n,); `throughput` (C,) and `worth` (paths, C) are room to write into.
    """
    count = worth.shape[0]
    for i in range(ids.shape[0]):
        x, n = (point[i, 0], point[i, 1], point[i, 2]), (normal[i, 0], normal[i, 1], normal[i, 2])
        if n[0] == 0.0 and n[1] == 0.0 and n[2] == 0.0:
            continue
        x, face = begin(scene, target[i], x, n)
        if face == LOST or buried(scene, level[i], x, n, target[i]):
            continue
        key = stream(seed, ids[i])
        for k in range(count):
            walk(scene, key, np.uint64(first + k), bounces, level[i], target[i], face, x, n, throughput, worth[k])
        for channel in range(worth.shape[1]):
            mean_worth, off = moments(worth, first, scene.background[channel], scene.lamplight[channel], channel)
            mean[i, channel], m2[i, channel] = np.pi * mean_worth, np.pi**2 * off
        paths[i] = count


@jit
def cast_rays(scene, level, origin, direction, on, t, number, what, normal):
    """First hits of frame rays (n, 3), all under one row of levels; fills t, number, what and normal.

    Rays from nowhere (`on` is -1) are those of a camera: they see the fronts of quads only.
    """
    fields, none = scene.start.shape[0], (0.0, 0.0, 0.0)
    for i in range(origin.shape[0]):
        x, d = (origin[i, 0], origin[i, 1], origin[i, 2]), (direction[i, 0], direction[i, 1], direction[i, 2])
        through, start, passed = on, x, 0.0
        t[i], number[i], what[i], face = nearest_hit(scene, level, x, none, d, on, NOWHERE)
        while on < 0 and what[i] == QUAD and dot(scene.quad_normal[number[i] - fields], d) >= 0.0:
            # A wall seen from behind is not there: go on from it.
            passed += t[i]
            through = number[i]
            start = (x[0] + passed * d[0], x[1] + passed * d[1], x[2] + passed * d[2])
            t[i], number[i], what[i], face = nearest_hit(scene, level, start, none, d, through, NOWHERE)
        t[i] += passed
        if what[i] != MISS and what[i] != BURIED:
            hit = (x[0] + t[i] * d[0], x[1] + t[i] * d[1], x[2] + t[i] * d[2])
            normal[i, 0], normal[i, 1], normal[i, 2] = hit_normal(scene, number[i], what[i], face, hit, d)
