"""Pictures without OpenGL: the package's own kernels march the level sets, with four rays per pixel."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from illumgrid.constants import CAP, SURFACE
from illumgrid.field.levelset import turned_levels
from illumgrid.field.volume import Floats
from illumgrid.show.camera import Camera
from illumgrid.show.caps import face_normals, faces_at
from illumgrid.show.cuts import CUT, greys
from illumgrid.show.looks import Layer, arriving, coated, layers_of
from illumgrid.show.shade import Coat, Colors, Shown, opaque
from illumgrid.tone import encode_rgba

SIDE = 2  # sub-samples along each side of a pixel
COAT_RAYS = 4  # rays per sub-sample that shows a coat, in pictures by lookups
_ROWS = 8  # picture rows that are traced together: bounds the memory


def directions_of(camera: Camera, width: int, rows: range, height: int) -> Floats:
    """Unit directions (n, 3) in the world of the sub-samples of some picture rows, row by row, left to right."""
    x = (2 * (np.arange(width * SIDE) + 0.5) / (width * SIDE) - 1) * camera.tangent * width / height
    y = (1 - 2 * (np.arange(rows.start * SIDE, rows.stop * SIDE) + 0.5) / (height * SIDE)) * camera.tangent
    world = (camera.forward + x[None, :, None] * camera.right + y[:, None, None] * camera.up).reshape(-1, 3)
    return np.asarray(world / np.linalg.norm(world, axis=1, keepdims=True))


def averaged(color: Colors, width: int) -> NDArray[np.uint8]:
    """Rows of a picture (rows, width, 4), sRGB and coverage, from the colours (n, 4) of their sub-samples."""
    return encode_rgba(np.clip(color, 0.0, 1.0).reshape(-1, SIDE, width, SIDE, 4).mean(axis=(1, 3)))


def traced(seen: Callable[[Floats], Colors], camera: Camera, width: int, height: int) -> NDArray[np.uint8]:
    """Picture (height, width, 4), sRGB and coverage, of the colours (n, 4) `seen` along directions from the eye."""
    from illumgrid.backends.numba_ import cores

    def strip(first: int) -> NDArray[np.uint8]:
        rows = range(first, min(first + _ROWS, height))
        return averaged(seen(directions_of(camera, width, rows, height)), width)

    with ThreadPoolExecutor(cores()) as pool:
        return np.concatenate(list(pool.map(strip, range(0, height, _ROWS))))


@dataclass(frozen=True, eq=False)
class Hits:
    """The first surfaces that rays from the eye meet.

    Parameters
    ----------
    point : (n, 3) float64
        In the world.
    normal : (n, 3) float64
        In the world, towards the side that is seen; 0 where nothing is met.
    facing : (n,) float64
        Cosine between the normal and the direction to the eye.
    number : (n,) int64
        Of the surface: fields count from 0, quads follow; -1 for none.
    what : (n,) int64
        `illumgrid.constants.SURFACE`, CAP, QUAD or MISS.
    """

    point: Floats
    normal: Floats
    facing: Floats
    number: NDArray[np.int64]
    what: NDArray[np.int64]

    def lit(self, number: int) -> NDArray[np.int64]:
        """Rows of the rays that meet a surface with light of its own: neither a cap nor a cut."""
        return np.flatnonzero((self.number == number) & (self.what != CAP) & (self.what != CUT))


def first_hits(shown: Shown, eye: Floats, directions: Floats, row: Floats | None = None) -> Hits:
    """First hits along world directions (n, 3) from one place or (n, 3), by default under the levels that are shown."""
    from illumgrid.backends.kernels import cast_rays

    scene, axes, n = shown.scene, shown.scene.fields[0].volume.direction, len(directions)
    t, number, what, normal = np.zeros(n), np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros((n, 3))
    origin, direction = np.broadcast_to(scene.to_frame(eye), (n, 3)).copy(), directions @ axes
    level = turned_levels(scene, shown.row) if row is None else row
    cast_rays(shown.light.marchable, level, origin, direction, -1, t, number, what, normal)
    met = number >= 0
    point = eye + np.where(met, t, 0.0)[:, None] * directions
    return Hits(point, normal @ axes.T, -np.einsum("ij,ij->i", normal, direction), number, what)


def place_on(shown: Shown, quad: int, points: Floats) -> tuple[Floats, Floats]:
    """Shares u and v (n,) of the edges of a quad at world points (n, 3) on it."""
    fields = shown.light.marchable
    u, v = ((shown.scene.to_frame(points) - fields.quad_corner[quad]) @ fields.quad_duals[quad].T).T
    return u, v


def colors_of(
    shown: Shown, hits: Hits, background: Colors, light: Colors | None = None, coat: Coat | None = None
) -> Colors:
    """Colours (n, 4) of the surfaces, lit by lookups or by irradiance `light` (n, 3), optionally under coats."""
    color = np.tile(background, (len(hits.what), 1))
    for k in range(len(shown.scene.fields)):
        caps = np.flatnonzero((hits.number == k) & (hits.what == CAP))
        if len(caps):
            face = faces_at(shown.scene.fields[k].volume, hits.point[caps])
            outer = np.einsum("ij,ij->i", hits.normal[caps], face_normals(shown.scene.fields[k].volume)[face]) > 0
            face = np.where(outer, face, -1)
            color[caps] = opaque(shown.cap(k, hits.point[caps], face, hits.facing[caps]))
        cut = np.flatnonzero((hits.number == k) & (hits.what == CUT))
        if len(cut):
            color[cut] = opaque(greys(shown.scene.fields[k], hits.point[cut]))
        lit = np.flatnonzero((hits.number == k) & (hits.what == SURFACE))
        own = None if light is None else light[lit]
        over = None if coat is None else Coat(coat.radiance[lit], coat.matte[lit])
        color[lit] = opaque(shown.field(k, hits.point[lit], hits.facing[lit], own, over))
    for k in range(len(shown.scene.quads)):
        lit = np.flatnonzero(hits.number == len(shown.scene.fields) + k)
        u, v = place_on(shown, k, hits.point[lit])
        share = shown.fade(k, u, v)[:, None]
        own = None if light is None else light[lit]
        color[lit] = share * opaque(shown.wall(k, u, v, hits.facing[lit], own)) + (1 - share) * background
    return color


def composed(
    shown: Shown, layers: list[Layer], background: Colors, lights: list[Colors] | None = None,
    coats: list[Coat] | None = None,
) -> Colors:  # fmt: skip
    """Colours (n, 4) of layers that are seen through one another; `lights` and `coats` as in `colors_of`."""
    total = layers[-1].behind[:, None].astype(np.float32) * background
    for k, layer in enumerate(layers):
        color = colors_of(
            shown, layer.hits, background, None if lights is None else lights[k], None if coats is None else coats[k]
        )
        film = layer.behind > 0
        color[film, 3] = 1 - layer.behind[film] / layer.weight[film]
        total += layer.weight[:, None].astype(np.float32) * color
    return np.asarray(total, np.float32)


def draw(shown: Shown, camera: Camera, width: int, height: int, background: Colors) -> NDArray[np.uint8]:
    """Picture (height, width, 4), sRGB and coverage, of one setting of the sweep."""

    def coat(layer: Layer, directions: Floats) -> Coat:
        rows = coated(shown, layer)
        numbers = np.ascontiguousarray(directions).view(np.uint64)  # an identity that does not depend on the strip
        ids = numbers[rows, 0] ^ numbers[rows, 1] << np.uint64(7) ^ numbers[rows, 2] << np.uint64(13)
        found = arriving(shown, camera.eye, layer, rows, ids, range(COAT_RAYS), 0, False)
        return Coat.over(layer.hits.facing, rows, found / np.float32(COAT_RAYS))

    def seen(directions: Floats) -> Colors:
        layers = layers_of(shown, camera.eye, directions)
        if shown.matte or shown.local or shown.trust:
            return composed(shown, layers, background)
        return composed(shown, layers, background, None, [coat(layer, directions) for layer in layers])

    if not (shown.matte or shown.trust):
        shown.sight  # noqa: B018  before threads ask for it
    return traced(seen, camera, width, height)
