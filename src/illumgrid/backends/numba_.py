"""Light transport by compiled kernels that march the trilinear level set: no mesh, no build for a new isovalue."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.levelset import in_frame, marchable
from illumgrid.samples import Queries, Samples, check_request
from illumgrid.scene import Scene
from illumgrid.stages import Backend, hookimpl


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Numba:
    """Paths by Numba kernels that march the trilinear level set.

    Parameters
    ----------
    threads : int
        Threads that share the queries; 0 takes one for each processor. The answer does not depend on it.
    """

    name: ClassVar[str] = "numba"
    geometry: ClassVar[Literal["mesh", "levelset", "both"]] = "levelset"
    threads: int = 0

    def __post_init__(self) -> None:
        if self.threads < 0:
            raise BadInput(f"{self.threads} threads were asked for; expected a positive number, or 0 for all")

    def solve(self, scene: Scene, queries: Queries, *, paths: range, bounces: int, seed: int) -> Samples:
        """Trace paths from every query: see `illumgrid.stages.Backend`."""
        check_request(paths, bounces)
        n = len(queries)
        mean, m2 = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
        count = np.zeros(n, np.int32)
        answer = Samples(queries, mean, m2, count)
        if n == 0 or len(paths) == 0:
            return answer
        from illumgrid.backends.kernels import solve_queries

        fields = marchable(scene)
        point, normal, level = in_frame(scene, queries)

        def chunk(rows: slice) -> None:
            # Random numbers wrap around and misses are infinite, on purpose; without the JIT NumPy would warn of it.
            with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
                solve_queries(
                    fields, queries.id[rows], point[rows], normal[rows], level[rows], queries.target[rows],
                    paths.start, len(paths), bounces, np.uint64(seed), mean[rows], m2[rows], count[rows],
                )  # fmt: skip

        chunk(slice(0, 0))  # compiles here, where Ctrl-C is heard, and once
        threads = self.threads or cores()
        # Ctrl-C waits for the chunks at work: at most a million paths each.
        size = max(1, min(1024, max(16, n // (8 * threads) + 1), (1 << 20) // len(paths)))
        chunks = [slice(i, i + size) for i in range(0, n, size)]
        if threads == 1 or len(chunks) == 1:
            for rows in chunks:
                chunk(rows)
            return answer
        pool = ThreadPoolExecutor(threads)
        try:
            list(pool.map(chunk, chunks))
        finally:
            pool.shutdown(cancel_futures=True)  # on Ctrl-C the chunks that wait are dropped
        return answer


@hookimpl
def register_backends() -> list[type[Backend]]:
    """Name this file's stage to the registry, as a plugin does."""
    return [Numba]
