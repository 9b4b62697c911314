"""The chain: ask, answer, fill. No disk, no names of stages, no screen."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np

from illumgrid.field.scene import Levels, Quad, Scene
from illumgrid.field.volume import interpolate, world_to_index
from illumgrid.grid import GridSpec, IlluminationGrid, WallTexture, fill_holes
from illumgrid.samplers.direct import Direct, reachable
from illumgrid.stages import Backend, Interpolator, Sampler
from illumgrid.transport.samples import Queries, Samples, combine, join_queries, join_samples

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""


class Map(Protocol):
    """Like the built-in ``map``: results in the order of the work. An executor's ``map`` will do."""

    def __call__(self, function: Callable[[Any], Any], work: Iterable[Any], /) -> Iterable[Any]:
        """Apply `function` to each piece of `work`."""


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
        Number of questions asked.
    paths : int
        Paths walked from each of a field's.
    holes : tuple of int
        For each field, nodes that its isosurfaces can show and no sample supports.
    """

    grids: tuple[IlluminationGrid, ...]
    walls: tuple[WallTexture, ...]
    seconds: dict[str, float]
    queries: int
    paths: int
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


def texel_paths(nodes: int, texels: int) -> int:
    """Paths from a texel for each from a node: up to eight, while the walls are no more work than the grids.

    A texel is seen across many pixels, where noise that a curved surface hides shows as blotches.
    """
    return int(np.clip(nodes // max(texels, 1), 1, 8))


def _wall_texture(rows: int, quad: Quad, answer: Samples) -> WallTexture:
    nu, nv = quad.texels
    support = (answer.paths > 0).astype(np.float32).reshape(rows, nv, nu)
    texel = np.linalg.norm(quad.edge_v) / nv, np.linalg.norm(quad.edge_u) / nu
    # Another row is another setting of the sweep: look there last.
    spacing = (1e3 * max(texel) * max(nu, nv), *texel)
    return WallTexture(fill_holes(spacing, answer.mean.reshape(rows, nv, nu, 3), support), support)


def _answer(
    scene: Scene, backend: Backend, paths: range, more: int, bounces: int, seed: int, queries: Queries
) -> Samples:
    if queries.target[0] >= len(scene.fields):
        paths = range(more * paths.start, more * paths.stop)
    return backend.solve(scene, queries, paths=paths, bounces=bounces, seed=seed)


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

    Few, because a backend of meshes builds one a row. The nodes of all fields, sorted by their place in the sweep, are
    cut into equal parts; those nearest to the middle of a part move onto its row.
    """
    specs = [GridSpec.over(field.volume, 10) for field in scene.fields]
    nodes = join_queries([q for q in Direct().queries(scene, specs, seed) if len(q)])
    low, high = np.array([field.range for field in scene.fields])[nodes.target].T
    place = (nodes.level[np.arange(len(nodes)), nodes.target] - low) / (high - low)
    shuffled = np.random.default_rng(seed).permutation(len(nodes))  # many stand at an end of the range
    asked = []
    for number, part in enumerate(np.array_split(shuffled[np.argsort(place[shuffled], kind="stable")], rows)):
        middle = place[part[len(part) // 2]] if len(part) else 0.0
        near = part[np.argsort(np.abs(place[part] - middle), kind="stable")[:count]]
        for field in np.unique(nodes.target[near]):
            points = nodes.point[near[nodes.target[near] == field]]
            level = scene.levels(middle)[0, field]
            first = (number * len(scene.fields) + int(field)) * count
            asked.append(Queries.at(scene, points, field=int(field), level=level, first_id=first))
    return join_queries(asked)


def light_left_out(scene: Scene, backend: Backend, bounces: int, seed: int = 0) -> float:
    """Share of all light that more than `bounces` reflections would add, from a few paths on a coarse grid.

    The paths with more bounces begin as those with fewer, so that the difference is light and not noise.
    """
    asked = _on_few_rows(scene, seed)
    mean = [
        float(backend.solve(scene, asked, paths=range(16), bounces=b, seed=seed).mean.mean())
        for b in (bounces, 3 * bounces + 20)
    ]
    return 1.0 - mean[0] / mean[1] if mean[1] > 0 else 0.0


def enough_bounces(scene: Scene, backend: Backend, seed: int = 0) -> tuple[int, float]:
    """Reflections to follow, and the share of light left out: below 1 %, and at least 4 reflections."""
    bounces, left_out = 4, light_left_out(scene, backend, 4, seed)
    while bounces < 128 and left_out >= 0.01:
        bounces += max(1, bounces // 4)
        left_out = light_left_out(scene, backend, bounces, seed)
    return bounces, left_out


def bake(
    scene: Scene,
    specs: Sequence[GridSpec],
    levels: Levels,
    sampler: Sampler,
    backend: Backend,
    interpolator: Interpolator,
    *,
    paths: Iterable[range],
    bounces: int,
    seed: int = 0,
    map: Map = map,
    progress: Progress = lambda what, done, total: None,
) -> Baked:
    """Compute the illumination grids of a scene, and the light of its walls.

    Parameters
    ----------
    scene : Scene
    specs : sequence of GridSpec
        The nodes, one lattice a field.
    levels : Levels
        Rows of the sweep at which the walls are lit.
    sampler, backend, interpolator
        Stage objects.
    paths : iterable of range
        Numbers of the paths from every node, one range after the other; the next is asked for when one is walked.
        A texel has `texel_paths` times as many.
    bounces : int
    seed : int
    map : callable, optional
        What spreads the batches: the built-in ``map``, or that of an executor or cluster.
    progress : callable, optional
        Told (what, done, total).
    """
    clock = [time.perf_counter()]
    batches = [batch for batch in sampler.queries(scene, specs, seed) if len(batch)]
    texels = wall_queries(scene, levels)
    more = texel_paths(sum(map(len, batches)), sum(map(len, texels)))
    batches += texels
    clock.append(time.perf_counter())

    total, walked = sum(len(batch) for batch in batches), 0
    answers: list[Samples] = []
    for numbers in paths:
        what, done, new = "more light" if answers else "light", 0, []
        progress(what, 0, total)
        for answer in map(partial(_answer, scene, backend, numbers, more, bounces, seed), batches):
            new.append(answer)
            done += len(answer)
            progress(what, done, total)
        answers = [combine(old, now) for old, now in zip(answers, new)] if answers else new
        walked += len(numbers)
    clock.append(time.perf_counter())

    grids = []
    del batches, texels
    for number, spec in enumerate(specs):
        samples = _of_field(scene, answers, number)
        answers = [a for a in answers if (a.queries.target != number).any()]  # a large run is held once, not twice
        grids.append(interpolator.fill(samples, spec, number))
        del samples
        progress("grid", number + 1, len(specs))
    walls = [_wall_texture(len(levels.table), quad, answer) for quad, answer in zip(scene.quads, answers)]
    clock.append(time.perf_counter())
    return Baked(
        grids=tuple(grids),
        walls=tuple(walls),
        seconds=dict(zip(("sampler", "backend", "interpolator"), np.diff(clock).tolist())),
        queries=total,
        paths=walked,
        holes=tuple(holes_within_range(scene, n, grid) for n, grid in enumerate(grids)),
    )


def _of_field(scene: Scene, answers: Sequence[Samples], number: int) -> Samples:
    own = [a if (a.queries.target == number).all() else a[a.queries.target == number] for a in answers]
    if own := [a for a in own if len(a)]:
        return join_samples(own)
    rgb = np.zeros((0, 3), np.float32)
    return Samples(Queries.at(scene, np.zeros((0, 3))), rgb, rgb, np.zeros(0, np.int32))
