"""``run.json`` of a finished run: scene, levels, lattices and recipe, and the arrays in the EXR file.

Nothing in it is trusted: shapes, names and counts are checked before an array is read or allocated.
"""

import json
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.lights import Distant, Harmonics, Light, Sky
from illumgrid.field.scene import Field, Levels, Material, Quad, Scene
from illumgrid.field.storing import NATIVE
from illumgrid.field.volume import Lattice, Volume, histogram
from illumgrid.grid import RGB, Channels, GridSpec, IlluminationGrid, WallTexture
from illumgrid.io import exr
from illumgrid.io import grids as grid_parts
from illumgrid.io.elsewhere import Source

FORMAT = 4
"""1 had RGB only; up to 2, fields were float32, x fastest, with one checksum for both files; up to 3, dense grids."""
PLACE = ("origin", "spacing", "direction")
BINS = 64  # bins of the histogram of a field
MOST_ROWS = 64
LOOKS = ("transmission", "translucent")
EDGES = ("corner", "edge_u", "edge_v")
KINDS = {
    "Sky": ("name", "radiance"),
    "Distant": ("name", "direction", "angle", "irradiance"),
    "Harmonics": ("name", "coefficients"),
}

Plan = dict[str, exr.Planned]  # by part, in the order of the file
Record = dict[str, Any]  # the content of run.json


@dataclass(frozen=True, eq=False)
class Stored:
    """The content of a finished folder, except the picture: one grid and one column of levels for every field.

    The recipe states how the run was made, in types of JSON: finite numbers, text, booleans, None, lists, dicts by
    text. With a `source` the fields are not written: the folder refers to it.
    """

    scene: Scene
    levels: Levels
    grids: tuple[IlluminationGrid, ...]
    walls: tuple[WallTexture, ...]
    recipe: dict[str, Any]
    source: Source | None = None

    def __post_init__(self) -> None:
        fields, table = len(self.scene.fields), np.asarray(self.levels.table)
        if len(self.grids) != fields:
            raise BadInput(f"{len(self.grids)} grids came for {fields} fields; expected one each")
        if len(self.walls) != len(self.scene.quads):
            raise BadInput(f"{len(self.walls)} wall textures came for {len(self.scene.quads)} quads; expected one each")
        if table.ndim != 2 or not table.size or table.shape[1] != fields or not np.isfinite(table).all():
            raise BadInput(f"the level table has shape {table.shape}; expected finite isovalues, one column per field")


def record_of(stored: Stored) -> Record:
    """The record without arrays, as JSON returns it (it keeps floats exactly, makes tuples lists and keys text)."""

    def lattice(of: Lattice) -> Record:
        return {"shape": of.shape} | {name: getattr(of, name).tolist() for name in PLACE}

    fields = [
        {"name": f.name, "range": f.range.tolist(), "inside": f.inside, "falling": f.falling}
        | {"slope": f.volume.slope, "intercept": f.volume.intercept, "unit": f.volume.unit}
        | ({} if f.volume.oriented else {"oriented": False})
        | {"albedo": f.material.albedo.tolist(), "emission": f.material.emission.tolist()}
        | {n: getattr(f.material, n) for n in LOOKS if getattr(f.material, n)}
        | ({} if f.material.roughness is None else {"roughness": f.material.roughness})
        | {"type": f.volume.stored.dtype.name, "extremes": f.volume.extremes}
        | {"histogram": histogram(f.volume, BINS)[0].tolist()}
        | lattice(f.volume)
        for f in stored.scene.fields
    ]
    quads = [
        {"name": q.name, "texels": list(q.texels), "light": q.light}
        | {name: getattr(q, name).tolist() for name in EDGES}
        | {"albedo": q.material.albedo.tolist(), "emission": q.material.emission.tolist()}
        for q in stored.scene.quads
    ]
    for about, f in zip(fields, stored.scene.fields):
        about.update({} if f.isovalue is None else {"isovalue": f.isovalue})
    lit = {f"light/{f.name}": grid.channels for f, grid in zip(stored.scene.fields, stored.grids)}
    lit |= {f"wall/{q.name}": wall.channels for q, wall in zip(stored.scene.quads, stored.walls)}
    record = {
        "format": FORMAT,
        "illumgrid": version("illumgrid"),
        "scene": {"fields": fields, "quads": quads, "background": stored.scene.background.tolist()}
        | {"lights": [_described(light) for light in stored.scene.lights]},
        "levels": np.asarray(stored.levels.table, float).tolist(),
        "grids": {
            f.name: lattice(grid.spec)
            | {"lit": _lit(grid)}
            | ({"blocks": count} if (count := grid_parts.blocks_of(grid)) else {})
            | ({"rows": len(grid.rows)} if grid.rows else {})
            for f, grid in zip(stored.scene.fields, stored.grids)
        },
        "channels": {part: asdict(channels) for part, channels in lit.items()},
        "recipe": stored.recipe,
    }
    return dict(json.loads(json.dumps(record, allow_nan=False)))


