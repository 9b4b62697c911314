"""Compare backends with closed forms: a table of z-scores."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

from illumgrid import registry
from illumgrid.errors import BadInput
from illumgrid.stages import Backend
from illumgrid.transport.agreement import Row, applies, judge, sidak
from illumgrid.transport.analytic import CASES, Case

_FALSE_ALARM = 1e-3  # probability that a table of correct results has a row that disagrees
_SLOWER = {"reference": 128, "embree": 8}  # slow backends: factor by which they trace fewer paths


def contenders(names: Iterable[str] = ()) -> dict[str, Backend]:
    """Backends that compute light, by name in the table: those named, or all that work; "numba" means both surfaces."""
    able = {title: stage for title, stage, can in registry.backends() if can.transport}
    found: dict[str, Backend] = {}
    for name in names:
        matching = {title: stage for title, stage in able.items() if name in (title, title.split(":")[0])}
        found |= matching or {name: registry.backend(name)}
    return found or able


def check(
    backends: Mapping[str, Backend], paths: int = 1 << 18, seed: int = 0, cases: Sequence[Case] | None = None
) -> Iterator[Row]:
    """Test every backend on every case; yield each row as soon as it is computed.

    The queries of a case share its `paths`, of which slow backends trace fewer. Correct results give a row that
    disagrees in one of a thousand tables.
    """
    if not 1 <= paths < 2**31:
        raise BadInput(f"got {paths} paths; expected at least 1 and fewer than 2**31")
    cases = [make() for make in CASES] if cases is None else cases
    level = _FALSE_ALARM / 2  # one half for the means, one for the single queries
    limit = sidak(max(1, 3 * len(cases) * len(backends)), level)
    limit_each = sidak(max(1, 3 * sum(len(case.expected) for case in cases) * len(backends)), level)
    return (
        judge(case, backend, paths // _SLOWER.get(title, 1), seed, limit, limit_each, title)
        for title, backend in backends.items()
        for case in cases
        if applies(case, backend)
    )
