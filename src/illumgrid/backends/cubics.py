"""A trilinear field along a ray through one cell is a cubic: where it first reaches a level."""

import numpy as np

from illumgrid.backends.simd import cached

jit = cached(_nrt=False)  # as in `march`
inlined = cached(_nrt=False, forceinline=True)


@inlined
def first_root(q0, q1, q2, q3, end):
    """Smallest t in [0, end] at which q0 + q1 t + q2 t² + q3 t³ reaches 0 from q0 < 0; inf if none."""
    # On [0, 1] the Bernstein coefficients bound the cubic, and most cells end here.
    a, b, c = q1 * end, q2 * end * end, q3 * end * end * end
    if 3.0 * q0 + a < 0.0 and 3.0 * q0 + 2.0 * a + b < 0.0 and q0 + a + b + c < 0.0:
        return np.inf
    # The roots of the derivative divide [0, 1] into monotone pieces.
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
        if b > 0.0 or (b == 0.0 and c >= 0.0):  # all zero: the cell is constant, at the level, hence solid
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
def root_in_cell(values, sign, corner, step_x, step_y, level, ex, ey, ez, dx, dy, dz, on_surface, length):
    """Distance to the solid within a cell, from the entry e on; inf if it is not met within `length`."""
    q0, q1, q2, q3 = cubic(values, sign, corner, step_x, step_y, level, ex, ey, ez, dx, dy, dz)
    if on_surface:
        return next_root(q1, q2, q3, length)
    if q0 >= 0.0:
        return 0.0
    return first_root(q0, q1, q2, q3, length)
