"""Where to light a finer lattice: a few paths from the nodes of a coarse one show where the light is rough."""

import base64
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from illumgrid.bake.accumulator import Bake, Map, Progress
from illumgrid.field.scene import Scene
from illumgrid.grid import GridSpec, IlluminationGrid, Nodes
from illumgrid.grid.nested import all_corners, finer, spread, within
from illumgrid.grid.nodes import reachable, reached
from illumgrid.interpolators.bilateral import read
from illumgrid.rng import shifted_seed
from illumgrid.samplers.direct import NodeQueries
from illumgrid.transport.samples import Queries, combine
from illumgrid.transport.tracer import Tracer

FEW, STORED = 0.02, 75
"""A halving, which makes the lattice eight times as large, is left out if it has fewer than this share of the lit
nodes, or if the grid would store more than this number of nodes for each lit one."""
LOOKED = 4
"""Paths per node of a first look."""
ROUGH = 0.1
"""Of the mean light: cells whose corners differ by more than this and their noise are refined."""
NOISE = 3.0
"""Approximate range, in standard errors, of eight corners of equal light: 2.85 for eight normal numbers."""
MOST = 4.0
"""Nodes lit in total, at most, for each of the coarse lattice."""
PATH_COUNTS = 8, 16, 32, 64
"""Candidates for the paths per node; in total at most the last for each coarse node."""
BESIDE = 16.0
"""Paths that take as long as everything else that a node costs: first look, query and filter."""
SHARED = 0.5
"""Share of its nodes' variance that a lookup keeps: 8/27 for independent noise, all for shared noise."""


@dataclass(frozen=True, eq=False)
class Chosen:
    """A sampler with the queries of `Direct` at some nodes.

    Parameters
    ----------
    nodes : tuple of (n,) int arrays
        Flat numbers of the nodes of each field's lattice.
    """

    name: ClassVar[str] = "direct"
    nodes: tuple[NDArray[np.int64], ...]

    def queries(self, scene: Scene, specs: Sequence[GridSpec], seed: int) -> Iterator[Queries]:
        """Queries at the nodes, with their flat numbers as ids: see `illumgrid.stages.Sampler`."""
        for number, (spec, nodes) in enumerate(zip(specs, self.nodes)):
            yield NodeQueries(scene, number, spec, nodes)


@dataclass(frozen=True, eq=False)
class Choice:
    """Nodes to light, some in a lattice whose spacing was halved `levels` times: see `illumgrid.grid.nested.finer`."""

    levels: int
    flat: tuple[NDArray[np.int64], ...]  # numbers in each field's lattice
    paths: int = PATH_COUNTS[-1]  # from each of them
    looked: tuple[IlluminationGrid, ...] = ()  # light of the coarsest lattices from a few paths


@dataclass(frozen=True)
class Seen:
    """The error of a lookup as estimated by a first look: squares, relative to the mean light.

    Parameters
    ----------
    noise : float
        Variance of one path.
    between : float
        Squared error of interpolation between the nodes of the coarsest lattice.
    falls : float
        Factor by which `between` falls when the spacing is halved: 2 where light jumps, 16 where it is smooth.
    """

    noise: float
    between: float
    falls: float

    @classmethod
    def of(cls, one: NDArray[np.floating], other: NDArray[np.floating]) -> "Seen":
        """From light (nx, ny, nz) by independent paths, two from each node; NaN where there is none.

        In the mean product of second differences noise cancels. Half a second difference is the error at a node of
        linear interpolation at twice the spacing; two thirds of its square are about the mean square between nodes. At
        twice the spacing, the squared error is thus a sixth of those products, summed over the axes; at the actual
        spacing it is smaller by `falls`, the ratio of the products two nodes apart to those one node apart.
        """
        mean = float(np.nanmean(one + other)) / 2 if np.isfinite(one).any() else 0.0
        if not mean > 0:
            return cls(0.0, 0.0, 2.0)
        near, far = (sum(_bends(one, other, axis, step) for axis in range(3)) / mean**2 for step in (1, 2))
        falls = float(np.clip(far / near, 2.0, 16.0)) if near > 0 else 2.0
        return cls(SHARED * float(np.nanmean(np.square(one - other))) / mean**2, max(near, 0.0) / 6 / falls, falls)

    def cost(self, nodes: Sequence[int], paths: int) -> float:
        """Time of these paths from the nodes of all levels, times the fourth power of the error; smaller is better.

        `nodes` are the numbers of nodes of the coarsest level, and of all levels up to each finer one. Where light
        jumps, half the spacing takes four times the nodes and halves the squared error; hence the fourth power.
        Infinite for too many paths in total.
        """
        if paths > PATH_COUNTS[0] and paths * nodes[-1] > PATH_COUNTS[-1] * nodes[0]:
            return np.inf
        square = self.between / self.falls ** (len(nodes) - 1) + self.noise / paths
        return float(square**2 * nodes[-1] * (BESIDE + paths))

    def paths(self, nodes: Sequence[int]) -> int:
        """Paths per node with the least cost: powers of two, which are spread best; the most if all costs are 0."""
        return min(reversed(PATH_COUNTS), key=lambda paths: self.cost(nodes, paths))


