"""The chain: ask, answer, combine, fill. No disk, no names of stages, no screen."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.scene import Levels, Quad, Scene, level_table
from illumgrid.field.volume import interpolate, world_to_index
from illumgrid.grid import GridSpec, IlluminationGrid, Nodes, WallTexture, channels_of, fill_holes
from illumgrid.grid.cache import cache_of
from illumgrid.grid.channels import Channels
from illumgrid.grid.nodes import reachable
from illumgrid.grid.walls import calmed
from illumgrid.interpolators.nearest import Nearest
from illumgrid.samplers.direct import Direct
from illumgrid.stages import Interpolator, Sampler
from illumgrid.transport.samples import Queries, Samples, combine, join_queries, join_samples
from illumgrid.transport.stages import fill_nodes
from illumgrid.transport.tracer import Tracer, answered, ending_in
from illumgrid.transport.walk import Keeper, Ranks, Walk, answer, in_order, split

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""


class Map(Protocol):
    """Like the built-in ``map``: results in the order of the work. An executor's ``map`` will do."""

    def __call__(self, function: Callable[[Any], Any], work: Iterable[Any], /) -> Iterable[Any]:
        """Apply `function` to each piece of `work`."""


NO_QUERIES = Queries(
    np.zeros(0, np.uint64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 0)), np.zeros(0, np.int32)
)
QUERY_ARRAYS = tuple(f.name for f in fields(Queries))


def shifted_seed(seed: int, shift: int) -> int:
    """Another seed, `shift` further on, within the 64 bits that a seed has."""
    return (seed + shift) % 2**64


