"""Scenes from files: a .toml with tables for fields, quads and the background."""

import difflib
import os
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.lights import Distant, Light, Sky
from illumgrid.field.rooms import fitting_texels
from illumgrid.field.scene import Field, Material, Quad, Scene
from illumgrid.field.signed import signed_pair, without_gaps
from illumgrid.field.volume import Volume, finite, smooth

LIMIT = 1 << 20
"""Bytes that a scene file may have: it holds words, the voxels are elsewhere."""

LONGEST_LINE = 2000
"""Characters. The time that tomllib takes for a key grows with the square of its dots."""

EXPECTED = "expected a scene file: TOML with one or more [[field]] tables"

Table = dict[str, Any]
Take = Callable[[str, Any], Any]
"""From a key and what a file says there to what a dataclass takes; bounds of its own are left to the dataclass."""


def read_scene(path: str | os.PathLike[str], *, smoothing: float = 0.0) -> Scene:
    """Read a scene from a .toml file.

    Parameters
    ----------
    path : str or path-like
        UTF-8, at most 1 MB, with these tables: ``[[field]]``, one or more, with `name`, `volume` (what `read_volume`
        reads, relative to this file), or `points` with `spacing`, `sigma` and perhaps `weights`, `columns`, `cell` (see
        `density`), and perhaps `albedo`, `emission`, `transmission`, `roughness`, `translucent` (see `Material`),
        `range`, or `isovalue` (held while others sweep), `inside`, `falling`, `signed` (true: two fields,
        ``NAME-positive`` where h >= c and ``NAME-negative`` where h <= -c), and the options of `read_volume`
        (`spacing`, `channel`, `time`, `array`, `label`, `crop`,
        `downsample`, `follow`); ``[[quad]]`` with `name`, `corner`, `edge_u`, `edge_v` and perhaps `albedo`,
        `emission`, `texels`, `light`; ``[[light]]`` with `name` and either `radiance`, or `nadir` and `zenith`, or
        `image`, or `direction`, `angle` and `irradiance`, see `Sky` and `Distant`; ``[background]`` with `radiance`.
        What is left out has the default of `Field`, `Material`, `Quad` or `Scene`; texels that are left out fit the
        first field, one for three voxels.
    smoothing : float, optional
        Standard deviation, in voxels, of a Gaussian that blurs every field before anything else.

    Returns
    -------
    scene : Scene

    Raises
    ------
    BadInput
        If it is not such a file, or a volume cannot be read; the sentence names file, table and key.
    """
    file = Path(os.path.abspath(path))
    with _place(file.name):
        try:
            return _scene(_tables(_content(file)), file.parent, smoothing)
        except RecursionError:
            raise BadInput(f"is nested too deeply; {EXPECTED}; leave the dotted keys and nested brackets out") from None


@contextmanager
def _place(words: str) -> Iterator[None]:
    """Say where the trouble is, before what it is."""
    try:
        yield
    except BadInput as problem:
        raise BadInput(f"{words}: {problem}") from None


def _content(file: Path) -> bytes:
    try:
        if file.is_dir():
            raise BadInput(f"a folder; {EXPECTED}; give the file in it")
        if not file.exists():
            raise BadInput(f"there is no such file; {EXPECTED}; check the path")
        if not file.is_file():
            raise BadInput(f"neither a file nor a folder; {EXPECTED}; copy it into a file")
        with open(file, "rb") as stream:
            content = stream.read(LIMIT + 1)
    except OSError as problem:
        raise BadInput(f"cannot be read ({problem.strerror}); {EXPECTED}; check path and permissions") from None
    if len(content) > LIMIT:
        raise BadInput(f"more than {LIMIT} bytes; {EXPECTED}; keep the voxels in files of their own")
    return content


