"""Rays that march through trilinear fields: the level set itself.

The solid of a field is {sign v >= level}: see `Marchable`. Index coordinates of field f are (x - origin[f]) /
spacing[f] for x in the frame of the scene; t is world distance throughout. Values are of the type that the file has:
arithmetic makes each a double.
"""

import numpy as np

from illumgrid import constants
from illumgrid.backends import simd
from illumgrid.backends.simd import address, at_least, cached, count_below
from illumgrid.backends.surfaces import begin, inside, meet_solid, solid_normal
from illumgrid.constants import BRICK_SHIFT, BURIED, CAP, MISS, NOWHERE, ON_A_VOXEL, REACH, SURFACE
from illumgrid.field.levelset import Marchable

# No fastmath: a miss is t = inf, and the sign of a coefficient near zero decides the side.
# Nor Numba's reference counts: nothing is allocated here, the caller keeps the arrays alive, and the atomic counts of a
# scene handed from function to function cost a third of the time.
jit = cached(simd, constants, _nrt=False)
# A call that hands a scene on moves 200 words: what every ray calls is inlined.
inlined = cached(simd, constants, _nrt=False, forceinline=True)

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
def cubic(values, sign, corner, step_x, step_y, level, ex, ey, ez, dx, dy, dz):
    """Coefficients of sign v - level along a ray through a trilinear cell, from its entry e in [0, 1]³.

    `corner` is the flat number of the cell's first voxel. Parker et al., "Interactive ray tracing for isosurface
    rendering", IEEE Visualization 1998, with the interpolation nested so that equal values cancel exactly.
    """
    f000 = sign * values[corner] - level
    f001 = sign * values[corner + 1] - level
    f010 = sign * values[corner + step_y] - level
    f011 = sign * values[corner + step_y + 1] - level
    corner += step_x
    x00, x01 = sign * values[corner] - level - f000, sign * values[corner + 1] - level - f001
    x10, x11 = sign * values[corner + step_y] - level - f010, sign * values[corner + step_y + 1] - level - f011
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
def first_of(x, y, z):
    """Whether x is the smallest of three, and whether y is. Without branches: no processor predicts a coin toss."""
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
    # It enters through the last of three planes.
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
    """Cells of a brick, as bits, that rank high enough and lie between the cells of a ray's two ends."""
    left = at_least(bricks, brick, rank)
    left &= BETWEEN[((min(c[0], end[0]) >> fine & 3) << 2) | (max(c[0], end[0]) >> fine & 3)]
    left &= BETWEEN[16 | ((min(c[1], end[1]) >> fine & 3) << 2) | (max(c[1], end[1]) >> fine & 3)]
    left &= BETWEEN[32 | ((min(c[2], end[2]) >> fine & 3) << 2) | (max(c[2], end[2]) >> fine & 3)]
    return left


@inlined
def bit_of(c, fine):
    """Number of the bit that stands for a cell in its brick: a cell of its own, or one for 2³ cells if `fine` is 1."""
    return ((c[0] >> fine & 3) << 4) | ((c[1] >> fine & 3) << 2) | (c[2] >> fine & 3)


@inlined
def root_in_cell(values, sign, corner, step_x, step_y, level, ex, ey, ez, dx, dy, dz, on_surface, length):
    """Distance to the solid within a cell, from the entry e on; inf if it is not met within `length`."""
    q0, q1, q2, q3 = cubic(values, sign, corner, step_x, step_y, level, ex, ey, ez, dx, dy, dz)
    if on_surface:
        return next_root(q1, q2, q3, length)
    if q0 >= 0.0:
        return 0.0
    return first_root(q0, q1, q2, q3, length)


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

    The x of the cell is -1 if it passes by, or comes to the box beyond `limit`.
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

    The cubic is asked in the cells `left` only, given as bits, none of which lies beyond t_end.
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
        left &= ~bit | (ONE << np.uint64(at))  # a bit is done with where the ray leaves what it stands for
    return t, False


@inlined
def leap(hop, b, shift, far, u, d, i, k, toward, t):
    """Leap over the cube of empty bricks that reaches `hop` bricks beyond b: (t, the brick behind it)."""
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

    Bytes are compared first: see `field.bricks`. The ray leaps over the largest cube of bricks ahead that ranks
    below the level. A brick that does not is crossed at once too if no cell between the ray's two ends in it ranks high
    enough; else the ray goes from cell to cell and asks the cubic in such cells only.
    `on_surface`: the ray starts on the level set itself, outside.
    """
    last = scene.shape[f, 0] - 1, scene.shape[f, 1] - 1, scene.shape[f, 2] - 1
    i, k = planes_along(u, d)
    t, t_out, face, p, c = enter_field(u, d, i, k, last, limit)
    if c[0] < 0:
        return np.inf, MISS, -1

    # In the solid already: at a cap, or buried.
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
    while 0 <= brick < beyond:  # t_out ends the march before that, but for rounding; what follows reads raw memory
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

    `own`: the ray starts on that solid, at a cap if `face` says so; then the convex box cannot be met again.
    """
    if own and face >= 0:
        return np.inf, MISS, NOWHERE
    sx, sy, sz = scene.spacing[f, 0], scene.spacing[f, 1], scene.spacing[f, 2]
    ux = snap((x[0] - scene.origin[f, 0]) / sx)
    uy = snap((x[1] - scene.origin[f, 1]) / sy)
    uz = snap((x[2] - scene.origin[f, 2]) / sz)
    return march(scene, f, level, (ux, uy, uz), (d[0] / sx, d[1] / sy, d[2] / sz), own, limit)


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
    _, gx, _, _ = cubic(scene.values, scene.sign[f], here, step_x, step_y, 0.0, wx, wy, wz, 1.0, 0.0, 0.0)
    _, gy, _, _ = cubic(scene.values, scene.sign[f], here, step_x, step_y, 0.0, wx, wy, wz, 0.0, 1.0, 0.0)
    _, gz, _, _ = cubic(scene.values, scene.sign[f], here, step_x, step_y, 0.0, wx, wy, wz, 0.0, 0.0, 1.0)
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
    sign = scene.sign[f]
    gx, gy, gz = sign * gx + 0.0, sign * gy + 0.0, sign * gz + 0.0  # no -0, whose sign would turn a frame of axes
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
    (solid_normal, normal_by_field),
    (inside, in_solid),
    (begin, stay),
):
    _question.register(Marchable, _answer)
