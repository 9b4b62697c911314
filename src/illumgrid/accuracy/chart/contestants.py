"""Who takes part: every sampler with every backend and every interpolator that can be had here."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from illumgrid import registry
from illumgrid.errors import BadInput
from illumgrid.field.scene import Scene
from illumgrid.stages import Backend, Interpolator, Sampler
from illumgrid.transport.samples import Queries
from illumgrid.transport.tracer import prepare

COUNTS = (8, 32, 128)
"""Level sets that a sampler with the option ``count`` tries."""

SLOWEST = 0.005
"""Share of the budget that a backend may take for 64 queries and 4 paths."""


@dataclass(frozen=True)
class Way:
    """A way to make samples, and all that may fill the grid from them.

    Parameters
    ----------
    sampler : Sampler
    backend : Backend
    surface : str
        What stands for the level sets: "levelset" or "mesh".
    interpolators : tuple of Interpolator
    denser : Way, optional
        The same with more level sets, which is tried after this one.
    slow : float
        What the backend takes, over what the fastest one takes.
    """

    sampler: Sampler
    backend: Backend
    surface: str
    interpolators: tuple[Interpolator, ...]
    denser: "Way | None" = None
    slow: float = 1.0

    def label(self, interpolator: Interpolator) -> str:
        """Name of a contestant, as the chart shows it."""
        count = getattr(self.sampler, "count", None)
        sampler = self.sampler.name if count is None else f"{self.sampler.name} {count}"
        surface = f" ({self.surface})" if hasattr(self.backend, "surface") else ""
        return f"{sampler}, {self.backend.name}{surface}, {interpolator.name}"


def _stages(kind: str) -> Iterator[Any]:
    """Every stage of a kind with its default options; what cannot be had here is passed over."""
    for entry in registry.entries():
        if entry.kind == kind and entry.missing() is None:
            try:
                yield registry.make(kind, entry.name, {})
            except (BadInput, ImportError):  # two packages claim the name, or something is missing after all
                continue


def backends(scene: Scene, asked: Queries, budget: float) -> tuple[list[tuple[Any, str, float]], list[str]]:
    """Backends with their surfaces and slowness, warm, and sentences about those that are too slow for the budget.

    The fastest one is never too slow.
    """
    took: list[tuple[float, Any, str]] = []
    notes = []
    few = asked[: min(64, len(asked))]
    few = few[np.flatnonzero((few.level == few.level[0]).all(axis=1))]  # a mesh is made for each level set
    for _, backend, can in registry.backends():
        try:
            tracer = prepare(backend, scene)
            for some in (few[:1], few):  # compiled and built in the first
                begun = time.perf_counter()
                tracer.solve(some, paths=range(4), bounces=2, seed=0)
        except BadInput as reason:
            notes.append(f"{backend.name} takes no part: {reason}")
            continue
        took.append(((time.perf_counter() - begun) * 64 / len(few), backend, can.surface))
    found, fastest = [], min((spent for spent, _, _ in took), default=1.0)
    for spent, backend, surface in took:
        if spent <= max(SLOWEST * budget, fastest):
            found.append((backend, surface, spent / fastest))
        else:
            notes.append(f"{backend.name} takes no part: 64 queries with 4 paths took {spent:.2f} s")
    return found, notes


def ways(scene: Scene, asked: Queries, budget: float) -> tuple[list[Way], list[str]]:
    """Every way to make samples here, with the fewest level sets each, and why some are missing."""
    tracers, notes = backends(scene, asked, budget)
    interpolators = tuple(_stages("interpolator"))
    found = []
    for sampler in _stages("sampler"):
        for backend, surface, slow in tracers:
            if not hasattr(sampler, "count"):
                found.append(Way(sampler, backend, surface, interpolators, slow=slow))
                continue
            way = None
            for count in COUNTS[::-1]:
                way = Way(replace(sampler, count=count), backend, surface, interpolators, way, slow)
            if way is not None:
                found.append(way)
    return found, notes
