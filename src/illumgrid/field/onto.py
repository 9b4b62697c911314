"""Meshes of other programs, moved onto level sets of a field."""

import numpy as np
from numpy.typing import ArrayLike

from illumgrid.errors import BadInput, shown_range
from illumgrid.field.scene import Field
from illumgrid.field.volume import Floats, index_to_world, interpolate, project, world_to_index

SINGLE = 1e-5
"""Share of a field's span of values by which vertices in single precision may miss the level set of their own mesh."""


def onto_levels(field: Field, points: ArrayLike, isovalue: float | None = None) -> Floats:
    """World points (n, 3) moved onto level sets of a field within its range, each by at most a voxel along each axis.

    Parameters
    ----------
    field : Field
    points : (n, 3) array_like
        World positions, as those of the vertices of a decimated isosurface, or of the surface of a segmentation.
    isovalue : float, optional
        Level set for all points. By default each is on the level set through itself; one whose level is outside the
        range moves onto the nearest level within.

    Returns
    -------
    (n, 3) float64

    Raises
    ------
    BadInput
        If the isovalue is outside the range, or some points lie too far away; the message gives their number.
    """
    low, high = field.range
    if isovalue is not None and not low <= isovalue <= high:
        raise BadInput(
            f"the isovalue is {isovalue:g}, but the light of field {field.name!r} is that of "
            f"{shown_range((low, high), 6)}; choose one within, or compute the light of a wider range"
        )
    world = np.asarray(points, float).reshape(-1, 3)
    top = np.array(field.volume.shape) - 1.0
    start = world_to_index(field.volume, np.where(np.isfinite(world), world, np.nan))
    near = np.clip(np.nan_to_num(start), 0.0, top)
    own = interpolate(field.volume, near)
    levels = np.clip(own, low, high) if isovalue is None else np.full(len(world), float(isovalue))
    least, most = field.volume.extremes
    # From closer points, Newton steps may leave rough data, or not end.
    moving = np.abs(own - levels) > SINGLE * (most - least)
    at, arrived = near.copy(), np.ones(len(world), bool)
    at[moving], arrived[moving] = project(field.volume, near[moving], levels[moving])
    with np.errstate(invalid="ignore"):
        off = np.flatnonzero(~(arrived & (np.abs(at - start).max(axis=1, initial=0.0) <= 1.0)))
    if len(off):
        where = ", ".join(f"{x:.4g}" for x in world[off[0]])
        these = (
            f"the level sets of {shown_range((low, high), 6)}" if isovalue is None else f"the level set {isovalue:g}"
        )
        raise BadInput(
            f"{len(off)} of {len(world)} vertices are more than a voxel away from {these} of field {field.name!r} "
            f"(the first, number {off[0]}, at {where}); expected a mesh on its isosurfaces, "
            "in its world coordinates: check the units, or compute the light of a wider range"
        )
    moved = (at != start).any(axis=1)
    return np.where(moved[:, None], index_to_world(field.volume, at), world)
