"""The command line: one file per command; only here does the package print."""

import io
import os
import re
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Any

import typer

from illumgrid.cli.bench import bench
from illumgrid.cli.density import density
from illumgrid.cli.export import export
from illumgrid.cli.heap import return_what_is_freed
from illumgrid.cli.info import info
from illumgrid.cli.plugins import plugins
from illumgrid.cli.preview import preview
from illumgrid.cli.run import run
from illumgrid.cli.stops import answered, listen, sentence, unanswered
from illumgrid.cli.terminal import say, say_what_compiles
from illumgrid.cli.verify import verify
from illumgrid.cli.view import view
from illumgrid.errors import BadInput
from illumgrid.io import disk

app = typer.Typer(
    help="Global illumination for every isosurface of a volume at once.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for command in (run, preview, view, export, info, density, bench, verify, plugins):
    app.command()(command)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"illumgrid {version('illumgrid')}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Global illumination for every isosurface of a volume at once."""
    try:
        os.getcwd()
    except OSError:
        raise BadInput(
            "the working folder is gone: deleted, moved or unmounted; expected one that exists; cd to it"
        ) from None


def main() -> None:
    """Run the command line: exit 2 and one sentence on bad input, 130 on Ctrl-C, SIGTERM and SIGHUP."""
    stops = [number for number in disk.STOPS if signal.getsignal(number) != signal.SIG_IGN]  # nohup ignores one
    listen(stops)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # what the terminal or the pipe has no sign for is written as \\u00fc
            stream.reconfigure(errors="backslashreplace")
    say_what_compiles()
    return_what_is_freed()
    code = guarded(lambda: app(standalone_mode=False))
    for number in stops:  # nothing is left but the end of the threads
        signal.signal(number, signal.SIG_IGN)
    if code == 130:  # threads may be at work in what does not stop, such as compilation: nobody waits for them
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)
    sys.exit(code)


def in_options(sentence: str) -> str:
    """Translate arguments of Python in a message into options of the command line."""
    for argument, option in {"overwrite=True": "--overwrite", "another folder": "another folder with -o"}.items():
        sentence = sentence.replace(argument, option)
    return re.sub(r"\bgrid=(\d+)", r"--grid \1", sentence)


def guarded(command: Callable[[], Any]) -> int:
    """Run a command and return its exit code."""
    disk.written.clear()
    disk.kept.clear()
    try:
        code = command()
        if code == 130:  # typer turns Ctrl-C into this code
            raise KeyboardInterrupt
        return code if isinstance(code, int) else 0
    except (typer.Abort, KeyboardInterrupt):
        return _stopped()
    except Exception as error:
        return _stopped() if unanswered[0] else _failed(error)  # libraries may turn a stop into another exception


def _stopped() -> int:
    answered()
    say(sentence())
    return 130


def _failed(error: Exception) -> int:
    """Report an error in one sentence and return 2; unexpected exceptions keep their traceback."""
    if isinstance(error, BadInput):
        say(f"illumgrid: {in_options(str(error))}")
    elif isinstance(error, MemoryError):
        say("illumgrid: out of memory; choose a coarser --grid or a smaller volume")
    elif isinstance(error, OSError):
        say(f"illumgrid: {error.strerror or error}{f': {error.filename}' if error.filename else ''}")
    elif hasattr(error, "show"):  # a usage error, of click or of typer's own copy of it
        error.show()
    else:
        raise error
    return 2
