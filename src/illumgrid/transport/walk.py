"""Tracing paths from many targets, in pieces of any size and order, with answers kept; the result has the same bits."""

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from illumgrid.grid.channels import Channels
from illumgrid.transport.samples import Queries, Samples
from illumgrid.transport.tracer import Tracer

PIECE = 1 << 17
"""Paths in the first piece of work."""
SECONDS = 2.0
"""Seconds that a piece should take; later pieces are sized by the pace of those before."""
AT_ONCE = 0.25
"""The same if somebody watches, and may look elsewhere before the next piece."""
MOST = 1 << 16
"""Largest number of targets of a piece, whose queries and answers are held in addition to those of the whole walk."""
LOOKED_AT = 1 << 22
"""Targets among which the next ones are searched at a time."""
GROWTH = 4.0
"""Largest ratio of the sizes of consecutive pieces."""

Ranks = Sequence[NDArray[np.integer]]
"""For each batch, ranks (n,): targets of low rank come first."""


Chooser = Callable[[NDArray[np.bool_], Sequence[int]], tuple[int, NDArray[np.int64]]]
"""From what has no answer yet, of all rows, and how many targets of each batch make a piece: the batch of the next
piece, and which of its targets, in their order."""


class Keeper(Protocol):
    """Keeps answers during a walk, and returns those of a walk that was stopped: see `illumgrid.io.partial`.

    A row is the place of a target in all batches, one after the other.
    """

    def begin(self, targets: Sequence[Queries], order: NDArray[np.int64]) -> Chooser | None:
        """Receive the targets, and the rows in the order in which their answers will come; may choose another order."""

    def known(self, paths: range) -> "Answer | None":
        """Answers of all rows, with paths -1 for unknown ones; None if none is known."""

    def keep(self, rows: NDArray[np.int64], answer: "Answer") -> None:
        """Take the answers of some rows."""

    def flush(self) -> None:
        """Bring the received answers to the disk, if that is worthwhile."""

    def end(self, answers: Sequence[Samples]) -> None:
        """Receive the moments of all paths of all rows at the end."""


class RunKeeper(Keeper, Protocol):
    """A keeper that also records what a whole run chose."""

    at_once: bool
    """Whether somebody waits for the first answers: then no coarse grid is lit first in which paths end."""
    chosen: dict[str, Any] | None
    """The choices of the run that is resumed."""

    def choose(self, chosen: dict[str, Any]) -> None:
        """Record the choices of a run, for a run that resumes it."""


class Answer(NamedTuple):
    """The result of a piece of work: samples without their queries, which are not sent back."""

    light: NDArray[np.float32]
    spread: NDArray[np.float32]
    paths: NDArray[np.int32]
    channels: Channels
    seconds: float


def answer(tracer: Tracer, bounces: int, seed: int, work: tuple[Queries, range]) -> Answer:
    """Do a piece of work."""
    begun = time.perf_counter()
    found = tracer.solve(work[0], paths=work[1], bounces=bounces, seed=seed)
    return Answer(found.light, found.spread, found.paths, found.channels, time.perf_counter() - begun)


@dataclass(eq=False)
class Walk:
    """A walk in progress: the pieces of its work, and the answers of each batch as they come in.

    An answer does not depend on what is asked together with it, so a piece may have any size.

    Parameters
    ----------
    targets : sequence of Queries
        Batches.
    ranges : sequence of range
        Numbers of the paths from each target of a batch.
    answers : list of Samples
        What is known already, one per batch, paths -1 where it is not; None for a batch without any.
    seconds : float
        That a piece should take.
    """

    targets: Sequence[Queries]
    ranges: Sequence[range]
    answers: list[Samples | None]
    seconds: float = SECONDS
    size: float = field(default_factory=lambda: float(PIECE))
    asked: deque[tuple[int, NDArray[np.int64]]] = field(default_factory=deque)

    def pieces(self, ranks: Ranks | None = None) -> Iterator[tuple[Queries, range]]:
        """Yield unknown targets in pieces: those of a low rank in all batches first."""
        ranks = ranks or [np.zeros(len(q), np.int8) for q in self.targets]
        for now in sorted({int(r) for each in ranks for r in np.unique(each)}):
            for number, (queries, paths, known) in enumerate(zip(self.targets, self.ranges, self.answers)):
                for rows in _due(ranks[number], now, known):
                    while len(rows):
                        some, rows = np.split(rows, [self._most(paths)])
                        self.asked.append((number, some))
                        yield queries[slice(None) if len(some) == len(queries) else some], paths

    def wanted(self, choose: Chooser) -> Iterator[tuple[Queries, range]]:
        """Yield unknown targets; each piece is chosen when the one before is answered."""
        while (unknown := self._unknown()).any():
            number, rows = choose(unknown, [self._most(paths) for paths in self.ranges])
            self.asked.append((number, rows))
            yield self.targets[number][rows], self.ranges[number]

    def _most(self, paths: range) -> int:
        """Number of targets of the next piece."""
        return min(max(1, int(self.size / max(len(paths), 1))), MOST)

    def _unknown(self) -> NDArray[np.bool_]:
        each = (np.ones(len(q), bool) if a is None else a.paths < 0 for q, a in zip(self.targets, self.answers))
        return np.concatenate([np.zeros(0, bool), *each])

    def take(self, found: Answer) -> tuple[int, NDArray[np.int64]]:
        """Store the answer to the oldest outstanding piece; returns the batch and the rows in it."""
        number, rows = self.asked.popleft()
        pace = len(rows) * len(self.ranges[number]) / max(found.seconds, 1e-3)
        self.size = min(max(pace * self.seconds, self.size / GROWTH, 1.0), GROWTH * self.size)
        queries, arrays = self.targets[number], found[:3]
        if len(rows) == len(queries):
            self.answers[number] = Samples(queries, *arrays, found.channels)
            return number, rows
        whole = self.answers[number]
        if whole is None:
            light, spread = np.zeros((2, len(queries), len(found.channels)), np.float32)
            unknown = np.full(len(queries), -1, np.int32)
            whole = self.answers[number] = Samples(queries, light, spread, unknown, found.channels)
        for own, new in zip((whole.light, whole.spread, whole.paths), arrays):
            own[rows] = new
        return number, rows


def _due(ranks: NDArray[np.integer], now: int, known: Samples | None) -> Iterator[NDArray[np.int64]]:
    """Unknown rows of one rank, in portions: their numbers need more memory than the marks of known rows."""
    for first in range(0, len(ranks), LOOKED_AT):
        some = slice(first, first + LOOKED_AT)
        due = ranks[some] == now
        yield first + np.flatnonzero(due if known is None else due & (known.paths[some] < 0))


def in_order(ranks: Ranks) -> NDArray[np.int64]:
    """Rows of all batches, in the order of `Walk.pieces`."""
    return np.argsort(np.concatenate(ranks), kind="stable")


def split(whole: Answer | None, targets: Sequence[Queries]) -> list[Samples | None]:
    """Answers to each batch, from those of all rows."""
    if whole is None:
        return [None] * len(targets)
    ends = np.cumsum([0, *map(len, targets)]).tolist()
    return [
        Samples(queries, whole.light[a:b], whole.spread[a:b], whole.paths[a:b], whole.channels)
        for queries, a, b in zip(targets, ends, ends[1:])
    ]
