"""The keys of a scene file: accepted values, and the message for a wrong value or key."""

import difflib
from collections.abc import Callable, Mapping
from typing import Any

from illumgrid.errors import BadInput

Table = dict[str, Any]
Take = Callable[[str, Any], Any]
"""From a key and its value in the file to an argument of a dataclass, which checks further bounds itself."""


def shown(value: Any) -> str:
    """The given value, on one line of limited length."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:60]}… ({len(text)} characters)"


def _text(key: str, value: Any) -> str:
    if not (isinstance(value, str) and value and value.isprintable()):
        raise BadInput(f"{key} is {shown(value)}; expected a printable text in quotes")
    return value


def _side(key: str, value: Any) -> str:
    if value not in ("above", "below"):
        raise BadInput(f"{key} is {shown(value)}; expected 'above' or 'below'")
    return str(value)


def _yes(key: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise BadInput(f"{key} is {shown(value)}; expected true or false")
    return value


def _numbers(count: int, expected: str, kind: type[int] | type[float] = float, most: float = 1e30) -> Take:
    """Accepts a list of `count` finite numbers (whole ones if `kind` is int), none beyond `most`."""

    def good(x: Any) -> bool:
        # In Python True is a whole number; comparisons with NaN are false.
        return not isinstance(x, bool) and isinstance(x, (int, kind)) and -most <= x <= most

    def take(key: str, value: Any) -> list[Any]:
        if not (isinstance(value, list) and len(value) == count and all(map(good, value))):
            raise BadInput(f"{key} is {shown(value)}; expected {expected}, none beyond {most:g}")
        return value

    return take


_COLOUR = _numbers(3, "three numbers in brackets (red, green, blue)")
_VECTOR = _numbers(3, "three numbers in brackets (x, y, z in world units)")


def _choice(key: str, value: Any) -> int | str:
    if isinstance(value, bool) or not isinstance(value, int | str):
        raise BadInput(f"{key} is {shown(value)}; expected a whole number from 0, or a name in quotes")
    return value


def _whole(key: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) > 2**31:
        raise BadInput(f"{key} is {shown(value)}; expected a whole number")
    return value


READING: Mapping[str, Take] = {
    "spacing": _numbers(3, "three positive numbers in brackets (along x, y, z)"),
    **dict.fromkeys(("channel", "time", "array"), _choice),
    "label": _whole,
    "crop": _numbers(6, "six whole numbers in brackets (first and last + 1 along x, y, z)", int, 2**31),
    "downsample": _whole,
    "follow": _yes,
}
"""What `read_volume` takes."""


def _distances(key: str, value: Any) -> float | list[float]:
    """A number, or three along x, y, z."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    three: list[float] = _numbers(3, "a positive number, or three in brackets (along x, y, z)")(key, value)
    return three


def _sigma(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadInput(f"{key} is {shown(value)}; expected the standard deviation of the Gaussian, in world units")
    return float(value)


def _cell(key: str, value: Any) -> Any:
    return value if value == "file" else _distances(key, value)


def _columns(key: str, value: Any) -> list[str]:
    if not (isinstance(value, list) and len(value) == 3 and all(isinstance(name, str) and name for name in value)):
        raise BadInput(f"{key} is {shown(value)}; expected three names in brackets (of x, y and z)")
    return value


DENSITY: Mapping[str, Take] = {
    "spacing": _distances,
    "sigma": _sigma,
    "weights": _text,
    "columns": _columns,
    "cell": _cell,
}
"""What `density` takes beside the points."""


def _share(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
        raise BadInput(f"{key} is {shown(value)}; expected a number from 0 to 1")
    return float(value)


def _level(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1.7e308:
        raise BadInput(f"{key} is {shown(value)}; expected a number")
    return float(value)


MATERIAL = {"albedo": _COLOUR, "emission": _COLOUR}
LOOKS = dict.fromkeys(("transmission", "roughness", "translucent"), _share)
FIELD: Mapping[str, Take] = {
    "name": _text,
    "volume": _text,
    **MATERIAL,
    **LOOKS,
    "range": _numbers(2, "two numbers in brackets (lowest and highest isovalue)", most=1.7e308),
    "isovalue": _level,
    "inside": _side,
    "falling": _yes,
    "signed": _yes,
    **READING,
}
POINTS: Mapping[str, Take] = {
    "points": _text,
    **{key: take for key, take in FIELD.items() if key not in ("volume", *READING)},
    **DENSITY,
}
"""A field made from points, in place of a volume."""
QUAD: Mapping[str, Take] = {
    "name": _text,
    "corner": _VECTOR,
    "edge_u": _VECTOR,
    "edge_v": _VECTOR,
    **MATERIAL,
    "texels": _numbers(2, "two whole numbers in brackets (along edge_u and edge_v)", int, 4096),
    "light": _text,
}
BACKGROUND: Mapping[str, Take] = {"radiance": _COLOUR}


def _degrees(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadInput(f"{key} is {shown(value)}; expected degrees, half of the light's angular size")
    return float(value)


LIGHT: Mapping[str, Take] = {
    "name": _text,
    "radiance": _COLOUR,
    "nadir": _COLOUR,
    "zenith": _COLOUR,
    "image": _text,
    "direction": _VECTOR,
    "angle": _degrees,
    "irradiance": _COLOUR,
}
KINDS_OF_LIGHT = (("radiance",), ("nadir", "zenith"), ("image",), ("direction", "angle", "irradiance"))
"""What a table [[light]] has besides its name: a constant sky, a gradient, an image, a disc of the sky."""


def unknown(kind: str, name: str, known: Mapping[str, Any]) -> BadInput:
    """The error for a name that is not among the known ones, with the nearest of these."""
    close = difflib.get_close_matches(name, known, 1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return BadInput(f"there is no {kind} {shown(name)}; expected only {', '.join(known)}{hint}")


def check_table(table: Table, keys: Mapping[str, Take], required: tuple[str, ...]) -> Table:
    """The content of a table, after the check of required keys, unknown keys and values."""
    for key in table:
        if key not in keys:
            raise unknown("key", key, keys)
    for key in required:
        if key not in table:
            raise BadInput(f"{key} is missing, there is {', '.join(table) or 'nothing'}; expected {key} = ...; add it")
    return {key: keys[key](key, value) for key, value in table.items()}
