"""A field on fewer voxels: means over blocks."""

from collections.abc import Sequence

import numpy as np

from illumgrid.field.volume import AT_ONCE, Volume, index_to_world, slabs


def block_means(volume: Volume, factors: Sequence[int]) -> Volume:
    """Means over blocks of so many voxels along each axis, at their centres; the border voxel fills the last ones.

    Works in slabs of whole blocks, so that it needs no second array as large as the field.
    """
    x, y, z = (int(f) for f in factors)
    nx, ny, nz = (-(-n // f) for n, f in zip(volume.shape, (x, y, z)))
    means = np.empty((nx, ny, nz))
    for rows in slabs((nx, *volume.shape[1:]), max(1, AT_ONCE // x)):
        part = volume.stored[rows.start * x : rows.stop * x]
        wanted = (rows.stop - rows.start) * x, ny * y, nz * z
        part = np.pad(part, [(0, int(n) - have) for n, have in zip(wanted, part.shape)], mode="edge")
        means[rows] = part.reshape(-1, x, ny, y, nz, z).mean(axis=(1, 3, 5), dtype=float)
    step = np.array([x, y, z])
    origin = index_to_world(volume, (step[None] - 1) / 2)[0]
    return Volume(means, origin, volume.spacing * step, volume.direction, volume.slope, volume.intercept, volume.unit)
