"""Rays that march through trilinear fields: the level set itself.

The solid of a field is {sign v >= level}: see `Marchable`. Index coordinates of field f are (x - origin[f]) /
spacing[f] for x in the frame of the scene; t is world distance throughout. Values have the type of the file;
arithmetic converts each to double.
"""

import numpy as np

from illumgrid import constants
from illumgrid.backends import cubics, simd
from illumgrid.backends.cubics import cubic, root_in_cell
from illumgrid.backends.simd import address, at_least, cached, count_below
from illumgrid.backends.surfaces import begin, inside, meet_solid
from illumgrid.constants import BRICK_SHIFT, BURIED, CAP, MISS, NOWHERE, ON_A_VOXEL, REACH, SURFACE
from illumgrid.field.levelset import Marchable

# No fastmath: a miss is t = inf, and the sign of a coefficient near zero decides the side.
# No reference counts either: nothing is allocated here, the caller keeps the arrays alive, and the atomic counts of a
# scene passed from function to function cost a third of the time.
jit = cached(cubics, simd, constants, _nrt=False)
# A call that passes a scene moves 200 words: what every ray calls is inlined.
inlined = cached(cubics, simd, constants, _nrt=False, forceinline=True)

ONE = np.uint64(1)


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
def dot(a, b):
    """Scalar product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def first_cell(u, d, last):
    """Cell along one axis that a ray enters at index coordinate u; beyond 0 .. last - 1 it has left the field."""
    cell = int(u)  # without branches: on a voxel the sign of d is unpredictable
    return cell - int((u == cell) & ((d < 0.0) | ((d == 0.0) & (cell == last))))


@inlined
def snap(u):
    """Index coordinate of a node that lies on a voxel."""
    nearest = np.round(u)
    return nearest if abs(u - nearest) < ON_A_VOXEL else u


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
def first_of(x, y, z):
    """Whether x is the smallest of three, and whether y is. Without branches, since the outcome is unpredictable."""
    return x <= y and x <= z, y < x and y <= z


@inlined
def enter(ux, uy, uz, ix, iy, iz, kx, ky, kz, last_x, last_y, last_z):
    """Distance at which a ray is in the box of a field, and the axis of the face it came through; -1: it starts inside.

    The distance is infinite if a ray parallel to a face passes by.
    """
    if 0.0 <= ux <= last_x and 0.0 <= uy <= last_y and 0.0 <= uz <= last_z:
        return 0.0, -1
    if (ix == 0.0 and not 0.0 <= ux <= last_x) or (iy == 0.0 and not 0.0 <= uy <= last_y):
        return np.inf, -1
    if iz == 0.0 and not 0.0 <= uz <= last_z:
        return np.inf, -1
    # It enters through the last of the three planes.
    t, face = 0.0, -1
    if ix != 0.0 and min(kx, last_x * ix + kx) > t:
        t, face = min(kx, last_x * ix + kx), 0
    if iy != 0.0 and min(ky, last_y * iy + ky) > t:
        t, face = min(ky, last_y * iy + ky), 1
    if iz != 0.0 and min(kz, last_z * iz + kz) > t:
        t, face = min(kz, last_z * iz + kz), 2
    return t, face


@inlined
def cell_at(u, t, d, low, high):
    """Cell, of those of a brick, at distance t along a ray."""
    return (
        follow(u[0], t, d[0], low[0], high[0]),
        follow(u[1], t, d[1], low[1], high[1]),
        follow(u[2], t, d[2], low[2], high[2]),
    )


@inlined
def cells_to_ask(bricks, brick, rank, c, end, fine):
    """Cells of a brick, as bits, whose rank is high enough and that lie between the cells of a ray's two ends."""
    left = at_least(bricks, brick, rank)
    left &= BETWEEN[((min(c[0], end[0]) >> fine & 3) << 2) | (max(c[0], end[0]) >> fine & 3)]
    left &= BETWEEN[16 | ((min(c[1], end[1]) >> fine & 3) << 2) | (max(c[1], end[1]) >> fine & 3)]
    left &= BETWEEN[32 | ((min(c[2], end[2]) >> fine & 3) << 2) | (max(c[2], end[2]) >> fine & 3)]
    return left


