"""Films and coats in pictures: surfaces seen through others, and reflections of coats.

A film shows its own light and, by its transmission, what lies behind; what lies behind is lit by its own grid. A coat
is a rough clear layer (GGX, refractive index 1.5) over the matte surface: its reflected rays end in the light that
grids and walls hold where they land. The light itself was computed without coats.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from illumgrid.constants import SURFACE
from illumgrid.field.layers import light_tables
from illumgrid.field.levelset import Marchable, marchable, turned_levels
from illumgrid.field.scene import Material, Scene
from illumgrid.field.volume import Floats
from illumgrid.grid import IlluminationGrid
from illumgrid.grid.cache import Cache
from illumgrid.grid.channels import channels_of, columns_of
from illumgrid.light import Illumination
from illumgrid.show.cuts import clipped_layers

if TYPE_CHECKING:
    from illumgrid.show.engines.software import Hits
    from illumgrid.show.shade import Colors, Shown

LAYERS = 4  # surfaces behind one another that are seen, as in the page
SMOOTHEST = 1e-4  # roughness of GGX below which a coat is a mirror to the eye


def displayed(scene: Scene) -> Scene:
    """The scene with the materials of pictures: translucent fields get a transmission."""

    def shown(material: Material) -> Material:
        share = material.translucent
        if not share or material.transmission:
            return material
        return replace(material, albedo=(1 - share) * material.albedo, emission=np.zeros(3), transmission=share)

    return replace(scene, fields=tuple(replace(f, material=shown(f.material)) for f in scene.fields))


class Sight(NamedTuple):
    """The input of `illumgrid.backends.sight`: a scene as pictures show it, with its light in RGB.

    Parameters
    ----------
    scene : Marchable
    cache : Cache
    place : float
        In the sweep.
    level : (F,) float64
        Turned levels.
    cap : float
        Radiance of caps of albedo 1.
    """

    scene: Marchable
    cache: Cache
    place: float
    level: Floats
    cap: float


def sight_of(shown: "Shown") -> Sight:
    """Lay out one setting of the sweep for `illumgrid.backends.sight`."""
    from illumgrid.show.shade import CAP_TONE

    light, scene = shown.light, shown.displayed
    level = turned_levels(scene, shown.row)
    return Sight(_lit(light, scene), _held(light, shown.share), shown.share, level, CAP_TONE / shown.exposure)


def _lit(light: Illumination, scene: Scene) -> Marchable:
    """The scene for marching, with its lights at the weights of the light."""
    laid, channels = marchable(scene), light.grids[0].channels
    if not light.weights or channels.names != channels_of(light.scene).names:
        return laid
    tables, mix = light_tables(scene, columns_of(light.scene)), np.array(channels.mix)
    names = "emission", "background", "usual", "harmonics", "disc_radiance", "image"
    return laid._replace(**{name: np.ascontiguousarray(tables[name] @ mix) for name in names})


def _held(light: Illumination, share: float) -> Cache:
    """Grids and walls in RGB as one cache, in which every ray may end."""

    def rgb(grid: IlluminationGrid) -> NDArray[np.float32]:
        if not grid.rows:
            return grid.values
        place = share * (len(grid.rows) - 1)
        below = min(int(place), len(grid.rows) - 2)
        one, other = (row.values for row in grid.rows[below : below + 2])
        return np.asarray(one + np.float32(place - below) * (other - one))

    scene = light.scene
    values = [*map(rgb, light.grids), *(wall.values for wall in light.walls)]
    shapes = np.array([v.shape[:3] for v in values], np.int64)
    together = np.concatenate([np.asarray(v, np.float32).reshape(-1, 3) for v in values])
    return Cache(
        light=together,
        trusted=np.ones(len(together), bool),
        start=np.cumsum([0, *shapes.prod(axis=1)], dtype=np.int64)[:-1],
        shape=shapes,
        origin=np.ascontiguousarray(scene.to_frame([grid.spec.origin for grid in light.grids])),
        spacing=np.array([grid.spec.spacing for grid in light.grids], float),
        near=np.zeros(len(values)),
        sweep=np.zeros((len(light.grids), 2)),
    )


class Layer(NamedTuple):
    """The surfaces that rays from the eye meet at one depth.

    Parameters
    ----------
    hits : Hits
    within : (n,) int64
        Bits of the fields whose shells the rays were in.
    weight : (n,) float64
        With which this is seen; 0 for rays that met less.
    behind : (n,) float64
        With which what lies behind is seen.
    """

    hits: "Hits"
    within: NDArray[np.int64]
    weight: Floats
    behind: Floats

    @property
    def inner(self) -> NDArray[np.bool_]:
        """Whether (n,) the inner side of a level set is seen."""
        number = np.maximum(self.hits.number, 0)
        return np.asarray((self.hits.what == SURFACE) & (self.within >> number & 1 > 0))


def layers_of(shown: "Shown", eye: Floats, directions: Floats) -> list[Layer]:
    """What rays along directions (n, 3) from the eye meet, one behind the other; one layer where nothing is a film."""
    if shown.clips:
        return clipped_layers(shown, eye, directions)
    return layers_from(shown, eye, directions, np.zeros(len(directions), np.int64))


def layers_from(shown: "Shown", eye: Floats, directions: Floats, start: NDArray[np.int64]) -> list[Layer]:
    """As `layers_of`, from one place or (n, 3), within the shells of the fields whose bits `start` (n,) has."""
    from illumgrid.backends.sight import cast_layers
    from illumgrid.show.engines.software import Hits, first_hits

    n = len(directions)
    if shown.trust or not any(f.material.transmission for f in shown.displayed.fields):
        hits = first_hits(shown, eye, directions)
        return [Layer(hits, np.zeros(n, np.int64), np.ones(n), np.zeros(n))]
    sight, axes = shown.sight, shown.scene.fields[0].volume.direction
    origin, direction = np.broadcast_to(shown.scene.to_frame(eye), (n, 3)).copy(), directions @ axes
    t, normal = np.zeros((LAYERS, n)), np.zeros((LAYERS, n, 3))
    number, what, within = np.full((LAYERS, n), -1), np.zeros((LAYERS, n), np.int64), np.zeros((LAYERS, n), np.int64)
    weight = np.zeros((LAYERS + 1, n))
    cast_layers(sight.scene, sight.level, origin, direction, start, t, number, what, normal, within, weight)
    found = []
    for k in range(LAYERS):
        point = eye + np.where(number[k] >= 0, t[k], 0.0)[:, None] * directions
        facing = -np.einsum("ij,ij->i", normal[k], direction)
        found.append(
            Layer(Hits(point, normal[k] @ axes.T, facing, number[k], what[k]), within[k], weight[k], weight[k + 1])
        )
    return found


def coated(shown: "Shown", layer: Layer) -> NDArray[np.int64]:
    """Rows of a layer that show the outer side of a surface with a coat."""
    rough = np.array([f.material.roughness is not None for f in shown.scene.fields])
    found = np.flatnonzero((layer.hits.what == SURFACE) & ~layer.inner)
    return np.asarray(found[rough[layer.hits.number[found]]])


def arriving(
    shown: "Shown", eye: Floats, layer: Layer, rows: NDArray[np.int64], ids: NDArray[np.uint64], rays: range, seed: int,
    matte: bool,
) -> "Colors":  # fmt: skip
    """Sum (m, 3) over some rays of the radiance that they bring to some rows (m,) of a layer.

    By way of their coats to the eye; or if `matte` of what reaches them, which times π is their irradiance.
    """
    from illumgrid.backends.sight import reflect_rays

    sight, hits, axes = shown.sight, layer.hits, shown.scene.fields[0].volume.direction
    number = hits.number[rows]
    rough = np.array([f.material.roughness or 0.0 for f in shown.scene.fields])
    alpha = np.full(len(rows), -1.0) if matte else np.maximum(np.square(rough[number]), SMOOTHEST)
    view = eye - hits.point[rows]
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    total = np.zeros((len(rows), 3))
    reflect_rays(
        *sight[:3], sight.cap, sight.level, ids, shown.scene.to_frame(hits.point[rows]), hits.normal[rows] @ axes,
        view @ axes, number, layer.within[rows], alpha, np.array([rays.start, rays.stop]), np.uint64(seed),
        np.zeros(3), total,
    )  # fmt: skip
    return np.maximum(total, 0.0).astype(np.float32)


def dimmed(facing: Floats) -> Floats:
    """Share (n,) of the matte light that leaves through a coat, at this cosine to the eye (n,)."""
    from illumgrid.backends.sight import AT_NORMAL

    return np.asarray((1.0 - AT_NORMAL) * (1.0 - (1.0 - np.clip(facing, 0.0, 1.0)) ** 5))
