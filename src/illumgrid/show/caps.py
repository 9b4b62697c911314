"""Light on caps, the flat faces that close a solid at the border of its volume.

If a field stands alone, only the sky lies beyond a face of its box: the light of the face is known in closed form, one
colour for each face. If walls or other fields lie beyond it, the light is unknown.
"""

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.layers import ALL
from illumgrid.field.open_sky import open_irradiance
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats, Volume, box_corners, world_to_index
from illumgrid.grid.channels import RGB, Channels, channels_of, columns_of
from illumgrid.light import Illumination

_BEYOND = 1e-6  # of the longest side: something beyond a face counts from this distance on


def face_normals(volume: Volume) -> Floats:
    """Outward unit vectors (6, 3) of the faces of a volume: of axis k face 2k, at its first voxels, and 2k + 1."""
    return np.stack([sign * axis for axis in volume.direction.T for sign in (-1.0, 1.0)])


def faces_at(volume: Volume, points: Floats) -> NDArray[np.int64]:
    """The face (n,) next to each of the world points (n, 3)."""
    index = world_to_index(volume, points)
    away = np.stack([index, index - (np.array(volume.shape) - 1)], axis=-1) * volume.spacing[:, None]
    return np.asarray(np.abs(away).reshape(len(points), 6).argmin(axis=1), np.int64)


def open_faces(scene: Scene, number: int) -> NDArray[np.bool_]:
    """Whether (6,) nothing of the scene lies beyond each face of the box of a field."""
    volume = scene.fields[number].volume
    last = np.array(volume.shape) - 1
    near = _BEYOND * last.max()
    others = [box_corners(f.volume) for k, f in enumerate(scene.fields) if k != number]
    quads = [q.corner + u * q.edge_u + v * q.edge_v for q in scene.quads for u in (0, 1) for v in (0, 1)]

    def clear(points: Floats, room: float) -> NDArray[np.bool_]:
        index = world_to_index(volume, points)
        return ~(np.stack([-index, index - last], axis=-1) > room).any(axis=0).reshape(6)

    # Boxes may touch; a quad in the plane of a face covers it.
    return clear(np.reshape(others, (-1, 3)), near) & clear(np.reshape(quads, (-1, 3)), -near)


def channels_on_caps(light: Illumination, number: int) -> tuple[Floats, Channels]:
    """Irradiance (6, C) of the faces of a field's box under the open sky, in the channels of its light."""
    scene, channels = light.scene, light.grids[number].channels
    kept = channels.names == channels_of(scene).names
    columns = columns_of(scene) if kept else ALL
    found = open_irradiance(scene, columns, face_normals(scene.fields[number].volume))
    return found, channels if kept else RGB


def light_on_caps(light: Illumination, number: int) -> NDArray[np.float32]:
    """Irradiance (6, 3) of the faces of a field's box as it is shown; NaN if they receive more than the sky's light."""
    found, channels = channels_on_caps(light, number)
    result = np.maximum(channels.rgb(found.astype(np.float32)), np.float32(0))  # smooth skies may be negative
    result[~open_faces(light.scene, number)] = np.nan
    return result
