"""Pictures: isosurfaces ray-marched in software by the package's own kernels, lit by a lookup. No GL is needed."""

import io
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from illumgrid.levelset import Marchable, marchable, turned, upward
from illumgrid.scene import Scene, upright
from illumgrid.tone import WHITE, encode_srgb
from illumgrid.volume import Floats, index_to_world

if TYPE_CHECKING:
    from illumgrid.illumination import Illumination

BACKGROUND = 0.045  # display-linear: a dark neutral, against which white surfaces and their shadows both stand out
CAP_TONE = 0.22  # display radiance of a cap, for albedo 1: caps are cuts, not lit surfaces
SIDE = 2  # sub-samples along each side of a pixel
HALF_ANGLE = 0.27  # tangent of half the vertical angle of view, 30 degrees in all
_ROWS = 24  # picture rows that are traced together: bounds the memory


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


def _column_ends(values: NDArray[np.float32], level: float) -> Floats:
    """Indices (m, 3) where the columns of `values` along the last axis enter and leave the solid {v >= level}."""
    solid = values >= level
    x, y = np.nonzero(solid.any(axis=2))
    last = values.shape[2] - 1
    found = []
    for step, end in ((-1, solid.argmax(axis=2)[x, y]), (1, last - solid[:, :, ::-1].argmax(axis=2)[x, y])):
        inner, outer = values[x, y, end].astype(float), values[x, y, np.clip(end + step, 0, last)].astype(float)
        share = np.divide(inner - level, inner - outer, out=np.zeros_like(inner), where=inner > outer)  # none at a cap
        found.append(np.stack([x, y, end + step * share], axis=1))
    return np.concatenate(found)


def _outline(scene: Scene, row: Floats) -> Floats:
    """World points (m, 3) whose hull is that of walls, and of the solids under a row of levels (volumes if none)."""
    found = []
    for field, level in zip(scene.fields, row * upward(scene)):
        values = turned(field.volume, field.inside)[0]
        for axis in range(3):
            ends = _column_ends(np.moveaxis(values, axis, 2), level)
            found.append(index_to_world(field.volume, np.insert(ends[:, :2], axis, ends[:, 2], axis=1)))
    if not sum(map(len, found)):
        corners = np.array(list(np.ndindex(2, 2, 2)))
        found = [index_to_world(f.volume, corners * (np.array(f.volume.shape) - 1)) for f in scene.fields]
    for quad in () if scene.background.any() else scene.quads:  # a room is seen whole, a floor under a sky goes on
        found.append(quad.corner + np.array([np.zeros(3), quad.edge_u, quad.edge_v, quad.edge_u + quad.edge_v]))
    return np.concatenate(found)


def fit_camera(scene: Scene, row: Floats, aspect: float) -> Camera:
    """Camera that looks at the solids under one row of levels from the front, right and above, and just holds them.

    Up is the array axis nearest to world +z, the front the one nearest to -y (the face, in medical coordinates). What
    is flat is seen from above; into a closed scene one looks straight.
    """
    right, front, up = upright(scene.fields[0].volume.direction)
    outline = _outline(scene, row)
    extent = np.ptp(outline @ np.stack([right, front, up], axis=1), axis=0)
    flat, closed = extent[2] < 0.5 * extent[:2].min(), not scene.background.any()
    azimuth, elevation = np.radians(0.0 if closed else 30.0), np.radians(60.0 if flat else 6.0 if closed else 18.0)
    forward = -np.cos(elevation) * (np.cos(azimuth) * front + np.sin(azimuth) * right) - np.sin(elevation) * up
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    return Camera(_eye(outline, right, up, forward, aspect), right, up, forward, HALF_ANGLE)


def _eye(outline: Floats, right: Floats, up: Floats, forward: Floats, aspect: float) -> Floats:
    """Nearest place from which all of `outline` (m, 3) fits the picture.

    Each point p bounds the eye e: |x| <= aspect (z - e_z) tan and |y| <= (z - e_z) tan, with x and y from the axis of
    view. The tightest bounds on either side meet at the farthest forward place.
    """
    margin = 1 / 1.08
    x, y, z = (outline @ np.stack([right, up, forward], axis=1)).T
    place = []
    depth = []
    for across, tangent in ((x, HALF_ANGLE * aspect * margin), (y, HALF_ANGLE * margin)):
        # across - e <= (z - e_z) tan and e - across <= (z - e_z) tan, with equality for one point each
        above, below = np.max(across - z * tangent), np.min(across + z * tangent)
        place.append(0.5 * (above + below))
        depth.append(0.5 * (below - above) / tangent)
    return np.asarray(place[0] * right + place[1] * up + min(depth) * forward)


