"""How many reflections a scene needs."""

import numpy as np

from illumgrid.field.scene import Scene
from illumgrid.grid import GridSpec
from illumgrid.samplers.direct import Direct
from illumgrid.transport.samples import Queries, join_queries
from illumgrid.transport.tracer import Tracer

LEAST = 8
"""Least number of reflections: deep folds lose more than the mean, and long paths are few."""
SHORT = 4
"""Reflections that bring 99 % of the light where paths are short."""
LEFT_OUT = 0.01


def _on_few_rows(scene: Scene, seed: int, rows: int = 4, count: int = 32) -> Queries:
    """About `count` queries on each of a few rows of the sweep, at the nodes of a coarse grid.

    Few rows, because a backend that traces meshes builds one per row. The nodes of all fields, sorted by their position
    in the sweep, are divided into equal parts; those nearest to the middle of a part move onto its row.
    """
    specs = [GridSpec.over(field.volume, 10) for field in scene.fields]
    nodes = join_queries([q for q in Direct().queries(scene, specs, seed) if len(q)])
    place = np.zeros(len(nodes))
    for number, field in enumerate(scene.fields):
        own = nodes.target == number
        place[own] = field.place(nodes.level[own, number])
    shuffled = np.random.default_rng(seed).permutation(len(nodes))  # many lie at an end of the range
    asked = []
    for number, part in enumerate(np.array_split(shuffled[np.argsort(place[shuffled], kind="stable")], rows)):
        middle = place[part[len(part) // 2]] if len(part) else 0.0
        near = part[np.argsort(np.abs(place[part] - middle), kind="stable")[:count]]
        for target in np.unique(nodes.target[near]):
            points = nodes.point[near[nodes.target[near] == target]]
            level = scene.levels(middle)[0, target]
            first = (number * len(scene.fields) + int(target)) * count
            asked.append(Queries.at(scene, points, field=int(target), level=level, first_id=first))
    return join_queries(asked)


def light_left_out(scene: Scene, tracer: Tracer, bounces: int, seed: int = 0) -> float:
    """Share of all light that more than `bounces` reflections would add, from a few paths on a coarse grid.

    The paths with more bounces begin as those with fewer, so that the difference is light and not noise.
    """
    asked = _on_few_rows(scene, seed)
    if not len(asked):
        return 0.0
    mean = [
        float(tracer.solve(asked, paths=range(16), bounces=b, seed=seed).mean.mean())
        for b in (bounces, 3 * bounces + 20)
    ]
    return 1.0 - mean[0] / mean[1] if mean[1] > 0 else 0.0


def enough_bounces(scene: Scene, tracer: Tracer, seed: int = 0, limit: float = LEFT_OUT) -> tuple[int, float]:
    """Number of reflections that leaves out less light than the limit, at least `LEAST`, and the share left out."""
    bounces, left_out = LEAST, light_left_out(scene, tracer, LEAST, seed)
    while bounces < 128 and left_out >= limit:
        bounces += max(1, bounces // 4)
        left_out = light_left_out(scene, tracer, bounces, seed)
    return bounces, left_out


def has_long_paths(scene: Scene, tracer: Tracer, seed: int = 0) -> bool:
    """Whether light needs many reflections: then lighting a coarse grid first pays off, since most paths end there."""
    return light_left_out(scene, tracer, SHORT, seed) >= LEFT_OUT
