"""An unfinished run as light to look at: finished parts are lit, from coarse to fine, all others are striped."""

import os
from collections.abc import Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid import registry
from illumgrid.bake.refined import Chosen, read_choice
from illumgrid.bake.targets import coarse_first, held_queries, node_queries, of_field
from illumgrid.bake.walls import wall_queries, wall_texture
from illumgrid.constants import BASE
from illumgrid.errors import BadInput
from illumgrid.field.lattice import specs_over
from illumgrid.field.scene import finer_texels, level_table
from illumgrid.field.volume import world_to_index
from illumgrid.grid import IlluminationGrid, Nodes, WallTexture
from illumgrid.grid.nested import finer
from illumgrid.interpolators.nested import Nested
from illumgrid.io import disk, partial, store
from illumgrid.light import Illumination
from illumgrid.transport.samples import Queries, Samples, combine, join_queries
from illumgrid.transport.stages import fill_nodes
from illumgrid.transport.walk import Answer, in_order, split

REACH = 3.5
"""Reach of a lit node, in nodes: half the diagonal between nodes of the coarsest pass, and a little more."""
_STRIPE = 2
"""Nodes across a stripe, which marks what is not lit."""


def place_of(folder: str | os.PathLike[str]) -> Path | None:
    """The partial run that a folder is, or that lies beside a folder that does not exist; None if there is none."""
    own = Path(folder)
    if partial.is_partial(own):
        return own
    if os.path.exists(own):  # also of "" and "/", which have no name
        return None
    near = partial.beside(own)
    return near if partial.is_partial(near) else None


def load(place: Path) -> tuple[Illumination, float]:
    """Read the light of a partial run, and the share of all light that it has.

    Raises
    ------
    BadInput
        If it cannot be read.
    """
    with disk.sentences(f"{place} cannot be used", "wait for the run, or start it again"):
        stored = store.read(place / partial.SCENE)
        kept = partial.read(place)
        about, chosen, scene = kept.attributes["identity"], kept.attributes["chosen"], stored.scene
        scene = finer_texels(scene, (chosen["plan"] or {}).get("finer", 1.0))
        sampler, interpolator = (
            registry.make(kind, about[kind]["name"], {k: v for k, v in about[kind].items() if k != "name"})
            for kind in ("sampler", "interpolator")
        )
        specs = specs_over(scene, chosen["grid"])
        levels = level_table(scene, about["isovalues"] or 32)
        if refined := chosen.get("refined"):
            base = specs_over(scene, chosen["grid"], BASE)
            choice = read_choice(refined)
            specs = [finer(spec, choice.levels) for spec in base]
            sampler, interpolator = Chosen(choice.flat), Nested(choice.levels)
        nodes = node_queries(scene, specs, sampler, about["seed"])
        held = held_queries(scene, nodes)
        targets = nodes + held + wall_queries(scene, levels)
        order = in_order([coarse_first(scene, specs, levels, batch) for batch in targets])
        if len(order) != kept.attributes["rows"]:
            raise BadInput(f"it is of {kept.attributes['rows']} points, not of {len(order)}")
        samples, share = _samples(targets, order, kept.ranges)
        whole = Answer(samples.light, samples.spread, samples.paths, samples.channels, 0.0)
        answers = [answer for answer in split(whole, targets) if answer is not None]
        del answers[len(nodes) : len(nodes) + len(held)]  # the middle of the sweep is used until the run has ended
        grids = []
        for number, (field, spec) in enumerate(zip(scene.fields, specs)):
            known = of_field(scene, answers, number)
            known = known[known.paths >= 0]
            grid = fill_nodes(interpolator, known, Nodes(spec, field, number))
            grids.append(_marked(grid, known))
        walls = [
            _wall(len(levels.table), quad, answer)
            for quad, answer in zip(scene.quads, answers[len(answers) - len(scene.quads) :])
        ]
    recipe = {**about, **chosen, "paths": chosen["paths"] or 0, "share": share}
    return Illumination(scene, levels, tuple(grids), tuple(walls), recipe), share


def _samples(targets: Sequence[Queries], order: NDArray[np.int64], ranges: Mapping[str, Any]) -> tuple[Samples, float]:
    """Samples in the order of the targets, with paths -1 for those without light; and the lit share."""
    queries, parts = join_queries(targets), []
    for arrays in ranges.values():
        light, spread, paths = (np.empty_like(arrays[key]) for key in ("light", "spread", "paths"))
        for own, key in ((light, "light"), (spread, "spread"), (paths, "paths")):
            own[order] = arrays[key]
        parts.append(Samples(queries, light, spread, paths, arrays["channels"]))
    if not parts:
        raise BadInput("nothing is lit yet")
    known = np.any([part.paths >= 0 for part in parts], axis=0)
    share = float(np.mean(parts[-1].paths >= 0))
    lit = [Samples(queries, p.light, p.spread, np.maximum(p.paths, 0), p.channels) for p in parts]
    whole = reduce(combine, lit)
    return Samples(queries, whole.light, whole.spread, np.where(known, whole.paths, -1), whole.channels), share


def _marked(grid: IlluminationGrid, known: Samples) -> IlluminationGrid:
    """The grid with stripes on the nodes that are far from every sample."""
    from scipy.ndimage import distance_transform_edt

    index = np.round(world_to_index(grid.spec, known.queries.point)).astype(np.int64)
    unlit = np.ones(grid.spec.shape, bool)
    unlit[tuple(np.clip(index, 0, np.array(grid.spec.shape) - 1).T)] = False
    far = distance_transform_edt(unlit) > REACH if len(known) else unlit
    stripes = np.indices(far.shape).sum(axis=0) // _STRIPE % 2
    lit = grid.light[~far]
    bright = 1.5 * lit.mean(axis=0) if len(lit) else np.ones(len(grid.channels))
    light = np.where(far[..., None], stripes[..., None] * bright, grid.light).astype(np.float32)
    support = np.where(far, 0.0, np.maximum(grid.support, 1.0)).astype(np.float32)
    return IlluminationGrid(grid.spec, light, grid.error, support, grid.channels, grid.errors)


def _wall(rows: int, quad: Any, answer: Samples) -> WallTexture:
    """Texture of a wall; an unlit texel has the light of its nearest lit one."""
    paths = np.maximum(answer.paths, 0)
    return wall_texture(rows, quad, Samples(answer.queries, answer.light, answer.spread, paths, answer.channels))
