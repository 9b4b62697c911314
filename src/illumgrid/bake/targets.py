"""Queries at nodes, their order, and the grid of each field from their samples."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.scene import Levels, Scene
from illumgrid.field.volume import world_to_index
from illumgrid.grid import GridSpec, IlluminationGrid, Nodes, channels_of
from illumgrid.samplers.direct import Direct, NodeQueries
from illumgrid.stages import Interpolator, Sampler
from illumgrid.transport.samples import Queries, Samples, join_queries, join_samples
from illumgrid.transport.stages import fill_nodes

HELD_ROWS = 5
"""Positions of the sweep, both ends included, at which a held level is lit."""


def node_queries(scene: Scene, specs: Sequence[GridSpec], sampler: Sampler, seed: int) -> list[Queries]:
    """The queries of a sampler; for `Direct` only the numbers of nodes are held, and queries made piece by piece."""
    if type(sampler) is Direct and all(field.isovalue is None for field in scene.fields):
        batches: list[Queries] = [NodeQueries(scene, number, spec) for number, spec in enumerate(specs)]
    else:
        batches = list(sampler.queries(scene, specs, seed))
    return [batch for batch in batches if len(batch)]


def held_queries(scene: Scene, nodes: Sequence[Queries]) -> list[Queries]:
    """Queries at the nodes of each field whose level is held, the others at `HELD_ROWS` positions of the sweep.

    One batch per field and position, position by position.
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


def coarse_first(scene: Scene, specs: Sequence[GridSpec], levels: Levels, queries: Queries) -> NDArray[np.int8]:
    """Ranks (n,) of targets: 0 for every fourth node or texel along each axis, 1 for every second, 2 for the others."""
    if isinstance(queries, NodeQueries):
        return _rank(np.unravel_index(queries.node, queries.spec.shape))
    index = np.zeros((len(queries), 3), np.int64)
    for target in np.unique(queries.target):
        own = queries.target == target
        if target < len(specs):
            index[own] = np.round(world_to_index(specs[target], queries.point[own]))
        else:
            nu, nv = scene.quads[target - len(specs)].texels
            number = (queries.id[own] & np.uint64((1 << 40) - 1)).astype(np.int64)
            index[own] = np.stack(np.unravel_index(number, (len(levels.table), nv, nu)), axis=1)
    return _rank(index.T)


def _rank(index: Sequence[NDArray[np.integer]] | NDArray[np.integer]) -> NDArray[np.int8]:
    even, fourth = (np.logical_and.reduce([axis % step == 0 for axis in index]).astype(np.int8) for step in (2, 4))
    return np.asarray(2 - even - fourth, np.int8)


def of_field(scene: Scene, answers: Sequence[Samples], number: int) -> Samples:
    """Samples of one field; a batch may hold several fields, and a field may have none."""
    own = [a if (a.queries.target == number).all() else a[a.queries.target == number] for a in answers]
    if own := [a for a in own if len(a)]:
        return own[0] if len(own) == 1 else join_samples(own)
    channels = channels_of(scene)
    none = np.zeros((0, len(channels)), np.float32)
    return Samples(Queries.at(scene, np.zeros((0, 3))), none, none, np.zeros(0, np.int32), channels)


def filled(
    scene: Scene, specs: Sequence[GridSpec], interpolator: Interpolator, answers: Sequence[Samples]
) -> Iterator[IlluminationGrid]:
    """The grid of each field in turn, from samples at all or some of its nodes."""
    for number, (field, spec) in enumerate(zip(scene.fields, specs)):
        samples = of_field(scene, answers, number)
        answers = [a for a in answers if (a.queries.target > number).any()]  # holds a large run once, not twice
        grid = fill_nodes(interpolator, samples, Nodes(spec, field, number))
        del samples
        yield grid
