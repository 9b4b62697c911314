"""The visible effect of an error: a picture at an unseen isovalue against the converged one, by FLIP."""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.scene import Scene, level_table
from illumgrid.field.volume import Floats
from illumgrid.grid import IlluminationGrid, WallTexture
from illumgrid.grid.channels import RGB, Channels
from illumgrid.light import Illumination
from illumgrid.rng import shifted_seed
from illumgrid.show import render
from illumgrid.show.engines.software import SIDE
from illumgrid.transport.samples import Queries
from illumgrid.transport.tracer import Tracer

PLACE = 0.437  # position in the sweep of the picture: samplers in equal steps have no level there
PATHS = 64  # paths from every point of the converged picture


@dataclass(frozen=True, eq=False)
class Shown(Illumination):
    """Light with a fixed exposure, the same for all that are compared. Walls are black."""

    exposure: float = 1.0


@dataclass(frozen=True, eq=False)
class Traced:
    """Replaces a grid: paths from every visible point."""

    scene: Scene
    tracer: Tracer
    field: int
    bounces: int
    seed: int
    channels: ClassVar[Channels] = RGB  # of caps: all light together

    def lookup(self, points: Floats, t: float = PLACE) -> NDArray[np.float32]:
        """Irradiance (n, 3) on the level set of the picture, at `t` in the sweep."""
        level = self.scene.levels(t)[0, self.field]
        asked = Queries.at(self.scene, points, field=self.field, level=level)
        return self.tracer.solve(asked, paths=range(PATHS), bounces=self.bounces, seed=self.seed).mean


def studio(
    scene: Scene, tracer: Tracer, exposure: float, bounces: int, seed: int, paths: float
) -> Callable[[list[IlluminationGrid]], float] | None:
    """A function from grids to the FLIP of their picture: 0 is the same as the converged one, 1 as different as can be.

    Parameters
    ----------
    scene : Scene
    tracer : Tracer
        For the converged picture.
    exposure : float
        The same for all pictures.
    bounces, seed : int
    paths : float
        About how many the converged picture may take.

    Returns
    -------
    callable or None
        None if the paths are too few for a picture, or FLIP is not installed.

    References
    ----------
    .. [1] P. Andersson et al., "FLIP: a difference evaluator for alternating images", Proc. ACM CGIT 3(2), 2020.
    """
    height = int(np.sqrt(paths / PATHS / SIDE**2 / (4 / 3) / 0.4))  # a surface covers about 40 % of a picture
    height = min(240, height // 12 * 12)
    if height < 48 or importlib.util.find_spec("flip_evaluator") is None:
        return None
    own_seed = shifted_seed(seed, 2**63)
    walls = tuple(
        WallTexture(np.zeros((2, *quad.texels[::-1], 3), np.float32), np.ones((2, *quad.texels[::-1]), np.float32))
        for quad in scene.quads
    )

    def picture(grids: list[Any]) -> NDArray[np.float32]:
        light = Shown(scene, level_table(scene, 2), tuple(grids), walls, {}, {}, exposure)
        isovalue = float(scene.levels(PLACE)[0, 0])
        shown = render(light, isovalue=isovalue, width=height * 4 // 3, height=height)
        return shown.astype(np.float32) / np.float32(255)

    converged = picture([Traced(scene, tracer, n, bounces, own_seed) for n in range(len(scene.fields))])

    def flip(grids: list[IlluminationGrid]) -> float:
        import flip_evaluator

        return float(flip_evaluator.evaluate(converged, picture(grids), "LDR", applyMagma=False)[1])

    return flip
