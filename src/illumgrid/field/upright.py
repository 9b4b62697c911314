"""The up direction: signed axes of the array, for cameras and skies."""

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.boundaries import otsu_threshold
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats, slabs

UPS = {
    f"{sign}{name}": factor * axis for sign, factor in (("", 1.0), ("-", -1.0)) for name, axis in zip("xyz", np.eye(3))
}
"""World directions (3,) that can be up."""


def axes_of(direction: Floats, up: str = "z") -> tuple[Floats, Floats, Floats]:
    """World directions (3,) right, front, up along the axes of an array with this `direction`.

    Up is the array axis nearest to the world direction `up`. The front is the one nearest to -y (the face, in medical
    coordinates); where y is vertical, the one from which +x points to the right.
    """
    if up not in UPS:
        raise BadInput(f"up is {up!r}; expected one of {', '.join(UPS)}")
    wanted = UPS[up]
    facing = np.cross(UPS["x"], wanted) if up.endswith("y") else UPS["-y"]
    heights = direction.T @ wanted
    vertical = int(np.argmax(np.abs(heights)))
    depths = np.where(np.arange(3) == vertical, 0.0, direction.T @ facing)
    level = int(np.argmax(np.abs(depths)))
    upward_axis = direction[:, vertical] * np.sign(heights[vertical])
    front = direction[:, level] * (np.sign(depths[level]) or 1.0)
    return np.cross(upward_axis, front), front, upward_axis


FLAT, ROUND = 0.3, 0.05  # area near an end over the largest section, from which it is a flat cut, to which rounded
BLUNT = 12.0  # over the number of sections: the share that the second one of a rounded end may have; of a ball, 6 to 8


def up_of(scene: Scene) -> str:
    """The default up direction: world +z, or -z for an object that is stored upside down.

    Only an array without orientation (`Volume.oriented`: its file states none) in a scene without walls is turned over,
    and only if the object, found by Otsu's threshold, ends in a flat cut on top and is rounded below, like a bust that
    stands on its head.
    """
    first = scene.fields[0]
    if first.volume.oriented or scene.quads or len(scene.fields) > 1:
        return "z"
    try:
        level = first.volume.to_stored(otsu_threshold(first.volume, first.inside))
    except BadInput:  # constant
        return "z"
    values = first.volume.stored
    areas = sum(np.count_nonzero(first.solid(values[slab], level), axis=(0, 1)) for slab in slabs(values.shape))
    there = areas[areas > 0]
    if len(there) < 4:
        return "z"
    below, above = there[[1, -2]] / there.max()  # the first and the last may be cut, or be means with empty slices
    rounded = max(ROUND, BLUNT / len(there))
    return "-z" if below < rounded and above > max(FLAT, 1.25 * rounded) else "z"


def sky_axes(scene: Scene) -> Floats:
    """World directions right, back and up, the rows of (3, 3): the axes in which skies are described."""
    right, front, up = axes_of(scene.fields[0].volume.direction, up_of(scene))
    return np.stack([right, -front, up])
