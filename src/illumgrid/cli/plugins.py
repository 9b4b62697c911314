"""``illumgrid plugins``: every stage, with its options and origin."""

import inspect
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from illumgrid.cli.terminal import reported_warnings, say

if TYPE_CHECKING:
    from illumgrid.registry import Entry


def plugins(
    new: Annotated[
        tuple[str, str, str] | None,
        typer.Option(
            metavar="NAME KIND DIR",
            help="Write a package with a new stage and its tests into DIR; KIND: sampler, backend or interpolator.",
        ),
    ] = None,
) -> None:
    """List every sampler, backend and interpolator: options, package, contract, and whether it can run here.

    Set an option by --set STAGE.OPTION=VALUE, such as --set sampler.count=40. ILLUMGRID_DISABLE_PLUGINS=1 disables all
    plugins of other packages, ILLUMGRID_DISABLE_PLUGINS=NAME,NAME those of these packages.
    """
    from illumgrid import registry

    if new is not None:
        from illumgrid.io.new_plugin import write_plugin

        with reported_warnings():
            written = write_plugin(new[2], new[0], new[1])
        say(f"wrote {', '.join(written)}; next: pip install -e {new[2]}, and pytest {new[2]}")
        return
    with reported_warnings():
        entries = registry.entries()
    for number, kind in enumerate(registry.KINDS):
        typer.echo(f"{chr(10) * bool(number)}{kind}s (--{kind} NAME)")
        for entry in entries:
            if entry.kind == kind:
                typer.echo("\n".join(_lines(entry)))
        if kind == "backend":
            typer.echo(f"  {'auto':<12} stands for {registry.auto_backend()}")


def _lines(entry: "Entry") -> Iterator[str]:
    from illumgrid.registry.options import options, short

    cure = entry.missing()
    state = "" if cure is None else f"; not available here: {cure}"
    contract = "" if entry.package == "illumgrid" else f", contract {entry.contract}"
    yield f"  {entry.name:<12} {entry.package} {entry.version}{contract}{state}"
    yield f"      {inspect.cleandoc(entry.stage.__doc__ or '').partition(chr(10))[0]}"
    rows = [(o.name, short(o.type), _shown(o.default), o.meaning) for o in options(entry.stage)]
    widths = [max((len(row[column]) for row in rows), default=0) for column in range(3)]
    for row in rows:
        yield "      " + "  ".join([*(text.ljust(width) for text, width in zip(row, widths)), row[3]]).rstrip()


def _shown(default: object) -> str:
    """A default as it would be typed."""
    return ",".join(map(str, default)) if isinstance(default, tuple) else str(default)
