"""Display-linear colours of what a picture shows: the same for every engine."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats
from illumgrid.show.trust import trust_colors
from illumgrid.tone import WHITE

if TYPE_CHECKING:
    from illumgrid.light import Illumination

BACKGROUND = 0.045  # display-linear: a dark neutral, against which white surfaces and their shadows both stand out
CAP_TONE = 0.22  # display radiance of a cap, for albedo 1: caps are cuts, not lit surfaces

Colors = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Shown:
    """One setting of the sweep, and how it is lit.

    Parameters
    ----------
    light : Illumination
    row : (F,) float64
        Isovalue of every field.
    share : float
        The place in the common sweep, 0 to 1, as the walls know it.
    local : bool
        Light by a lamp at the camera only.
    trust : bool
        In place of light, how sure it is: see `illumgrid.show.trust`.
    """

    light: "Illumination"
    row: Floats
    share: float
    local: bool
    trust: bool = False

    @cached_property
    def scene(self) -> Scene:
        """Scene that is lit."""
        return self.light.scene

    def field(self, number: int, points: Floats, facing: Floats) -> Colors:
        """Colours (n, 3) of the level set of a field at world points (n, 3) that face the eye by this cosine (n,)."""
        if self.trust:
            return trust_colors(self.light.grids[number], points, facing)
        albedo = self.scene.fields[number].material.albedo
        if self.local:
            return np.float32(WHITE) * _headlit(albedo / albedo.max(initial=1e-9), facing)
        return self.light.grids[number].lookup(points) * (albedo / np.pi * self.light.exposure).astype(np.float32)

    def cap(self, number: int) -> Colors:
        """Colour (3,) of the cuts through the solid of a field."""
        if self.trust:
            return np.full(3, CAP_TONE, np.float32)
        return (CAP_TONE * self.scene.fields[number].material.albedo).astype(np.float32)

    def wall(self, number: int, u: Floats, v: Floats, facing: Floats) -> Colors:
        """Colours (n, 3) of the front of a quad at shares u, v (n,) of its edges."""
        material = self.scene.quads[number].material
        if self.trust:  # no bar is known there: no colour that could be taken for one
            return _headlit(np.full(3, CAP_TONE), facing)
        if self.local:
            return np.float32(WHITE) * _headlit(np.maximum(material.albedo, material.emission.clip(0, 1)), facing)
        shown = material.albedo / np.pi * self.light.walls[number].lookup(u, v, self.share) + material.emission
        return (shown * self.light.exposure).astype(np.float32)


def _headlit(color: Floats, facing: Floats) -> Colors:
    return (color * np.maximum(facing, 0.0)[:, None]).astype(np.float32)
