"""The camera: the up direction, the position of the eye, and the extent of the picture."""

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.scene import Scene
from illumgrid.field.upright import axes_of, up_of
from illumgrid.field.volume import Floats, box_corners, index_to_world, slabs

HALF_ANGLE = 0.27  # tangent of half the vertical angle of view, 30 degrees in all
MARGIN = 1.08  # margin: the picture is this much larger than its content
VIEWS = {
    "front": (0.0, 0.0), "back": (180.0, 0.0), "right": (90.0, 0.0), "left": (-90.0, 0.0),
    "top": (0.0, 90.0), "bottom": (0.0, -90.0), "iso": (45.0, math.degrees(math.asin(1 / math.sqrt(3)))),
}  # fmt: skip
"""Azimuth and elevation in degrees: from the front to the right, and upwards."""

View = str | tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera in the world.

    Parameters
    ----------
    eye : (3,) float64
    right, up, forward : (3,) float64
        Orthonormal, forward × up = right: whatever the axes of the data, a picture is never mirrored.
    tangent : float
        Tangent of half the vertical angle of view.
    """

    eye: Floats
    right: Floats
    up: Floats
    forward: Floats
    tangent: float


def camera_text(camera: Camera) -> str:
    """A camera as JSON."""
    parts = {name: getattr(camera, name).tolist() for name in ("eye", "right", "up", "forward")}
    return json.dumps({**parts, "tangent": camera.tangent})


def camera_of(text: str) -> Camera:
    """The camera that `camera_text` wrote."""
    try:
        parts = json.loads(text)
        vectors = [np.array(parts[name], dtype=float) for name in ("eye", "right", "up", "forward")]
        tangent = float(parts["tangent"])
        fits = all(v.shape == (3,) and np.isfinite(v).all() for v in vectors) and 0 < tangent < math.inf
    except (ValueError, TypeError, KeyError):
        fits = False
    if not fits:
        raise BadInput(
            f"the camera is {text[:60]!r}; expected eye, right, up, forward and tangent as preview writes them"
        )
    eye, right, up, forward = vectors
    return Camera(eye, right, up, forward, tangent)


def angles(view: str | tuple[float, float]) -> tuple[float, float]:
    """Azimuth and elevation, in degrees, of a named view or of ``"azimuth,elevation"``.

    Raises
    ------
    BadInput
        On an unknown name, or numbers that are no angles.
    """
    if isinstance(view, str) and view in VIEWS:
        return VIEWS[view]
    try:
        azimuth, elevation = map(float, view.split(",") if isinstance(view, str) else view)
    except (TypeError, ValueError):
        azimuth = elevation = math.nan
    if not (math.isfinite(azimuth) and -90 <= elevation <= 90):
        raise BadInput(
            f"the view is {view!r}; expected one of {', '.join(VIEWS)}, or azimuth,elevation in degrees such as 30,18, "
            "with an elevation from -90 to 90"
        )
    return azimuth, elevation


def _column_ends(values: NDArray[Any], level: np.float64, sign: float) -> Floats:
    """Indices (m, 3) where columns of `values` along the last axis enter and leave the solid {sign v >= sign level}."""
    last, found = values.shape[2] - 1, []
    for slab in slabs(values.shape):
        part = values[slab]
        solid = part >= level if sign > 0 else part <= level
        x, y = np.nonzero(solid.any(axis=2))
        for step, end in ((-1, solid.argmax(axis=2)[x, y]), (1, last - solid[:, :, ::-1].argmax(axis=2)[x, y])):
            # The level, counted inward: 0 at a cap, where the volume ends.
            inner, outer = (sign * part[x, y, k].astype(float) for k in (end, np.clip(end + step, 0, last)))
            share = np.divide(inner - sign * level, inner - outer, out=np.zeros_like(inner), where=inner > outer)
            found.append(np.stack([x + slab.start, y, end + step * share], axis=1))
    return np.concatenate(found)


def outline_of(scene: Scene, row: Floats) -> Floats:
    """World points (m, 3) whose hull is that of walls and of the solids under a row of levels (else volumes)."""
    found = []
    for field, isovalue in zip(scene.fields, row):
        level = np.float64(field.volume.to_stored(isovalue))
        for axis in range(3):
            ends = _column_ends(np.moveaxis(field.volume.stored, axis, 2), level, field.upward)
            found.append(index_to_world(field.volume, np.insert(ends[:, :2], axis, ends[:, 2], axis=1)))
    if not sum(map(len, found)):
        found = [box_corners(f.volume) for f in scene.fields]
    for quad in () if scene.open else scene.quads:  # a room must be seen whole; a floor under a sky continues anyway
        found.append(quad.corner + np.array([np.zeros(3), quad.edge_u, quad.edge_v, quad.edge_u + quad.edge_v]))
    return np.concatenate(found)


def widest_row(scene: Scene) -> Floats:
    """Isovalues (F,) under which the solid of every field is largest; all other settings lie within."""
    return np.array([field.widest for field in scene.fields])


ZOOM = 1e6  # the largest zoom: beyond it, and below its inverse, nothing is visible, and tangents overflow


def fit_camera(
    scene: Scene,
    row: Floats,
    aspect: float,
    view: View = None,
    zoom: float = 1.0,
    *,
    up: str | None = None,
    roll: float = 0.0,
) -> Camera:
    """Camera that looks at the solids under one or several rows of levels, and just contains them.

    Parameters
    ----------
    scene : Scene
    row : (F,) or (n, F) float64
        Isovalue of every field.
    aspect : float
        Width of the picture over its height.
    view : str or (azimuth, elevation), optional
        By default from the front, 30 degrees from the right and 18 from above; flat objects are seen from above, and
        closed scenes straight from the front.
    zoom : float
        Magnification about the middle of the picture.
    up : {"x", "y", "z", "-x", "-y", "-z"}, optional
        World direction that is up, by the array axis nearest to it; by default that of `up_of`.
    roll : float
        Degrees by which the picture is rotated clockwise.
    """
    outline = np.concatenate([outline_of(scene, one) for one in np.atleast_2d(row)])
    axes = axes_of(scene.fields[0].volume.direction, up_of(scene) if up is None else up)
    if view is None:
        extent = np.ptp(outline @ np.stack(axes, axis=1), axis=0)
        flat, closed = extent[2] < 0.5 * extent[:2].min(), not scene.open
        view = 0.0 if closed else 30.0, 60.0 if flat else 6.0 if closed else 18.0
    return camera_around(outline, axes, aspect, view, zoom, roll)


def camera_around(
    outline: Floats,
    axes: tuple[Floats, Floats, Floats],
    aspect: float,
    view: View,
    zoom: float = 1.0,
    roll: float = 0.0,
) -> Camera:
    """Camera that just contains world points (m, 3), seen from `view` relative to these `axes` (right, front, up)."""
    if not 1 / ZOOM <= zoom <= ZOOM:
        raise BadInput(
            f"the zoom is {zoom}; expected a positive number up to {ZOOM:g}: 2 shows everything twice as large"
        )
    if not math.isfinite(roll):
        raise BadInput(f"the roll is {roll}; expected degrees")
    azimuth, elevation = np.radians(angles("front" if view is None else view))
    side, front, upward_axis = axes
    forward = -np.cos(elevation) * (np.cos(azimuth) * front + np.sin(azimuth) * side) - np.sin(elevation) * upward_axis
    level = np.cos(azimuth) * side - np.sin(azimuth) * front
    above = np.cross(level, forward)
    turn = np.radians(roll)
    right, up = np.cos(turn) * level + np.sin(turn) * above, np.cos(turn) * above - np.sin(turn) * level
    return Camera(_eye(outline, right, up, forward, aspect), right, up, forward, HALF_ANGLE / zoom)


def _eye(outline: Floats, right: Floats, up: Floats, forward: Floats, aspect: float) -> Floats:
    """Nearest position from which all of `outline` (m, 3) fits into the picture.

    Each point p bounds the eye e: |x| <= aspect (z - e_z) tan and |y| <= (z - e_z) tan, with x and y from the axis of
    view. The tightest bounds on either side meet at the farthest forward place.
    """
    x, y, z = (outline @ np.stack([right, up, forward], axis=1)).T
    place = []
    depth = []
    for across, tangent in ((x, HALF_ANGLE * aspect / MARGIN), (y, HALF_ANGLE / MARGIN)):
        # across - e <= (z - e_z) tan and e - across <= (z - e_z) tan, with equality for one point each
        above, below = np.max(across - z * tangent), np.min(across + z * tangent)
        place.append(0.5 * (above + below))
        depth.append(0.5 * (below - above) / tangent)
    return np.asarray(place[0] * right + place[1] * up + min(depth) * forward)
