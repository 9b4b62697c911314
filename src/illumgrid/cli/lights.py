"""Options that choose the light of a finished run."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from illumgrid.errors import BadInput

if TYPE_CHECKING:
    from illumgrid.field.lights import Sky
    from illumgrid.light import Illumination

Weights = Annotated[
    list[str] | None,
    typer.Option("--light", metavar="NAME=W", help="Multiply a light of the scene by W (repeatable)."),
]
SkyImage = Annotated[
    Path | None,
    typer.Option(
        "--sky",
        metavar="IMAGE",
        help="Light a run of --lights sh by this image of a sky: .exr or .hdr, latitude-longitude.",
    ),
]
Turn = Annotated[
    float, typer.Option("--turn", metavar="DEG", help="Turn the light of a run of --lights sh about the up axis.")
]


def relit(light: "Illumination", weights: list[str] | None, sky: Path | None, turn: float) -> "Illumination":
    """The light with the options applied."""
    if sky is not None or turn:
        light = light.under(_sky(sky), turn)
    parsed = {}
    for text in weights or []:
        name, equals, number = text.rpartition("=")
        try:
            parsed[name] = float(number)
        except ValueError:
            equals = ""
        if not equals:
            raise BadInput(f"--light is {text!r}; expected NAME=W with a number W, such as key=1.5")
    return light.mix(**parsed) if parsed else light


def _sky(path: Path | None) -> "Sky | None":
    import numpy as np

    from illumgrid.field.lights import Sky
    from illumgrid.io.readers.sky import read_image

    return None if path is None else Sky("sky", np.asarray(read_image(path), float))
