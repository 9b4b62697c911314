"""scikit-image's marching cubes, a few cells at a time, so that Ctrl-C need not wait for all triangles."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.volume import Floats

AT_ONCE = 1 << 19
"""Cells of a call, at most half more: 0.4 to 0.8 s on one machine where every cell is crossed."""

Winding = Literal["ascent", "descent"]


def march(values: NDArray[np.float32], level: float, winding: Winding) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (k, 3), in indices, and faces (m, 3) of the level set of an array, as one call would number them.

    The array is cut into slabs along the first axis, and each plane of cells into strips along the second if two planes
    are too many. Along these axes vertices have more digits than from a single call, whose single precision must hold
    the index and the fraction of the edge together.
    """
    rows, wide, deep = (n - 1 for n in values.shape)
    cut = 2 * wide * deep > AT_ONCE
    rows, wide = (1, max(1, AT_ONCE // (2 * deep) - 1)) if cut else (max(1, AT_ONCE // (wide * deep)), wide)
    vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    starts: list[int] = []  # of the slab before: where the faces begin that a strip shares
    begins: list[int] = []  # of this slab
    for first in range(0, values.shape[0] - 1, rows):
        met, starts, begins, done = np.concatenate(faces[-max(1, len(begins)) :]), begins, [], 0
        for low in range(0, values.shape[1] - 1, wide):
            # A piece begins with the last layer of cells of the slab before and the last row of the strip before: their
            # faces come in the same order, and so say which vertex is which. Places would not: vertices of several
            # edges may meet in a corner.
            x, y = max(first - 1, 0), max(low - 1, 0)
            part = values[x : first + rows + 1, y : low + wide + 1]
            above = len(_cubes(part[:2], level, winding)[1]) if first else 0
            aside = len(_cubes(part[-2:, :2], level, winding)[1]) if low else 0
            start = starts[len(begins)] if cut and first else len(met) - above
            known = np.concatenate([met[start : start + above], faces[-1][len(faces[-1]) - aside :]])
            begins.append(done - aside)
            points, triangles = _cubes(part, level, winding)
            old = int(triangles[: len(known)].max(initial=-1)) + 1
            number = np.arange(count - old, count - old + len(points))
            number[triangles[: len(known)]] = known
            points[:, :2] += x, y
            vertices.append(points[old:])
            faces.append(number[triangles[len(known) :]])
            count, done = count + len(points) - old, done + len(faces[-1])
    return np.concatenate(vertices), np.concatenate(faces)


def _cubes(values: NDArray[np.float32], level: float, winding: Winding) -> tuple[Floats, NDArray[np.int64]]:
    from skimage.measure import marching_cubes

    if not float(values.min()) < level < float(values.max()):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    points, triangles, _, _ = marching_cubes(values, level, gradient_direction=winding)
    return points.astype(float), triangles.astype(np.int64)