@inlined
def bit_of(c, fine):
    """Number of the bit of a cell in its brick; if `fine` is 1, a bit belongs to 2³ cells."""
    return ((c[0] >> fine & 3) << 4) | ((c[1] >> fine & 3) << 2) | (c[2] >> fine & 3)


@inlined
def planes_along(u, d):
    """For each axis i and k such that a ray meets the plane at index coordinate p at t = p i + k.

    A ray parallel to it never does: i = 0, k = inf. Bricks and cells compute it alike, so that a brick's last cell ends
    exactly where the brick does.
    """
    ix, iy, iz = (
        1.0 / d[0] if d[0] != 0.0 else 0.0,
        1.0 / d[1] if d[1] != 0.0 else 0.0,
        1.0 / d[2] if d[2] != 0.0 else 0.0,
    )
    kx = -u[0] * ix if d[0] != 0.0 else np.inf
    ky = -u[1] * iy if d[1] != 0.0 else np.inf
    kz = -u[2] * iz if d[2] != 0.0 else np.inf
    return (ix, iy, iz), (kx, ky, kz)


@inlined
def enter_field(u, d, i, k, last, limit):
    """Where a ray enters the box of a field: (t, t where it leaves, axis of the face, position, cell).

    The x of the cell is -1 if the ray misses the box, or reaches it beyond `limit`.
    """
    outside = np.inf, np.inf, -1, u, (-1, -1, -1)
    t, face = enter(u[0], u[1], u[2], i[0], i[1], i[2], k[0], k[1], k[2], last[0], last[1], last[2])
    if t == np.inf:
        return outside
    t_out = min(
        limit, max(k[0], last[0] * i[0] + k[0]), max(k[1], last[1] * i[1] + k[1]), max(k[2], last[2] * i[2] + k[2])
    )
    if t > t_out:
        return outside
    px = min(max(u[0] + t * d[0], 0.0), last[0]) if face != 0 else (0.0 if d[0] > 0.0 else 1.0 * last[0])
    py = min(max(u[1] + t * d[1], 0.0), last[1]) if face != 1 else (0.0 if d[1] > 0.0 else 1.0 * last[1])
    pz = min(max(u[2] + t * d[2], 0.0), last[2]) if face != 2 else (0.0 if d[2] > 0.0 else 1.0 * last[2])
    cx, cy, cz = first_cell(px, d[0], last[0]), first_cell(py, d[1], last[1]), first_cell(pz, d[2], last[2])
    if cx < 0 or cy < 0 or cz < 0 or cx >= last[0] or cy >= last[1] or cz >= last[2]:
        return outside
    return t, t_out, face, (px, py, pz), (cx, cy, cz)


@inlined
def far_sides(b, ahead, shift):
    """Index coordinates of the planes through which a ray may leave brick b, of 2^shift cells along each side."""
    return 1.0 * ((b[0] + ahead[0]) << shift), 1.0 * ((b[1] + ahead[1]) << shift), 1.0 * ((b[2] + ahead[2]) << shift)


