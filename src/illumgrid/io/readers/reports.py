"""What libraries report while they read: kept off the terminal, and handed over as warnings of ours."""

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager


class _Kept(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.reports: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.reports.append(record.getMessage())


@contextmanager
def captured(logger: str) -> Iterator[list[str]]:
    """The reports of a library's logger, in place of the terminal."""
    kept, log = _Kept(), logging.getLogger(logger)
    propagated, others = log.propagate, log.handlers
    log.propagate, log.handlers = False, [kept]
    try:
        yield kept.reports
    finally:
        log.propagate, log.handlers = propagated, others


def plain(report: str) -> str:
    """A report on one line, without addresses and what a terminal would obey."""
    text = re.sub(r"<[^<>]*> *|@ ?\d+", "", report)
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())[:150]
