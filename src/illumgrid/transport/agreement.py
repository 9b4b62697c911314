"""Comparison of a backend's results with a closed form, as z-scores."""

import time
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.volume import Floats
from illumgrid.transport.analytic import Case
from illumgrid.transport.stages import Backend, capabilities

Bools = NDArray[np.bool_]

_HOLES = 0.01
"""Share of the queries that may stay unanswered: where noise tilts the normal, it may miss the mesh."""


@dataclass(frozen=True)
class Row:
    """One case judged with one backend."""

    scene: str
    backend: str
    reason: str  # the closed form
    expected: float  # as `measured`, a mean over the queries, of the colour that differs most
    measured: float
    z: float  # mean difference in units of its standard error and discretisation bound; infinite without an answer
    worst: float  # largest such |difference| of a single query
    agrees: bool
    seconds: float


HEADER = f"{'scene':30} {'backend':14} {'expected':>10} {'measured':>10} {'z':>7} {'max |z|':>8}  verdict"


def line(row: Row) -> str:
    """A row as text, below `HEADER`."""
    numbers = f"{row.expected:10.5g} {row.measured:10.5g} {row.z:7.2f} {row.worst:8.2f}"
    return f"{row.scene:30} {row.backend:14} {numbers}  {'agrees' if row.agrees else 'DISAGREES'} ({row.reason})"


def sidak(tests: int, level: float) -> float:
    """|z| that any of `tests` independent standard normal numbers exceeds with probability `level`.

    References
    ----------
    .. [1] Z. Šidák, "Rectangular confidence regions for the means of multivariate normal distributions", J. Amer.
           Statist. Assoc. 62(318), 1967.
    """
    return NormalDist().inv_cdf(0.5 * (1 + (1 - level) ** (1 / tests)))


def _score(off: Floats, bar: Floats, bound: Floats, noise: float) -> tuple[Floats, Floats]:
    """Score z of the mean over queries (3,), and of each query (n, 3), from differences and standard errors (n, 3)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        # The bound is a bias: it does not average out over many queries.
        whole = off.mean(axis=0) / np.hypot(noise * np.sqrt((bar**2).sum(axis=0)) / len(off), bound.mean())
        # A bar from few paths can be too short by chance: none counts as shorter than their root mean square.
        longest = np.maximum(bar, np.sqrt((bar**2).mean(axis=0))) if noise else 0.0 * bar
        each = off / np.hypot(longest, bound[:, None])
    return np.where(off.mean(axis=0) == 0, 0.0, whole), np.where(off == 0, 0.0, each)


def _measure(case: Case, backend: Backend, paths: int, seed: int) -> tuple[Floats, Floats, Bools, float]:
    """The result of a backend for `expected`, its standard error, which queries were answered, and the share of noise.

    The last is the share of the standard error that is measured as noise: 0 if every path finds the same light.
    """
    # A power of two suits scrambled sequences.
    least = 4 if case.area is None else 0  # m2 needs the spread of a query's own paths
    count = 1 << max(least, int(np.log2(max(1, paths / len(case.queries)))))
    if case.area is None:
        one, other = (
            backend.solve(case.scene, case.queries, paths=range(count // 2), bounces=case.bounces, seed=s)
            for s in (seed, (seed + 2**63) % 2**64)
        )
        good = (one.paths > 0) & (other.paths > 0)
        light, bar = (
            0.5 * (one.mean.astype(float) + other.mean.astype(float)),
            0.5 * np.hypot(one.stderr, other.stderr, dtype=float),
        )
        # Bars allow for what few paths may have missed; the difference of two seeds measures the noise itself.
        off = 0.5 * (one.mean.astype(float) - other.mean)[good]
        share = min(1.0, np.sqrt((off**2).sum() / (bar[good] ** 2).sum())) if good.any() and off.any() else 0.0
        return light, bar, good, float(share)
    answer = backend.solve(case.scene, case.queries, paths=range(count), bounces=case.bounces, seed=seed)
    light, good = answer.mean.astype(float), answer.paths > 0
    if case.kept is not None:
        fewer = backend.solve(case.scene, case.queries, paths=range(count), bounces=case.bounces - 1, seed=seed)
        light -= case.kept * fewer.mean
    light *= case.area[:, None]
    # Twice the variance of one point of a cell is the mean of (y1 - y2)², and it is the variance of y1 + y2.
    bar = np.sqrt(((light[::2] - light[1::2]) ** 2).sum(axis=0))
    return light.sum(axis=0)[None], bar[None], np.ones(1, bool), 1.0


def applies(case: Case, backend: Backend) -> bool:
    """Whether a case applies to a backend: queries on voxels need the trilinear level set itself."""
    return not case.voxels or capabilities(backend).surface == "levelset"


def judge(
    case: Case, backend: Backend, paths: int, seed: int, limit: float, limit_each: float, title: str | None = None
) -> Row:
    """Trace about `paths` paths, shared by the queries of a case; it agrees if no |z| is above its limit."""
    begun = time.perf_counter()
    measured, bar, answered, noise = _measure(case, backend, paths, seed)
    enough = answered.mean() > 1 - _HOLES
    expected, bound = (np.broadcast_to(part, (len(measured), *part.shape[1:])) for part in (case.expected, case.bound))
    measured, bar, expected, bound = (part[answered] if enough else part for part in (measured, bar, expected, bound))
    whole, each = _score(measured - expected, bar, bound, noise)
    worst = float(np.abs(each).max()) if enough else np.inf
    color = int(np.abs(whole).argmax())
    z = float(whole[color]) if enough else np.inf
    return Row(
        scene=case.name,
        backend=title or backend.name,
        reason=case.reason,
        expected=float(expected[:, color].mean()),
        measured=float(measured[:, color].mean()),
        z=z,
        worst=worst,
        agrees=abs(z) <= limit and worst <= limit_each,
        seconds=time.perf_counter() - begun,
    )