@dataclass(frozen=True, eq=False)
class Bake:
    """Light at some targets and the paths it comes from: walks more paths, combines, and can be stored.

    Parameters
    ----------
    targets : tuple of Queries
        Batches of nodes, texels or points.
    weights : tuple of int
        Paths from each target of a batch for every path of a walk: 1, or `texel_paths` for texels.
    bounces, seed : int
    answers : tuple of Samples
        Moments of the light, one per batch; empty before the first walk.
    walked : tuple of range
        Numbers of the paths walked, disjoint.
    """

    targets: tuple[Queries, ...]
    weights: tuple[int, ...]
    bounces: int
    seed: int
    answers: tuple[Samples, ...] = ()
    walked: tuple[range, ...] = ()

    @classmethod
    def of(cls, targets: Sequence[Queries], bounces: int, seed: int) -> "Bake":
        """Begin with targets that are all equal."""
        return cls(tuple(targets), (1,) * len(targets), bounces, seed)

    @property
    def paths(self) -> int:
        """Paths walked from a target of weight 1."""
        return sum(map(len, self.walked))

    @property
    def samples(self) -> Samples:
        """All answers, one batch after the other."""
        return self.answers[0] if len(self.answers) == 1 else join_samples(self.answers)

    def walk(
        self,
        tracer: Tracer,
        paths: range,
        map: Map = map,
        progress: Progress = lambda what, done, total: None,
        keep: Keeper | None = None,
        ranks: Ranks | None = None,
    ) -> "Bake":
        """Walk the paths with these numbers from every target as well; see `bake` for the others."""
        ranges = [range(n * paths.start, n * paths.stop) for n in self.weights]
        going = Walk(self.targets, ranges, split(keep.known(paths) if keep else None, self.targets))
        first = np.cumsum([0, *map(len, self.targets)])
        total, within = int(first[-1]), 0
        what = "more light" if self.answers else "light"
        done = sum(int((known.paths >= 0).sum()) for known in going.answers if known is not None)

        def tick(count: int) -> None:
            nonlocal within
            within += count
            progress(what, min(done + within, total), total)

        progress(what, done, total)
        before = answered.set(tick)
        try:
            for found in map(partial(answer, tracer, self.bounces, self.seed), going.pieces(ranks)):
                number, rows = going.take(found)
                if keep:
                    keep.keep(first[number] + rows, found)
                done, within = done + len(rows), 0
                progress(what, done, total)
        finally:
            answered.reset(before)
            if keep:
                keep.flush()
        each = (  # a batch of no targets makes no piece of work
            tracer.solve(q, paths=r, bounces=self.bounces, seed=self.seed) if a is None else a
            for a, q, r in zip(going.answers, self.targets, ranges)
        )
        return self.merge(replace(self, answers=tuple(each), walked=(paths,)))

    def merge(self, other: "Bake") -> "Bake":
        """Combine with a bake of the same targets and seed that walked other paths."""
        if (self.bounces, self.seed) != (other.bounces, other.seed):
            raise BadInput(
                f"a bake of {self.bounces} bounces and seed {self.seed} met one of {other.bounces} and {other.seed}; "
                "expected the same to combine"
            )
        if not self.answers or not other.answers:
            return self if self.answers else other
        if any(max(a.start, b.start) < min(a.stop, b.stop) for a in self.walked for b in other.walked):
            raise BadInput(f"paths {self.walked} and {other.walked} overlap; expected disjoint ranges to combine")
        answers = tuple(combine(a, b) for a, b in zip(self.answers, other.answers))
        return replace(other, answers=answers, walked=self.walked + other.walked)

    def state(self) -> dict[str, NDArray[Any]]:
        """All that the bake holds, as plain arrays: `from_state` takes them back."""
        queries = join_queries(self.targets or (NO_QUERIES,))
        arrays = {name: getattr(queries, name) for name in QUERY_ARRAYS}
        if self.answers:
            samples, channels = self.samples, self.samples.channels
            arrays |= {"light": samples.light, "spread": samples.spread, "paths": samples.paths}
            arrays |= {"channels": np.array(channels.names), "mix": np.array(channels.mix)}
        return arrays | {
            "batches": np.array([len(q) for q in self.targets]),
            "weights": np.array(self.weights),
            "walked": np.array([(r.start, r.stop) for r in self.walked], int).reshape(-1, 2),
            "bounces": np.array(self.bounces),
            "seed": np.array(self.seed, np.uint64),
        }

    @classmethod
    def from_state(cls, arrays: Mapping[str, NDArray[Any]]) -> "Bake":
        """Take up a bake where `state` left it."""
        queries = Queries(*(arrays[name] for name in QUERY_ARRAYS))
        ends = np.cumsum(arrays["batches"]).tolist()
        rows = [slice(a, b) for a, b in zip([0, *ends], ends)]
        answers: tuple[Samples, ...] = ()
        if len(arrays["walked"]):
            channels = Channels(tuple(arrays["channels"].tolist()), tuple(map(tuple, arrays["mix"].tolist())))
            whole = Samples(queries, arrays["light"], arrays["spread"], arrays["paths"], channels)
            answers = tuple(whole[row] for row in rows)
        return cls(
            tuple(queries[row] for row in rows), tuple(arrays["weights"].tolist()), int(arrays["bounces"]),
            int(arrays["seed"]), answers, tuple(range(a, b) for a, b in arrays["walked"].tolist()),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Baked:
    """Light for every field, and how it came about.

    Parameters
    ----------
    grids : tuple of IlluminationGrid
        One a field.
    walls : tuple of WallTexture
        One a quad.
    seconds : dict
        Wall time of each stage.
    queries : int
        Number of queries answered, texels among them.
    paths : int
        Paths walked from each of a field's.
    texels, texel_paths : int
        Queries on walls, and paths walked from each.
    holes : tuple of int
        For each field, nodes that its isosurfaces can show and no sample supports.
    """

    grids: tuple[IlluminationGrid, ...]
    walls: tuple[WallTexture, ...]
    seconds: dict[str, float]
    queries: int
    paths: int
    texels: int
    texel_paths: int
    holes: tuple[int, ...]


def wall_queries(scene: Scene, levels: Levels) -> list[Queries]:
    """Queries at the middles of the texels of every quad's front, for every row of levels: one batch a quad."""
    batches = []
    for number, quad in enumerate(scene.quads, len(scene.fields)):
        nu, nv = quad.texels
        rows, v, u = np.indices((len(levels.table), nv, nu)).reshape(3, -1)
        point = quad.corner + ((u + 0.5) / nu)[:, None] * quad.edge_u + ((v + 0.5) / nv)[:, None] * quad.edge_v
        batches.append(
            Queries(
                id=np.arange(len(rows), dtype=np.uint64) | np.uint64(number << 40),
                point=point,
                normal=np.tile(quad.normal, (len(rows), 1)),
                level=levels.table[rows],
                target=np.full(len(rows), number, np.int32),
            )
        )
    return batches


def coarse_first(scene: Scene, specs: Sequence[GridSpec], levels: Levels, queries: Queries) -> NDArray[np.int8]:
    """Ranks (n,) of targets: 0 for every fourth node or texel along each axis, 1 for every second, 2 for the others."""
    index = np.zeros((len(queries), 3), np.int64)
    for target in np.unique(queries.target):
        own = queries.target == target
        if target < len(specs):
            index[own] = np.round(world_to_index(specs[target], queries.point[own]))
        else:
            nu, nv = scene.quads[target - len(specs)].texels
            number = (queries.id[own] & np.uint64((1 << 40) - 1)).astype(np.int64)
            index[own] = np.stack(np.unravel_index(number, (len(levels.table), nv, nu)), axis=1)
    even, fourth = ((index % step == 0).all(axis=1).astype(np.int8) for step in (2, 4))
    return np.asarray(2 - even - fourth, np.int8)


def texel_paths(nodes: int, texels: int) -> int:
    """Paths from a texel for each from a node: up to eight, while the walls are no more work than the grids.

    A texel is seen across many pixels, where noise that a curved surface hides shows as blotches.
    """
    return int(np.clip(nodes // max(texels, 1), 1, 8))


def wall_texture(rows: int, quad: Quad, answer: Samples) -> WallTexture:
    """The texture of a quad from the samples at its texels, for so many rows of levels; its noise is calmed."""
    nu, nv = quad.texels
    support = (answer.paths > 0).astype(np.float32).reshape(rows, nv, nu)
    texel = np.linalg.norm(quad.edge_v) / nv, np.linalg.norm(quad.edge_u) / nu
    # Another row is another setting of the sweep: look there last.
    spacing = (1e3 * max(texel) * max(nu, nv), *texel)
    shape = rows, nv, nu
    calm = calmed(
        answer.light.reshape(*shape, -1), answer.mean.reshape(*shape, 3), answer.error.reshape(shape), support
    )
    light = fill_holes(spacing, calm, support)
    return WallTexture(light, support, answer.channels)


def holes_within_range(scene: Scene, field: int, grid: IlluminationGrid) -> int:
    """Nodes without support through which an isosurface of the range passes, outside the solids of other fields."""
    own = scene.fields[field]
    near = reachable(own, grid.spec)
    empty = near[grid.support.reshape(-1)[near] == 0]
    nodes = grid.spec.nodes(empty)
    level = interpolate(own.volume, world_to_index(own.volume, nodes))
    seen = (level >= own.range[0]) & (level <= own.range[1])
    for number, other in enumerate(scene.fields):
        if number != field:
            index = world_to_index(other.volume, nodes)
            within = ((index >= 0) & (index <= np.array(other.volume.shape) - 1)).all(axis=1)
            value = interpolate(other.volume, index)
            seen &= ~(within & other.solid(value, scene.levels_through(field, level)[:, number]))
    return int(seen.sum())


def _on_few_rows(scene: Scene, seed: int, rows: int = 4, count: int = 32) -> Queries:
    """About `count` queries on each of a few rows of the sweep, from the nodes of a coarse grid.

    Few, because a backend of meshes builds one per row. The nodes of all fields, sorted by their place in the sweep,
    are cut into equal parts; those nearest to the middle of a part move onto its row.
    """
    specs = [GridSpec.over(field.volume, 10) for field in scene.fields]
    nodes = join_queries([q for q in Direct().queries(scene, specs, seed) if len(q)])
    place = np.zeros(len(nodes))
    for number, field in enumerate(scene.fields):
        own = nodes.target == number
        place[own] = field.place(nodes.level[own, number])
    shuffled = np.random.default_rng(seed).permutation(len(nodes))  # many stand at an end of the range
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


def enough_bounces(scene: Scene, tracer: Tracer, seed: int = 0) -> tuple[int, float]:
    """Reflections to follow, and the share of light left out: below 1 %, and at least 4 reflections."""
    bounces, left_out = 4, light_left_out(scene, tracer, 4, seed)
    while bounces < 128 and left_out >= 0.01:
        bounces += max(1, bounces // 4)
        left_out = light_left_out(scene, tracer, bounces, seed)
    return bounces, left_out


def bake(
    scene: Scene,
    specs: Sequence[GridSpec],
    levels: Levels,
    sampler: Sampler,
    tracer: Tracer,
    interpolator: Interpolator,
    *,
    paths: Iterable[range],
    bounces: int,
    seed: int = 0,
    map: Map = map,
    progress: Progress = lambda what, done, total: None,
    keep: Keeper | None = None,
) -> Baked:
    """Compute the illumination grids of a scene, and the light of its walls.

    Parameters
    ----------
    scene : Scene
    specs : sequence of GridSpec
        The nodes, one lattice a field.
    levels : Levels
        Rows of the sweep at which the walls are lit.
    sampler, interpolator
        Stage objects.
    tracer : Tracer
        A backend with the scene set up: `illumgrid.transport.tracer.prepare`.
    paths : iterable of range
        Numbers of the paths from every node, one range after the other; the next is asked for when one is walked.
        A texel has `texel_paths` times as many.
    bounces : int
    seed : int
    map : callable, optional
        What spreads the batches: the built-in ``map``, or that of an executor or cluster.
    progress : callable, optional
        Called with (what, done, total).
    keep : Keeper, optional
        Keeps the light as it is computed, from coarse to fine, and knows that of a run that was stopped.
    """
    clock = [time.perf_counter()]
    nodes = [batch for batch in sampler.queries(scene, specs, seed) if len(batch)]
    texels = wall_queries(scene, levels)
    asked, on_walls = (sum(len(batch) for batch in batches) for batches in (nodes, texels))
    more = texel_paths(asked, on_walls)
    held, count = held_queries(scene, nodes), len(nodes)
    state = Bake((*nodes, *held, *texels), (1,) * (count + len(held)) + (more,) * len(texels), bounces, seed)
    del nodes, texels
    clock.append(time.perf_counter())
    ranks = None if keep is None else [coarse_first(scene, specs, levels, batch) for batch in state.targets]
    if keep is not None and ranks:
        keep.begin(state.targets, in_order(ranks))
    for numbers in paths:
        state = state.walk(tracer, numbers, map, progress, keep, ranks)
    if keep is not None and state.answers:
        keep.end(state.answers)
    clock.append(time.perf_counter())

    grids, walked = [], state.paths
    rows = list(state.answers[count : count + len(held)])
    answers = [*state.answers[:count], *state.answers[count + len(held) :]]
    del state, held
    for number, spec in enumerate(specs):
        samples = of_field(scene, answers, number)
        answers = [a for a in answers if (a.queries.target > number).any()]  # a large run is held once, not twice
        nodes_of = Nodes(spec, scene.fields[number], number)
        grids.append(fill_nodes(interpolator, samples, nodes_of))
        if scene.fields[number].isovalue is not None:
            lit = tuple(fill_nodes(interpolator, rows.pop(0), nodes_of) for _ in range(HELD_ROWS))
            grids[-1] = replace(grids[-1], values=grids[-1].light, rows=lit)
        del samples
        progress("grid", number + 1, len(specs))
    walls = [wall_texture(len(levels.table), quad, answer) for quad, answer in zip(scene.quads, answers)]
    clock.append(time.perf_counter())
    return Baked(
        grids=tuple(grids),
        walls=tuple(walls),
        seconds=dict(zip(("sampler", "backend", "interpolator"), np.diff(clock).tolist())),
        queries=asked + on_walls,
        paths=walked,
        texels=on_walls,
        texel_paths=more * walked,
        holes=tuple(holes_within_range(scene, n, grid) for n, grid in enumerate(grids)),
    )


COARSE, COARSE_PATHS = 0.7, 4
"""Nodes of a cache for each node along an axis, and paths from each."""

MOST_BIAS = 0.003
"""Of the mean light: by how much paths that end in a cache may be off in the mean; a test holds it on four scenes."""


def light_known_first(
    scene: Scene, specs: Sequence[GridSpec], levels: Levels, tracer: Tracer, *, bounces: int, seed: int, **how: Any
) -> Tracer:
    """The same tracer, whose paths end in the light of a coarser grid, which is computed here: every bounce at once.

    The coarse light has paths of its own, random numbers of its own, and the same walls for every other row of levels.

    Parameters
    ----------
    specs : sequence of GridSpec
        Nodes that are to be lit afterwards.
    bounces : int
        Of the paths that are to be walked. Those of the cache have twice as many: the light falls by the same factor
        with each, so that these leave out the square of what those do.
    **how
        `map` and `progress` of `bake`.
    """
    sizes = [max(2, round(COARSE * max(spec.shape))) for spec in specs]
    coarse = [GridSpec.over(field.volume, size) for field, size in zip(scene.fields, sizes)]
    rows = level_table(scene, max(2, len(levels.table) // 2))
    known = bake(
        scene, coarse, rows, Direct(), tracer, Nearest(), paths=[range(COARSE_PATHS)],
        bounces=2 * bounces, seed=shifted_seed(seed, 2**60), **how,
    )  # fmt: skip
    return ending_in(cache_of(scene, known.grids, known.walls), tracer)


HELD_ROWS = 5
"""Places of the sweep, its ends among them, at which a level that is held is lit."""


def held_queries(scene: Scene, nodes: Sequence[Queries]) -> list[Queries]:
    """Queries at the nodes of each field whose level is held, with the others at `HELD_ROWS` places of the sweep.

    One batch a field and place, place after place.
    """
    batches = []
    for number, field in enumerate(scene.fields):
        if field.isovalue is None:
            continue
        own = [batch[batch.target == number] for batch in nodes if (batch.target == number).any()]
        asked = join_queries(own) if own else Queries.at(scene, np.zeros((0, 3)), number)
        for row, level in enumerate(scene.levels(np.linspace(0.0, 1.0, HELD_ROWS))):
            levels = np.tile(level, (len(asked), 1))
            levels[:, number] = asked.level[:, number]
            ids = asked.id | np.uint64(row + 1) << np.uint64(56)
            batches.append(Queries(ids, asked.point, asked.normal, levels, asked.target))
    return batches


def of_field(scene: Scene, answers: Sequence[Samples], number: int) -> Samples:
    """Samples of one field; a batch may hold several fields, and a field may have none."""
    own = [a if (a.queries.target == number).all() else a[a.queries.target == number] for a in answers]
    if own := [a for a in own if len(a)]:
        return join_samples(own)
    channels = channels_of(scene)
    none = np.zeros((0, len(channels)), np.float32)
    return Samples(Queries.at(scene, np.zeros((0, 3))), none, none, np.zeros(0, np.int32), channels)
