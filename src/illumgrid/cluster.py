"""Many processes or machines: a ``map`` over the workers of dask.distributed.

The scene goes to every worker once, where it is set up once; pieces of work follow, a few for each worker at a time. A
lost worker's pieces are done again by others. An answer does not depend on who computes it, so that any number of
workers gives the same bits, on one kind of processor and one set of versions.
"""

import logging
import platform
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from illumgrid.errors import BadInput

AHEAD = 3
"""Pieces of work for each thread that are on their way at a time."""
TRIES = 5
"""How often a piece is restarted whose scene or answer was lost with a worker."""
PATIENCE = 30.0
"""Seconds to wait for a scheduler, or for its first worker."""


def machine() -> dict[str, str]:
    """Properties of this machine that determine the last digits of light."""
    from llvmlite.binding import get_host_cpu_name

    versions = {name: version(name) for name in ("illumgrid", "numba", "numpy", "scipy")}
    return {"processor": get_host_cpu_name(), "system": platform.machine(), **versions}


def _work(function: Callable[[Any], Any], piece: Any, expected: dict[str, str] | None) -> Any:
    """Do a piece of work on a worker."""
    if expected is not None and (other := _other(machine(), expected)):
        raise BadInput(f"a worker on {platform.node()} has {other}; {_REMEDY}")
    return function(piece)


_REMEDY = "expected the same on all, for the same bits; any_machine=True accepts light that differs in its last digits"


def _other(found: dict[str, str], expected: dict[str, str]) -> str:
    """The differences between two machines, as text; empty if there are none."""
    return ", ".join(
        f"{key} {found.get(key)} (here {expected[key]})" for key in expected if found.get(key) != expected[key]
    )


@dataclass(eq=False)
class ClusterMap:
    """Like the built-in ``map``, over the workers of a cluster; results come in the order of the work."""

    client: Any
    expected: dict[str, str] | None

    def __call__(self, function: Callable[[Any], Any], work: Iterable[Any]) -> Iterator[Any]:
        """Apply `function` to each piece of `work`."""
        shared = self._share(function)
        waiting: deque[tuple[Any, Any]] = deque()
        pieces = iter(work)
        try:
            while True:
                while len(waiting) < max(2, AHEAD * self._threads()):
                    try:
                        piece = next(pieces)
                    except StopIteration:
                        break
                    waiting.append((piece, self._submit(shared, piece)))
                if not waiting:
                    return
                piece, future = waiting.popleft()
                for _ in range(TRIES):
                    try:
                        result = future.result()
                        break
                    except _lost():
                        shared = self._share(function)
                        future = self._submit(shared, piece)
                        waiting = deque(
                            (p, self._submit(shared, p) if f.status != "finished" else f) for p, f in waiting
                        )
                else:
                    raise BadInput(f"a piece of work was lost {TRIES} times with its worker; look at the workers' logs")
                yield result
        finally:
            with suppress(Exception):
                self.client.cancel([future for _, future in waiting])

    def _share(self, function: Callable[[Any], Any]) -> Any:
        return self.client.scatter(function, broadcast=True, hash=False)

    def _submit(self, shared: Any, piece: Any) -> Any:
        return self.client.submit(_work, shared, piece, self.expected, pure=False)

    def _threads(self) -> int:
        return int(sum(self.client.nthreads().values()))


def _lost() -> tuple[type[BaseException], ...]:
    """The exceptions that dask raises when a worker was lost with its data."""
    from concurrent.futures import CancelledError

    from distributed.client import FutureCancelledError
    from distributed.scheduler import KilledWorker

    return CancelledError, FutureCancelledError, KilledWorker


@contextmanager
def cluster(
    workers: int | None = None, address: str | None = None, *, any_machine: bool = False
) -> Iterator[tuple[ClusterMap, str]]:
    """Start `workers` processes on this machine, or join the scheduler at `address`.

    Parameters
    ----------
    workers : int, optional
    address : str, optional
        Such as ``tcp://host:8786``.
    any_machine : bool
        Accept workers with another processor, or with other versions of what computes.

    Yields
    ------
    ClusterMap
        For ``map=`` of `illumgrid.run`.
    str
        A line about the workers.

    Raises
    ------
    BadInput
        If dask.distributed is missing, nobody answers, or a worker is of another kind.
    """
    try:
        from distributed import Client, LocalCluster
        from distributed.comm import addressing
    except ImportError as reason:
        raise BadInput(f"several workers need dask.distributed ({reason}); pip install 'illumgrid[dask]'") from None
    with ExitStack() as stack:
        logging.getLogger("distributed").setLevel(logging.ERROR)
        if address is None:
            local = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=":0", memory_limit=0
            )
            stack.enter_context(local)
            address = local.scheduler_address
        try:  # before there is a client: one of a malformed address takes minutes to close
            addressing.get_address_host_port(addressing.normalize_address(address))
        except ValueError as reason:
            raise BadInput(
                f"the address of the dask scheduler is {address!r} ({reason}); expected one such as tcp://host:8786"
            ) from None
        try:
            client = stack.enter_context(Client(address, timeout=PATIENCE, set_as_default=False))
            client.wait_for_workers(1, timeout=PATIENCE)
        except (OSError, TimeoutError, ValueError) as reason:
            raise BadInput(
                f"no worker of a dask scheduler at {address!r} answered ({reason}); start it first"
            ) from reason
        expected = None if any_machine else machine()
        try:
            found = client.run(machine)
        except Exception as reason:
            raise BadInput(
                f"a worker cannot compute light ({reason}); expected illumgrid installed on each"
            ) from reason
        for where, about in found.items():
            if expected and (other := _other(about, expected)):
                raise BadInput(f"the worker {where} has {other}; {_REMEDY}")
        threads = sum(client.nthreads().values())
        yield ClusterMap(client, expected), f"{len(found)} workers with {threads} threads at {address}"
