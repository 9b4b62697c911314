"""Everything that the author of a stage imports: the protocols, the hooks, and the types that they use."""

from illumgrid.transport.stages import (
    CONTRACT,
    Backend,
    GridSpec,
    IlluminationGrid,
    Interpolator,
    Nodes,
    Queries,
    Sampler,
    Samples,
    hookimpl,
    on_level_sets,
    register_backends,
    register_interpolators,
    register_samplers,
)

__all__ = [
    "CONTRACT",
    "Backend",
    "GridSpec",
    "IlluminationGrid",
    "Interpolator",
    "Nodes",
    "Queries",
    "Sampler",
    "Samples",
    "hookimpl",
    "on_level_sets",
    "register_backends",
    "register_interpolators",
    "register_samplers",
]
