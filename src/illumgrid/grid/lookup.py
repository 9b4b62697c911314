"""Reading light between the nodes of a lattice, and filling nodes without light of their own."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.field.volume import Lattice
from illumgrid.grid.blocks import read, whole


def read_lattice(spec: Lattice, values: NDArray[np.float32], points: ArrayLike) -> NDArray[np.float32]:
    """Trilinear `values` (nx, ny, nz, m) at world points (n, 3), clamped to the border: (n, m)."""
    return read(whole(values.shape[:3]), spec, values[None], points)


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
    for x in range(len(holes)):  # slab by slab; only light of nodes that are not holes is read
        hole = holes[x]
        filled[x][hole] = filled[tuple(axis[x][hole] for axis in nearest)]
    return filled
