"""Reading light between the nodes of a lattice, and filling nodes that have none of their own."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.constants import ON_A_VOXEL
from illumgrid.field.volume import Lattice


def read_lattice(spec: Lattice, values: NDArray[np.float32], points: ArrayLike) -> NDArray[np.float32]:
    """Trilinear `values` (nx, ny, nz, m) at world points (n, 3), clamped to the border: (n, m)."""
    from illumgrid.grid.trilinear import read

    world = np.ascontiguousarray(points, dtype=float).reshape(-1, 3)
    result = np.zeros((len(world), values.shape[3]), dtype=np.float32)
    place = (np.ascontiguousarray(x, dtype=float) for x in (spec.origin, spec.direction, spec.spacing))
    fixed = np.ascontiguousarray(values, np.float32).view()
    fixed.flags.writeable = False  # always: else Numba compiles again, for another type
    read(fixed, *place, ON_A_VOXEL, world, result)
    return result


def fill_holes(spacing: ArrayLike, values: NDArray[np.float32], support: NDArray[np.float32]) -> NDArray[np.float32]:
    """Give nodes of support 0 the value of the nearest supported node, so that lookup is never black and never NaN.

    Values (nx, ny, nz, C) that can be written to are filled where they are.
    """
    holes = support == 0
    if not holes.any() or holes.all():
        return values
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(holes, sampling=np.asarray(spacing), return_distances=False, return_indices=True)
    filled = values if values.flags.writeable else values.copy()
    for x in range(len(holes)):  # a slab at a time: what is read is light of nodes that are no holes
        hole = holes[x]
        filled[x][hole] = filled[tuple(axis[x][hole] for axis in nearest)]
    return filled
