"""Pictures without OpenGL: the level sets are marched by the package's own kernels, four rays per pixel."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from illumgrid.constants import CAP, SURFACE
from illumgrid.field.levelset import turned_levels
from illumgrid.field.volume import Floats
from illumgrid.show.camera import Camera
from illumgrid.show.shade import Colors, Shown, opaque
from illumgrid.tone import encode_rgba

SIDE = 2  # sub-samples along each side of a pixel
_ROWS = 24  # picture rows that are traced together: bounds the memory


def _directions(camera: Camera, width: int, rows: range, height: int) -> Floats:
    """Unit directions (n, 3) in the world of the sub-samples of some picture rows, row by row, left to right."""
    x = (2 * (np.arange(width * SIDE) + 0.5) / (width * SIDE) - 1) * camera.tangent * width / height
    y = (1 - 2 * (np.arange(rows.start * SIDE, rows.stop * SIDE) + 0.5) / (height * SIDE)) * camera.tangent
    world = (camera.forward + x[None, :, None] * camera.right + y[:, None, None] * camera.up).reshape(-1, 3)
    return np.asarray(world / np.linalg.norm(world, axis=1, keepdims=True))


def traced(seen: Callable[[Floats], Colors], camera: Camera, width: int, height: int) -> NDArray[np.uint8]:
    """Picture (height, width, 4), sRGB and coverage, of the colours (n, 4) `seen` along directions from the eye."""
    from illumgrid.backends.numba_ import cores

    def strip(first: int) -> NDArray[np.uint8]:
        rows = range(first, min(first + _ROWS, height))
        color = np.clip(seen(_directions(camera, width, rows, height)), 0.0, 1.0)
        return encode_rgba(color.reshape(len(rows), SIDE, width, SIDE, 4).mean(axis=(1, 3)))

    with ThreadPoolExecutor(cores()) as pool:
        return np.concatenate(list(pool.map(strip, range(0, height, _ROWS))))


def draw(shown: Shown, camera: Camera, width: int, height: int, background: Colors) -> NDArray[np.uint8]:
    """Picture (height, width, 4), sRGB and coverage, of one setting of the sweep."""
    fields, eye = shown.light.marchable, shown.scene.to_frame(camera.eye)
    axes = shown.scene.fields[0].volume.direction

    def seen(directions: Floats) -> Colors:
        from illumgrid.backends.kernels import cast_rays

        direction, n = directions @ axes, len(directions)
        origin = np.tile(eye, (n, 1))
        t, number, what, normal = np.zeros(n), np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros((n, 3))
        cast_rays(fields, turned_levels(shown.scene, shown.row), origin, direction, -1, t, number, what, normal)
        facing = -np.einsum("ij,ij->i", normal, direction)
        color = np.tile(background, (n, 1))
        for k in range(len(shown.scene.fields)):
            color[(number == k) & (what == CAP)] = opaque(shown.cap(k))
            lit = np.flatnonzero((number == k) & (what == SURFACE))
            color[lit] = opaque(shown.field(k, camera.eye + t[lit, None] * directions[lit], facing[lit]))
        for k in range(len(shown.scene.quads)):
            lit = np.flatnonzero(number == len(shown.scene.fields) + k)
            place = (eye + t[lit, None] * direction[lit] - fields.quad_corner[k]) @ fields.quad_duals[k].T
            u, v = place.T
            share = shown.fade(k, u, v)[:, None]
            color[lit] = share * opaque(shown.wall(k, u, v, facing[lit])) + (1 - share) * background
        return color

    return traced(seen, camera, width, height)
