"""What an eye would see of the error: a picture at an unseen isovalue against the converged one, by FLIP."""

import importlib.util
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid import show as preview
from illumgrid import tone
from illumgrid.accuracy.truth import Truth, apart
from illumgrid.field.scene import Scene, level_table
from illumgrid.field.volume import Floats
from illumgrid.grid import IlluminationGrid, WallTexture
from illumgrid.light import Illumination
from illumgrid.show.engines.software import SIDE
from illumgrid.stages import Backend
from illumgrid.transport.samples import Queries

SHARE = 0.437
"""Of the sweep: where the picture is taken. No sampler in equal steps asks there."""

PATHS = 64


@dataclass(frozen=True, eq=False)
class Shown(Illumination):
    """Light with an exposure of its own, the same for all that are compared. Walls are black."""

    exposure: float = 1.0


@dataclass(frozen=True, eq=False)
class Traced:
    """In place of a grid: paths from every point that is looked up."""

    scene: Scene
    backend: Backend
    field: int
    row: Floats
    bounces: int
    seed: int

    def lookup(self, points: Floats) -> NDArray[np.float32]:
        """Irradiance (n, 3) on the level set of the picture."""
        asked = Queries.at(self.scene, points, field=self.field, level=self.row[self.field])
        return self.backend.solve(
            self.scene, asked, paths=range(PATHS), bounces=self.bounces, seed=apart(self.seed)
        ).mean


@dataclass(frozen=True, eq=False)
class Studio:
    """Takes pictures of grids, and judges them by the converged one.

    Parameters
    ----------
    scene : Scene
    exposure : float
    width, height : int
    converged : (height, width, 3) uint8
    """

    scene: Scene
    exposure: float
    width: int
    height: int
    converged: NDArray[np.uint8]

    @classmethod
    def open(cls, scene: Scene, backend: Backend, truth: Truth, seed: int, paths: float) -> "Studio | None":
        """A studio whose converged picture takes about so many paths; None if that is too few, or without FLIP."""
        height = int(np.sqrt(paths / PATHS / SIDE**2 / (4 / 3) / 0.4))  # a surface covers some 40 % of a picture
        height = min(240, height // 12 * 12)
        if height < 48 or importlib.util.find_spec("flip_evaluator") is None:
            return None
        albedo = np.array([field.material.albedo for field in scene.fields])[truth.queries.target]
        exposure = tone.automatic_exposure(truth.light, albedo)
        row = scene.levels(SHARE)[0]
        grids = [Traced(scene, backend, n, row, truth.bounces, seed) for n in range(len(scene.fields))]
        width = height * 4 // 3
        picture = _taken(scene, grids, exposure, width, height)
        return cls(scene, exposure, width, height, picture)

    def flip(self, grids: list[IlluminationGrid]) -> float:
        """Mean FLIP between the converged picture and that of the grids: 0 the same, 1 as different as can be.

        P. Andersson et al., "FLIP: a difference evaluator for alternating images", Proc. ACM CGIT 3(2), 2020.
        """
        import flip_evaluator

        seen = _taken(self.scene, grids, self.exposure, self.width, self.height)
        pair = [picture.astype(np.float32) / 255 for picture in (self.converged, seen)]
        return float(flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)[1])


def _taken(scene: Scene, grids: list[Any], exposure: float, width: int, height: int) -> NDArray[np.uint8]:
    walls = [
        WallTexture(np.zeros((2, *quad.texels[::-1], 3), np.float32), np.ones((2, *quad.texels[::-1]), np.float32))
        for quad in scene.quads
    ]
    light = Shown(scene, level_table(scene, 2), tuple(grids), tuple(walls), {}, exposure)
    return preview.render(light, isovalue=float(scene.levels(SHARE)[0, 0]), width=width, height=height)
