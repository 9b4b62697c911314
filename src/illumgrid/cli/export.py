"""``illumgrid export``: the light of a finished run in a file for another program."""

from pathlib import Path
from typing import Annotated

import typer

from illumgrid.cli.lights import SkyImage, Turn, Weights, relit
from illumgrid.cli.terminal import progress_bars, reported_warnings, say
from illumgrid.errors import BadInput


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A finished run.")],
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="File to write: .vti .nrrd .exr .npz (grid), .glb .ply (isosurface).")
    ],
    field: Annotated[
        str | None, typer.Option(metavar="NAME", help="Field whose light is written. [default: the first]")
    ] = None,
    isovalue: Annotated[
        float | None,
        typer.Option(metavar="C", help="Isovalue of the surface (.glb, .ply). [default: the middle of the range]"),
    ] = None,
    on: Annotated[
        str | None,
        typer.Option(
            metavar="grid|field",
            help="Write values at the nodes of the grid or at the voxels of the field. [default: grid]",
        ),
    ] = None,
    onto: Annotated[
        Path | None,
        typer.Option(
            metavar="MESH",
            help="Light this mesh (.ply .stl .obj .glb) instead of an isosurface. Its vertices lie near level sets "
            "of the range; --isovalue moves them onto one.",
        ),
    ] = None,
    weights: Weights = None,
    sky: SkyImage = None,
    turn: Turn = 0.0,
    array: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Array in a .nrrd: irradiance, error, support, field, color. [default: irradiance]",
        ),
    ] = None,
) -> None:
    """Write the light of a finished run for another program."""
    from illumgrid.chain import load
    from illumgrid.io import exports, store

    exports.check(file, isovalue, on, array, onto)
    own = folder / store.EXR
    if file.exists() and own.exists() and file.samefile(own):
        raise BadInput(f"{file} is the run itself; expected another name for the copy")
    with reported_warnings():
        light = relit(load(folder), weights, sky, turn)
        with progress_bars() as progress:
            written = exports.write(light, file, field, isovalue, on=on, array=array, onto=onto, progress=progress)
    say(f"wrote {file}: {written}")
