"""A backend set up for a scene: the setup runs once, and its data belong to the tracer."""

from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Protocol, cast

from illumgrid.field.levelset import Marchable, marchable
from illumgrid.field.scene import Scene
from illumgrid.grid.channels import Channels, channels_of, columns_of
from illumgrid.transport.samples import Queries, Samples
from illumgrid.transport.stages import Backend

answered: ContextVar[Callable[[int], None]] = ContextVar("answered", default=lambda count: None)
"""What a tracer calls while it solves, with the number of queries that have their answer since the last call."""


class Tracer(Protocol):
    """Answers queries about one scene."""

    def solve(self, queries: Queries, *, paths: range, bounces: int, seed: int) -> Samples:
        """Trace the paths with these numbers from every query: see `Backend.solve`."""


@dataclass(frozen=True, eq=False)
class _Unprepared:
    """A backend that has `solve` and nothing to prepare."""

    backend: Backend
    scene: Scene

    def solve(self, queries: Queries, *, paths: range, bounces: int, seed: int) -> Samples:
        return self.backend.solve(self.scene, queries, paths=paths, bounces=bounces, seed=seed)


def prepare(backend: Backend, scene: Scene) -> Tracer:
    """Set up a scene for a backend; a backend without a method ``prepare`` is called by its ``solve``."""
    own = getattr(backend, "prepare", None)
    return cast(Tracer, own(scene)) if own else _Unprepared(backend, scene)


def laid_out(scene: Scene) -> tuple[Channels, Marchable]:
    """Channels of a scene, and the scene laid out for marching, with albedos and light per channel.

    All channels use the same paths.
    """
    return channels_of(scene), marchable(scene, columns_of(scene))


def solve_once(backend: Any, scene: Scene, queries: Queries, *, paths: range, bounces: int, seed: int) -> Samples:
    """Set up a scene and solve once: the method ``solve`` of a backend with ``prepare``."""
    answer: Samples = backend.prepare(scene).solve(queries, paths=paths, bounces=bounces, seed=seed)
    return answer
