"""The weights of `bilateral`, compiled: locally weighted regression over samples by position, level and normal.

Serial, no state, the GIL released; threads are the caller's. Index coordinates u count spacings of the lattice that was
lit, x voxels. The constants are in spacings or pure numbers, so that the result does not depend on units.
"""

import numpy as np

from illumgrid.compiled import njit

jit = njit()
inlined = njit(_nrt=False, forceinline=True)

LEVEL = 0.2  # node spacings between level sets, one standard deviation of the weight
TURN = 0.2  # of 1 - n·n': the weight falls to 1/e there, at 37 degrees, and to e^-10 for opposite normals
RIDGE = 0.1  # ridge for slopes that the samples do not determine: times the weights' sum, in squared spacings
NEGLIGIBLE = 14.0  # weights below e^-14 of the largest are dropped
NEAREST = 0.499  # spacings within which a hole of the lit lattice makes a hole; from half a spacing the others count
REACH = 2.0 - 1e-4  # spacings along each axis beyond which a sample has no weight
STEPS, HOLD = 4, 0.5  # steps of a node beyond the range towards the range, and voxels along each axis that it may move
MOVED = STEPS * HOLD
MOST = 512  # samples that one point uses, at most


@inlined
def outward(values, x, y, z, sign, spacing):
    """Value of the trilinear field at voxel coordinates, and its gradient by interpolated central differences.

    Per world unit along the volume's axes, times `sign`; where the differences cancel, that of the trilinear cell.
    """
    nx, ny, nz = values.shape
    a, b, c = min(max(int(x), 0), nx - 2), min(max(int(y), 0), ny - 2), min(max(int(z), 0), nz - 2)
    u, v, w = min(max(x - a, 0.0), 1.0), min(max(y - b, 0.0), 1.0), min(max(z - c, 0.0), 1.0)
    h, gx, gy, gz, cx, cy, cz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for corner in range(8):
        i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
        p, q, r = (u if i else 1.0 - u), (v if j else 1.0 - v), (w if k else 1.0 - w)
        here = np.float64(values[a + i, b + j, c + k])
        h += p * q * r * here
        cx += (q * r if i else -q * r) * here
        cy += (p * r if j else -p * r) * here
        cz += (p * q if k else -p * q) * here
        low, high = max(a + i - 1, 0), min(a + i + 1, nx - 1)
        gx += p * q * r * (np.float64(values[high, b + j, c + k]) - values[low, b + j, c + k]) / (high - low)
        low, high = max(b + j - 1, 0), min(b + j + 1, ny - 1)
        gy += p * q * r * (np.float64(values[a + i, high, c + k]) - values[a + i, low, c + k]) / (high - low)
        low, high = max(c + k - 1, 0), min(c + k + 1, nz - 1)
        gz += p * q * r * (np.float64(values[a + i, b + j, high]) - values[a + i, b + j, low]) / (high - low)
    if gx == 0.0 and gy == 0.0 and gz == 0.0:
        gx, gy, gz = cx, cy, cz
    return h, sign * gx / spacing[0], sign * gy / spacing[1], sign * gz / spacing[2]


@inlined
def unit(gx, gy, gz):
    """Unit vector against a gradient, and its length; scaled first, since the square of a tiny slope underflows."""
    largest = max(abs(gx), abs(gy), abs(gz))
    if not largest > 0.0:
        return 0.0, 0.0, 0.0, 0.0
    gx, gy, gz = gx / largest, gy / largest, gz / largest
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    return -gx / length, -gy / length, -gz / length, length * largest


@jit
def slopes(values, spacing, nodes, x, out):
    """Size (n,) of the gradient at voxel coordinates x (n, 3), per step of the lattice of spacing `nodes`."""
    for i in range(len(x)):
        _, gx, gy, gz = outward(values, x[i, 0], x[i, 1], x[i, 2], 1.0, spacing)
        _, _, _, out[i] = unit(gx * nodes[0], gy * nodes[1], gz * nodes[2])


@inlined
def hat(d):
    """Weight of a sample d spacings away along an axis: smooth, and 0 from two spacings on."""
    t = 1.0 - 0.25 * d * d
    return t * t if t > 0.0 else 0.0


