"""A finished run on the disk: a folder with ``illumination.exr``, ``run.json`` and perhaps ``preview.png``.

``moments.npz``, of a run from the command line, is what more paths go on from: see `illumgrid.io.partial`.

``illumination.exr`` is a multi-part OpenEXR file (see `illumgrid.io.exr`). Each field has two parts,

- ``light/<field name>``: the channels of its illumination grid (R, G, B; or Y, where it is grey), error and support; of
  several lights also each alone, ``key.Y`` (to be multiplied by the light's colour) or ``key.R``, and ``key.Y.error``;
- ``field/<field name>``: the field's values as they were used, in their type;

where nodes are held in blocks (see `illumgrid.grid.blocks`) another, ``blocks/<field name>``, says where they lie;

and each quad one, ``wall/<quad name>``: light and support of its texels, (nu, nv, rows of the level table).

``run.json`` says where the arrays lie in the world, how channels of light mix to RGB, and all else. Its ``checksum``
covers itself, and in it that of the EXR file: the EXR library never sees a damaged file, and a digit that changed is
never taken for a result. To describe a run the pixels are not read.
"""

import errno
import hashlib
import json
import os
from contextlib import suppress
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
from illumgrid.io import disk, exr
from illumgrid.io import grids as grid_parts
from illumgrid.io.disk import ELSEWHERE
from illumgrid.io.elsewhere import Source, digest, fields_again, referred

FORMAT = 4
"""1 had RGB only; to 2, fields were float32, x fastest, and one checksum covered both files; to 3, grids were dense."""
EXR, RUN, PREVIEW, MOMENTS = "illumination.exr", "run.json", "preview.png", "moments.npz"
PLACE = ("origin", "spacing", "direction")
BINS = 64  # of the histogram of a field
LOOKS = ("transmission", "translucent")
EDGES = ("corner", "edge_u", "edge_v")
KINDS = {
    "Sky": ("name", "radiance"),
    "Distant": ("name", "direction", "angle", "irradiance"),
    "Harmonics": ("name", "coefficients"),
}
AGAIN = "give a folder that 'illumgrid run' wrote, or run it again"

Plan = dict[str, exr.Planned]  # by part, in the order of the file
Record = dict[str, Any]  # the content of run.json


