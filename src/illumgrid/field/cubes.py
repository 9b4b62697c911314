"""Marching cubes of scikit-image a few planes at a time: Ctrl-C waits for one slab, not for millions of triangles."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.volume import Floats

AT_ONCE = 1 << 19
"""Cells of a slab: at most half a second, where every cell is crossed."""

Winding = Literal["ascent", "descent"]


def march(values: NDArray[np.float32], level: float, winding: Winding) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (k, 3), in indices, and faces (m, 3) of the level set of an array, as one call would number them.

    Along the first axis vertices have more digits than one call gives them, whose single precision holds the index and
    the share of the edge together.
    """
    rows = max(1, AT_ONCE // ((values.shape[1] - 1) * (values.shape[2] - 1)))
    vertices, faces = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)]
    count = 0
    for first in range(0, values.shape[0] - 1, rows):
        # Each slab begins with the last layer of cells of the slab before: their faces come in the same order, and so
        # say which vertex is which. Places would not: vertices of several edges may meet in a corner.
        shared = _cubes(values[first - 1 : first + 1], level, winding) if first else None
        old, again = (len(part) for part in shared) if shared else (0, 0)
        begin = max(first - 1, 0)
        points, triangles = _cubes(values[begin : first + rows + 1], level, winding)
        number = np.arange(count - old, count - old + len(points))
        number[triangles[:again]] = faces[-1][len(faces[-1]) - again :]
        points[:, 0] += begin
        vertices.append(points[old:])
        faces.append(number[triangles[again:]])
        count += len(points) - old
    return np.concatenate(vertices), np.concatenate(faces)


def _cubes(values: NDArray[np.float32], level: float, winding: Winding) -> tuple[Floats, NDArray[np.int64]]:
    from skimage.measure import marching_cubes

    if not float(values.min()) < level < float(values.max()):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    points, triangles, _, _ = marching_cubes(values, level, gradient_direction=winding)
    return points.astype(float), triangles.astype(np.int64)
