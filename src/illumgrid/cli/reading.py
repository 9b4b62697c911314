"""Options that say what a volume file cannot say by itself, or which part of it is wanted."""

from typing import Annotated, Any

import typer

Spacing = Annotated[
    tuple[float, float, float] | None,
    typer.Option("--spacing", metavar="X Y Z", help="Distances between voxels. [default: those of the file]"),
]
Channel = Annotated[
    str | None, typer.Option("--channel", metavar="N", help="Which channel of the file: number, from 0, or name.")
]
Time = Annotated[str | None, typer.Option("--time", metavar="N", help="Which time step of the file, from 0.")]
Array = Annotated[
    str | None, typer.Option("--array", metavar="NAME", help="Which array of the file: name, or number from 0.")
]
Label = Annotated[
    int | None, typer.Option("--label", metavar="N", help="The file is a label map: light the surface of this label.")
]
Crop = Annotated[
    tuple[int, int, int, int, int, int] | None,
    typer.Option("--crop", metavar="A B C D E F", help="Only voxels A to B - 1 along x, C to D - 1, E to F - 1."),
]
Downsample = Annotated[
    int | None, typer.Option("--downsample", min=1, metavar="N", help="Means over blocks of N x N x N voxels.")
]


def given(**options: Any) -> dict[str, Any]:
    """The options that were given, as arguments of `read_volume`."""
    return {name: value for name, value in options.items() if value is not None}