@dataclass(frozen=True, eq=False)
class Stored:
    """What a finished folder holds, except the picture: one grid and one column of levels for every field.

    The recipe says how the run was made, in what JSON has: finite numbers, text, booleans, None, lists, dicts of text.
    With a `source` the fields are not written: the folder refers to it.
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
            raise BadInput(f"the level table has shape {table.shape}; expected finite isovalues, one column a field")


def claim(folder: str | os.PathLike[str], overwrite: bool) -> None:
    """Check that a result may be written to `folder`; changes nothing.

    Raises
    ------
    BadInput
        If it holds a finished run (unless `overwrite`) or anything that is not ours, or cannot be made or replaced.
    """
    with disk.sentences(f"{folder} cannot be written to", ELSEWHERE):
        place = Path(os.path.abspath(folder))
        disk.try_to_write(folder)
        try:
            place.lstat()
        except FileNotFoundError:
            return
        if place.is_symlink() or not place.is_dir():
            raise BadInput(f"{folder} is {'a symbolic link' if place.is_symlink() else 'not a folder'}; {ELSEWHERE}")
        if os.path.ismount(place) or place.samefile(Path.cwd()):  # the folder is replaced as a whole
            raise BadInput(f"{folder} is a mount point or the folder you are in; {ELSEWHERE}")
        _refuse_foreign(place, folder)
        if not overwrite and any(place.iterdir()):
            raise BadInput(f"{folder} holds a finished run; pass overwrite=True or {ELSEWHERE}")


def _refuse_foreign(place: Path, folder: str | os.PathLike[str]) -> None:
    """Raise unless `place`, which the user calls `folder`, is empty or a finished run and nothing besides."""
    plain = {p.name: p.is_file() and not p.is_symlink() for p in place.iterdir()}
    foreign = sorted(name for name in plain if not plain[name] or name not in (EXR, RUN, PREVIEW, MOMENTS))
    if plain and not {EXR, RUN} <= plain.keys():
        foreign = foreign or sorted(plain)  # not a run: a file that happens to have such a name
    if foreign:
        raise BadInput(f"{folder} holds {foreign[0]!r}, which is not of a finished run; {ELSEWHERE}")


def write(folder: str | os.PathLike[str], stored: Stored, picture: bytes | None, overwrite: bool) -> None:
    """Put a finished run, and its `picture` as PNG, at `folder`, whole or not at all; parents are made as needed.

    Raises
    ------
    BadInput
        As `claim` does, also if another run took the folder meanwhile; and if the disk is full.
    """
    record = _describe(stored)
    if stored.source is not None:
        record["source"] = json.loads(json.dumps(referred(stored.source, Path(os.path.abspath(folder)))))
        for about, f in zip(record["scene"]["fields"], stored.scene.fields):
            about["sha256"] = digest(f.volume)
    claim(folder, overwrite)
    with disk.sentences(f"{folder} could not be written; the disk may be full", ELSEWHERE):
        place = Path(os.path.abspath(folder))
        disk.make_parents(place)
        with disk.beside(place) as work:
            fresh = work / "new"
            fresh.mkdir()  # with the umask's mode; `work` is closed to others
            _write_exr(fresh / EXR, stored)
            exr.check_whole(fresh / EXR, _plan(record))
            record["exr"] = _digest(fresh / EXR)
            record["checksum"] = _checksum(record, fresh / EXR)
            (fresh / RUN).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
            if picture is not None:
                (fresh / PREVIEW).write_bytes(picture)
            claim(folder, overwrite)
            disk.put(fresh, place, lambda fresh, place: _move(fresh, place, work / "old", overwrite))


def amend(folder: str | os.PathLike[str], changes: Record) -> None:
    """Change entries of a finished run's recipe; its arrays stay as they are.

    Raises
    ------
    BadInput
        If the record cannot be read, or written anew.
    """
    place = Path(os.path.abspath(folder))
    with disk.sentences(f"{folder} could not be amended", AGAIN):
        record = _read_record(place / RUN)
        record["recipe"].update(json.loads(json.dumps(changes, allow_nan=False)))
        record["checksum"] = _checksum(record, place / EXR)
        with disk.beside(place) as work:
            (work / "new.json").write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
            disk.put(work / "new.json", place / RUN)


def _move(fresh: Path, place: Path, old: Path, overwrite: bool) -> None:
    """Rename `fresh` to `place`; an older run there goes to `old`, and back if that fails.

    A kill between the two renames leaves nothing at `place` and both runs whole in the hidden folder beside it, from
    which `disk.sweep` puts the older one back: not worth an atomic exchange that only Linux has.
    """
    try:
        with suppress(OSError):  # only an empty folder goes
            place.rmdir()
        if overwrite and place.exists():
            place.rename(old)
            _refuse_foreign(old, place)  # what came in since we looked
        fresh.rename(place)
    except BaseException as reason:
        with suppress(OSError):
            old.rename(place)
        if isinstance(reason, OSError) and reason.errno in (errno.EEXIST, errno.ENOTEMPTY) and place.exists():
            raise BadInput(f"{place} was taken by another run meanwhile; {ELSEWHERE}") from reason
        raise


def read(folder: str | os.PathLike[str]) -> Stored:
    """Read a finished run, trusting nothing.

    Raises
    ------
    BadInput
        If what the folder holds is not a whole and unchanged run of the format known here.
    """
    place = Path(folder)
    if not place.exists():
        disk.sweep(Path(os.path.abspath(place)))  # an older run that a killed writer had moved aside
    for name in (EXR, RUN):
        if not (place / name).is_file():
            raise BadInput(f"{place / name} is missing; {AGAIN}")
    with disk.sentences(f"{place / RUN} is not the record of a run", AGAIN):
        record = _read_record(place / RUN)
        plan = _plan(record)
    with disk.sentences(f"{place / EXR} cannot be used", AGAIN):
        known = record["format"] < 3 or record["exr"] == _digest(place / EXR)
        if not known or record["checksum"] != _checksum(record, place / EXR):
            raise BadInput(f"it, or {RUN} beside it, was damaged or changed since it was written")
        parts = exr.read(place / EXR, plan)
    with disk.sentences(f"{place / RUN} is not the record of a run", AGAIN):
        fields = [about.get("sha256") for about in record["scene"]["fields"]]
        volumes = fields_again(record["source"], Path(os.path.abspath(place)), fields) if "source" in record else None
        return _rebuild(record, plan, parts, volumes)


def describe(folder: str | os.PathLike[str]) -> Record:
    """What ``run.json`` says, its pixels unread: of every field also extremes, histogram and share of lit nodes.

    Raises
    ------
    BadInput
        If the folder holds no run, or its record was damaged. Damage to the pixels is not noticed.
    """
    place = Path(folder)
    if not (place / EXR).is_file() or not (place / RUN).is_file():
        return _describe(read(folder))  # says what is missing
    with disk.sentences(f"{place / RUN} is not the record of a run", AGAIN):
        record = _read_record(place / RUN)
        if record["format"] < 3:
            return _describe(read(folder))
        if record["checksum"] != _checksum(record, place / EXR):
            raise BadInput("it was damaged or changed since it was written")
    return record


def _describe(stored: Stored) -> Record:
    """All but the arrays, as JSON reads it back (it keeps floats exactly, makes tuples lists and keys text)."""

    def lattice(of: Lattice) -> Record:
        return {"shape": of.shape} | {name: getattr(of, name).tolist() for name in PLACE}

    fields = [
        {"name": f.name, "range": f.range.tolist(), "inside": f.inside, "falling": f.falling}
        | {"slope": f.volume.slope, "intercept": f.volume.intercept, "unit": f.volume.unit}
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
    """Share of the nodes that have light of their own; of the coarsest of several densities."""
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


def _digest(file: Path) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _checksum(record: Record, exr: Path) -> str:
    """Of the record, which holds the digest of the EXR file; before format 3, of both files together."""
    digest = hashlib.sha256()
    if record["format"] < 3:
        with exr.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256")
    rest = {key: value for key, value in record.items() if key != "checksum"}
    digest.update(json.dumps(rest, sort_keys=True, allow_nan=False).encode())
    return digest.hexdigest()


def _read_record(path: Path) -> Record:
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
    return Volume(values, origin, spacing, direction, slope, intercept, about.get("unit"))


def _rebuild(record: Record, plan: Plan, parts: exr.Parts, volumes: list[Volume] | None) -> Stored:
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


MOST_ROWS = 64


def _rows(record: Record, field: str) -> list[str]:
    """Names of the parts that hold a field's grid at places of the sweep, if its level is held."""
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


