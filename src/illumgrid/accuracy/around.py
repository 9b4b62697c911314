"""Runs before they are built: what they light ahead, and the nodes that a lookup at some points reads."""

from collections.abc import Sequence
from dataclasses import dataclass

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
from illumgrid.grid import GridSpec, IlluminationGrid, Nodes
from illumgrid.grid.nodes import reachable
from illumgrid.interpolators.nearest import Nearest
from illumgrid.samplers.direct import Corners, Direct, at_nodes, corners
from illumgrid.transport.samples import Queries, Samples, join_queries
from illumgrid.transport.stages import fill_nodes
from illumgrid.transport.tracer import Tracer

BESIDE = 2
"""Nodes beside those of a cell, along each axis, that these read."""


def lattice(specs: Sequence[GridSpec], tracer: Tracer, bounces: int) -> Ahead:
    """All nodes of some lattices, with nothing lit ahead."""
    return Ahead(specs, Direct(), tracer, Nearest(), bounces=bounces)


def looked(scene: Scene, tracer: Tracer, longest: int | None, bounces: int | None, seed: int) -> Ahead:
    """What `run` lights ahead from a lattice of so many nodes; by default its own nodes and bounces."""
    return light_ahead(
        scene, specs_over(scene, longest, BASE), level_table(scene, 2), tracer, (None, None, None), refining=True,
        cached=False, automatic=bounces is None, seed=seed,
        bounces=enough_bounces(scene, tracer, seed)[0] if bounces is None else bounces,
    )  # fmt: skip


def filled(scene: Scene, ahead: Ahead, answers: Sequence[Samples]) -> list[IlluminationGrid]:
    """Grids from the light at all nodes of a run, or at some of them."""
    return [
        fill_nodes(ahead.interpolator, of_field(scene, answers, number), Nodes(spec, scene.fields[number], number))
        for number, spec in enumerate(ahead.specs)
    ]


@dataclass(frozen=True, eq=False)
class Around:
    """Nodes around some points, as `Corners`, of a run whose nodes read those beside them."""

    scene: Scene
    ahead: Ahead
    points: Queries
    asked: Queries  # one for each such node
    nodes: int  # how many the whole would have to light

    def read(self, samples: Samples) -> tuple[Floats, NDArray[np.bool_]]:
        """Light (n, 3) at the points, and whether (n,) all of their nodes have light of their own."""
        return look_up(filled(self.scene, self.ahead, [samples]), self.points)


def around(scene: Scene, ahead: Ahead, points: Queries) -> Corners | Around:
    """The nodes that a lookup at some points reads: the eight of each point, or as many as fill those."""
    if ahead.interpolator == Nearest():
        return corners(scene, ahead.specs, points)
    sampler, levels = ahead.sampler, ahead.refined["levels"] if ahead.refined else 0
    parts, count = [], 0
    for number, (own, spec) in enumerate(zip(scene.fields, ahead.specs)):
        nodes = sampler.nodes[number] if isinstance(sampler, Chosen) else reachable(own, spec)
        index = world_to_index(spec, points.point[points.target == number])
        read = np.zeros(spec.shape, bool)
        for step in 2 ** np.arange(levels + 1):
            last = (np.array(spec.shape) - 1) // step
            cell = np.unique(np.clip(np.floor(index / step).astype(np.int64), 0, last - 1), axis=0)
            for beside in np.ndindex((2 * BESIDE + 2,) * 3):
                place = np.clip(cell + (np.array(beside) - BESIDE), 0, last) * step
                read[tuple(place.T)] = True
        parts.append(at_nodes(scene, number, spec, nodes[read.reshape(-1)[nodes]]))
        count += len(nodes)
    return Around(scene, ahead, points, join_queries(parts), count)
