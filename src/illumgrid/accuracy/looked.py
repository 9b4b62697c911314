"""Runs whose nodes a first look chooses, as candidates of a plan and of the chart."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from illumgrid.accuracy.reference import look_up
from illumgrid.bake.ahead import Ahead, light_ahead
from illumgrid.bake.bounces import enough_bounces
from illumgrid.bake.refined import Chosen
from illumgrid.bake.targets import of_field
from illumgrid.constants import BASE
from illumgrid.field.lattice import specs_over
from illumgrid.field.scene import Scene, level_table
from illumgrid.field.volume import Floats, world_to_index
from illumgrid.grid import IlluminationGrid, Nodes
from illumgrid.samplers.direct import at_nodes
from illumgrid.transport.samples import Queries, Samples, join_queries
from illumgrid.transport.stages import fill_nodes
from illumgrid.transport.tracer import Tracer

BESIDE = 2
"""Nodes beside those of a cell, along each axis, that these read."""


def looked(scene: Scene, tracer: Tracer, longest: int | None, bounces: int | None, seed: int) -> tuple[Ahead, int]:
    """What `run` lights ahead from a lattice of so many nodes, by default its own, and the bounces that follow."""
    followed = enough_bounces(scene, tracer, seed)[0] if bounces is None else bounces
    ahead = light_ahead(
        scene, specs_over(scene, longest, BASE), level_table(scene, 2), tracer, (None, None, None), refining=True,
        cached=False, automatic=bounces is None, bounces=followed, seed=seed,
    )  # fmt: skip
    return ahead, followed


def filled(scene: Scene, ahead: Ahead, answers: Sequence[Samples]) -> list[IlluminationGrid]:
    """Grids from the light at chosen nodes, or at some of them."""
    return [
        fill_nodes(ahead.interpolator, of_field(scene, answers, number), Nodes(spec, scene.fields[number], number))
        for number, spec in enumerate(ahead.specs)
    ]


@dataclass(frozen=True, eq=False)
class Around:
    """The chosen nodes that a lookup at some points reads, as `illumgrid.samplers.direct.corners` has them."""

    scene: Scene
    ahead: Ahead
    points: Queries
    asked: Queries = field(init=False)  # one for each such node
    nodes: int = field(init=False)  # how many were chosen

    def __post_init__(self) -> None:
        assert self.ahead.refined is not None and isinstance(self.ahead.sampler, Chosen)
        parts, chosen, steps = [], self.ahead.sampler.nodes, 2 ** np.arange(self.ahead.refined["levels"] + 1)
        for number, (spec, nodes) in enumerate(zip(self.ahead.specs, chosen)):
            index = world_to_index(spec, self.points.point[self.points.target == number])
            read = np.zeros(spec.shape, bool)
            for step in steps:
                last = (np.array(spec.shape) - 1) // step
                cell = np.unique(np.clip(np.floor(index / step).astype(np.int64), 0, last - 1), axis=0)
                for beside in np.ndindex((2 * BESIDE + 2,) * 3):
                    place = np.clip(cell + (np.array(beside) - BESIDE), 0, last) * step
                    read[tuple(place.T)] = True
            parts.append(at_nodes(self.scene, number, spec, nodes[read.reshape(-1)[nodes]]))
        object.__setattr__(self, "asked", join_queries(parts))
        object.__setattr__(self, "nodes", sum(map(len, chosen)))

    def read(self, samples: Samples) -> tuple[Floats, NDArray[np.bool_]]:
        """Light (n, 3) at the points, and whether (n,) all of their nodes have light of their own."""
        return look_up(filled(self.scene, self.ahead, [samples]), self.points)
