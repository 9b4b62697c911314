"""Points at which a grid is judged: on level sets of the whole range, where neither grids nor probes asked."""

import numpy as np

from illumgrid.field.scene import Scene
from illumgrid.rng import shifted_seed
from illumgrid.samplers.coarea import points_on_level_sets
from illumgrid.stages import on_level_sets
from illumgrid.transport.samples import Queries, join_queries


def other_paths(seed: int) -> int:
    """A seed whose paths have nothing in common with those of `seed`."""
    return shifted_seed(seed, 2**63)


def unseen_on_level_sets(scene: Scene, levels: int, points: int, seed: int) -> Queries:
    """About `points` uniform by area on level sets of their own, one at random from each of `levels` equal steps."""
    random = np.random.default_rng((other_paths(seed), 1))
    rows = scene.levels((np.arange(levels) + random.random(levels)) / levels)
    each = max(1, round(points / (levels * len(scene.fields))))
    none = Queries.at(scene, np.zeros((0, 3)))
    found = join_queries([none, *on_level_sets(scene, rows, other_paths(seed), points=each)])
    return found[np.flatnonzero(found.normal.any(axis=1))]


def unseen_in_volume(scene: Scene, points: int, seed: int) -> Queries:
    """As `unseen_on_level_sets`, but each point on a level set of its own, and no surface is extracted."""
    return points_on_level_sets(scene, points, (other_paths(seed), 2))