def _tables(content: bytes) -> Table:
    try:
        text = content.decode("utf-8-sig")
        if any(len(line) > LONGEST_LINE for line in text.split("\n")):
            raise BadInput(f"a line has more than {LONGEST_LINE} characters; {EXPECTED}; break it")
        return tomllib.loads(text)
    except UnicodeDecodeError as problem:
        raise BadInput(f"byte {problem.start} is not UTF-8; {EXPECTED}; save it as UTF-8 text") from None
    except BadInput:
        raise
    except ValueError as problem:  # of tomllib, or of a number with thousands of digits
        reason = " ".join(str(problem).split()).replace(". ", ", ")[:200]
        raise BadInput(f"not TOML ({reason}); {EXPECTED}; mend it there") from None


def _shown(value: Any) -> str:
    """What came, on one line that is not long."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:60]}… ({len(text)} characters)"


def _text(key: str, value: Any) -> str:
    if not (isinstance(value, str) and value and value.isprintable()):
        raise BadInput(f"{key} is {_shown(value)}; expected a printable text in quotes")
    return value


def _side(key: str, value: Any) -> str:
    if value not in ("above", "below"):
        raise BadInput(f"{key} is {_shown(value)}; expected 'above' or 'below'")
    return str(value)


def _yes(key: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise BadInput(f"{key} is {_shown(value)}; expected true or false")
    return value


def _numbers(count: int, expected: str, kind: type[int] | type[float] = float, most: float = 1e30) -> Take:
    """Takes a list of `count` numbers (whole ones if `kind` is int) that are finite and not beyond `most`."""

    def good(x: Any) -> bool:
        # In Python true is a whole number; NaN is not at most anything.
        return not isinstance(x, bool) and isinstance(x, (int, kind)) and -most <= x <= most

    def take(key: str, value: Any) -> list[Any]:
        if not (isinstance(value, list) and len(value) == count and all(map(good, value))):
            raise BadInput(f"{key} is {_shown(value)}; expected {expected}, none beyond {most:g}")
        return value

    return take


_COLOUR = _numbers(3, "three numbers in brackets (red, green, blue)")
_VECTOR = _numbers(3, "three numbers in brackets (x, y, z in world units)")


def _choice(key: str, value: Any) -> int | str:
    if isinstance(value, bool) or not isinstance(value, int | str):
        raise BadInput(f"{key} is {_shown(value)}; expected a whole number from 0, or a name in quotes")
    return value


def _whole(key: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) > 2**31:
        raise BadInput(f"{key} is {_shown(value)}; expected a whole number")
    return value


_READING: Mapping[str, Take] = {
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
        raise BadInput(f"{key} is {_shown(value)}; expected the standard deviation of the Gaussian, in world units")
    return float(value)


def _cell(key: str, value: Any) -> Any:
    return value if value == "file" else _distances(key, value)


def _columns(key: str, value: Any) -> list[str]:
    if not (isinstance(value, list) and len(value) == 3 and all(isinstance(name, str) and name for name in value)):
        raise BadInput(f"{key} is {_shown(value)}; expected three names in brackets (of x, y and z)")
    return value


_DENSITY: Mapping[str, Take] = {
    "spacing": _distances,
    "sigma": _sigma,
    "weights": _text,
    "columns": _columns,
    "cell": _cell,
}
"""What `density` takes beside the points."""


def _share(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
        raise BadInput(f"{key} is {_shown(value)}; expected a number from 0 to 1")
    return float(value)


def _level(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1.7e308:
        raise BadInput(f"{key} is {_shown(value)}; expected a number")
    return float(value)


_MATERIAL = {"albedo": _COLOUR, "emission": _COLOUR}
_LOOKS = dict.fromkeys(("transmission", "roughness", "translucent"), _share)
_FIELD: Mapping[str, Take] = {
    "name": _text,
    "volume": _text,
    **_MATERIAL,
    **_LOOKS,
    "range": _numbers(2, "two numbers in brackets (lowest and highest isovalue)", most=1.7e308),
    "isovalue": _level,
    "inside": _side,
    "falling": _yes,
    "signed": _yes,
    **_READING,
}
_POINTS: Mapping[str, Take] = {
    "points": _text,
    **{key: take for key, take in _FIELD.items() if key not in ("volume", *_READING)},
    **_DENSITY,
}
"""A field made from points, in place of a volume."""
_QUAD: Mapping[str, Take] = {
    "name": _text,
    "corner": _VECTOR,
    "edge_u": _VECTOR,
    "edge_v": _VECTOR,
    **_MATERIAL,
    "texels": _numbers(2, "two whole numbers in brackets (along edge_u and edge_v)", int, 4096),
    "light": _text,
}
_BACKGROUND: Mapping[str, Take] = {"radiance": _COLOUR}


def _degrees(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadInput(f"{key} is {_shown(value)}; expected degrees, half of the light's angular size")
    return float(value)


_LIGHT: Mapping[str, Take] = {
    "name": _text,
    "radiance": _COLOUR,
    "nadir": _COLOUR,
    "zenith": _COLOUR,
    "image": _text,
    "direction": _VECTOR,
    "angle": _degrees,
    "irradiance": _COLOUR,
}
_KINDS_OF_LIGHT = (("radiance",), ("nadir", "zenith"), ("image",), ("direction", "angle", "irradiance"))
"""What a table [[light]] has besides its name: a constant sky, a gradient, an image, a disc of the sky."""


def _unknown(kind: str, name: str, known: Mapping[str, Any]) -> BadInput:
    close = difflib.get_close_matches(name, known, 1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return BadInput(f"there is no {kind} {_shown(name)}; expected only {', '.join(known)}{hint}")


def _checked(table: Table, keys: Mapping[str, Take], required: tuple[str, ...]) -> Table:
    """What the table says, after the check that it has the required keys, no others than `keys`, and good values."""
    for key in table:
        if key not in keys:
            raise _unknown("key", key, keys)
    for key in required:
        if key not in table:
            raise BadInput(f"{key} is missing, there is {', '.join(table) or 'nothing'}; expected {key} = ...; add it")
    return {key: keys[key](key, value) for key, value in table.items()}


def _listed(tables: Table, kind: str, keys: Mapping[str, Take], required: tuple[str, ...]) -> list[tuple[str, Table]]:
    """The tables [[kind]], checked, each with the words that say where it is: number and name."""
    found = tables.get(kind, [])
    if not (isinstance(found, list) and all(isinstance(table, dict) for table in found)):
        came = f"the single table [{kind}]" if isinstance(found, dict) else f"{kind} = {_shown(found)}"
        raise BadInput(f"{came} came; expected tables [[{kind}]], in double brackets")
    placed = []
    for number, table in enumerate(found, 1):
        name = table.get("name")
        place = f"[[{kind}]] {number}" + (f" {_shown(name)}" if isinstance(name, str) else "")
        with _place(place):
            if kind == "field" and "points" in table:
                if "volume" in table:
                    raise BadInput("points and volume came together; expected one of them; leave the other out")
                checked = _checked(table, _POINTS, ("name", "points", "spacing", "sigma"))
            else:
                checked = _checked(table, keys, required)
            placed.append((place, _with_material(checked)))
    return placed


def _scene(tables: Table, folder: Path, smoothing: float) -> Scene:
    for name in tables:
        if name not in ("field", "quad", "light", "background"):
            raise _unknown("table", name, {"field": 0, "quad": 0, "background": 0, "light": 0})
    fields = _listed(tables, "field", _FIELD, ("name", "volume"))
    quads = _listed(tables, "quad", _QUAD, ("name", "corner", "edge_u", "edge_v"))
    background = tables.get("background", {})
    if not isinstance(background, dict):
        raise BadInput(f"background is {_shown(background)}; expected one table [background] with radiance = [0, 0, 0]")
    with _place("[background]"):
        radiance = _checked(background, _BACKGROUND, ()).get("radiance", [0, 0, 0])
        if min(radiance) < 0:
            raise BadInput(f"radiance is {radiance}; expected three numbers from 0 up")
    if not fields:
        raise BadInput("there is no [[field]]; expected at least one, with name and volume")
    seen: dict[str, str] = {}
    for place, table in (*fields, *quads):
        if table["name"] in seen:
            raise BadInput(f"{place}: name is that of {seen[table['name']]}, too; expected names that differ")
        seen[table["name"]] = place
    walls, solids = list[Quad](), list[Field]()
    for place, table in quads:
        with _place(place):
            walls.append(Quad(**table))
    lights = []
    for place, table in _listed(tables, "light", _LIGHT, ("name",)):
        with _place(place):
            lights.append(_light(table, folder))
    volumes: dict[str, Volume] = {}  # two fields may be two ranges of one file
    for place, table in fields:  # last, because reading takes longest
        with _place(place):
            solids.extend(_fields(table, _volume(table, folder, smoothing, volumes)))
    fitted = [q if "texels" in t else fitting_texels(q, solids[0].volume) for q, (_, t) in zip(walls, quads)]
    return Scene(tuple(solids), tuple(fitted), radiance, tuple(lights))


def _light(table: Table, folder: Path) -> Light:
    """The light of a checked table."""
    own = _without(table, {"name": 0, "material": 0})
    if set(own) not in map(set, _KINDS_OF_LIGHT):
        kinds = ", or ".join(" with ".join(kind) for kind in _KINDS_OF_LIGHT)
        raise BadInput(f"{' with '.join(own) or 'nothing but a name'} came; expected {kinds}")
    if "direction" in own:
        return Distant(table["name"], **own)
    if "image" in own:
        from illumgrid.io.readers.sky import read_image

        with _place("image"):
            return Sky(table["name"], np.asarray(read_image(folder / own["image"]), float))
    return Sky(table["name"], np.array(own["radiance"] if "radiance" in own else (own["nadir"], own["zenith"])))


def _fields(table: Table, volume: Volume) -> tuple[Field, ...]:
    """The field of a checked table, or the two of a signed one."""
    if "isovalue" in table and "range" in table:
        raise BadInput("range and isovalue came together; expected one of them: a level that is held has no range")
    if table.get("signed"):
        for key in ("inside", "falling", "isovalue"):
            if key in table:
                raise BadInput(f"signed and {key} came together; expected one of them; leave {key} out")
        return signed_pair(table["name"], volume, table.get("range"), table["material"])
    own = _without(table, {**_READING, **_DENSITY, "points": 0, "signed": 0})
    return (Field(**{**own, "volume": volume}),)


def _without(table: Table, keys: Mapping[str, Any]) -> Table:
    return {key: value for key, value in table.items() if key not in keys}


def _with_material(table: Table) -> Table:
    """The table with `material` in place of `albedo` and `emission`; None for a signed field that says neither."""
    keys = {**_MATERIAL, **_LOOKS}
    given = {key: table[key] for key in keys if key in table}
    return {**_without(table, keys), "material": None if table.get("signed") and not given else Material(**given)}


def _volume(table: Table, folder: Path, smoothing: float, read: dict[str, Volume]) -> Volume:
    """Volume of a field, smoothed; `read` keeps what other fields have read."""
    from illumgrid.io.points import density_of_file
    from illumgrid.io.readers import read_volume

    read_by, named, keys = (
        (density_of_file, "points", _DENSITY) if "points" in table else (read_volume, "volume", _READING)
    )
    reading = {key: table[key] for key in keys if key in table}
    known = f"{table[named]} {reading}"
    with _place(named):
        if known not in read:
            read[known] = read_by(folder / table[named], **reading)
        if smoothing == 0:
            return read[known]
        whole = without_gaps(read[known]) if table.get("signed") else finite(read[known], table.get("inside", "above"))
        return smooth(whole, smoothing)
