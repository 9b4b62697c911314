"""One query at each node: light decoupled from the extraction of surfaces.

Banks and Beason, "Decoupling illumination from isosurface generation using 4D light transport", TVCG 2009.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats, index_to_world, interpolate, project, world_to_index
from illumgrid.field.volume import corners as corners_of
from illumgrid.grid import GridSpec
from illumgrid.grid.nodes import reachable
from illumgrid.stages import Sampler, hookimpl
from illumgrid.transport.samples import Queries, Samples, join_queries

_BATCH = 1 << 14

Part = tuple[NDArray[np.intp], tuple[int, ...], Floats, Callable[[NDArray[np.int64]], Queries]]
"""Which points lie in a lattice, its shape, their places (n, 3) in it, and a function from node numbers to queries."""


def at_nodes(scene: Scene, field: int, spec: GridSpec, nodes: NDArray[np.integer]) -> Queries:
    """Queries of `Direct` at the nodes with these flat numbers, which become their ids."""
    own, points = scene.fields[field], spec.nodes(nodes)
    index = world_to_index(own.volume, points)
    isovalues = interpolate(own.volume, index)
    # A rim node stands for the end of the range: light of a level outside the sweep would be wrong there (at the value
    # of an empty background everything is solid, and dark). A projection moves at most one voxel, so a node of a
    # coarser grid moves there over intermediate isovalues.
    level = np.clip(isovalues, *own.range)
    rim = np.flatnonzero(level != isovalues)
    steps = int(np.ceil((spec.spacing / own.volume.spacing).max() - 1e-9))
    for step in range(1, steps):
        between = isovalues[rim] + (level - isovalues)[rim] * step / steps
        moved, arrived = project(own.volume, index[rim], between)
        index[rim[arrived]] = moved[arrived]
    points[rim] = index_to_world(own.volume, index[rim]) if steps > 1 else points[rim]
    asked = Queries.at(scene, points, field=field, level=level)
    ids = nodes.astype(np.uint64) | np.uint64(field << 40)
    return Queries(ids, asked.point, asked.normal, asked.level, asked.target)


@dataclass(frozen=True)
class Direct:
    """One query on each grid node that the sweep can reach, on the level set through the node itself.

    For a rim node, whose own isovalue lies outside the range, the query is moved along the gradient onto the level set
    at the nearest end of the range.
    """

    name: ClassVar[str] = "direct"

    def queries(self, scene: Scene, specs: Sequence[GridSpec], seed: int) -> Iterator[Queries]:
        """Queries at the nodes, with their flat numbers as ids: see `illumgrid.stages.Sampler`."""
        for number, (field, spec) in enumerate(zip(scene.fields, specs)):
            nodes = reachable(field, spec)
            for first in range(0, len(nodes), _BATCH):
                yield at_nodes(scene, number, spec, nodes[first : first + _BATCH])


class NodeQueries(Queries):
    """The queries of `Direct` at nodes of one field, stored as the nodes' numbers: 4 bytes each.

    At all nodes that the sweep can reach, or at those whose numbers are given.

    Rows of it are plain queries; `point`, `normal` and `level` are computed on each access, some nodes at a time.
    """

    scene: Scene
    field: int
    spec: GridSpec
    node: NDArray[np.integer]

    def __init__(self, scene: Scene, field: int, spec: GridSpec, node: NDArray[np.integer] | None = None) -> None:
        node = reachable(scene.fields[field], spec) if node is None else node
        node = node.astype(np.int32) if np.prod(spec.shape) < 1 << 31 else node
        for name, value in zip(("scene", "field", "spec", "node"), (scene, field, spec, node)):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.node)

    def __getitem__(self, rows: slice | NDArray[np.bool_] | NDArray[np.integer]) -> Queries:
        node = self.node[rows].astype(np.int64)
        parts = [node[first : first + _BATCH] for first in range(0, len(node), _BATCH)] or [node]
        found = [at_nodes(self.scene, self.field, self.spec, part) for part in parts]  # the results need more memory
        return found[0] if len(found) == 1 else join_queries(found)

    def _all(self, name: str) -> Floats:
        whole = np.empty((len(self), *getattr(self[:0], name).shape[1:]))
        for first in range(0, len(self), _BATCH):
            some = slice(first, first + _BATCH)
            whole[some] = getattr(self[some], name)
        return whole

    @property
    def id(self) -> NDArray[np.uint64]:
        """Flat numbers of the nodes, with the number of the field in the upper bits."""
        return self.node.astype(np.uint64) | np.uint64(self.field << 40)

    @property
    def target(self) -> NDArray[np.int32]:
        """The number of the field."""
        return np.full(len(self), self.field, np.int32)

    @property
    def point(self) -> Floats:
        """Computed on each access."""
        return self._all("point")

    @property
    def normal(self) -> Floats:
        """Computed on each access."""
        return self._all("normal")

    @property
    def level(self) -> Floats:
        """Computed on each access."""
        return self._all("level")


@dataclass(frozen=True, eq=False)
class Corners:
    """The nodes, or texels, that lookups at some points read, of a grid that is never computed as a whole."""

    asked: Queries  # one for each such node
    row: NDArray[np.int64]  # (n, 8): positions in `asked` of the nodes of each point
    weight: Floats  # (n, 8): trilinear weights

    @classmethod
    def of(cls, points: int, parts: Iterable[Part]) -> "Corners":
        """Gather the nodes of all points from parts, one lattice for some of the points each."""
        row, weight = np.zeros((points, 8), np.int64), np.zeros((points, 8))
        found, first = list[Queries](), 0
        for own, shape, index, ask in parts:
            around, share = zip(*corners_of(np.broadcast_to(0, shape), index))
            flat = [np.ravel_multi_index(tuple(node.T), shape, mode="clip") for node in around]  # an axis may have one
            unique, place = np.unique(np.stack(flat, axis=1), return_inverse=True)
            row[own], weight[own] = first + place.reshape(-1, 8), np.stack(share, axis=1)
            found.append(ask(unique))
            first += len(unique)
        return cls(join_queries(found), row, weight)

    def read(self, samples: Samples) -> tuple[Floats, NDArray[np.bool_]]:
        """Light (n, 3) at the points, and whether (n,) all of their nodes have light of their own.

        A node without light counts as the mean of the others, which is close to one filled from a neighbour.
        """
        lit = (samples.paths > 0)[self.row] & (self.weight > 0)
        weight = np.where(lit, self.weight, 0.0)
        total = weight.sum(axis=1, keepdims=True)
        light = np.einsum("nk,nkc->nc", weight, samples.mean[self.row].astype(float)) / np.where(total > 0, total, 1.0)
        return light, np.asarray((lit | (self.weight == 0)).all(axis=1))


def corners(scene: Scene, specs: Sequence[GridSpec], points: Queries) -> Corners:
    """The nodes around the points of queries in grids with these lattices, one per field."""

    def part(number: int, spec: GridSpec) -> Part:
        own = np.flatnonzero(points.target == number)
        return own, spec.shape, world_to_index(spec, points.point[own]), partial(at_nodes, scene, number, spec)

    return Corners.of(len(points), [part(number, spec) for number, spec in enumerate(specs)])


@hookimpl
def register_samplers() -> list[type[Sampler]]:
    """Register the stage of this file, as a plugin does."""
    return [Direct]
