"""A backend set up for a scene: the setup runs once, and its data belong to the tracer."""

from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any, Protocol, cast

from illumgrid.errors import BadInput
from illumgrid.field.levelset import Marchable, marchable
from illumgrid.field.scene import Scene
from illumgrid.grid.cache import NO_CACHE, Cache
from illumgrid.grid.channels import Channels, channels_of, columns_of
from illumgrid.transport.samples import Queries, Samples
from illumgrid.transport.stages import Backend

answered: ContextVar[Callable[[int], None]] = ContextVar("answered", default=lambda count: None)
"""Called by a tracer while it solves, with the number of queries that were answered since the last call."""


class Tracer(Protocol):
    """Answers queries about one scene."""

    def solve(self, queries: Queries, *, paths: range, bounces: int, seed: int) -> Samples:
        """Trace the paths with these numbers from every query: see `Backend.solve`."""


@dataclass(frozen=True, eq=False)
class _Unprepared:
    """A backend that has `solve` and no preparation."""

    backend: Backend
    scene: Scene

    def solve(self, queries: Queries, *, paths: range, bounces: int, seed: int) -> Samples:
        return self.backend.solve(self.scene, queries, paths=paths, bounces=bounces, seed=seed)


def prepare(backend: Backend, scene: Scene, cache: Cache = NO_CACHE) -> Tracer:
    """Set up a scene for a backend; for a backend without a method ``prepare``, its ``solve`` is called.

    With a cache, paths end where it is trusted: see `ending_in`.
    """
    own = getattr(backend, "prepare", None)
    tracer = cast(Tracer, own(scene)) if own else _Unprepared(backend, scene)
    return tracer if cache is NO_CACHE else ending_in(cache, tracer)


def ending_in(cache: Cache, tracer: Tracer) -> Tracer:
    """The same tracer, whose paths end where a cache is trusted: all later bounces cost one lookup.

    A path that meets a surface before its last bounce ends there with albedo / π times the cached irradiance. It goes
    on from caps, from the backs of walls, after rays shorter than the lattice's spacing, in cells that are not trusted,
    and if its levels do not belong to one setting of the sweep. Light straight from sky and lamps is unchanged, and so
    are the random numbers: the result is a function of cache, seed, query and path.

    Parameters
    ----------
    cache : Cache
        From `illumgrid.grid.cache.cache_of` for the tracer's scene, such as
        ``cache_of(light.scene, light.grids, light.walls)``.
    tracer : Tracer
        From `prepare`.

    Raises
    ------
    BadInput
        If the tracer is that of a plugin without support for a cache.
    """
    if not hasattr(tracer, "cache"):
        raise BadInput(
            f"{type(tracer).__name__} follows paths to their ends only; expected the backend numba, embree or reference"
        )
    light = cache.light.view()
    light.flags.writeable = False  # always, also in another process; otherwise Numba compiles for another type
    ending: Tracer = replace(cast(Any, tracer), cache=cache._replace(light=light))
    return ending


def laid_out(scene: Scene) -> tuple[Channels, Marchable]:
    """Channels of a scene, and the scene laid out for marching, with albedos and light per channel.

    All channels use the same paths.
    """
    return channels_of(scene), marchable(scene, columns_of(scene))


def solve_once(backend: Any, scene: Scene, queries: Queries, *, paths: range, bounces: int, seed: int) -> Samples:
    """Set up a scene and solve once: the method ``solve`` of a backend with ``prepare``."""
    answer: Samples = backend.prepare(scene).solve(queries, paths=paths, bounces=bounces, seed=seed)
    return answer
