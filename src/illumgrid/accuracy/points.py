"""Points at which errors are measured: on level sets and walls, between the nodes, texels and rows of a run."""

import numpy as np

from illumgrid.field.scene import Scene
from illumgrid.rng import shifted_seed
from illumgrid.samplers.coarea import points_on_level_sets
from illumgrid.stages import on_level_sets
from illumgrid.transport.samples import Queries, join_queries


def other_paths(seed: int) -> int:
    """A seed whose paths are independent of those of `seed`."""
    return shifted_seed(seed, 2**63)


def unseen_on_level_sets(scene: Scene, levels: int, points: int, seed: int) -> Queries:
    """About `points` points, uniform by area on random level sets: one in each of `levels` equal steps of the sweep."""
    random = np.random.default_rng((other_paths(seed), 1))
    rows = scene.levels((np.arange(levels) + random.random(levels)) / levels)
    each = max(1, round(points / (levels * len(scene.fields))))
    none = Queries.at(scene, np.zeros((0, 3)))
    found = join_queries([none, *on_level_sets(scene, rows, other_paths(seed), points=each)])
    return found[np.flatnonzero(found.normal.any(axis=1))]


def unseen_in_volume(scene: Scene, points: int, seed: int) -> Queries:
    """Like `unseen_on_level_sets`, but each point has a level set of its own, and no surface is extracted."""
    return points_on_level_sets(scene, points, (other_paths(seed), 2))


def unseen_on_walls(scene: Scene, points: int, seed: int) -> Queries:
    """Points uniform by area on the fronts of quads that reflect, each at a random position of the sweep."""
    shown = [number for number, quad in enumerate(scene.quads) if quad.material.albedo.any()]
    if not shown:
        return Queries.at(scene, np.zeros((0, 3)))
    random = np.random.default_rng((other_paths(seed), 3))
    area = np.array([scene.quads[number].area for number in shown])
    chosen = np.sort(np.array(shown)[random.choice(len(shown), points, p=area / area.sum())])
    u, v, t = random.random((3, points))
    corner, along, across, normal = (
        np.array([getattr(quad, name) for quad in scene.quads])[chosen]
        for name in ("corner", "edge_u", "edge_v", "normal")
    )
    target = (chosen + len(scene.fields)).astype(np.int32)
    return Queries(
        id=np.arange(points, dtype=np.uint64) | target.astype(np.uint64) << np.uint64(40),
        point=corner + u[:, None] * along + v[:, None] * across,
        normal=normal,
        level=scene.levels(t),
        target=target,
    )
