"""Options that add what a volume file does not say, or choose a part of it."""

import inspect
from collections.abc import Callable
from functools import wraps
from inspect import Parameter
from typing import Annotated, Any

import typer

from illumgrid.errors import BadInput

OPTIONS: dict[str, Any] = {
    "spacing": Annotated[
        tuple[float, float, float] | None,
        typer.Option("--spacing", metavar="X Y Z", help="Distances between voxels. [default: those of the file]"),
    ],
    "channel": Annotated[
        str | None, typer.Option("--channel", metavar="N", help="Which channel of the file: number, from 0, or name.")
    ],
    "time": Annotated[str | None, typer.Option("--time", metavar="N", help="Which time step of the file, from 0.")],
    "array": Annotated[
        str | None, typer.Option("--array", metavar="NAME", help="Which array of the file: name, or number from 0.")
    ],
    "label": Annotated[
        str | None,
        typer.Option(
            "--label", metavar="N[,N…]", help="The file is a label map: light smooth surfaces of these labels."
        ),
    ],
    "crop": Annotated[
        tuple[int, int, int, int, int, int] | None,
        typer.Option(
            "--crop",
            metavar="A B C D E F",
            help="Only voxels A to B - 1 along x, C to D - 1 along y, E to F - 1 along z.",
        ),
    ],
    "downsample": Annotated[
        int | None,
        typer.Option(
            "--downsample", min=1, metavar="N", help="Reduce the volume to means over blocks of N x N x N voxels."
        ),
    ],
    "follow": Annotated[
        bool, typer.Option("--follow", help="Read data files outside the folder of the header that names them.")
    ],
}


NONE: dict[str, Any] = {}
"""No option given."""


def with_reading(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameter `reading` of a command by these options; it receives those that were given."""

    @wraps(command)
    def with_options(**options: Any) -> None:
        follow = options.pop("follow") or None
        reading = given(**{name: options.pop(name) for name in OPTIONS if name in options}, follow=follow)
        command(**options, reading=reading)

    parameters = []
    for parameter in inspect.signature(command).parameters.values():
        if parameter.name != "reading":
            parameters.append(parameter)
            continue
        for name, option in OPTIONS.items():
            default = False if name == "follow" else None
            parameters.append(Parameter(name, parameter.kind, default=default, annotation=option))
    with_options.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    with_options.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return with_options


def labels_of(text: str | None) -> tuple[int, ...]:
    """Labels from what was typed, such as 1,3."""
    if text is None:
        return ()
    words = text.replace(",", " ").split()
    if not words or not all(word.removeprefix("-").isdecimal() for word in words) or len(set(words)) < len(words):
        raise BadInput(f"--label is {text!r}; expected different whole numbers, such as 3 or 1,3")
    return tuple(map(int, words))


def check_inside(inside: str | None, label: str | None) -> None:
    """Refuse an unknown side, and any side together with a label, whose field is positive inside the label."""
    if inside not in (None, "above", "below"):
        raise BadInput(f"--inside is {inside!r}; expected above or below")
    if inside is not None and label is not None:
        raise BadInput("--inside and --label came together; expected one of them: the inside of a label is solid")


def given(**options: Any) -> dict[str, Any]:
    """The options that were given, as arguments of `read_volume`."""
    return {name: value for name, value in options.items() if value is not None}
