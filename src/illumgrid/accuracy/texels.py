"""Choose the texels of walls for a requested error, from the error of several choices before walls are lit.

As for grids: a lookup on a wall reads eight texels, two along each axis in each of two rows of the sweep. Those around
some points are lit, and the light interpolated from them is compared with a reference at the points.
"""

from dataclasses import dataclass

import numpy as np

from illumgrid.accuracy.points import unseen_on_walls
from illumgrid.accuracy.reference import begin, parts_of
from illumgrid.bake.accumulator import Bake
from illumgrid.bake.around import texels_around
from illumgrid.field.scene import Levels, Scene, finer_texels
from illumgrid.rng import shifted_seed
from illumgrid.transport.tracer import Tracer

FINER = (1.0, 2**0.5, 2.0, 8**0.5, 4.0)
"""Factors that are tried, on the scene's number of texels along each edge."""
POINTS, REFERENCE_PATHS, PATHS = 512, 128, 16
SHARE = 0.7  # fraction of the requested error that interpolation between texels may cause: the rest is for noise
GAIN = 0.9  # finer texels are worth their time if their error is below this fraction of that of coarser ones


@dataclass(frozen=True)
class Walls:
    """Texels of walls, and the relative error of interpolation between them and between rows."""

    finer: float  # factor on the scene's number of texels along each edge
    off: float


def walls_for(scene: Scene, tracer: Tracer, levels: Levels, bounces: int, error: float, seed: int) -> Walls | None:
    """Choose the fewest texels, at least the scene's, with an interpolation error of at most `SHARE` of `error`.

    If none suffice, for instance if rows of the sweep are too far apart: the fewest that are not much worse than the
    best. None without walls that reflect, or without light on them.
    """
    truth = begin(tracer, unseen_on_walls(scene, POINTS, seed), bounces, seed, REFERENCE_PATHS)
    if not truth.mean > 0:
        return None
    seeds, best = (seed, shifted_seed(seed, 2**62)), Walls(0.0, np.inf)
    for finer in FINER:
        around = texels_around(finer_texels(scene, finer), levels, truth.queries)
        bakes = (Bake.of([around.asked], bounces, s).walk(tracer, range(PATHS)) for s in seeds)
        (one, covered), (other, _) = (around.read(bake.samples) for bake in bakes)
        parts = parts_of(one, other, covered, truth, truth)
        walls = Walls(finer, float(np.sqrt(max(parts.grid + parts.uncovered, 0.0))))
        if walls.off <= SHARE * error:
            return walls
        best = walls if walls.off < GAIN * best.off else best
    return best
