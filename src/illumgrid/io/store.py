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
from pathlib import Path
from typing import Any

from illumgrid.errors import BadInput
from illumgrid.grid import WallTexture
from illumgrid.io import disk, exr
from illumgrid.io import grids as grid_parts
from illumgrid.io.disk import ELSEWHERE
from illumgrid.io.elsewhere import digest, fields_again, referred
from illumgrid.io.record import Record, Stored, plan_of, read_record, rebuild, record_of

EXR, RUN, PREVIEW, MOMENTS = "illumination.exr", "run.json", "preview.png", "moments.npz"
AGAIN = "give a folder that 'illumgrid run' wrote, or run it again"


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
    """Raise unless `place`, which the user calls `folder`, is empty or contains only a finished run."""
    plain = {p.name: p.is_file() and not p.is_symlink() for p in place.iterdir()}
    foreign = sorted(name for name in plain if not plain[name] or name not in (EXR, RUN, PREVIEW, MOMENTS))
    if plain and not {EXR, RUN} <= plain.keys():
        foreign = foreign or sorted(plain)  # not a run, but a file that happens to have such a name
    if foreign:
        raise BadInput(f"{folder} holds {foreign[0]!r}, which is not of a finished run; {ELSEWHERE}")


def write(folder: str | os.PathLike[str], stored: Stored, picture: bytes | None, overwrite: bool) -> None:
    """Put a finished run, and its `picture` as PNG, at `folder`, whole or not at all; parents are made as needed.

    Raises
    ------
    BadInput
        As `claim` does, also if another run took the folder meanwhile; and if the disk is full.
    """
    record = record_of(stored)
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
            exr.check_whole(fresh / EXR, plan_of(record))
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
        If the record cannot be read, or rewritten.
    """
    place = Path(os.path.abspath(folder))
    with disk.sentences(f"{folder} could not be amended", AGAIN):
        record = read_record(place / RUN)
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
            _refuse_foreign(old, place)  # what appeared there since the check
        fresh.rename(place)
    except BaseException as reason:
        with suppress(OSError):
            old.rename(place)
        if isinstance(reason, OSError) and reason.errno in (errno.EEXIST, errno.ENOTEMPTY) and place.exists():
            raise BadInput(f"{place} was taken by another run meanwhile; {ELSEWHERE}") from reason
        raise


def read(folder: str | os.PathLike[str]) -> Stored:
    """Read a finished run; nothing in it is trusted.

    Raises
    ------
    BadInput
        If what the folder holds is not a whole and unchanged run of the format known here.
    """
    place = Path(folder)
    if not place.exists():
        disk.sweep(Path(os.path.abspath(place)))  # an older run that a killed writer had moved aside
    if place.is_file():
        raise BadInput(f"{place} is a file; expected the folder of a run; light it by 'illumgrid run {place}' first")
    for name in (EXR, RUN):
        if not (place / name).is_file():
            raise BadInput(f"{place / name} is missing; {AGAIN}")
    with disk.sentences(f"{place / RUN} is not the record of a run", AGAIN):
        record = read_record(place / RUN)
        plan = plan_of(record)
    with disk.sentences(f"{place / EXR} cannot be used", AGAIN):
        known = record["format"] < 3 or record["exr"] == _digest(place / EXR)
        if not known or record["checksum"] != _checksum(record, place / EXR):
            raise BadInput(f"it, or {RUN} beside it, was damaged or changed since it was written")
        parts = exr.read(place / EXR, plan)
    with disk.sentences(f"{place / RUN} is not the record of a run", AGAIN):
        fields = [about.get("sha256") for about in record["scene"]["fields"]]
        volumes = fields_again(record["source"], Path(os.path.abspath(place)), fields) if "source" in record else None
        return rebuild(record, plan, parts, volumes)


def describe(folder: str | os.PathLike[str]) -> Record:
    """The content of ``run.json`` without the pixels: for every field also extremes, histogram and share of lit nodes.

    Raises
    ------
    BadInput
        If the folder holds no run, or its record was damaged. Damage to the pixels is not noticed.
    """
    place = Path(folder)
    if not (place / EXR).is_file() or not (place / RUN).is_file():
        return record_of(read(folder))  # says what is missing
    with disk.sentences(f"{place / RUN} is not the record of a run", AGAIN):
        record = read_record(place / RUN)
        if record["format"] < 3:
            return record_of(read(folder))
        if record["checksum"] != _checksum(record, place / EXR):
            raise BadInput("it was damaged or changed since it was written")
    return record


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
    """Whether a folder looks like a finished run, and not like one of DICOM slices."""
    return (Path(folder) / RUN).is_file() or (Path(folder) / EXR).is_file()
