"""What the machine takes for a node and for a path, measured on nodes that lie as they do in a run."""

import time
import timeit
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from illumgrid.field.scene import Scene
from illumgrid.grid import GridSpec, Nodes
from illumgrid.grid.nodes import reachable
from illumgrid.interpolators.nearest import Nearest
from illumgrid.samplers.direct import at_nodes
from illumgrid.transport.tracer import Tracer


@dataclass(frozen=True)
class Pace:
    """Seconds for each node and for each path of a node."""

    node: float
    path: float

    def seconds(self, nodes: int, paths: int) -> float:
        """Predicted time of a run."""
        return nodes * (self.node + paths * self.path)

    def paths_in(self, seconds: float, nodes: int) -> int:
        """Paths from each of the nodes that the time allows, an even number; below 0 if it allows none."""
        return 2 * int((seconds / nodes - self.node) / self.path / 2)


def measure_pace(
    scene: Scene, tracer: Tracer, specs: Sequence[GridSpec], paths: int, bounces: int, seed: int, about: int = 1 << 16
) -> Pace:
    """Time `about` paths, and the making and filling of nodes, on runs of 64 neighbouring nodes of each field."""
    random = np.random.default_rng((seed, 3))
    per_path, per_node = [], []
    for number, spec in enumerate(specs):
        nodes, field = reachable(scene.fields[number], spec), scene.fields[number]
        starts = random.integers(0, len(nodes), (max(1, min(len(nodes), 1 << 13) // 64), 1))
        many = nodes[(starts + np.arange(64)).ravel() % len(nodes)]
        asked = at_nodes(scene, number, spec, many[: max(256, about // paths)])
        tracer.solve(asked[:1], paths=range(2), bounces=bounces, seed=seed)  # loads what is compiled
        begun = time.perf_counter()
        answer = tracer.solve(asked, paths=range(paths), bounces=bounces, seed=seed)
        per_path.append((time.perf_counter() - begun) / (len(asked) * paths))
        # Few nodes would cost as much as many; and the least of three, for in so short a time a stall counts for many.
        small = GridSpec.over(field.volume, 24)
        asking = timeit.repeat(partial(at_nodes, scene, number, spec, many), number=1, repeat=3)
        filling = timeit.repeat(partial(Nearest().fill, answer, Nodes(small, field, number)), number=1, repeat=3)
        per_node.append(min(asking) / len(many) + min(filling) / int(np.prod(small.shape)))
    return Pace(float(np.mean(per_node)), float(np.mean(per_path)))