def _bends(one: NDArray[np.floating], other: NDArray[np.floating], axis: int, step: int) -> float:
    """Mean product of the second differences, `step` nodes apart, of light by independent paths."""
    one, other = (np.moveaxis(light, axis, 0) for light in (one, other))
    if len(one) <= 2 * step:
        return 0.0
    first, second = (a[2 * step :] - 2 * a[step:-step] + a[: -2 * step] for a in (one, other))
    known = np.isfinite(first) & np.isfinite(second)
    return float((first[known] * second[known]).mean(dtype=float)) if known.any() else 0.0


def chosen(
    scene: Scene,
    base: Sequence[GridSpec],
    levels: int,
    tracer: Tracer,
    *,
    bounces: int,
    seed: int,
    map: Map = map,
    progress: Progress = lambda what, done, total: None,
) -> Choice:
    """Choose the nodes to light, from the coarse lattices `base` with at most `levels` halvings, and their paths.

    Chooses all nodes of the coarsest level that an isosurface of the range can show; then, level by level, nodes of the
    next finer lattice in cells whose corners differ by more than `ROUGH` of the mean light plus noise, the roughest
    first, up to `MOST` nodes for each of the coarsest level. A level that has few nodes or does not pay is left out:
    see `Seen.cost`. All fields get the number of paths of the field with the most nodes.
    """
    looks = [
        _of_field(scene, number, spec, levels, tracer, bounces, seed, map, progress) for number, spec in enumerate(base)
    ]
    used = max(len(found) for found, *_ in looks) - 1
    nodes = []
    for spec, (found, *_) in zip(base, looks):
        shape, finest = finer(spec, used).shape, []
        for level, flat in enumerate(found):
            place = np.stack(np.unravel_index(flat, finer(spec, level).shape)) << (used - level)
            finest.append(np.ravel_multi_index(tuple(place), shape))
        nodes.append(np.unique(np.concatenate(finest)))
    _, paths = max((sum(map(len, found)), paths) for found, _, paths in looks)
    return Choice(used, tuple(nodes), paths, tuple(grid for _, grid, _ in looks))


