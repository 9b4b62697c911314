"""How surfaces look in pictures, as options say it: coats, translucency."""

from typing import TYPE_CHECKING, Annotated

import typer

from illumgrid.errors import BadInput

if TYPE_CHECKING:
    from illumgrid.light import Illumination

KEYS = "roughness", "translucent"

Look = Annotated[
    list[str] | None,
    typer.Option(
        "--look",
        metavar="[NAME.]KEY=W",
        help="Of a field, in pictures only: roughness=0.2 gives it a glossy coat (0 a mirror, 1 dull), translucent=0.6 "
        "lets 60 % of what lies behind through. Repeatable.",
    ),
]


def looking(light: "Illumination", looks: list[str] | None) -> "Illumination":
    """The light with the looks that options name, by default of the first field."""
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
                f"--look is {text[:60]!r}; expected roughness=W or translucent=W with W from 0 to 1, perhaps after the "
                "name of a field: film.translucent=0.6"
            )
        given.setdefault(light.scene.number_of(name or None), {})[key] = share
    for number, own in given.items():
        field = light.scene.fields[number]
        material = {key: getattr(field.material, key) for key in KEYS} | own
        light = light.looking(field.name, **material)
    return light