@inlined
def hit_in_brick(
    values, sign, start, step_x, step_y, level, left, fine, c, u, d, i, k, ahead, toward, t, t_end, on_surface
):  # fmt: skip
    """Follow a ray from cell to cell of a brick (Amanatides & Woo 1987), from cell c at t on: (t, whether it hit).

    The cubic is solved only in the cells `left`, given as bits, none of which lies beyond t_end.
    """
    at = bit_of(c, fine)
    while left != 0:
        sx, sy, sz = (c[0] + ahead[0]) * i[0] + k[0], (c[1] + ahead[1]) * i[1] + k[1], (c[2] + ahead[2]) * i[2] + k[2]
        t_cell = max(t, min(sx, sy, sz))
        bit = ONE << np.uint64(at)
        if left & bit != 0:
            corner = start + c[0] * step_x + c[1] * step_y + c[2]
            ex = min(max(u[0] + t * d[0] - c[0], 0.0), 1.0)
            ey = min(max(u[1] + t * d[1] - c[1], 0.0), 1.0)
            ez = min(max(u[2] + t * d[2] - c[2], 0.0), 1.0)
            root = root_in_cell(
                values, sign, corner, step_x, step_y, level, ex, ey, ez, d[0], d[1], d[2], on_surface, t_cell - t
            )
            if root < np.inf:
                return t + root, True
        on_surface = False
        t = t_cell
        if t >= t_end:
            break
        on_x, on_y = first_of(sx, sy, sz)
        c = (
            c[0] + (toward[0] if on_x else 0),
            c[1] + (toward[1] if on_y else 0),
            c[2] + (0 if on_x or on_y else toward[2]),
        )
        at = bit_of(c, fine)
        left &= ~bit | (ONE << np.uint64(at))  # clear the bit when the ray leaves its cells
    return t, False


@inlined
def leap(hop, b, shift, far, u, d, i, k, toward, t):
    """Skip the cube of empty bricks that extends `hop` bricks beyond b: (t, the brick behind it)."""
    end_x, end_y, end_z = b[0] + hop * toward[0], b[1] + hop * toward[1], b[2] + hop * toward[2]
    side = 1.0 * (hop << shift)
    tx = (far[0] + side * toward[0]) * i[0] + k[0]
    ty = (far[1] + side * toward[1]) * i[1] + k[1]
    tz = (far[2] + side * toward[2]) * i[2] + k[2]
    t = max(t, min(tx, ty, tz))
    by_x, by_y = first_of(tx, ty, tz)
    mx = min(max(int(u[0] + t * d[0]) >> shift, min(b[0], end_x)), max(b[0], end_x))
    my = min(max(int(u[1] + t * d[1]) >> shift, min(b[1], end_y)), max(b[1], end_y))
    mz = min(max(int(u[2] + t * d[2]) >> shift, min(b[2], end_z)), max(b[2], end_z))
    return t, (
        end_x + toward[0] if by_x else mx,
        end_y + toward[1] if by_y else my,
        mz if by_x or by_y else end_z + toward[2],
    )