def _of_field(
    scene: Scene, number: int, spec: GridSpec, levels: int, tracer: Tracer, bounces: int, seed: int, map: Map,
    progress: Progress,
) -> tuple[list[NDArray[np.int64]], IlluminationGrid, int]:  # fmt: skip
    """Nodes of each level, numbered in its own lattice; light of the coarsest from a few paths; paths per node."""
    field = scene.fields[number]
    flat = reachable(field, spec)
    found, lit, room = [flat], [len(flat)], MOST * len(flat)
    grid, noise, half = _look(scene, number, spec, flat, tracer, bounces, seed, map, progress)
    first, seen = grid, _seen(grid, flat, half())
    for level in range(levels):
        if level:
            grid, noise, _ = _look(scene, number, spec, flat, tracer, bounces, seed, map, progress)
        asked = np.zeros(spec.shape, bool)
        asked.reshape(-1)[flat] = True
        rough = np.where(all_corners(asked), spread(grid), np.float32(0))
        spec = finer(spec, 1)
        may = reached(field, spec)
        # Corners differ by their noise, too: that of four paths exceeds everything else in a room with a small lamp.
        least = ROUGH * grid.mean + NOISE * noise
        more = within(rough > least) & may
        while lit[-1] + int(more.sum()) > room:  # raise the limit until there is room
            least *= 1.25
            more = within(rough > least) & may
        flat = np.flatnonzero(more)
        finest = [*lit, lit[-1] + len(flat)]
        if len(flat) <= FEW * finest[-1] or more.size > STORED * finest[-1]:
            break
        if seen.cost(finest, seen.paths(finest)) >= seen.cost(lit, seen.paths(lit)):
            break
        found.append(flat)
        lit = finest
    return found, first, seen.paths(lit)


def _look(
    scene: Scene, number: int, spec: GridSpec, flat: NDArray[np.int64], tracer: Tracer, bounces: int, seed: int,
    map: Map, progress: Progress,
) -> tuple[IlluminationGrid, float, Callable[[], NDArray[np.float32]]]:  # fmt: skip
    """Light of these nodes from a few paths, with random numbers of their own, and the standard error of its noise.

    Also returns a function that computes the light (n, C) from the first half of the paths alone. The halves have
    sequences of their own: the paths of one sequence are spread evenly and therefore not independent.
    """
    nodes = Nodes(spec, scene.fields[number], number)
    queries = [NodeQueries(scene, number, spec, flat)]
    one, other = (
        Bake.of(queries, bounces, shifted_seed(seed, start)).walk(
            tracer, range(LOOKED // 2), map, lambda what, done, total: progress("first look", done, total)
        ).samples
        for start in (2**59, 3 * 2**59)
    )  # fmt: skip
    samples = combine(one, other)
    light = np.zeros((*spec.shape, len(samples.channels)), np.float32)  # holes stay dark: nothing reads them
    error, support = np.full(spec.shape, np.inf, np.float32), np.zeros(spec.shape, np.float32)
    for every, some in zip((light, error, support), read(samples, nodes, nodes, flat)):
        every.reshape(-1, *every.shape[3:])[flat] = some
    grid, lit = IlluminationGrid(spec, light, error, support, samples.channels), samples.paths > 0
    noise = 0.0
    if lit.any():
        noise = float(np.median(samples.error[lit]) / np.sqrt(np.median(grid.support[grid.support > 0])))
    return grid, noise, lambda: read(one, nodes, nodes, flat)[0]


def _seen(grid: IlluminationGrid, flat: NDArray[np.int64], half: NDArray[np.float32]) -> Seen:
    """Estimate the error of a grid, from the light (n, C) at these nodes by half of its paths."""
    whole, one = (np.full(grid.spec.shape, np.nan) for _ in range(2))
    shown = grid.channels.shown
    whole.reshape(-1)[flat] = shown(grid.light.reshape(-1, len(grid.channels))[flat]).mean(axis=-1)
    one.reshape(-1)[flat] = shown(half).mean(axis=-1)
    one[grid.support == 0] = np.nan
    return Seen.of(one, 2 * whole - one)  # the filter is linear in the light


def written(choice: Choice, base: Sequence[GridSpec]) -> dict[str, Any]:
    """The choice in types of JSON, for the record of a run."""
    texts = []
    for flat, spec in zip(choice.flat, base):
        mask = np.zeros(int(np.prod(finer(spec, choice.levels).shape)), bool)
        mask[flat] = True
        texts.append(base64.b85encode(zlib.compress(np.packbits(mask).tobytes())).decode("ascii"))
    return {"levels": choice.levels, "nodes": texts}


def read_choice(record: Mapping[str, Any]) -> Choice:
    """The choice from a record of `written`."""
    masks = (np.unpackbits(np.frombuffer(zlib.decompress(base64.b85decode(t)), np.uint8)) for t in record["nodes"])
    return Choice(int(record["levels"]), tuple(map(np.flatnonzero, masks)))
