"""Texels for an asked error: how far walls of some texels would be off, before they are lit.

As for grids: a lookup on a wall reads eight texels, two of each axis and two rows of the sweep. Those around some
points are lit, and what they hold there is compared with the light at the points.
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
"""Texels along each edge that are tried, for each of the scene's."""
POINTS, REFERENCE_PATHS, PATHS = 512, 128, 16
SHARE = 0.7  # of the asked error that texels may be off: the rest is noise
GAIN = 0.9  # of the error of coarser texels, above which finer ones are not worth their time


@dataclass(frozen=True)
class Walls:
    """How finely walls are divided, and by how much reading between texels and rows is then off, relative."""

    finer: float  # texels along each edge for each of the scene's
    off: float


def walls_for(scene: Scene, tracer: Tracer, levels: Levels, bounces: int, error: float, seed: int) -> Walls | None:
    """The fewest texels, from the scene's up, between which light is off by less than its share of an error.

    Where none will do, as where rows of the sweep are too far apart, the fewest that are not much worse than the best;
    None without walls to show, and in the dark.
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
