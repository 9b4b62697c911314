"""The methods to compare: every available sampler with every backend and every interpolator."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from illumgrid import registry
from illumgrid.field.scene import Scene
from illumgrid.stages import Backend, Interpolator
from illumgrid.transport.samples import Queries
from illumgrid.transport.tracer import Tracer, prepare

COUNTS = (8, 32, 128)  # level sets that a sampler with the option ``count`` tries
SLOWEST = 0.005  # share of the budget that a backend may take for 64 queries and 4 paths


@dataclass(frozen=True, eq=False)
class Method:
    """A sampler with a backend, and the interpolators that may fill the grid from their samples."""

    sampler: Any  # a Sampler, once it is known
    backend: Backend
    tracer: Tracer
    surface: str  # representation of the level sets: "levelset" or "mesh"
    interpolators: tuple[Interpolator, ...]
    denser: "Method | None" = None  # the same with more level sets, tried after this one
    slow: float = 1.0  # time of the backend over that of the fastest one
    looked: bool = False  # whether a first look chooses the nodes, as `run` does under a sky

    def label(self, interpolator: Any) -> str:
        """Name of a contestant, as the chart shows it."""
        count = getattr(self.sampler, "count", None)
        sampler = (
            "first look" if self.looked else self.sampler.name if count is None else f"{self.sampler.name} {count}"
        )
        surface = f" ({self.surface})" if hasattr(self.backend, "surface") else ""
        changed = [] if interpolator == type(interpolator)() else map(str, asdict(interpolator).values())
        return f"{sampler}, {self.backend.name}{surface}, {' '.join([interpolator.name, *changed])}"


def tracers(scene: Scene, asked: Queries, budget: float) -> tuple[list[Method], list[str]]:
    """Methods without a sampler, one per backend and surface, already compiled; and why other backends are omitted."""
    found, notes = [], []
    few = asked[: min(64, len(asked))]
    few = few[np.flatnonzero((few.level == few.level[0]).all(axis=1))]  # a mesh is made for each level set
    for _, backend, can in registry.backends():
        if not can.transport:
            notes.append(f"{backend.name} does not compete: it computes no light transport, so no reference judges it")
            continue
        try:
            tracer = prepare(backend, scene)
            for some in (few[:1], few):  # the first call compiles and builds
                begun = time.perf_counter()
                tracer.solve(some, paths=range(4), bounces=2, seed=0)
        except Exception as reason:  # if a plugin's backend fails, the others go on
            notes.append(f"{backend.name} does not compete: {reason or type(reason).__name__}")
            continue
        spent = (time.perf_counter() - begun) * 64 / len(few)
        found.append(Method(None, backend, tracer, can.surface, (), slow=spent))
    fastest = min((method.slow for method in found), default=1.0)
    late = [method for method in found if method.slow > max(SLOWEST * budget, fastest)]
    notes += [f"{m.backend.name} does not compete: 64 queries with 4 paths took {m.slow:.2f} s" for m in late]
    return [replace(m, slow=m.slow / fastest) for m in found if m not in late], notes


def methods(tracers: Sequence[Method]) -> list[Method]:
    """Every sampler and interpolator with each of the `tracers`; each method begins with the fewest level sets."""
    found = []
    interpolators = tuple(registry.available("interpolator"))
    for sampler in registry.available("sampler"):
        for tracer in tracers:
            method = replace(tracer, sampler=sampler, interpolators=interpolators)
            if hasattr(sampler, "count"):
                denser = None
                for count in COUNTS[::-1]:
                    denser = method = replace(method, sampler=replace(sampler, count=count), denser=denser)
            found.append(method)
    return found
