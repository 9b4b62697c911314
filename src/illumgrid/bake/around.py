"""Light of built grids at the points of queries, and the nodes or texels on which lookups at these points depend."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from illumgrid.bake.ahead import Ahead
from illumgrid.bake.refined import Chosen
from illumgrid.bake.targets import filled
from illumgrid.bake.walls import at_texels, place_on_walls
from illumgrid.field.scene import Levels, Scene
from illumgrid.field.volume import Floats, world_to_index
from illumgrid.grid import IlluminationGrid
from illumgrid.grid.nodes import reachable
from illumgrid.interpolators.nearest import Nearest
from illumgrid.samplers.direct import Corners, Part, at_nodes, corners
from illumgrid.transport.samples import Queries, Samples, join_queries

BESIDE = 2
"""Nodes on either side of those of a cell, along each axis, from which these may be filled."""


def look_up(grids: Sequence[IlluminationGrid], asked: Queries) -> tuple[Floats, NDArray[np.bool_]]:
    """Light (n, 3) at the points of queries, in the grid of the field of each; and coverage (n,), as `Corners.read`."""
    light, covered = np.zeros((len(asked), 3)), np.zeros(len(asked), bool)
    for number, grid in enumerate(grids):
        own = asked.target == number
        light[own], covered[own] = grid.lookup(asked.point[own]), grid.covered(asked.point[own])
    return light, covered


@dataclass(frozen=True, eq=False)
class Around:
    """Nodes around some points, like `Corners`, for an interpolator that fills nodes from those beside them."""

    scene: Scene
    ahead: Ahead
    points: Queries
    asked: Queries  # one for each such node

    def read(self, samples: Samples) -> tuple[Floats, NDArray[np.bool_]]:
        """Light (n, 3) at the points, and whether (n,) all of their nodes have light of their own."""
        return look_up(list(filled(self.scene, self.ahead.specs, self.ahead.interpolator, [samples])), self.points)


def around(scene: Scene, ahead: Ahead, points: Queries) -> Corners | Around:
    """The nodes on which lookups at points depend: eight per point for `Nearest`, else all that fill the eight."""
    if ahead.interpolator == Nearest():
        return corners(scene, ahead.specs, points)
    sampler, parts = ahead.sampler, list[Queries]()
    for number, (own, spec) in enumerate(zip(scene.fields, ahead.specs)):
        nodes = sampler.nodes[number] if isinstance(sampler, Chosen) else reachable(own, spec)
        index = world_to_index(spec, points.point[points.target == number])
        read = np.zeros(spec.shape, bool)
        for step in 2 ** np.arange(ahead.levels + 1):
            last = (np.array(spec.shape) - 1) // step
            cell = np.unique(np.clip(np.floor(index / step).astype(np.int64), 0, last - 1), axis=0)
            for beside in np.ndindex((2 * BESIDE + 2,) * 3):
                place = np.clip(cell + (np.array(beside) - BESIDE), 0, last) * step
                read[tuple(place.T)] = True
        parts.append(at_nodes(scene, number, spec, nodes[read.reshape(-1)[nodes]]))
    return Around(scene, ahead, points, join_queries(parts))


def texels_around(scene: Scene, levels: Levels, points: Queries) -> Corners:
    """The eight texels that a lookup at each point on a wall reads."""
    quad, u, v, t = place_on_walls(scene, points)

    def part(number: int) -> Part:
        own, (nu, nv), rows = np.flatnonzero(quad == number), scene.quads[number].texels, len(levels.table)
        index = np.stack([t[own] * (rows - 1), v[own] * nv - 0.5, u[own] * nu - 0.5], axis=1)
        return own, (rows, nv, nu), index, partial(at_texels, scene, levels, number)

    return Corners.of(len(points), map(part, np.unique(quad).tolist()))
