"""Compiled weights of local biharmonic splines. Serial, stateless, with the GIL released; the caller runs threads."""

import numpy as np

from illumgrid.compiled import njit

jit = njit()

AMPLIFIES = 2.0
"""Sum of |weights| of a node above which a ridge is added: the largest amplification of errors of its samples."""
_TAIL = 1e-8  # regularisation of the linear tail without a ridge: nine digits remain
_FIRST_RIDGE, _STEEPER, _LADDER = 1e-2, 10.0, 4


@jit
def solve_weights(x, ridge, tail, matrix, right, weight):
    """Weights (n,) for the value at the origin of a spline through points x (n, 3), none farther than 1.

    They minimise the power function of the biharmonic kernel -|x - y| plus `ridge` |weight|² and |Σ weight x|² / `tail`
    among weights that add up to 1. Solved by Cholesky decomposition: a constant added to the kernel changes nothing
    under that condition, and one above 2 makes the matrix positive definite for points in the unit ball (Hinrichs,
    Nickolas, Wolf, "A note on the metric geometry of the unit ball", Mathematische Zeitschrift 268, 2011).
    """
    n = len(x)
    for i in range(n):
        for j in range(i + 1):
            distance = np.sqrt((x[i, 0] - x[j, 0]) ** 2 + (x[i, 1] - x[j, 1]) ** 2 + (x[i, 2] - x[j, 2]) ** 2)
            moment = x[i, 0] * x[j, 0] + x[i, 1] * x[j, 1] + x[i, 2] * x[j, 2]
            matrix[i, j] = 3.0 - distance + moment / tail
        matrix[i, i] += ridge
        right[i, 0] = 3.0 - np.sqrt(x[i, 0] ** 2 + x[i, 1] ** 2 + x[i, 2] ** 2)
        right[i, 1] = 1.0
    for j in range(n):
        own = matrix[j, j]
        pivot = own
        for k in range(j):
            pivot -= matrix[j, k] ** 2
        if not pivot > 1e-13 * own:
            return False  # two samples coincide numerically
        matrix[j, j] = np.sqrt(pivot)
        for i in range(j + 1, n):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / matrix[j, j]
    for side in range(2):
        for i in range(n):
            for k in range(i):
                right[i, side] -= matrix[i, k] * right[k, side]
            right[i, side] /= matrix[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                right[i, side] -= matrix[k, i] * right[k, side]
            right[i, side] /= matrix[i, i]
    missing = (1.0 - right[:n, 0].sum()) / right[:n, 1].sum()
    for i in range(n):
        weight[i] = right[i, 0] + missing * right[i, 1]
    return True


@jit
def weigh(node, site, distance, point, mean, shown, amplifies, weight, value, steps):
    """Weights (m, k), values (m, C) and steps of the ridge (m,) for nodes (m, 3) with sites (m, k) around them.

    The first `shown` channels are clamped to the range of their samples; layers are not: they are parts of a sum.
    """
    m, k = site.shape
    x, own, used = np.zeros((k, 3)), np.zeros(k), np.zeros(k, np.int64)
    matrix, right = np.zeros((k, k)), np.zeros((k, 2))
    for number in range(m):
        # Scale the existing neighbours into a ball of radius 1 around the node.
        n, nearest, radius = 0, 0, 0.0
        for j in range(k):
            if distance[number, j] < np.inf:
                used[n] = j
                radius = max(radius, distance[number, j])
                if distance[number, j] < distance[number, used[nearest]]:
                    nearest = n
                n += 1
        if n == 1 or distance[number, used[nearest]] <= 1e-9 * radius:  # the node is a sample
            weight[number, used[nearest]] = 1.0
            for c in range(mean.shape[1]):
                value[number, c] = mean[site[number, used[nearest]], c]
            continue
        for i in range(n):
            for axis in range(3):
                x[i, axis] = (point[site[number, used[i]], axis] - node[number, axis]) / radius
        # Without a ridge if possible; else with increasing ridges, the last of which amounts to a plain mean.
        ridge, tail, step = 0.0, _TAIL, 0
        while True:
            solved = solve_weights(x[:n], ridge, tail, matrix, right, own)
            amplified = 0.0
            for i in range(n):
                amplified += abs(own[i])
            if (solved and amplified <= amplifies) or step == _LADDER:
                break
            ridge = _FIRST_RIDGE * _STEEPER**step
            tail = ridge
            step += 1
        steps[number] = step
        for i in range(n):
            weight[number, used[i]] = own[i]
        # Between sheets of different light a spline overshoots: clamp it to the range of its neighbours.
        for c in range(mean.shape[1]):
            low, high, total = np.inf, -np.inf, 0.0
            for i in range(n):
                light = mean[site[number, used[i]], c]
                low, high = min(low, light), max(high, light)
                total += own[i] * light
            value[number, c] = min(max(total, low), high) if c < shown else total