def _plan(record: Record) -> Plan:
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


def _write_exr(path: Path, stored: Stored) -> None:
    def split(of: WallTexture) -> dict[str, Any]:
        return {name: of.light[..., c] for c, name in enumerate(of.channels.names)}

    def images(arrays: dict[str, Any]) -> tuple[exr.Planned, dict[str, exr.Rows]]:
        shape = next(iter(arrays.values())).shape
        return exr.Planned(shape, tuple(arrays)), {name: exr.Turned(array) for name, array in arrays.items()}

    parts: dict[str, tuple[exr.Planned, dict[str, exr.Rows]]] = {}

    for f, grid in zip(stored.scene.fields, stored.grids):
        parts |= grid_parts.images(f.name, grid)
        parts |= {f"rows/{k}/{f.name}": grid_parts.lattice(row) for k, row in enumerate(grid.rows)}
        if stored.source is None:
            parts[f"field/{f.name}"] = exr.of_field(f.volume.stored)
    for quad, wall in zip(stored.scene.quads, stored.walls):
        turned = split(wall) | {"support": wall.support}
        parts[f"wall/{quad.name}"] = images({channel: array.swapaxes(0, 2) for channel, array in turned.items()})
    exr.write(path, parts)


def is_run(folder: str | os.PathLike[str]) -> bool:
    """Whether a folder looks like a finished run, rather than one of DICOM slices."""
    return (Path(folder) / RUN).is_file() or (Path(folder) / EXR).is_file()
