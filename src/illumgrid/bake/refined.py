"""Where to light a fine lattice: a few paths from the nodes of a coarse one show where the light is rough."""

import base64
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from illumgrid.bake.accumulator import Bake, Map, Progress
from illumgrid.field.scene import Scene
from illumgrid.grid import GridSpec, IlluminationGrid, Nodes
from illumgrid.grid.nested import all_corners, finer, spread, within
from illumgrid.grid.nodes import reachable
from illumgrid.interpolators.bilateral import read
from illumgrid.rng import shifted_seed
from illumgrid.samplers.direct import NodeQueries
from illumgrid.transport.samples import Queries
from illumgrid.transport.tracer import Tracer

FEW, STORED = 0.02, 75
"""A level is not worth a grid of eight times the size if it has fewer than this share of the lit nodes, or if the grid
would have more nodes than so many for each lit one."""
LOOKED = 4
"""Paths from each node that show where light is rough."""
ROUGH = 0.1
"""Of the mean light: cells whose corners differ by more, beyond their noise, are lit at twice the nodes."""
NOISE = 3.0
"""Standard errors by which eight corners of equal light differ, about: the range of eight normal numbers is 2.85."""
MOST = 4.0
"""Nodes lit in all, at most, for each of the coarse lattice."""
FEWEST, MOST_PATHS = 8, 64
"""Paths from each node that is lit: most where no finer ones are."""


@dataclass(frozen=True, eq=False)
class Chosen:
    """A sampler that asks at some nodes, as `Direct` would.

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
    looked: tuple[IlluminationGrid, ...] = ()  # light of the coarsest lattices by a few paths


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
    """Choose the nodes to light, from the coarse lattices `base` on and with at most so many levels.

    All nodes of the coarsest level that an isosurface of the range can show, and, level after level, those of the next
    finer one in cells whose corners differ by more than `ROUGH` of the mean light beyond noise, the roughest first, up
    to `MOST` nodes for each of the coarsest level. A level of few nodes is left out.
    """
    found, looked = [], []
    for number, spec in enumerate(base):
        levels_of, first = _of_field(scene, number, spec, levels, tracer, bounces, seed, map, progress)
        found.append(levels_of)
        looked.append(first)
    used = max(len(each) for each in found) - 1
    nodes = []
    for spec, each in zip(base, found):
        shape, finest = finer(spec, used).shape, []
        for level, flat in enumerate(each):
            place = np.stack(np.unravel_index(flat, finer(spec, level).shape)) << (used - level)
            finest.append(np.ravel_multi_index(tuple(place), shape))
        nodes.append(np.unique(np.concatenate(finest)))
    return Choice(used, tuple(nodes), tuple(looked))


def _of_field(
    scene: Scene, number: int, spec: GridSpec, levels: int, tracer: Tracer, bounces: int, seed: int, map: Map,
    progress: Progress,
) -> tuple[list[NDArray[np.int64]], IlluminationGrid]:  # fmt: skip
    """Nodes of each level, as numbers in its own lattice, and the light of the coarsest by a few paths."""
    field = scene.fields[number]
    flat = reachable(field, spec)
    found, lit, room = [flat], len(flat), MOST * len(flat)
    grid, noise = _look(scene, number, spec, flat, tracer, bounces, seed, map, progress)
    first = grid
    for level in range(levels):
        if level:
            grid, noise = _look(scene, number, spec, flat, tracer, bounces, seed, map, progress)
        asked = np.zeros(spec.shape, bool)
        asked.reshape(-1)[flat] = True
        rough = np.where(all_corners(asked), spread(grid), np.float32(0))
        spec = finer(spec, 1)
        may = np.zeros(spec.shape, bool)
        may.reshape(-1)[reachable(field, spec)] = True
        # Corners differ by their noise, too: that of four paths exceeds all else in a room with a small lamp.
        least = ROUGH * grid.mean + NOISE * noise
        more = within(rough > least) & may
        while lit + int(more.sum()) > room:  # raise the limit until there is room
            least *= 1.25
            more = within(rough > least) & may
        flat = np.flatnonzero(more)
        lit += len(flat)
        if len(flat) <= FEW * lit or more.size > STORED * lit:
            break
        found.append(flat)
    return found, first


def _look(
    scene: Scene, number: int, spec: GridSpec, flat: NDArray[np.int64], tracer: Tracer, bounces: int, seed: int,
    map: Map, progress: Progress,
) -> tuple[IlluminationGrid, float]:  # fmt: skip
    """Light of these nodes by a few paths, with random numbers of their own, and its standard error from noise."""
    nodes = Nodes(spec, scene.fields[number], number)
    looked = Bake.of([NodeQueries(scene, number, spec, flat)], bounces, shifted_seed(seed, 2**59)).walk(
        tracer, range(LOOKED), map, lambda what, done, total: progress("first look", done, total)
    )
    samples = looked.samples
    light = np.zeros((*spec.shape, len(samples.channels)), np.float32)  # holes stay dark: nobody reads them
    error, support = np.full(spec.shape, np.inf, np.float32), np.zeros(spec.shape, np.float32)
    for every, some in zip((light, error, support), read(samples, nodes, nodes, flat)):
        every.reshape(-1, *every.shape[3:])[flat] = some
    grid, lit = IlluminationGrid(spec, light, error, support, samples.channels), samples.paths > 0
    if not lit.any():
        return grid, 0.0
    return grid, float(np.median(samples.error[lit]) / np.sqrt(np.median(grid.support[grid.support > 0])))


def paths_for(choice: Choice, base: Sequence[GridSpec]) -> int:
    """Paths from each node: a power of two, which spreads them best, the fewer, the more nodes are lit.

    `MOST_PATHS` divided by the 1.5th power of the lit nodes for each coarse one: among more nodes noise averages out,
    and where light is rough it counts for less than the jumps.
    """
    lit, coarse = sum(map(len, choice.flat)), 0
    for flat, spec in zip(choice.flat, base):
        place = np.stack(np.unravel_index(flat, finer(spec, choice.levels).shape))
        coarse += int((place % 2**choice.levels == 0).all(axis=0).sum())
    share = MOST_PATHS * (coarse / max(lit, 1)) ** 1.5
    return int(np.clip(2 ** np.floor(np.log2(max(share, 1.0))), FEWEST, MOST_PATHS))


def written(choice: Choice, base: Sequence[GridSpec]) -> dict[str, Any]:
    """The choice in what JSON has, for a record of a run."""
    texts = []
    for flat, spec in zip(choice.flat, base):
        mask = np.zeros(int(np.prod(finer(spec, choice.levels).shape)), bool)
        mask[flat] = True
        texts.append(base64.b85encode(zlib.compress(np.packbits(mask).tobytes())).decode("ascii"))
    return {"levels": choice.levels, "nodes": texts}


def read_choice(record: Mapping[str, Any]) -> Choice:
    """The choice that `written` made a record of."""
    masks = (np.unpackbits(np.frombuffer(zlib.decompress(base64.b85decode(t)), np.uint8)) for t in record["nodes"])
    return Choice(int(record["levels"]), tuple(map(np.flatnonzero, masks)))
