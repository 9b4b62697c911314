"""Options that add what a volume file does not say, or choose a part of it."""

from typing import Annotated, Any

import typer

from illumgrid.errors import BadInput

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
    str | None,
    typer.Option("--label", metavar="N[,N…]", help="The file is a label map: smooth surfaces of these labels."),
]
Crop = Annotated[
    tuple[int, int, int, int, int, int] | None,
    typer.Option("--crop", metavar="A B C D E F", help="Only voxels A to B - 1 along x, C to D - 1, E to F - 1."),
]
Downsample = Annotated[
    int | None, typer.Option("--downsample", min=1, metavar="N", help="Means over blocks of N x N x N voxels.")
]
Follow = Annotated[
    bool, typer.Option("--follow", help="Read data files outside the folder of the header that names them.")
]


def labels_of(text: str | None) -> tuple[int, ...]:
    """Labels from what was typed, such as 1,3."""
    if text is None:
        return ()
    words = text.replace(",", " ").split()
    if not words or not all(word.removeprefix("-").isdecimal() for word in words) or len(set(words)) < len(words):
        raise BadInput(f"--label is {text!r}; expected labels that differ, whole numbers, such as 3 or 1,3")
    return tuple(map(int, words))


def check_inside(inside: str | None, label: str | None) -> None:
    """Refuse a side that is none, and one beside a label, whose field is positive inside the label."""
    if inside not in (None, "above", "below"):
        raise BadInput(f"--inside is {inside!r}; expected above or below")
    if inside is not None and label is not None:
        raise BadInput("--inside and --label came together; expected one of them: solid is what has the label")


def given(**options: Any) -> dict[str, Any]:
    """The options that were given, as arguments of `read_volume`."""
    return {name: value for name, value in options.items() if value is not None}