@inlined
def first_from(keys, low, high, least):
    """The first position from `low` to `high` at which ascending keys reach a value."""
    while low < high:
        middle = (low + high) >> 1
        if keys[middle] < least:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def weigh(start, column, place, shape, u, level, normal, exponents, weights, near):
    """Find the samples around index u and their weights: fills `weights` and `near`, returns how many there are."""
    low0, high0 = max(int(np.ceil(u[0] - 2.5)), 0), min(int(np.floor(u[0] + 2.5)), shape[0] - 1)
    low1, high1 = max(int(np.ceil(u[1] - 2.5)), 0), min(int(np.floor(u[1] + 2.5)), shape[1] - 1)
    low2, high2 = max(int(np.ceil(u[2] - 2.5)), 0), min(int(np.floor(u[2] + 2.5)), shape[2] - 1)
    count, top = 0, -np.inf
    for a in range(low0, high0 + 1):
        for b in range(low1, high1 + 1):
            row = a * shape[1] + b
            for i in range(first_from(column, start[row], start[row + 1], low2), start[row + 1]):
                if column[i] > high2:
                    break
                x, y, z = place[i, 0] - u[0], place[i, 1] - u[1], place[i, 2] - u[2]
                if max(abs(x), abs(y), abs(z)) >= REACH or count == MOST:
                    continue
                delta, slope = abs(place[i, 3] - level), place[i, 7]
                if delta >= 1e6 * slope:
                    if delta > 0.0:
                        continue
                    slope = 1.0
                delta /= LEVEL * slope
                if -0.5 * delta * delta < top - NEGLIGIBLE:
                    continue
                cosine = place[i, 4] * normal[0] + place[i, 5] * normal[1] + place[i, 6] * normal[2]
                exponent = -0.5 * delta * delta - (1.0 - cosine) / TURN
                if exponent < top - NEGLIGIBLE:
                    continue
                exponents[count], weights[count], near[count] = exponent, hat(x) * hat(y) * hat(z) / slope, i
                top = max(top, exponent)
                count += 1
    kept = 0
    for j in range(count):
        if exponents[j] >= top - NEGLIGIBLE:
            weights[kept], near[kept] = weights[j] * np.exp(exponents[j] - top), near[j]
            kept += 1
    return kept


@inlined
def solve(system, right, least):
    """Solve a positive definite system of four equations for the columns of `right`, in place, by Cholesky."""
    for j in range(4):
        for k in range(j):
            system[j, j] -= system[j, k] * system[j, k]
        system[j, j] = np.sqrt(max(system[j, j], least))
        for i in range(j + 1, 4):
            for k in range(j):
                system[i, j] -= system[i, k] * system[j, k]
            system[i, j] /= system[j, j]
    for k in range(right.shape[1]):
        for i in range(4):
            for j in range(i):
                right[i, k] -= system[i, j] * right[j, k]
            right[i, k] /= system[i, i]
        for i in range(3, -1, -1):
            for j in range(i + 1, 4):
                right[i, k] -= system[j, i] * right[j, k]
            right[i, k] /= system[i, i]


@inlined
def fit(place, light, u, count, weights, near, system, right):
    """Fit a linear function of position to the samples: its coefficients, and in the last column those of the weights.

    Returns the sum of the weights.
    """
    system[:], right[:], total = 0.0, 0.0, 0.0
    for j in range(count):
        i, weight = near[j], weights[j]
        at = (1.0, place[i, 0] - u[0], place[i, 1] - u[1], place[i, 2] - u[2])
        total += weight
        for r in range(4):
            for s in range(r + 1):
                system[r, s] += weight * at[r] * at[s]
            for k in range(light.shape[1]):
                right[r, k] += weight * at[r] * light[i, k]
    for r in range(1, 4):
        system[r, r] += RIDGE * total
    right[0, light.shape[1]] = 1.0
    solve(system, right, 1e-12 * total)
    return total


