"""From scene and stages to grids: sample queries, solve them, combine, fill. No disk, no names of stages, no output."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from illumgrid.bake.accumulator import Bake, Map, Progress
from illumgrid.bake.targets import HELD_ROWS, coarse_first, filled, held_queries, node_queries
from illumgrid.bake.walls import texel_paths, wall_queries, wall_texture
from illumgrid.field.scene import Levels, Scene
from illumgrid.field.volume import interpolate, world_to_index
from illumgrid.grid import GridSpec, IlluminationGrid, Nodes, WallTexture
from illumgrid.grid.nodes import reached
from illumgrid.stages import Interpolator, Sampler
from illumgrid.transport.stages import fill_nodes
from illumgrid.transport.tracer import Tracer
from illumgrid.transport.walk import Keeper, in_order


@dataclass(frozen=True, eq=False)
class Baked:
    """Light for every field, and how it was computed.

    Parameters
    ----------
    grids : tuple of IlluminationGrid
        One per field.
    walls : tuple of WallTexture
        One per quad.
    seconds : dict
        Wall time of each stage.
    queries : int
        Number of queries answered, texels among them.
    paths : int
        Paths per query of a field.
    texels : int
        Queries on walls, and paths per such query.
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


def holes_within_range(scene: Scene, field: int, grid: IlluminationGrid) -> int:
    """Unsupported nodes through which an isosurface of the range passes, outside the solids of other fields."""
    own = scene.fields[field]
    empty = np.flatnonzero(grid.dark & reached(own, grid.spec))
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
        The nodes, one lattice per field.
    levels : Levels
        Rows of the sweep at which the walls are lit.
    sampler, interpolator
        Stage objects.
    tracer : Tracer
        A backend with the scene set up: `illumgrid.transport.tracer.prepare`.
    paths : iterable of range
        Numbers of the paths from every node, one range after the other; the next range is requested when one is done.
        A texel gets `texel_paths` times as many.
    bounces : int
    seed : int
    map : callable, optional
        Applies a function to batches: the built-in ``map``, or that of an executor or cluster.
    progress : callable, optional
        Called with (what, done, total).
    keep : Keeper, optional
        Keeps the light as it is computed, from coarse to fine, and returns that of a stopped run.
    """
    clock = [time.perf_counter()]
    nodes = node_queries(scene, specs, sampler, seed)
    texels = wall_queries(scene, levels)
    asked, on_walls = (sum(len(batch) for batch in batches) for batches in (nodes, texels))
    more = texel_paths(asked, on_walls)
    held, count = held_queries(scene, nodes), len(nodes)
    state = Bake((*nodes, *held, *texels), (1,) * (count + len(held)) + (more,) * len(texels), bounces, seed)
    del nodes, texels
    clock.append(time.perf_counter())
    ranks = None if keep is None else [coarse_first(scene, specs, levels, batch) for batch in state.targets]
    choose = keep.begin(state.targets, in_order(ranks)) if keep is not None and ranks else None
    for numbers in paths:
        state = state.walk(tracer, numbers, map, progress, keep, ranks, choose)
    if keep is not None and state.answers:
        keep.end(state.answers)
    del ranks, tracer
    clock.append(time.perf_counter())

    grids, walked = list[IlluminationGrid](), state.paths
    rows, on_quads = list(state.answers[count : count + len(held)]), state.answers[count + len(held) :]
    filling = filled(scene, specs, interpolator, state.answers[:count])
    del state, held
    for number, (field, grid) in enumerate(zip(scene.fields, filling)):
        if field.isovalue is not None:
            nodes_of = Nodes(grid.spec, field, number)
            grid = replace(grid, rows=tuple(fill_nodes(interpolator, rows.pop(0), nodes_of) for _ in range(HELD_ROWS)))
        grids.append(grid)
        progress("grid", number + 1, len(specs))
    walls = [wall_texture(len(levels.table), quad, answer) for quad, answer in zip(scene.quads, on_quads)]
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
