"""Light transport by compiled kernels, which march the trilinear level set or trace rays against its mesh."""

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cache
from itertools import chain
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numba
import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.levelset import Marchable
from illumgrid.field.scene import Scene
from illumgrid.field.storing import read_at_random
from illumgrid.grid.cache import NO_CACHE, Cache
from illumgrid.grid.channels import Channels
from illumgrid.stages import Backend, hookimpl
from illumgrid.transport.samples import Queries, Samples, in_frame, in_turn
from illumgrid.transport.tracer import answered, laid_out, prepare, solve_once

if TYPE_CHECKING:
    from illumgrid.backends.mesh.meshes import Meshes


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Numba:
    """Paths by Numba kernels.

    Parameters
    ----------
    threads : int
        Threads that share the queries; 0 means one per processor. The result does not depend on it.
    surface : {"auto", "levelset", "mesh"}
        Representation of a level set. "levelset" marches the trilinear field: nothing is built, and every query may
        have its own level. "mesh" traces rays against the marching-cubes mesh, which differs by O(spacing²): one is
        built for each row of levels, at most `meshes.MOST_ROWS`. "auto" is "levelset": a single call does not show how
        many rays its meshes will serve in all, and results must not depend on it.
    """

    name: ClassVar[str] = "numba"
    geometry: ClassVar[Literal["mesh", "levelset", "both"]] = "both"
    threads: int = 0
    surface: str = "auto"

    def __post_init__(self) -> None:
        if self.threads < 0:
            raise BadInput(f"got {self.threads} threads; expected a positive number, or 0 for all")
        if self.surface not in ("auto", "levelset", "mesh"):
            raise BadInput(f"the surface is {self.surface!r}; expected 'auto', 'levelset' or 'mesh'")

    def prepare(self, scene: Scene) -> "NumbaTracer":
        """Lay the fields out; meshes are built on first use."""
        meshes = None
        if self.surface == "mesh":
            from illumgrid.backends.mesh import bvh
            from illumgrid.backends.mesh.meshes import Meshes, check_opaque

            check_opaque(scene)
            meshes = Meshes(scene, bvh.build)
        return NumbaTracer(self, scene, *laid_out(scene), meshes, pool(self.threads))

    solve = solve_once


@dataclass(frozen=True, eq=False)
class NumbaTracer:
    """A scene set up for `Numba`: any number of threads may use it. A copy in another process is set up there."""

    backend: Numba
    scene: Scene
    channels: Channels
    fields: Marchable
    meshes: "Meshes | None"
    threads: ThreadPoolExecutor
    cache: Cache = NO_CACHE

    def __reduce__(self) -> tuple[Any, ...]:
        return prepare, (self.backend, self.scene, self.cache)

    @in_turn
    def solve(self, queries: Queries, *, paths: range, bounces: int, seed: int) -> Samples:
        """Trace paths from every query: see `illumgrid.stages.Backend`."""
        n = len(queries)
        mean, m2 = np.zeros((2, n, len(self.channels)), np.float32)
        count = np.zeros(n, np.int32)
        answer = Samples(queries, mean, m2, count, self.channels)
        if n == 0 or len(paths) == 0:
            return answer
        from illumgrid.backends.kernels import solve_queries

        channels, (point, normal, level) = len(self.channels), in_frame(self.scene, queries)
        stop = np.zeros(1, np.uint8)

        def chunk(surfaces: Any, rows: NDArray[np.int64]) -> None:
            if "stack" in surfaces._fields:  # each piece of work has a stack of its own
                surfaces = surfaces._replace(stack=surfaces.stack.copy())
            light, spread = np.zeros((2, len(queries.id[rows]), channels), np.float32)
            good = np.zeros(len(light), np.int32)
            # Random numbers wrap around and misses are infinite, on purpose; without the JIT NumPy would warn of it.
            with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
                solve_queries(
                    surfaces, self.cache, queries.id[rows], point[rows], normal[rows], level[rows],
                    queries.target[rows], paths.start, bounces, np.uint64(seed), np.empty(channels),
                    np.empty((len(paths), channels)), light, spread, good, stop,
                )  # fmt: skip
            mean[rows], m2[rows], count[rows] = light, spread, good

        # Chunks of at most a million paths, so that progress is visible and threads end together.
        threads = self.backend.threads or cores()
        size = max(1, min(1024, max(16, n // (8 * threads) + 1), (1 << 20) // len(paths)))
        pieces: Iterator[tuple[Any, NDArray[np.int64]]] = (
            (surfaces, members[i : i + size])
            for surfaces, members in self._surfaces(queries.level)
            for i in range(0, len(members), size)
        )
        first = next(pieces)
        if not compiled(solve_queries, first[0]):
            beside(lambda: chunk(first[0], first[1][:0]))
        with read_at_random([field.volume.stored for field in self.scene.fields]):
            share(self.threads, chunk, chain([first], pieces), stop)
        return answer

    def _surfaces(self, level: NDArray[np.float64]) -> Iterator[tuple[Any, NDArray[np.int64]]]:
        """The surfaces, and the queries on them."""
        if self.meshes is None:
            yield self.fields, np.arange(len(level))
            return
        from illumgrid.backends.mesh.meshes import meshed, row_groups

        for row, members in row_groups(self.scene, level):
            yield meshed(self.fields, self.meshes.of(row)), members


LOOK = 0.2
"""Seconds after which a wait checks for Ctrl-C: a signal just before the system call would not interrupt it."""


def beside(work: Callable[[], None]) -> None:
    """Do work that cannot be interrupted, such as compilation, in another thread; Ctrl-C ends only the wait for it."""
    trouble: list[BaseException] = []

    def do() -> None:
        try:
            work()
        except BaseException as problem:
            trouble.append(problem)

    thread = threading.Thread(target=do, daemon=True)  # the process does not wait for it at its end
    thread.start()
    while thread.is_alive():
        thread.join(LOOK)
    if trouble:
        raise trouble[0]


def compiled(kernel: Any, surfaces: Any) -> bool:
    """Whether a kernel is compiled for surfaces of this type; as plain Python, it always is."""
    known = getattr(kernel, "signatures", None)
    return known is None or any(signature[0] == numba.typeof(surfaces) for signature in known)


def pool(threads: int) -> ThreadPoolExecutor:
    """So many threads, 0 for one per processor. The calling thread is not among them: it waits for Ctrl-C."""
    return _pool(threads or cores(), os.getpid())


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """The threads that all tracers of a process share; a forked process has none of its parent's."""
    return ThreadPoolExecutor(threads)


def share(
    threads: ThreadPoolExecutor,
    work: Callable[..., None],
    pieces: Iterator[tuple[Any, NDArray[np.int64]]],
    stop: NDArray[np.uint8],
) -> None:
    """Do the work on all pieces. Pieces are made while others are computed, but not many ahead of their turn.

    On Ctrl-C waiting pieces are dropped, and `stop` (1,) makes the running ones end.
    """
    waiting: dict[Future[None], int] = {}
    report = answered.get()

    def until(most: int) -> None:
        while len(waiting) > most:
            for future in wait(waiting, LOOK, FIRST_COMPLETED).done:
                future.result()
                report(waiting.pop(future))

    try:
        for piece in pieces:
            waiting[threads.submit(work, *piece)] = len(piece[1])
            until(4 * cores())
        until(0)
    except BaseException:
        stop[0] = 1
        raise
    finally:
        for future in waiting:
            future.cancel()
        wait(waiting)


@hookimpl
def register_backends() -> list[type[Backend]]:
    """Register the stage of this file, as a plugin does."""
    return [Numba]
