"""Display-linear colours of a picture's surfaces: the same for every engine."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats
from illumgrid.light import Illumination
from illumgrid.show.caps import light_on_caps
from illumgrid.show.cuts import Clip
from illumgrid.show.looks import Sight, dimmed, displayed, sight_of
from illumgrid.show.tints import Tint
from illumgrid.show.trust import trust_colors
from illumgrid.tone import WHITE, curve, luminance

BACKGROUND = 0.045  # display-linear: a dark neutral, against which white surfaces and their shadows are both visible
CAP_TONE = 0.45  # display radiance of a cap of albedo 1 whose light is unknown: a dark one would look like a hole

Colors = NDArray[np.float32]


def opaque(color: Colors) -> Colors:
    """Colours (..., 4) with full coverage."""
    return np.concatenate([color, np.ones((*color.shape[:-1], 1), np.float32)], axis=-1)


class Coat(NamedTuple):
    """The contribution of coats.

    Parameters
    ----------
    radiance : (n, 3) float32
        Radiance that they reflect to the eye.
    matte : (n,) float64
        Share of the matte light that leaves through them.
    """

    radiance: Colors
    matte: Floats

    @classmethod
    def over(cls, facing: Floats, rows: NDArray[np.int64], radiance: Colors) -> "Coat":
        """Coats over some rows (m,) of n that face the eye by these cosines (n,), and reflect this radiance (m, 3)."""
        whole = cls(np.zeros((len(facing), 3), np.float32), np.ones(len(facing)))
        whole.radiance[rows], whole.matte[rows] = radiance, dimmed(facing[rows])
        return whole


@dataclass(frozen=True, eq=False)
class Shown:
    """One setting of the sweep, and its lighting.

    Parameters
    ----------
    light : Illumination
    row : (F,) float64
        Isovalue of every field.
    share : float
        Position in the common sweep, 0 to 1, at which wall textures are read.
    local : bool
        Use a lamp at the camera, without shadows, instead of the stored light.
    trust : bool
        Show the relative error bar instead of light: see `illumgrid.show.trust`.
    stops : float
        Exposure beyond the automatic one, in EV: each doubles the light.
    clips : tuple of Clip
        Clip planes.
    tint : Tint, optional
        Colours of all fields, instead of their albedos.
    """

    light: Illumination
    row: Floats
    share: float
    local: bool = False
    trust: bool = False
    stops: float = 0.0
    clips: tuple[Clip, ...] = ()
    tint: Tint | None = None

    @cached_property
    def scene(self) -> Scene:
        """Scene that is lit."""
        return self.light.scene

    @cached_property
    def displayed(self) -> Scene:
        """Scene with the materials that are shown."""
        return displayed(self.scene)

    @cached_property
    def sight(self) -> Sight:
        """The scene laid out for rays through films and coats."""
        return sight_of(self)

    @property
    def plain(self) -> bool:
        """Whether triangles can show it: no films, no coats, no cuts."""
        return self.matte and not self.clips

    @property
    def matte(self) -> bool:
        """Whether it has neither films nor coats."""
        return all(field.material.plain for field in self.scene.fields)

    @cached_property
    def exposure(self) -> float:
        """Factor on albedo/π · E."""
        return self.light.exposure * float(2.0**self.stops)

    def field(
        self, number: int, points: Floats, facing: Floats, light: Colors | None = None, coat: Coat | None = None
    ) -> Colors:
        """Colours (n, 3) of the level set of a field at world points (n, 3) that face the eye by this cosine (n,).

        Irradiance `light` (n, 3), if any, takes the place of a lookup.
        """
        if self.trust:
            return trust_colors(self.light.grids[number], points, facing)
        material = self.displayed.fields[number].material
        albedo = material.albedo
        kept = 1.0 - material.transmission
        if self.local:
            color = kept * albedo / albedo.max(initial=1e-9)
            return self._lamplit(color if self.tint is None else kept * self.tint.colors(points), facing)
        light = self.light.grids[number].lookup(points, self.share) if light is None else light
        if self.tint is not None:
            bright = luminance(curve(light * np.float32(self.exposure / np.pi)))
            shown = np.float32(kept) * bright[:, None] * self.tint.colors(points)
        else:
            shown = light * (albedo / np.pi * self.exposure).astype(np.float32)
        if coat is not None:
            shown = shown * coat.matte[:, None].astype(np.float32) + coat.radiance * np.float32(self.exposure)
        return curve(shown)

    @cached_property
    def caps(self) -> tuple[Colors, ...]:
        """Irradiance of the faces of each field's box: see `illumgrid.show.caps.light_on_caps`."""
        return tuple(light_on_caps(self.light, number) for number in range(len(self.scene.fields)))

    def cap(self, number: int, points: Floats, face: NDArray[np.integer], facing: Floats) -> Colors:
        """Colours (n, 3) of caps of a field at world points (n, 3) on these faces (n,) of its box, -1 on inner sides.

        A plain tone where their light is unknown, and in pictures of error bars.
        """
        if self.local and not self.trust:
            return self.field(number, points, facing)
        albedo = np.full(3, 0.5) if self.trust else self.displayed.fields[number].material.albedo
        color = np.tile((CAP_TONE * albedo).astype(np.float32), (len(points), 1))
        if not self.trust:
            light = self.caps[number][face]
            lit = np.flatnonzero((face >= 0) & np.isfinite(light[:, 0]))
            color[lit] = self.field(number, points[lit], facing[lit], light[lit])
        return color

    def wall(self, number: int, u: Floats, v: Floats, facing: Floats, light: Colors | None = None) -> Colors:
        """Colours (n, 3) of the front of a quad at shares u, v (n,) of its edges; `light` as for `field`."""
        material = self.scene.quads[number].material
        if self.trust:  # walls have no error bar: grey, which is no colour of the scale
            return _facing(np.full(3, 0.5 * CAP_TONE), facing)
        if self.local:
            return self._lamplit(np.maximum(material.albedo, material.emission.clip(0, 1)), facing)
        light = self.light.walls[number].lookup(u, v, self.share) if light is None else light
        shown = material.albedo / np.pi * light + material.emission
        return curve((shown * self.exposure).astype(np.float32))

    def fade(self, number: int, u: Floats, v: Floats) -> Colors:
        """Coverage (n,) of a quad at shares u, v (n,) of its edges: a floor under the open sky fades out."""
        if not fades(self.scene, number):
            return np.ones(len(u), np.float32)
        rim = np.hypot(2 * u - 1, 2 * v - 1)  # a disc within the quad
        share = np.clip((1.0 - rim) / 0.6, 0.0, 1.0)
        return np.asarray(share * share * (3 - 2 * share), np.float32)

    def _lamplit(self, color: NDArray[np.floating], facing: Floats) -> Colors:
        return curve(np.float32(2.0**self.stops * WHITE) * _facing(color, facing))


def fades(scene: Scene, number: int) -> bool:
    """Whether a quad is the floor under an open sky, which pictures let fade out."""
    return scene.open and len(scene.quads) == 1 and not scene.quads[number].material.emission.any()


def _facing(color: NDArray[np.floating], facing: Floats) -> Colors:
    return (color * np.maximum(facing, 0.0)[:, None]).astype(np.float32)
