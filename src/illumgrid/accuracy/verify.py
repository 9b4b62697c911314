"""Closed forms against backends: a table of z-scores."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from illumgrid import registry
from illumgrid.accuracy.points import other_paths
from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats
from illumgrid.stages import Backend
from illumgrid.transport.analytic import CASES, Case
from illumgrid.transport.stages import capabilities

Bools = NDArray[np.bool_]

_FALSE_ALARM = 1e-3
"""Probability that a table of right answers has a row that disagrees."""

_HOLES = 0.01
"""Share of the queries that may go unanswered: where noise turns a normal aside, it may not lead to the mesh."""

_SLOWER = {"reference": 128, "embree": 8}  # times fewer paths


@dataclass(frozen=True)
class Row:
    """One case judged with one backend.

    Parameters
    ----------
    scene, backend : str
    reason : str
        The closed form.
    expected, measured : float
        Means over the queries, of the colour that differs most.
    z : float
        Mean difference in units of its standard error and discretisation bound; infinite if a query got no answer.
    worst : float
        Largest such |difference| of a single query.
    agrees : bool
    seconds : float
    """

    scene: str
    backend: str
    reason: str
    expected: float
    measured: float
    z: float
    worst: float
    agrees: bool
    seconds: float


HEADER = f"{'scene':30} {'backend':14} {'expected':>10} {'measured':>10} {'z':>7} {'max |z|':>8}  verdict"


def line(row: Row) -> str:
    """A row as text, below `HEADER`."""
    numbers = f"{row.expected:10.5g} {row.measured:10.5g} {row.z:7.2f} {row.worst:8.2f}"
    return f"{row.scene:30} {row.backend:14} {numbers}  {'agrees' if row.agrees else 'DISAGREES'} ({row.reason})"


def contenders() -> dict[str, Backend]:
    """The backends of light that work on this machine, by the names of the table; numba with both of its surfaces."""
    return {title: stage for title, stage, can in registry.backends() if can.transport}


def _named(names: Iterable[str | Backend]) -> dict[str, Backend]:
    """Stages by the names of the table; "numba" alone is both of its surfaces."""
    found: dict[str, Backend] = {}
    everyone = contenders()
    for name in names:
        if not isinstance(name, str):
            found[name.name] = name
        elif matching := {title: stage for title, stage in everyone.items() if name in (title, title.split(":")[0])}:
            found |= matching
        else:
            found[name] = registry.backend(name)
    return found


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
        # The bound is a bias: over many queries it does not average out.
        whole = off.mean(axis=0) / np.hypot(noise * np.sqrt((bar**2).sum(axis=0)) / len(off), bound.mean())
        # A bar from few paths can be too short by luck: none is taken to be shorter than their root mean square.
        longest = np.maximum(bar, np.sqrt((bar**2).mean(axis=0))) if noise else 0.0 * bar
        each = off / np.hypot(longest, bound[:, None])
    return np.where(off.mean(axis=0) == 0, 0.0, whole), np.where(off == 0, 0.0, each)


def _measure(case: Case, backend: Backend, paths: int, seed: int) -> tuple[Floats, Floats, Bools, float]:
    """What a backend finds for `expected`, its standard error, which queries were answered, and the error's noise.

    The last is the share of the standard error that is seen as noise: 0 if every path finds the same.
    """
    # A power of two suits scrambled sequences.
    least = 4 if case.area is None else 0  # the spread of a query's own paths is asked for
    count = 1 << max(least, int(np.log2(max(1, paths / len(case.queries)))))
    if case.area is None:
        one, other = (
            backend.solve(case.scene, case.queries, paths=range(count // 2), bounces=case.bounces, seed=s)
            for s in (seed, other_paths(seed))
        )
        good = (one.paths > 0) & (other.paths > 0)
        light, bar = (
            0.5 * (one.mean.astype(float) + other.mean.astype(float)),
            0.5 * np.hypot(one.stderr, other.stderr, dtype=float),
        )
        # Bars allow for what few paths may have missed; how far two seeds are apart tells the noise that there is.
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
    """Whether a case can be asked of a backend: on voxels only the trilinear level set itself passes."""
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


def check(
    backends: Iterable[str | Backend] | None = None,
    paths: int = 1 << 18,
    seed: int = 0,
    cases: Sequence[Case] | None = None,
) -> Iterator[Row]:
    """Judge every case with every backend.

    Parameters
    ----------
    backends : iterable of str or Backend, optional
        Names such as "numba:mesh" or "embree", or stages; by default all that are available.
    paths : int
        Light paths for each case, shared by its queries; those in NumPy, which are slow, trace fewer.
    seed : int
    cases : sequence of Case, optional
        By default all of `illumgrid.transport.analytic.CASES`.

    Yields
    ------
    Row
        As soon as it is judged. Right answers get a row that disagrees once in a thousand tables.
    """
    if not 1 <= paths < 2**31:
        raise BadInput(f"{paths} paths were asked for; expected at least 1 and fewer than 2**31")
    stages = contenders() if backends is None else _named(backends)
    cases = [make() for make in CASES] if cases is None else cases
    level = _FALSE_ALARM / 2  # one half for the means, one for the single queries
    limit = sidak(max(1, 3 * len(cases) * len(stages)), level)
    limit_each = sidak(max(1, 3 * sum(len(case.expected) for case in cases) * len(stages)), level)
    for title, backend in stages.items():
        for case in cases:
            if applies(case, backend):
                yield judge(case, backend, paths // _SLOWER.get(title, 1), seed, limit, limit_each, title)