def _rays(scene: Scene, camera: Camera, width: int, rows: range, height: int) -> tuple[Floats, Floats]:
    """Frame origins and directions (n, 3) of the sub-samples of some picture rows, row by row, left to right."""
    x = (2 * (np.arange(width * SIDE) + 0.5) / (width * SIDE) - 1) * camera.tangent * width / height
    y = (1 - 2 * (np.arange(rows.start * SIDE, rows.stop * SIDE) + 0.5) / (height * SIDE)) * camera.tangent
    world = camera.forward + x[None, :, None] * camera.right + y[:, None, None] * camera.up
    direction = world.reshape(-1, 3) @ scene.fields[0].volume.direction
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.broadcast_to(scene.to_frame(camera.eye), direction.shape).copy(), direction


def _shade(
    light: "Illumination", fields: Marchable, row: Floats, share: float, rays: tuple[Floats, Floats], local: bool
) -> NDArray[np.float32]:
    """Display-linear colours (n, 3) of rays."""
    from illumgrid.backends.kernels import CAP, SURFACE, cast_rays

    scene, fields_count = light.scene, len(light.scene.fields)
    origin, direction = rays
    n = len(origin)
    t, field, what, normal = np.zeros(n), np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros((n, 3))
    cast_rays(fields, row * upward(scene), origin, direction, -1, t, field, what, normal)
    color = np.full((n, 3), BACKGROUND, dtype=np.float32)
    for number, own in enumerate(scene.fields):
        albedo = own.material.albedo
        color[(field == number) & (what == CAP)] = CAP_TONE * albedo
        lit = np.flatnonzero((field == number) & (what == SURFACE))
        if local:
            facing = -np.einsum("ij,ij->i", normal[lit], direction[lit])
            color[lit] = WHITE * albedo / albedo.max(initial=1e-9) * np.maximum(facing, 0.0)[:, None]
        else:
            points = scene.from_frame(origin[lit] + t[lit, None] * direction[lit])
            color[lit] = light.grids[number].lookup(points) * (albedo / np.pi * light.exposure)
    for number, quad in enumerate(scene.quads):
        lit = np.flatnonzero(field == fields_count + number)
        material = quad.material
        if local:
            facing = -np.einsum("ij,ij->i", normal[lit], direction[lit])
            color[lit] = WHITE * np.maximum(material.albedo, material.emission.clip(0, 1)) * facing[:, None]
        else:
            points = origin[lit] + t[lit, None] * direction[lit]
            u, v = ((points - fields.quad_corner[number]) @ fields.quad_duals[number].T).T
            shown = material.albedo / np.pi * light.walls[number].lookup(u, v, share) + material.emission
            color[lit] = shown * light.exposure
    return color


def render(
    light: "Illumination",
    field: str | None = None,
    isovalue: float | None = None,
    *,
    width: int = 960,
    height: int = 720,
    local: bool = False,
) -> NDArray[np.uint8]:
    """Picture (height, width, 3), sRGB, of one setting of the sweep.

    Parameters
    ----------
    light : Illumination
    field : str, optional
        The field that `isovalue` belongs to, by default the first; the others follow the common sweep.
    isovalue : float, optional
        By default the middle of the range.
    width, height : int
        Pixels.
    local : bool
        Light by a lamp at the camera only, for comparison.
    """
    scene = light.scene
    number = 0 if field is None else scene.number_of(field)
    row = scene.levels(0.5)[0] if isovalue is None else scene.levels_through(number, isovalue)[0]
    low, high = scene.fields[number].range
    share = float(np.clip((row[number] - low) / (high - low), 0.0, 1.0))  # of the common sweep, as the walls know it
    camera = fit_camera(scene, row, width / height)
    fields = marchable(scene)

    def strip(rows: range) -> NDArray[np.float32]:
        color = _shade(light, fields, row, share, _rays(scene, camera, width, rows, height), local)
        pixels = np.clip(color, 0.0, 1.0).reshape(len(rows), SIDE, width, SIDE, 3)
        return np.asarray(pixels.mean(axis=(1, 3)))

    def strips() -> Iterator[range]:
        for first in range(0, height, _ROWS):
            yield range(first, min(first + _ROWS, height))

    from illumgrid.backends.numba_ import cores

    with ThreadPoolExecutor(cores()) as pool:
        return encode_srgb(np.concatenate(list(pool.map(strip, strips()))))


def png(picture: NDArray[np.uint8]) -> bytes:
    """A picture (height, width, 3) as a PNG file."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()
