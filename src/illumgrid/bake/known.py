"""A coarse grid that is lit first, in which the paths of the fine one end."""

from collections.abc import Sequence
from typing import Any

from illumgrid.bake import bake
from illumgrid.field.scene import Levels, Scene, level_table
from illumgrid.grid import GridSpec
from illumgrid.grid.cache import cache_of
from illumgrid.interpolators.nearest import Nearest
from illumgrid.rng import shifted_seed
from illumgrid.samplers.direct import Direct
from illumgrid.transport.tracer import Tracer, ending_in

COARSE, COARSE_PATHS = 0.7, 4
"""Nodes of a cache relative to those of the grid, along an axis, and paths per node."""

MOST_BIAS = 0.003
"""Largest bias of paths that end in a cache, relative to the mean light; a test checks it on four scenes."""


def light_known_first(
    scene: Scene, specs: Sequence[GridSpec], levels: Levels, tracer: Tracer, *, bounces: int, seed: int, **how: Any
) -> Tracer:
    """The same tracer, whose paths end in the light of a coarser grid, which is computed here.

    The coarse light has its own paths and random numbers, and walls at every other row of levels.

    Parameters
    ----------
    specs : sequence of GridSpec
        Nodes that will be lit afterwards.
    bounces : int
        Of the paths that will be traced. Those of the cache have twice as many: the light falls by the same factor with
        each bounce, so the share that they omit is the square of the share omitted by `bounces`.
    **how
        `map` and `progress` of `bake`.
    """
    sizes = [max(2, round(COARSE * max(spec.shape))) for spec in specs]
    coarse = [GridSpec.over(field.volume, size) for field, size in zip(scene.fields, sizes)]
    rows = level_table(scene, max(2, len(levels.table) // 2))
    known = bake(
        scene, coarse, rows, Direct(), tracer, Nearest(), paths=[range(COARSE_PATHS)],
        bounces=2 * bounces, seed=shifted_seed(seed, 2**60), **how,
    )  # fmt: skip
    return ending_in(cache_of(scene, known.grids, known.walls), tracer)
