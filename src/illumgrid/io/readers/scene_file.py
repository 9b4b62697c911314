"""Scenes from files: a .toml with tables for fields, quads and the background."""

import os
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.filters import finite, smooth
from illumgrid.field.lights import Distant, Light, Sky
from illumgrid.field.rooms import fitting_texels
from illumgrid.field.scene import Field, Material, Quad, Scene
from illumgrid.field.signed import signed_pair, without_gaps
from illumgrid.field.volume import Volume
from illumgrid.io.readers.scene_keys import (
    BACKGROUND,
    DENSITY,
    FIELD,
    KINDS_OF_LIGHT,
    LIGHT,
    LOOKS,
    MATERIAL,
    POINTS,
    QUAD,
    READING,
    Table,
    Take,
    check_table,
    shown,
    unknown,
)

LIMIT = 1 << 20
"""Most bytes of a scene file: it contains words; voxels are elsewhere."""

LONGEST_LINE = 2000
"""Characters. The time that tomllib takes for a key grows with the square of its dots."""

EXPECTED = "expected a scene file: TOML with one or more [[field]] tables"


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
    """Prefix a message with the place of the problem."""
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
        raise BadInput(f"not TOML ({reason}); {EXPECTED}; correct it there") from None


def _listed(tables: Table, kind: str, keys: Mapping[str, Take], required: tuple[str, ...]) -> list[tuple[str, Table]]:
    """The tables [[kind]], checked, each with words for its place: number and name."""
    found = tables.get(kind, [])
    if not (isinstance(found, list) and all(isinstance(table, dict) for table in found)):
        came = f"the single table [{kind}]" if isinstance(found, dict) else f"{kind} = {shown(found)}"
        raise BadInput(f"{came} came; expected tables [[{kind}]], in double brackets")
    placed = []
    for number, table in enumerate(found, 1):
        name = table.get("name")
        place = f"[[{kind}]] {number}" + (f" {shown(name)}" if isinstance(name, str) else "")
        with _place(place):
            if kind == "field" and "points" in table:
                if "volume" in table:
                    raise BadInput("points and volume came together; expected one of them; leave the other out")
                checked = check_table(table, POINTS, ("name", "points", "spacing", "sigma"))
            else:
                checked = check_table(table, keys, required)
            placed.append((place, _with_material(checked)))
    return placed


def _scene(tables: Table, folder: Path, smoothing: float) -> Scene:
    for name in tables:
        if name not in ("field", "quad", "light", "background"):
            raise unknown("table", name, {"field": 0, "quad": 0, "background": 0, "light": 0})
    fields = _listed(tables, "field", FIELD, ("name", "volume"))
    quads = _listed(tables, "quad", QUAD, ("name", "corner", "edge_u", "edge_v"))
    background = tables.get("background", {})
    if not isinstance(background, dict):
        raise BadInput(f"background is {shown(background)}; expected one table [background] with radiance = [0, 0, 0]")
    with _place("[background]"):
        radiance = check_table(background, BACKGROUND, ()).get("radiance", [0, 0, 0])
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
    for place, table in _listed(tables, "light", LIGHT, ("name",)):
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
    if set(own) not in map(set, KINDS_OF_LIGHT):
        kinds = ", or ".join(" with ".join(kind) for kind in KINDS_OF_LIGHT)
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
    own = _without(table, {**READING, **DENSITY, "points": 0, "signed": 0})
    return (Field(**{**own, "volume": volume}),)


def _without(table: Table, keys: Mapping[str, Any]) -> Table:
    return {key: value for key, value in table.items() if key not in keys}


def _with_material(table: Table) -> Table:
    """The table with `material` in place of `albedo` and `emission`; None for a signed field that gives neither."""
    keys = {**MATERIAL, **LOOKS}
    given = {key: table[key] for key in keys if key in table}
    return {**_without(table, keys), "material": None if table.get("signed") and not given else Material(**given)}


def _volume(table: Table, folder: Path, smoothing: float, read: dict[str, Volume]) -> Volume:
    """Volume of a field, smoothed; `read` keeps what was read for other fields."""
    from illumgrid.io.points import density_of_file
    from illumgrid.io.readers import read_volume

    read_by, named, keys = (
        (density_of_file, "points", DENSITY) if "points" in table else (read_volume, "volume", READING)
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