@inlined
def march(scene, f, level, u, d, on_surface, limit):
    """First meeting of a ray with the solid of field f, in index coordinates u + t d: (t, what, axis of a cap).

    Bytes are compared first: see `field.bricks`. The ray skips the largest cube of bricks ahead whose rank is below the
    level. Another brick is also crossed at once if no cell between the ray's two ends in it has a rank that is high
    enough; otherwise the ray goes from cell to cell and solves the cubic in such cells only.
    `on_surface`: the ray starts on the level set itself, outside.
    """
    last = scene.shape[f, 0] - 1, scene.shape[f, 1] - 1, scene.shape[f, 2] - 1
    i, k = planes_along(u, d)
    t, t_out, face, p, c = enter_field(u, d, i, k, last, limit)
    if c[0] < 0:
        return np.inf, MISS, -1

    # In the solid already: at a cap, or inside.
    step_y, start, sign = scene.shape[f, 2], scene.start[f], scene.sign[f]
    step_x = step_y * scene.shape[f, 1]
    if not on_surface:
        corner = start + c[0] * step_x + c[1] * step_y + c[2]
        q0, _, _, _ = cubic(
            scene.values, sign, corner, step_x, step_y, level, p[0] - c[0], p[1] - c[1], p[2] - c[2], d[0], d[1], d[2]
        )
        if q0 >= 0.0:
            return t, (CAP if face >= 0 else BURIED), face

    # From brick to brick.
    ahead = int(d[0] > 0.0), int(d[1] > 0.0), int(d[2] > 0.0)
    toward = 2 * ahead[0] - 1, 2 * ahead[1] - 1, 2 * ahead[2] - 1
    many_y, many_z = scene.brick_shape[f, 1], scene.brick_shape[f, 2]
    bricks = address(scene.bricks) + (scene.brick_start[f] << 7)
    octant = 64 + 8 * (4 * ahead[0] + 2 * ahead[1] + ahead[2])
    rank, shift = rank_of(scene.steps[f], level), scene.shift[f]
    b, fine, side = (c[0] >> shift, c[1] >> shift, c[2] >> shift), shift - BRICK_SHIFT, 1 << shift
    brick, beyond = ((b[0] * many_y + b[1]) * many_z + b[2]) << 7, (scene.brick_shape[f, 0] * many_y * many_z) << 7
    started = False
    while 0 <= brick < beyond:  # t_out ends the march earlier, except for rounding; the code below reads raw memory
        empty, far = count_below(bricks, brick + octant, rank), far_sides(b, ahead, shift)
        if empty == 8:
            return np.inf, MISS, -1
        if empty > 1:
            t, b = leap(REACH[empty - 1] - 1, b, shift, far, u, d, i, k, toward, t)
        else:
            tx, ty, tz = far[0] * i[0] + k[0], far[1] * i[1] + k[1], far[2] * i[2] + k[2]
            t_brick = min(tx, ty, tz)
            if empty == 0:
                low = b[0] << shift, b[1] << shift, b[2] << shift
                high = min(low[0] + side, last[0]) - 1, min(low[1] + side, last[1]) - 1, min(low[2] + side, last[2]) - 1
                if started:
                    c = cell_at(u, t, d, low, high)
                left = cells_to_ask(bricks, brick, rank, c, cell_at(u, t_brick, d, low, high), fine)
                t, hit = hit_in_brick(
                    scene.values, sign, start, step_x, step_y, level, left, fine, c, u, d, i, k, ahead,
                    toward, t, min(t_brick, t_out), on_surface,
                )  # fmt: skip
                if hit:
                    return (t, SURFACE, -1) if t < limit else (np.inf, MISS, -1)
            t = max(t, t_brick)
            by_x, by_y = first_of(tx, ty, tz)
            b = (
                b[0] + (toward[0] if by_x else 0),
                b[1] + (toward[1] if by_y else 0),
                b[2] + (0 if by_x or by_y else toward[2]),
            )
        if t >= t_out:
            return np.inf, MISS, -1
        started, on_surface = True, False
        brick = ((b[0] * many_y + b[1]) * many_z + b[2]) << 7
    return np.inf, MISS, -1


@inlined
def march_from(scene, f, level, x, n, d, own, face, limit):
    """First meeting of the frame ray x + t d with field f's trilinear solid, t < limit: (t, what, axis of a cap).

    `own`: the ray starts on that solid; if `face` is a cap, it cannot meet the convex box again.
    """
    if own and face >= 0:
        return np.inf, MISS, NOWHERE
    sx, sy, sz = scene.spacing[f, 0], scene.spacing[f, 1], scene.spacing[f, 2]
    ux = snap((x[0] - scene.origin[f, 0]) / sx)
    uy = snap((x[1] - scene.origin[f, 1]) / sy)
    uz = snap((x[2] - scene.origin[f, 2]) / sz)
    return march(scene, f, level, (ux, uy, uz), (d[0] / sx, d[1] / sy, d[2] / sz), own, limit)


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
    corner, sign = scene.start[f] + cx * step_x + cy * step_y + cz, scene.sign[f]
    q0, _, _, _ = cubic(scene.values, sign, corner, step_x, step_y, level, ux - cx, uy - cy, uz - cz, 0.0, 0.0, 0.0)
    return q0 >= 0.0


@jit
def stay(scene, own, x, n):
    """Queries lie on the trilinear set: nothing to do."""
    return x, np.int64(NOWHERE)


for _question, _answer in (
    (meet_solid, march_from),
    (inside, in_solid),
    (begin, stay),
):
    _question.register(Marchable, _answer)
