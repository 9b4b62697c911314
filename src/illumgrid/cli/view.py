"""``illumgrid view``: sweep the isovalue of a finished run interactively."""

from pathlib import Path
from typing import Annotated

import typer

from illumgrid.cli.lights import SkyImage, Turn, Weights, relit
from illumgrid.cli.long import loaded
from illumgrid.cli.looks import Color, ColorMap, ColorRange, Look, looking, tint_of
from illumgrid.cli.reading import given
from illumgrid.cli.stops import ends_normally
from illumgrid.cli.terminal import reported_warnings, say
from illumgrid.errors import BadInput


def view(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR|INPUT",
            help="A run, finished or not; or an input of run, which is lit in INPUT-light while you look.",
        ),
    ],
    export: Annotated[
        Path | None, typer.Option("--export", metavar="HTML", help="Write the page as one file instead of serving it.")
    ] = None,
    no_open: Annotated[bool, typer.Option("--no-open", help="Print the address of the page; open no browser.")] = False,
    desktop: Annotated[
        bool,
        typer.Option("--desktop", help="Open a PyVista window instead of a page; it extracts each isosurface."),
    ] = False,
    weights: Weights = None,
    sky: SkyImage = None,
    turn: Turn = 0.0,
    look: Look = None,
    color: Color = None,
    cmap: ColorMap = "viridis",
    color_range: ColorRange = None,
    up: Annotated[
        str | None,
        typer.Option(metavar="AXIS", help="World axis that points up: x, y, z, -x, -y, -z. [default: z, see docs]"),
    ] = None,
) -> None:
    """Sweep the isovalue interactively: in the browser, in a file to send, or in a window."""
    from illumgrid.io import disk

    if export is not None and export.suffix.lower() not in (".html", ".htm"):
        raise BadInput(f"--export is {export.name!r}; expected a file name that ends in .html")
    if desktop and (export is not None or no_open):
        raise BadInput("--desktop came with --export or --no-open; expected it without them")
    otherwise = given(weights=weights, sky=sky, turn=turn or None, look=look, color=color)
    if export is None and not desktop and not otherwise:
        from illumgrid import unfinished
        from illumgrid.cli import lazily
        from illumgrid.field.builtin import SCENES

        place = unfinished.place_of(folder)
        if place is not None and lazily.go_on(place, not no_open, up):
            return
        if place is None and (folder.is_file() or (str(folder) in SCENES and not folder.exists())):
            finished = lazily.look_at(str(folder), not no_open, up)
            if finished is None:
                return
            folder = finished
            say(f"{folder} is finished")
    with reported_warnings():
        light = looking(relit(loaded(folder), weights, sky, turn), look)
        tint = tint_of(light, color, cmap, color_range)
    if desktop and (tint is not None or look):
        raise BadInput("--desktop came with --look or --color; expected it without them: its window shows only light")
    if desktop:
        from illumgrid.show.viewer.desktop import show

        show(light, up)
        return
    from illumgrid.show.viewer import page

    text = page(light, up, tint).encode()
    if export is not None:
        disk.write_file(export, text)
        say(f"wrote {export}, {len(text) / 1e6:.1f} MB: open it in any browser")
        return
    from illumgrid.show.viewer.server import serve

    with serve(text) as server:
        say(f"serving {server.address} to this machine only; stop with Ctrl-C")
        if not no_open:
            from illumgrid.cli.lazily import browse

            browse(server.address)
        with ends_normally():
            server.serve_forever()
