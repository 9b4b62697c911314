"""``illumgrid view``: sweep the isovalue of a finished run by hand."""

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from illumgrid.cli.terminal import say
from illumgrid.errors import BadInput


def view(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A finished run.")],
    export: Annotated[
        Path | None, typer.Option("--export", metavar="HTML", help="Write the page as one file instead of serving it.")
    ] = None,
    no_open: Annotated[bool, typer.Option("--no-open", help="Print the page's address; open no browser.")] = False,
    desktop: Annotated[
        bool, typer.Option("--desktop", help="A window of PyVista instead of a page: each isovalue is extracted anew.")
    ] = False,
) -> None:
    """Sweep the isovalue by hand: in the browser, in a file to mail, or in a window."""
    from illumgrid.chain import load
    from illumgrid.io import store

    if export is not None and export.suffix.lower() not in (".html", ".htm"):
        raise BadInput(f"--export is {export.name!r}; expected a file name that ends in .html")
    if desktop and (export is not None or no_open):
        raise BadInput("--desktop came with --export or --no-open; expected one of the three")
    light = load(folder)
    if desktop:
        from illumgrid.show.viewer.desktop import show

        show(light)
        return
    from illumgrid.show.viewer import page

    text = page(light).encode()
    if export is not None:
        store.write_file(export, text)
        say(f"wrote {export}, {len(text) / 1e6:.1f} MB: open it in any browser, or mail it")
        return
    from illumgrid.show.viewer.server import serve

    with serve(text) as server:
        say(f"serving {server.address} to this machine only; Ctrl-C ends it")
        if not no_open:
            import webbrowser

            webbrowser.open(server.address)
        with suppress(KeyboardInterrupt):  # the normal end of a server: exit 0
            server.serve_forever()
