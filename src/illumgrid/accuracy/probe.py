"""What a grid of some size would be off, and what it would take, before it is built.

`Direct` asks at nodes, so the light that a grid of any size would hold at a point is known from the eight nodes around
that point alone. The pilot lights those for some points on grids of many sizes and compares with the light at the
points: that measures the error of a grid without building it.
"""

import time
import timeit
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from illumgrid.accuracy.parts import Split, missing, split
from illumgrid.accuracy.truth import Truth, begin, converge, enough, trace, unseen_in_volume
from illumgrid.errors import BadInput
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats, world_to_index
from illumgrid.field.volume import corners as corners_of
from illumgrid.grid import GridSpec, Nodes
from illumgrid.interpolators.nearest import Nearest
from illumgrid.samplers.direct import at_nodes, reachable
from illumgrid.stages import Backend
from illumgrid.transport.samples import Queries, Samples, combine, join_queries

FEWEST, MOST = 4, 1 << 16  # paths
BOUNCES = (0, 1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48, 64, 96, 128)


@dataclass(frozen=True, eq=False)
class Corners:
    """The nodes that a lookup at some points reads, in a grid that is never built.

    Parameters
    ----------
    asked : Queries
        One for each such node.
    row : (n, 8) int64
        Where in `asked` the nodes of each point are.
    weight : (n, 8) float64
        Trilinear weights.
    nodes : int
        How many nodes the whole grid would have to light.
    """

    asked: Queries
    row: NDArray[np.int64]
    weight: Floats
    nodes: int

    def read(self, samples: Samples) -> tuple[Floats, NDArray[np.bool_]]:
        """Light (n, 3) at the points, and whether (n,) all of their nodes have light of their own.

        A node without light counts as the mean of the others, as one that is filled from a neighbour does, nearly.
        """
        lit = (samples.paths > 0)[self.row] & (self.weight > 0)
        weight = np.where(lit, self.weight, 0.0)
        total = weight.sum(axis=1, keepdims=True)
        light = np.einsum("nk,nkc->nc", weight, samples.mean[self.row].astype(float)) / np.where(total > 0, total, 1.0)
        return light, np.asarray((lit | (self.weight == 0)).all(axis=1))


def specs_of(scene: Scene, longest: int) -> list[GridSpec]:
    """Lattices, one a field, with this many nodes along the axis with most voxels."""
    return [GridSpec.over(field.volume, longest) for field in scene.fields]


def corners(scene: Scene, longest: int, points: Queries) -> Corners:
    """The nodes around the points of queries, in grids with this many nodes along the longest axis."""
    row, weight = np.zeros((len(points), 8), np.int64), np.zeros((len(points), 8))
    parts, first, nodes = [], 0, 0
    for number, spec in enumerate(specs_of(scene, longest)):
        nodes += len(reachable(scene.fields[number], spec))
        own = np.flatnonzero(points.target == number)
        around, share = zip(*corners_of(spec, world_to_index(spec, points.point[own])))
        flat = np.stack([np.ravel_multi_index(tuple(node.T), spec.shape) for node in around], axis=1)
        unique, place = np.unique(flat, return_inverse=True)
        row[own], weight[own] = first + place.reshape(flat.shape), np.stack(share, axis=1)
        parts.append(at_nodes(scene, number, spec, unique))
        first += len(unique)
    return Corners(join_queries(parts), row, weight, nodes)


@dataclass(frozen=True)
class Measured:
    """What a grid of some size would be off, from the pilot.

    Parameters
    ----------
    grid : int
        Nodes along the longest axis.
    nodes : int
        Nodes to light, in all.
    split : Split
        With `paths` paths.
    paths : int
    falls : float
        The noise (squared) falls as paths to this power; 1 for independent paths, more for well-spread ones.
    """

    grid: int
    nodes: int
    split: Split
    paths: int
    falls: float = 1.0

    @property
    def floor(self) -> float:
        """Mean squared error that no number of paths takes away, and one standard error more.

        Where the light is rough, a few points carry the error, and a pilot misses them more often than not.
        """
        return float(max(0.0, self.split.total - self.split.noise) + self.split.uncertain)

    def squared(self, paths: int) -> float:
        """Predicted mean squared error with this many paths."""
        return float(self.floor + self.split.noise * (self.paths / paths) ** self.falls)

    def paths_for(self, squared: float) -> int | None:
        """Fewest paths that are predicted to reach a mean squared error; None if none do."""
        return self.paths_within(squared - self.floor) if squared > self.floor else None

    def paths_within(self, noise: float) -> int:
        """Fewest paths whose noise is predicted to have at most this mean square."""
        needed = self.paths * (self.split.noise / noise) ** (1 / self.falls)
        return min(MOST, max(FEWEST, 2 * int(np.ceil(needed / 2))))


@dataclass(frozen=True)
class Pace:
    """What the machine takes: seconds for each node and for each path of a node."""

    node: float
    path: float

    def seconds(self, nodes: int, paths: int) -> float:
        """Predicted time of a run."""
        return nodes * (self.node + paths * self.path)

    def paths_in(self, seconds: float, nodes: int) -> int:
        """Paths from each of the nodes that the time allows, an even number; below 0 if it allows none."""
        return 2 * int((seconds / nodes - self.node) / self.path / 2)


