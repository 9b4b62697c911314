"""Light computed before a bake: a coarse grid in which paths end, a first look that chooses the nodes, or nothing."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from illumgrid.bake.bounces import enough_bounces
from illumgrid.bake.known import light_known_first
from illumgrid.bake.refined import ROUGH, Chosen, chosen, written
from illumgrid.constants import BASE, PATHS
from illumgrid.field.diagnosis import noisy
from illumgrid.field.lattice import specs_over
from illumgrid.field.layers import layers_of
from illumgrid.field.scene import Levels, Scene, level_table
from illumgrid.grid import GridSpec
from illumgrid.grid.cache import cache_of
from illumgrid.grid.nested import finer, halvings
from illumgrid.grid.nodes import reached
from illumgrid.interpolators.bilateral import Bilateral
from illumgrid.interpolators.nearest import Nearest
from illumgrid.interpolators.nested import Nested
from illumgrid.samplers.direct import Direct
from illumgrid.stages import Interpolator, Sampler
from illumgrid.transport.stages import capabilities
from illumgrid.transport.tracer import Tracer, ending_in

BY_NORMAL: tuple[Interpolator, int] = Bilateral(1.0), 16
"""The interpolator for noisy data, and the number of paths that suffices for it, since it averages neighbours."""


@dataclass(frozen=True, eq=False)
class Ahead:
    """The queries and stages of a bake, and the light that was computed before it."""

    specs: Sequence[GridSpec]
    sampler: Sampler
    tracer: Tracer
    interpolator: Interpolator
    cached: bool = False  # whether paths end in the light of a cache
    refined: dict[str, Any] | None = None  # the nodes that a first look chose
    paths: int = PATHS
    bounces: int = 0  # number of reflections that its paths follow
    name: str = ""  # of the light computed before

    @property
    def levels(self) -> int:
        """How often a first look halved the spacing of its lattice."""
        return self.refined["levels"] if self.refined else 0


def light_ahead(
    scene: Scene, specs: Sequence[GridSpec], levels: Levels, tracer: Tracer, stages: tuple[Any, Any, Any], *,
    refining: bool, cached: bool, automatic: bool, bounces: int, **how: Any,
) -> Ahead:  # fmt: skip
    """Compute a coarse grid in which paths end, a first look that chooses the nodes, both, or neither."""
    in_look = refining and automatic and hasattr(tracer, "cache")  # the look has its light anyway
    ending = tracer
    if cached and not in_look:
        ending = light_known_first(scene, specs, levels, tracer, bounces=bounces, **how)
    if not refining:
        return Ahead(specs, stages[0], ending, stages[2], cached, bounces=bounces, name="cache" if cached else "")
    nodes = chosen(scene, specs, halvings(specs), ending, bounces=2 * bounces, **how)
    if in_look:
        ending = ending_in(cache_of(scene, nodes.looked, (), ROUGH), tracer)  # no path ends in a cell that is refined
    return Ahead(
        [finer(spec, nodes.levels) for spec in specs], Chosen(nodes.flat), ending, Nested(nodes.levels),
        cached or in_look, written(nodes, specs), nodes.paths, bounces, "look",
    )  # fmt: skip


def lattice(specs: Sequence[GridSpec], tracer: Tracer, bounces: int) -> Ahead:
    """All nodes of some lattices, with no light computed before."""
    return Ahead(specs, Direct(), tracer, Nearest(), bounces=bounces)


def looked(scene: Scene, tracer: Tracer, longest: int | None, bounces: int | None, seed: int) -> Ahead:
    """The first look of `run` at lattices of `longest` nodes along the longest axis; None: the defaults of `run`."""
    return light_ahead(
        scene, specs_over(scene, longest, BASE), level_table(scene, 2), tracer, (None, None, None), refining=True,
        cached=False, automatic=bounces is None, seed=seed,
        bounces=enough_bounces(scene, tracer, seed)[0] if bounces is None else bounces,
    )  # fmt: skip


def nodes_to_light(scene: Scene, ahead: Ahead) -> int:
    """Number of nodes that a run lights."""
    if isinstance(ahead.sampler, Chosen):
        return sum(map(len, ahead.sampler.nodes))
    # Masks take an eighth of the memory of node numbers.
    return sum(int(np.count_nonzero(reached(field, spec))) for field, spec in zip(scene.fields, ahead.specs))


def refinable_by(scene: Scene, sampler: Any, backend: Any, interpolator: Any) -> bool:
    """Whether nodes are refined where the light is rough: under one light, with the default stages.

    In the studio, whose key casts sharp shadows, refinement gained little for its time.
    """
    return len(layers_of(scene)) == 1 and _free(scene, sampler, backend, interpolator)


def by_normal_in(scene: Scene, sampler: Any, backend: Any, interpolator: Any) -> bool:
    """Whether `bilateral` is used: for noisy data under several lights, with the default stages."""
    several = len(layers_of(scene)) > 1
    return several and _free(scene, sampler, backend, interpolator) and all(map(noisy, scene.fields))


def _free(scene: Scene, sampler: Any, backend: Any, interpolator: Any) -> bool:
    """Whether a run may choose: no stage was requested, there are no walls, and all isovalues sweep together."""
    can = capabilities(backend)
    return (
        not scene.quads
        and (sampler.name, interpolator.name) == ("direct", "nearest")
        and can.transport
        and can.surface == "levelset"
        and all(field.isovalue is None for field in scene.fields)
    )
