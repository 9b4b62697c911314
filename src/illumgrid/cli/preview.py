"""``illumgrid preview``: pictures of a finished run."""

import math
from pathlib import Path
from typing import Annotated

import typer

from illumgrid.cli.told import say
from illumgrid.errors import BadInput


def preview(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A finished run.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="PNG", help="The picture to write.")],
    field: Annotated[
        str | None, typer.Option(metavar="NAME", help="Field that --isovalue belongs to. [default: the first]")
    ] = None,
    isovalue: Annotated[
        float | None, typer.Option(metavar="C", help="Isovalue to show. [default: the middle of the range]")
    ] = None,
    local: Annotated[
        bool, typer.Option("--local", help="A lamp at the camera in place of the computed light.")
    ] = False,
) -> None:
    """Draw one isosurface of a finished run."""
    from illumgrid import preview as pictures
    from illumgrid import store
    from illumgrid.illumination import load

    if output.suffix.lower() != ".png":
        raise BadInput(f"--output is {output.name!r}; expected a file name that ends in .png")
    if isovalue is not None and not math.isfinite(isovalue):
        raise BadInput(f"--isovalue is {isovalue}; expected a finite number")
    light = load(folder)
    number = 0 if field is None else light.scene.number_of(field)
    if isovalue is not None:
        low, high = light.scene.fields[number].range
        if not low <= isovalue <= high:
            say(f"note: the isovalue {isovalue:g} lies outside the range {low:g} to {high:g} of the light")
    store.write_file(output, pictures.png(pictures.render(light, field, isovalue, local=local)))
    say(f"wrote {output}" + ("" if local else f" at exposure {light.exposure:.4g}"))
