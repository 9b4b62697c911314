"""Label maps: one label as a field whose zero is a smooth surface of the label."""

from dataclasses import replace

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.io.readers.limits import check_memory
from illumgrid.io.readers.stored import Stored

BLUR = 1.5
"""Standard deviation, in voxels, of the blur that turns the staircase of voxels into a surface."""

KEPT = 0.05
"""Voxels: at least so far on its own side of the surface is the centre of each voxel, whatever the blur does."""

MARGIN = 8
"""Voxels around a label in which distances are computed; beyond they are those of its edge."""


def distance_to(stored: Stored, label: int) -> Stored:
    """Smooth signed distance from the surface of a label, positive inside it.

    Parameters
    ----------
    stored : Stored
        A label map.
    label : int
        Which of its values.

    Returns
    -------
    field : Stored
        Distances in world units, on the same voxels.

    Notes
    -----
    The surface may lie anywhere between the centres of voxels inside and outside; a mask puts it half-way, in steps.
    Here the signed distance d is blurred, G d, and the shrinkage of curved surfaces by the blur is compensated,
    G d + G(d - G d). The centre of each voxel stays on its side. Measured (docs/files.md): balls of 6 to 24 voxels keep
    their radius within 0.02 voxels; the error is 0.06 voxels at points of their surface (root mean square; 0.20 for
    the mask) and at most 3.2° for normals (21° for the mask).
    """
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    inside = stored.values == (label - stored.intercept) / stored.slope
    if not inside.any() or inside.all():
        found = np.unique(stored.values) * stored.slope + stored.intercept
        shown = ", ".join(f"{value:g}" for value in found[:20]) + (", ..." if len(found) > 20 else "")
        raise BadInput(f"--label is {label}; expected one of the labels of the file, which are {shown}")
    spacing = np.linalg.norm(stored.steps, axis=0)
    box = _around(inside)
    mask = inside[box]
    check_memory(mask.size * 40 + inside.size * 4)
    near = float(spacing.min())
    distance = np.asarray(distance_transform_edt(mask, sampling=spacing), np.float32)
    distance -= distance_transform_edt(~mask, sampling=spacing).astype(np.float32)
    distance -= np.sign(distance) * np.float32(0.5 * near)  # the surface is between two centres
    smooth = gaussian_filter(distance, BLUR, mode="nearest")
    smooth += gaussian_filter(distance - smooth, BLUR, mode="nearest")
    smooth = np.where(mask, np.maximum(smooth, KEPT * near), np.minimum(smooth, -KEPT * near))
    values = np.full(inside.shape, smooth.min(), np.float32)
    values[box] = smooth
    return replace(stored, values=values, slope=1.0, intercept=0.0)


def _around(inside: "np.ndarray[tuple[int, ...], np.dtype[np.bool_]]") -> tuple[slice, ...]:
    """The bounding box of the inside, with a margin."""
    box = []
    for axis in range(3):
        there = np.flatnonzero(inside.any(axis=tuple({0, 1, 2} - {axis})))
        box.append(slice(max(int(there[0]) - MARGIN, 0), int(there[-1]) + MARGIN + 1))
    return tuple(box)
