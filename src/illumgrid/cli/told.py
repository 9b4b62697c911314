"""What every command says, and how: one line to the user, warnings as they come, bars with the time left."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

from illumgrid.errors import WARNINGS, BadInput, IllumgridWarning

if TYPE_CHECKING:
    from illumgrid.bake import Progress


def say(text: str) -> None:
    """One line to the user, not to a pipe."""
    typer.echo(text, err=True)


Ignore = Annotated[
    list[str] | None,
    typer.Option("--ignore", metavar="NAME", help="Warning not to be told, such as noise; repeatable."),
]


@contextmanager
def heard(ignored: Sequence[str] | None = None) -> Iterator[list[str]]:
    """Collect the package's warnings as sentences, and say each, but for those with `ignored` names."""
    for name in ignored or ():
        if name not in WARNINGS:
            raise BadInput(f"--ignore got {name!r}; expected the name of a warning: {', '.join(WARNINGS)}")
    sentences: list[str] = []

    def show(message: Warning | str, category: type[Warning], *rest: Any) -> None:
        if issubclass(category, IllumgridWarning) and str(message).partition(":")[0] not in (ignored or ()):
            sentences.append(str(message))
            say(f"note: {message}")

    with warnings.catch_warnings():
        warnings.simplefilter("always", IllumgridWarning)
        warnings.showwarning = show  # type: ignore[assignment]
        yield sentences


@contextmanager
def told_progress() -> Iterator["Progress"]:
    """A bar with the time left, for work that takes longer than a moment."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    bars: dict[str, Any] = {}
    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description:<6}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn(),
        console=console, transient=True, disable=not console.is_terminal,
    ) as progress:  # fmt: skip

        def tell(what: str, done: int, total: int) -> None:
            if what not in bars:
                bars[what] = progress.add_task(what, total=max(total, 1))
            progress.update(bars[what], completed=done)

        yield tell


def told_left_out(recipe: Mapping[str, Any]) -> str:
    """What the bounces left out would add, as the end of a sentence; empty where nobody estimated it."""
    left = recipe.get("left_out")
    if left is None:
        return ""
    share = f"about {left:.1%}" if left >= 0.0005 else "less than 0.1%"
    return f", bounces beyond {recipe['bounces']} would add {share}"
