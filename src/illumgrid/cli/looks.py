"""Options for the look of surfaces in pictures: coats, translucency, cuts, colours of a second quantity."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from illumgrid.errors import BadInput

if TYPE_CHECKING:
    from illumgrid.light import Illumination
    from illumgrid.show.tints import Tint

KEYS = "roughness", "translucent"

Look = Annotated[
    list[str] | None,
    typer.Option(
        "--look",
        metavar="[NAME.]KEY=W",
        help="Change a field in pictures only: roughness=0.2 adds a glossy coat (0 a mirror, 1 dull), translucent=0.6 "
        "shows 60 % of what lies behind. Repeatable.",
    ),
]
Clips = Annotated[
    list[str] | None,
    typer.Option(
        "--clip",
        metavar="AXIS=PLACE",
        help="Leave out what lies beyond a plane in world coordinates: x=12.5, or before it: -x=12.5. The cut shows "
        "the data in grey; the light is that of the whole. Repeatable.",
    ),
]
Color = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|FILE",
        help="Colour surfaces by another field of the run, or by a volume file in the same world coordinates, with the "
        "brightness of a white surface.",
    ),
]
ColorMap = Annotated[str, typer.Option("--cmap", metavar="NAME", help="Colormap of matplotlib for --color.")]
ColorRange = Annotated[
    tuple[float, float] | None,
    typer.Option(metavar="LO HI", help="Values of --color at the ends of the colormap. [default: all its values]"),
]


def tint_of(light: "Illumination", color: str | None, cmap: str, ends: tuple[float, float] | None) -> "Tint | None":
    """The second quantity that the options name: a field of the run, or a file; None without --color."""
    if color is None:
        if cmap != "viridis" or ends is not None:
            option = "--color-range" if ends is not None else "--cmap"
            raise BadInput(f"{option} came without --color; expected both, or neither")
        return None
    from illumgrid.show.tints import Tint

    for field in light.scene.fields:
        if field.name == color:
            return Tint(field.volume, color, cmap, ends)
    if not Path(color).exists():
        names = ", ".join(field.name for field in light.scene.fields)
        raise BadInput(f"--color is {color[:60]!r}; expected a volume file, or a field of the run: {names}")
    from illumgrid.io.readers import read_volume

    return Tint(read_volume(color), Path(color).name.partition(".")[0], cmap, ends)


def looking(light: "Illumination", looks: list[str] | None) -> "Illumination":
    """The light with the looks that the options set, by default on the first field."""
    given: dict[int, dict[str, float]] = {}
    for text in looks or []:
        place, _, value = text.rpartition("=")
        name, _, key = place.rpartition(".")
        try:
            share = float(value)
        except ValueError:
            share = -1.0
        if key not in KEYS or not 0 <= share <= 1:
            raise BadInput(
                f"--look is {text[:60]!r}; expected roughness=W or translucent=W with W from 0 to 1, optionally after "
                "the name of a field: film.translucent=0.6"
            )
        given.setdefault(light.scene.number_of(name or None), {})[key] = share
    for number, own in given.items():
        field = light.scene.fields[number]
        material = {key: getattr(field.material, key) for key in KEYS} | own
        light = light.looking(field.name, **material)
    return light
