"""The error of the light of walls: at places on them and in the sweep at which no texel and no row of the table is."""

import numpy as np

from illumgrid.accuracy.points import other_paths
from illumgrid.field.scene import Scene
from illumgrid.transport.samples import Queries


def unseen_on_walls(scene: Scene, points: int, seed: int) -> Queries:
    """Points uniform by area on the fronts of quads that reflect, each at a setting of the sweep of its own."""
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