@dataclass(frozen=True, eq=False)
class Pilot:
    """Points of a scene at which light is known, to measure grids against.

    Parameters
    ----------
    scene : Scene
    backend : Backend
    seed : int
    truth : Truth
    few : Truth
        Some of the points, with fewer paths: enough to see what bounces add, since both sides walk the same paths.
    """

    scene: Scene
    backend: Backend
    seed: int
    truth: Truth
    few: Truth

    @classmethod
    def start(cls, scene: Scene, backend: Backend, points: int, error: float, seed: int, most: int = 1024) -> "Pilot":
        """Light some points well enough to judge an `error`, with paths so long that a tenth of it is left out.

        The truth's own variance is subtracted wherever it is used, so that it may be as large as the error judged; it
        has at most `most` paths.
        """
        asked = unseen_in_volume(scene, points, seed)
        first = begin(scene, backend, asked, enough(scene, backend, 0.1 * error, seed), seed)
        if not len(first) or not first.mean > 0:
            raise BadInput("no light reaches the surfaces of this scene; expected a background or a lamp that does")
        few = first[:: max(1, len(first) // 512)]
        return cls(scene, backend, seed, converge(first, scene, backend, seed, error, most), few)

    def fewer(self, bounces: int) -> Truth:
        """The light at the points with fewer bounces, by the same paths."""
        return self._again(self.truth, min(bounces, self.truth.bounces))

    def _again(self, truth: Truth, bounces: int) -> Truth:
        light = trace(self.scene, self.backend, truth.queries, range(truth.paths), bounces, self.seed)
        return replace(truth, halves=light, bounces=bounces)

    def left_out(self, bounces: int) -> float:
        """Root mean square of the light that more bounces would add, relative."""
        return float(np.sqrt((missing(self._again(self.few, bounces), self.few) ** 2).mean()))

    def bounces_for(self, tolerance: float) -> int:
        """Fewest bounces that leave out less than a `tolerance`."""
        for bounces in BOUNCES:
            if bounces >= self.truth.bounces or self.left_out(bounces) <= tolerance:
                return min(bounces, self.truth.bounces)
        return self.truth.bounces

    def measure(self, grid: int, fewer: Truth, bounces: int, paths: int) -> Measured:
        """What a grid of this size is off, with `paths` paths from two seeds each."""
        around = corners(self.scene, grid, self.truth.queries)
        seeds = self.seed, (self.seed + 2**62) % 2**64
        start = [self._light(around.asked, range(paths // 4), bounces, seed) for seed in seeds]
        rest = [self._light(around.asked, range(paths // 4, paths), bounces, seed) for seed in seeds]
        found = []
        for pair in (start, [combine(a, b) for a, b in zip(start, rest)]):
            (one, covered), (other, _) = (around.read(samples) for samples in pair)
            found.append(split(one, other, covered, fewer, self.truth))
        falls = np.log(found[0].noise / found[1].noise) / np.log(4) if min(f.noise for f in found) > 0 else 1.0
        return Measured(grid, around.nodes, found[1], paths, float(np.clip(falls, 0.8, 1.6)))

    def _light(self, asked: Queries, paths: range, bounces: int, seed: int) -> Samples:
        return self.backend.solve(self.scene, asked, paths=paths, bounces=bounces, seed=seed)


def _in_rows(nodes: NDArray[np.int64], count: int, random: np.random.Generator) -> NDArray[np.int64]:
    """About `count` of the nodes, or all, in runs of 64."""
    starts = random.integers(0, max(1, len(nodes) - 63), max(1, min(len(nodes), count) // 64))
    return np.asarray(nodes[np.unique((starts[:, None] + np.arange(64)).clip(0, len(nodes) - 1))])


def timed(scene: Scene, backend: Backend, grid: int, paths: int, bounces: int, seed: int, about: int = 1 << 16) -> Pace:
    """Time the machine on nodes that lie as they do in a run: in rows, next to one another."""
    random = np.random.default_rng((seed, 3))
    per_path, per_node = [], []
    for number, spec in enumerate(specs_of(scene, grid)):
        nodes = reachable(scene.fields[number], spec)
        chosen, many = (_in_rows(nodes, count, random) for count in (max(256, about // paths), 1 << 13))
        asked = at_nodes(scene, number, spec, chosen)
        small = GridSpec.over(scene.fields[number].volume, 24)
        backend.solve(scene, asked[:1], paths=range(2), bounces=bounces, seed=seed)  # loads what is compiled
        begun = time.perf_counter()
        answer = backend.solve(scene, asked, paths=range(paths), bounces=bounces, seed=seed)
        per_path.append((time.perf_counter() - begun) / (len(chosen) * paths))
        # Few nodes would cost as much as many; and the least of three, for in so short a time a stall counts for many.
        asking = timeit.repeat(partial(at_nodes, scene, number, spec, many), number=1, repeat=3)
        filling = timeit.repeat(
            partial(Nearest().fill, answer, Nodes(small, scene.fields[number], number)), number=1, repeat=3
        )
        per_node.append(min(asking) / len(many) + min(filling) / int(np.prod(small.shape)))
    return Pace(float(np.mean(per_node)), float(np.mean(per_path)))
