"""Rays that march through trilinear fields: the level set itself.

A field comes as {v >= level}: `Marchable` has turned it so. Index coordinates of field f are (x - origin[f]) /
spacing[f] for x in the frame of the scene; t is world distance throughout.
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
def cells_to_ask(bricks, brick, rank, cx, cy, cz, end_x, end_y, end_z):
    """Cells of a brick, as bits, that rank high enough and lie between the cells of a ray's two ends."""
    left = at_least(bricks, brick, rank)
    left &= BETWEEN[((min(cx, end_x) & 3) << 2) | (max(cx, end_x) & 3)]
    left &= BETWEEN[16 | ((min(cy, end_y) & 3) << 2) | (max(cy, end_y) & 3)]
    left &= BETWEEN[32 | ((min(cz, end_z) & 3) << 2) | (max(cz, end_z) & 3)]
    return left


@inlined
def root_in_cell(values, corner, step_x, step_y, level, ex, ey, ez, dx, dy, dz, on_surface, length):
    """Distance to the solid within a cell, from the entry e on; inf if it is not met within `length`."""
    q0, q1, q2, q3 = cubic(values, corner, step_x, step_y, level, ex, ey, ez, dx, dy, dz)
    if on_surface:
        return next_root(q1, q2, q3, length)
    if q0 >= 0.0:
        return 0.0
    return first_root(q0, q1, q2, q3, length)


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

    # Enter the box of the field.
    t, face = enter(ux, uy, uz, ix, iy, iz, kx, ky, kz, last_x, last_y, last_z)
    if t == np.inf:
        return np.inf, MISS, -1
    t_out = min(limit, max(kx, last_x * ix + kx), max(ky, last_y * iy + ky), max(kz, last_z * iz + kz))
    if t > t_out:
        return np.inf, MISS, -1
    px = min(max(ux + t * dx, 0.0), last_x) if face != 0 else (0.0 if dx > 0.0 else 1.0 * last_x)
    py = min(max(uy + t * dy, 0.0), last_y) if face != 1 else (0.0 if dy > 0.0 else 1.0 * last_y)
    pz = min(max(uz + t * dz, 0.0), last_z) if face != 2 else (0.0 if dz > 0.0 else 1.0 * last_z)
    cx, cy, cz = first_cell(px, dx, last_x), first_cell(py, dy, last_y), first_cell(pz, dz, last_z)
    if cx < 0 or cy < 0 or cz < 0 or cx >= last_x or cy >= last_y or cz >= last_z:
        return np.inf, MISS, -1

    # In the solid already: at a cap, or buried.
    step_y, start = scene.shape[f, 2], scene.start[f]
    step_x = step_y * scene.shape[f, 1]
    if not on_surface:
        corner = start + cx * step_x + cy * step_y + cz
        q0, _, _, _ = cubic(scene.values, corner, step_x, step_y, level, px - cx, py - cy, pz - cz, dx, dy, dz)
        if q0 >= 0.0:
            return t, (CAP if face >= 0 else BURIED), face

    # From brick to brick.
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
            # Cross one brick, cell by cell where it is not empty.
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
                left = cells_to_ask(bricks, brick, rank, cx, cy, cz, end_x, end_y, end_z)
                t_end = min(t_brick, t_out)
                plane_x, plane_y, plane_z = 1.0 * (cx + ahead_x), 1.0 * (cy + ahead_y), 1.0 * (cz + ahead_z)
                at = ((cx & 3) << 4) | ((cy & 3) << 2) | (cz & 3)
                while left != 0:
                    # Ask the cubic in this cell, if it ranks high enough.
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
                        root = root_in_cell(
                            scene.values, corner, step_x, step_y, level, ex, ey, ez, dx, dy, dz, on_surface, t_cell - t
                        )
                        if root < np.inf:
                            t += root
                            return (t, SURFACE, -1) if t < limit else (np.inf, MISS, -1)
                    on_surface = False
                    t = t_cell
                    if t >= t_end:
                        break
                    # Go to the next cell.
                    on_x, on_y = first_of(sx, sy, sz)
                    plane_x += along_x if on_x else 0.0
                    plane_y += along_y if on_y else 0.0
                    plane_z += 0.0 if on_x or on_y else along_z
                    at += 16 * toward_x if on_x else (4 * toward_y if on_y else toward_z)
            # Go to the next brick.
            t, started, on_surface = max(t, t_brick), True, False
            if t >= t_out:
                return np.inf, MISS, -1
            by_x, by_y = first_of(tx, ty, tz)
            far_x += 4.0 * along_x if by_x else 0.0
            far_y += 4.0 * along_y if by_y else 0.0
            far_z += 0.0 if by_x or by_y else 4.0 * along_z
            bx += toward_x if by_x else 0
            by += toward_y if by_y else 0
            bz += 0 if by_x or by_y else toward_z
            brick += hop_x if by_x else (hop_y if by_y else hop_z)
        else:
            # Leap over the largest cube of empty bricks ahead.
            if empty == 8:
                return np.inf, MISS, -1
            hop = REACH[empty - 1] - 1
            up_x, up_y, up_z = hop * toward_x, hop * toward_y, hop * toward_z
            tx = (far_x + 4.0 * up_x) * ix + kx
            ty = (far_y + 4.0 * up_y) * iy + ky
            tz = (far_z + 4.0 * up_z) * iz + kz
            t, started, on_surface = max(t, min(tx, ty, tz)), True, False
            if t >= t_out:
                return np.inf, MISS, -1
            by_x, by_y = first_of(tx, ty, tz)
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
def stay(scene, own, x, n):
    """Queries lie on the trilinear set: nothing to do."""
    return x, NOWHERE


for _question, _answer in (
    (meet_solid, march_from),
    (solid_normal, normal_by_field),
    (inside, in_solid),
    (begin, stay),
):
    _question.register(Marchable, _answer)
