"""What every command writes to the terminal: single lines, warnings as they occur, progress with the time left."""

import logging
import time
import unicodedata
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

from illumgrid.errors import WARNINGS, BadInput, IllumgridWarning

if TYPE_CHECKING:
    from illumgrid.bake.accumulator import Progress

INTERVAL = 10.0  # seconds between two lines of progress without a terminal


def say(text: str) -> None:
    """Write one line to stderr, so that a pipe carries results only."""
    typer.echo(harmless(text), err=True)


def result(text: str) -> None:
    """Write to stdout."""
    typer.echo(harmless(text))


def harmless(text: str) -> str:
    """Text with escaped control characters, so that the content of a file cannot control the terminal."""
    return "".join(c if c in "\n\t" or unicodedata.category(c) not in ("Cc", "Cf") else ascii(c)[1:-1] for c in text)


Ignore = Annotated[
    list[str] | None,
    typer.Option("--ignore", metavar="NAME", help="Silence a warning by name, e.g. noise (repeatable)."),
]


@contextmanager
def reported_warnings(ignored: Sequence[str] | None = None) -> Iterator[list[str]]:
    """Write each warning of the package as a note, except those with `ignored` names, and collect the sentences."""
    for name in ignored or ():
        if name not in WARNINGS:
            raise BadInput(f"--ignore got {name!r}; expected the name of a warning: {', '.join(WARNINGS)}")
    sentences: list[str] = []

    def show(message: Warning | str, category: type[Warning], *rest: Any) -> None:
        fresh = issubclass(category, IllumgridWarning) and str(message) not in sentences  # each picture may say it
        if fresh and str(message).partition(":")[0] not in (ignored or ()):
            sentences.append(str(message))
            say(f"note: {message}")

    with warnings.catch_warnings():
        warnings.simplefilter("always", IllumgridWarning)
        warnings.showwarning = show  # type: ignore[assignment]
        yield sentences


def say_what_compiles() -> None:
    """Report when compilation begins, and every `INTERVAL` seconds what is compiled."""
    begun: list[float] = []

    def note(record: logging.LogRecord) -> bool:
        now = time.monotonic()
        if not begun:
            say("compiling, once for each kind of data and scene: this may take a minute")
            begun.extend((now, now))
        elif now - begun[1] >= INTERVAL:
            begun[1] = now
            say(f"compiling for {now - begun[0]:.0f} s: {record.getMessage()}")
        return False

    log = logging.getLogger("illumgrid.compiled")
    log.setLevel(logging.INFO)
    log.addFilter(note)


@contextmanager
def progress_bars(about: Callable[[], str] = lambda: "") -> Iterator["Progress"]:
    """Progress of long work: a bar with the time left on a terminal, elsewhere a line every `INTERVAL` seconds.

    The current text of `about` is added.
    """
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _progress_lines(about)
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    bars: dict[str, Any] = {}
    columns = (
        TextColumn("{task.description:<6}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn(),
        TextColumn("{task.fields[about]}"),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True) as progress:

        def report(what: str, done: int, total: int) -> None:
            if what not in bars:
                bars[what] = progress.add_task(what, total=max(total, 1), about="")
            progress.update(bars[what], completed=done, about=about())

        yield report


def _progress_lines(about: Callable[[], str]) -> "Progress":
    last = time.monotonic()
    begun: dict[str, tuple[float, int]] = {}  # when, and with how much done already

    def report(what: str, done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        since, before = begun.setdefault(what, (now, done))
        if now - last >= INTERVAL:
            last = now
            left = (now - since) * (total - done) / (done - before) if done > before else None
            more = [] if left is None else [f"{_duration(left)} left"]
            say(", ".join([f"{what}: {done / max(total, 1):.0%}", *more, *filter(None, [about()])]))

    return report


def _duration(seconds: float) -> str:
    """An approximate time in words."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"about {seconds / size:.0f} {unit}"
    return f"about {seconds:.0f} s"


def omitted_light(recipe: Mapping[str, Any]) -> str:
    """How much light the truncated bounces omit, as the end of a sentence; empty where no estimate exists."""
    left = recipe.get("left_out")
    if left is None:
        return ""
    share = f"about {left:.1%}" if left >= 0.0005 else "less than 0.1%"
    return f", bounces beyond {recipe['bounces']} would add {share}"