def _lit(grid: IlluminationGrid) -> float:
    """Share of the nodes that have light of their own; of several densities, that of the coarsest."""
    step = int(grid.held.layout.step[0])
    return len(grid.lit) / float(np.prod((np.array(grid.spec.shape) - 1) // step + 1))


def _described(light: Light) -> Record:
    parts = {key: getattr(light, key) for key in KINDS[type(light).__name__]}
    return {"kind": type(light).__name__} | {
        k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in parts.items()
    }


def _light(about: Record) -> Light:
    if about["kind"] not in KINDS:
        raise BadInput(f"a light of kind {str(about['kind'])[:40]!r} came; expected one of {', '.join(KINDS)}")
    kind: Any = {cls.__name__: cls for cls in (Sky, Distant, Harmonics)}[about["kind"]]
    light: Light = kind(*(about[key] for key in KINDS[about["kind"]]))
    return light


def read_record(path: Path) -> Record:
    """The content of ``run.json``, if its format is known here."""
    record: Record = json.loads(path.read_text(encoding="utf-8"))
    if record["format"] not in range(1, FORMAT + 1):
        raise BadInput(f"its format is {record['format']!r}; illumgrid {version('illumgrid')} reads 1 to {FORMAT}")
    if not isinstance(record["recipe"], dict):
        raise BadInput("its recipe is not a table")
    return record


def _field_volume(record: Record, about: Record, plan: Plan, parts: exr.Parts) -> Volume:
    part = f"field/{about['name']}"
    inside, image = plan[part], parts.pop(part)
    values = exr.field_values(image, inside) if inside.field else exr.array(image, "Y", inside.shape)
    origin, spacing, direction = (about[k] for k in PLACE)
    slope, intercept = about.get("slope", 1.0), about.get("intercept", 0.0)
    oriented = False if about.get("oriented") is False else None  # older folders say it by their place alone
    return Volume(values, origin, spacing, direction, slope, intercept, about.get("unit"), oriented=oriented)


def rebuild(record: Record, plan: Plan, parts: exr.Parts, volumes: list[Volume] | None) -> Stored:
    """The content of a folder, from its record and the arrays of its parts; `volumes` are fields that are not in it."""
    grids, fields = [], []
    for number, about in enumerate(record["scene"]["fields"]):
        where, channels = record["grids"][about["name"]], _channels(record, f"light/{about['name']}")
        spec = GridSpec(_shape(where), *(where[k] for k in PLACE))
        rows = tuple(grid_parts.of_lattice(spec, channels, parts.pop(part)) for part in _rows(record, about["name"]))
        grid = grid_parts.rebuilt(about["name"], spec, channels, parts, grid_parts.count_of(where))
        grids.append(replace(grid, rows=rows) if rows else grid)
        volume = _field_volume(record, about, plan, parts) if volumes is None else volumes[number]
        looks = {name: about[name] for name in (*LOOKS, "roughness") if name in about}
        material = Material(about["albedo"], about["emission"], **looks)
        falling = about.get("falling", False)
        held = about.get("isovalue")
        fields.append(Field(about["name"], volume, material, about["range"], about["inside"], falling, held))
    quads, walls = [], []
    for about in record["scene"]["quads"]:
        part, shape = f"wall/{about['name']}", _wall_shape(about, record)
        texels, channels = parts.pop(part), _channels(record, part)
        values, support = (exr.array(texels, names, shape).swapaxes(0, 2) for names in (channels.names, "support"))
        walls.append(WallTexture(values, np.ascontiguousarray(support), channels))
        material = Material(about["albedo"], about["emission"])
        corner, edge_u, edge_v = (np.array(about[name], float) for name in EDGES)
        quads.append(Quad(about["name"], corner, edge_u, edge_v, material, (shape[0], shape[1]), about.get("light")))
    lights = tuple(map(_light, record["scene"].get("lights", [])))
    scene = Scene(tuple(fields), tuple(quads), record["scene"]["background"], lights)
    return Stored(scene, Levels(np.array(record["levels"], float)), tuple(grids), tuple(walls), record["recipe"])


def _rows(record: Record, field: str) -> list[str]:
    """Names of the parts that hold a field's grid at positions of the sweep, if its level is held."""
    count = record["grids"][field].get("rows", 0)
    if not (isinstance(count, int) and 0 <= count <= MOST_ROWS and count != 1):
        raise BadInput(f"the rows of field {field!r} are {str(count)[:40]!r}; expected 2 to {MOST_ROWS}, or none")
    return [f"rows/{row}/{field}" for row in range(count)]


def _shape(about: Record) -> tuple[int, int, int]:
    match about["shape"]:
        case [int(nx), int(ny), int(nz)] if min(nx, ny, nz) >= 2:
            return nx, ny, nz
    raise BadInput(f"the shape {str(about['shape'])[:80]} came; expected three whole numbers of at least 2")


def _wall_shape(about: Record, record: Record) -> tuple[int, int, int]:
    match about["texels"]:
        case [int(nu), int(nv)] if min(nu, nv) >= 1:
            return nu, nv, len(record["levels"])
    raise BadInput(f"the texels {str(about['texels'])[:80]} came; expected two whole numbers of at least 1")


def _channels(record: Record, part: str) -> Channels:
    if record["format"] == 1:
        return RGB
    match record["channels"][part]:
        case {"names": [*names], "mix": [*mix]} if len(names) == len(mix) and np.isfinite(np.array(mix, float)).all():
            return Channels(tuple(map(str, names)), tuple((float(r), float(g), float(b)) for r, g, b in mix))
    raise BadInput(f"the channels of {part!r} are {str(record['channels'][part])[:80]}; expected names and their mix")


def plan_of(record: Record) -> Plan:
    """The parts that the EXR file of a record must have, with their shapes and channels."""
    plan: Plan = {}
    for about in record["scene"]["fields"]:
        name, where = about["name"], record["grids"][about["name"]]
        shape, channels = _shape(where), _channels(record, f"light/{name}")
        plan |= grid_parts.planned(name, shape, channels, grid_parts.count_of(where))
        (every,) = grid_parts.planned(name, shape, channels, 0).values()
        plan |= dict.fromkeys(_rows(record, name), every)
        if "source" not in record:
            plan[f"field/{about['name']}"] = _planned_field(record, about)
    for about in record["scene"]["quads"]:
        part = f"wall/{about['name']}"
        plan[part] = exr.Planned(_wall_shape(about, record), (*_channels(record, part).names, "support"))
    return plan


def _planned_field(record: Record, about: Record) -> exr.Planned:
    if record["format"] < 3:
        return exr.Planned(_shape(about), ("Y",))
    if about["type"] not in [kind.name for kind in NATIVE]:
        raise BadInput(f"the values of {about['name']!r} are {str(about['type'])[:40]!r}; expected {NATIVE}")
    return exr.Planned(_shape(about), ("Y" if about["type"] == "float32" else exr.BYTES,), about["type"], field=True)
