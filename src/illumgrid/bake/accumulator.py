"""Light at some targets with its paths: more paths are traced and combined; the state can be stored and restored."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.grid.channels import Channels
from illumgrid.transport.samples import Queries, Samples, combine, join_queries, join_samples
from illumgrid.transport.tracer import Tracer, answered
from illumgrid.transport.walk import AT_ONCE, Chooser, Keeper, Ranks, Walk, answer, split

Progress = Callable[[str, int, int], None]
"""Called with a description, the amount done, and the total amount."""


class Map(Protocol):
    """Like the built-in ``map``: results in the order of the work, such as an executor's ``map``."""

    def __call__(self, function: Callable[[Any], Any], work: Iterable[Any], /) -> Iterable[Any]:
        """Apply `function` to each piece of `work`."""


NO_QUERIES = Queries(
    np.zeros(0, np.uint64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 0)), np.zeros(0, np.int32)
)

QUERY_ARRAYS = tuple(f.name for f in fields(Queries))


@dataclass(frozen=True, eq=False)
class Bake:
    """Light at some targets with its paths: traces more paths, combines them, and can be stored.

    Parameters
    ----------
    targets : tuple of Queries
        Batches of nodes, texels or points.
    weights : tuple of int
        Paths from each target of a batch for every path of a walk: 1, or `texel_paths` for texels.
    bounces, seed : int
    answers : tuple of Samples
        Moments of the light, one per batch; empty before the first walk.
    walked : tuple of range
        Numbers of the paths traced, disjoint.
    """

    targets: tuple[Queries, ...]
    weights: tuple[int, ...]
    bounces: int
    seed: int
    answers: tuple[Samples, ...] = ()
    walked: tuple[range, ...] = ()

    @classmethod
    def of(cls, targets: Sequence[Queries], bounces: int, seed: int) -> "Bake":
        """Begin with targets of equal weight."""
        return cls(tuple(targets), (1,) * len(targets), bounces, seed)

    @property
    def paths(self) -> int:
        """Paths traced from a target of weight 1."""
        return sum(map(len, self.walked))

    @property
    def samples(self) -> Samples:
        """All answers, one batch after the other."""
        return self.answers[0] if len(self.answers) == 1 else join_samples(self.answers)

    def walk(
        self,
        tracer: Tracer,
        paths: range,
        map: Map = map,
        progress: Progress = lambda what, done, total: None,
        keep: Keeper | None = None,
        ranks: Ranks | None = None,
        choose: Chooser | None = None,
    ) -> "Bake":
        """Trace the paths with these numbers from every target, in addition; see `bake` for the other arguments.

        In the order of `ranks`; with a `map` that takes one piece after another, each piece is chosen when it is taken.
        """
        ranges = [range(n * paths.start, n * paths.stop) for n in self.weights]
        going = Walk(self.targets, ranges, split(keep.known(paths) if keep else None, self.targets))
        going.seconds = AT_ONCE if choose else going.seconds
        first = np.cumsum([0, *map(len, self.targets)])
        total, within = int(first[-1]), 0
        what = "more light" if self.answers else "light"
        done = sum(int((known.paths >= 0).sum()) for known in going.answers if known is not None)

        def tick(count: int) -> None:
            nonlocal within
            within += count
            progress(what, min(done + within, total), total)

        progress(what, done, total)
        before = answered.set(tick)
        try:
            pieces = going.wanted(choose) if choose else going.pieces(ranks)
            for found in map(partial(answer, tracer, self.bounces, self.seed), pieces):
                number, rows = going.take(found)
                if keep:
                    keep.keep(first[number] + rows, found)
                done, within = done + len(rows), 0
                progress(what, done, total)
        finally:
            answered.reset(before)
            if keep:
                keep.flush()
        each = (  # a batch without targets makes no piece of work
            tracer.solve(q, paths=r, bounces=self.bounces, seed=self.seed) if a is None else a
            for a, q, r in zip(going.answers, self.targets, ranges)
        )
        return self.merge(replace(self, answers=tuple(each), walked=(paths,)))

    def merge(self, other: "Bake") -> "Bake":
        """Combine with a bake of the same targets and seed that traced other paths."""
        if (self.bounces, self.seed) != (other.bounces, other.seed):
            raise BadInput(
                f"a bake of {self.bounces} bounces and seed {self.seed} met one of {other.bounces} and {other.seed}; "
                "expected the same to combine"
            )
        if not self.answers or not other.answers:
            return self if self.answers else other
        if any(max(a.start, b.start) < min(a.stop, b.stop) for a in self.walked for b in other.walked):
            raise BadInput(f"paths {self.walked} and {other.walked} overlap; expected disjoint ranges to combine")
        answers = tuple(combine(a, b) for a, b in zip(self.answers, other.answers))
        return replace(other, answers=answers, walked=self.walked + other.walked)

    def state(self) -> dict[str, NDArray[Any]]:
        """The whole state as plain arrays: see `from_state`."""
        queries = join_queries(self.targets or (NO_QUERIES,))
        arrays = {name: getattr(queries, name) for name in QUERY_ARRAYS}
        if self.answers:
            samples, channels = self.samples, self.samples.channels
            arrays |= {"light": samples.light, "spread": samples.spread, "paths": samples.paths}
            arrays |= {"channels": np.array(channels.names), "mix": np.array(channels.mix)}
        return arrays | {
            "batches": np.array([len(q) for q in self.targets]),
            "weights": np.array(self.weights),
            "walked": np.array([(r.start, r.stop) for r in self.walked], int).reshape(-1, 2),
            "bounces": np.array(self.bounces),
            "seed": np.array(self.seed, np.uint64),
        }

    @classmethod
    def from_state(cls, arrays: Mapping[str, NDArray[Any]]) -> "Bake":
        """Restore a bake from its `state`."""
        queries = Queries(*(arrays[name] for name in QUERY_ARRAYS))
        ends = np.cumsum(arrays["batches"]).tolist()
        rows = [slice(a, b) for a, b in zip([0, *ends], ends)]
        answers: tuple[Samples, ...] = ()
        if len(arrays["walked"]):
            channels = Channels(tuple(arrays["channels"].tolist()), tuple(map(tuple, arrays["mix"].tolist())))
            whole = Samples(queries, arrays["light"], arrays["spread"], arrays["paths"], channels)
            answers = tuple(whole[row] for row in rows)
        return cls(
            tuple(queries[row] for row in rows), tuple(arrays["weights"].tolist()), int(arrays["bounces"]),
            int(arrays["seed"]), answers, tuple(range(a, b) for a, b in arrays["walked"].tolist()),
        )  # fmt: skip