@jit
def estimate(
    start, column, place, light, variance, each, shape, u, level, normal, exponents, weights, near, system, right,
    found, bars,
):  # fmt: skip
    """Light at index u of the lit lattice, for a surface of this level and normal, from the samples around it.

    Samples lie in the order of the nodes that they are next to: `start` (rows + 1,) is where each row of nodes along
    the last axis begins, `column` (m,) the node in it. place (m, 8): index coordinates, level, normal, slope. The
    weights are those of a joint bilateral filter,

        w = hat(dx) hat(dy) hat(dz) exp(-(δ/LEVEL)²/2) / |∇h'| exp(-(1 - n·n')/TURN),   δ = |c' - c| / |∇h'|,

    the value is that of the linear function of position which fits best (moving least squares, a ridge on its slope),
    clamped to the range of the samples. A steep sample is close to more levels; its weight is divided by its slope, so
    that its sum over all levels is the same. Otherwise steep places, which are brighter on rough fields, would
    dominate. Fills found (C,); returns variance and number of samples, 0 if none is near. If channels are mixed later,
    `each` (m, C) is the variance of every channel of the samples, and bars[0] becomes that of the result; else both
    have no columns.

    The variance is Σ a² σ² from the samples' noise, with their weights a in the fit, plus (1 + Σ a²) s², where s² is
    the scatter of the samples about the fit beyond noise; the light at the point is assumed to scatter as much.
    """
    count, channels = weigh(start, column, place, shape, u, level, normal, exponents, weights, near), light.shape[1]
    if count == 0:
        return np.inf, 0.0
    total = fit(place, light, u, count, weights, near, system, right)
    scatter, own, spread, noise, squares = 0.0, 0.0, 0.0, 0.0, 0.0
    bars[:] = 0.0
    for j in range(count):
        i, weight = near[j], weights[j]
        x, y, z = place[i, 0] - u[0], place[i, 1] - u[1], place[i, 2] - u[2]
        share = weight * (right[0, channels] + right[1, channels] * x + right[2, channels] * y + right[3, channels] * z)
        own += share * share * variance[i]
        spread += share * share
        noise += weight * variance[i]
        squares += weight * weight
        for k in range(channels):
            miss = light[i, k] - right[0, k] - right[1, k] * x - right[2, k] * y - right[3, k] * z
            scatter += weight * miss * miss / channels
            if k < bars.shape[1]:
                bars[0, k] += share * share * each[i, k]
                bars[1, k] += weight * miss * miss
                bars[2, k] += weight * each[i, k]
    for k in range(channels):
        lowest, highest = np.inf, -np.inf
        for j in range(count):
            lowest, highest = min(lowest, light[near[j], k]), max(highest, light[near[j], k])
        found[k] = min(max(right[0, k], lowest), highest)
    if not noise < np.inf:
        bars[0] = np.inf
        return np.inf, 1.0 / spread
    alike = total * total / squares
    free = alike / max(alike - 1.0, 0.5) / total
    for k in range(bars.shape[1]):
        bars[0, k] += max(0.0, bars[1, k] * free - bars[2, k] / total) * (1.0 + spread)
    misfit = max(0.0, scatter / total * alike / max(alike - 1.0, 0.5) - noise / total)
    return own + misfit * (1.0 + spread), 1.0 / spread


@jit
def fill(
    values,
    spacing,
    sign,
    ends,
    scale,
    shift,
    start,
    column,
    place,
    light,
    variance,
    each,
    dark,
    shape,
    ratio,
    x,
    out,
    error,
    errors,
    support,
):
    """Fill light (n, C), error and support (n,) at nodes in voxel coordinates x (n, 3), and `errors` of each channel.

    A node whose value lies beyond the `ends` of the range is moved along the gradient to the nearest end first. u is x
    times `ratio`; `dark` are the flat numbers, in order, of the nodes of the lit lattice that are holes.
    """
    exponents, weights, near = np.empty(MOST), np.empty(MOST), np.empty(MOST, np.int64)
    system, right = np.empty((4, 4)), np.empty((4, light.shape[1] + 1))
    found, bars = np.zeros(light.shape[1]), np.zeros((3, errors.shape[1]))
    for i in range(len(x)):
        a, b, c = x[i, 0], x[i, 1], x[i, 2]
        node = int(np.round(a * ratio[0])), int(np.round(b * ratio[1])), int(np.round(c * ratio[2]))
        aside = max(abs(a * ratio[0] - node[0]), abs(b * ratio[1] - node[1]), abs(c * ratio[2] - node[2]))
        if aside < NEAREST:
            flat = (node[0] * shape[1] + node[1]) * shape[2] + node[2]
            hole = first_from(dark, 0, len(dark), flat)
            if hole < len(dark) and dark[hole] == flat:
                continue
        h, gx, gy, gz = outward(values, a, b, c, sign, spacing)
        level = min(max(h, ends[0]), ends[1])
        for _ in range(STEPS):
            steep = gx * gx * spacing[0] ** 2 + gy * gy * spacing[1] ** 2 + gz * gz * spacing[2] ** 2
            if h == level or not steep > 0.0:
                break
            far = sign * (level - h) / steep
            sx, sy, sz = far * gx * spacing[0], far * gy * spacing[1], far * gz * spacing[2]
            largest = max(abs(sx), abs(sy), abs(sz))
            if not largest < 1e9:
                break
            hold = min(1.0, HOLD / largest) if largest > 0.0 else 1.0
            a = min(max(a + hold * sx, 0.0), values.shape[0] - 1.0)
            b = min(max(b + hold * sy, 0.0), values.shape[1] - 1.0)
            c = min(max(c + hold * sz, 0.0), values.shape[2] - 1.0)
            h, gx, gy, gz = outward(values, a, b, c, sign, spacing)
        nx, ny, nz, steep = unit(gx, gy, gz)
        if steep == 0.0:
            continue
        square, count = estimate(
            start, column, place, light, variance, each, shape, (a * ratio[0], b * ratio[1], c * ratio[2]),
            (level - shift) * scale, (nx, ny, nz), exponents, weights, near, system, right, found, bars,
        )  # fmt: skip
        if count > 0.0:
            error[i], support[i] = np.sqrt(square), count
            for k in range(light.shape[1]):
                out[i, k] = found[k]
            for k in range(errors.shape[1]):
                errors[i, k] = np.sqrt(bars[0, k])
