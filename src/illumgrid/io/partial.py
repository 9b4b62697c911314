"""An unfinished run: the finished part of its light, in ``DIR.partial`` beside its DIR.

``light.zarr`` is a Zarr v3 group. For each range of paths it has a group ``0-32`` with the arrays ``light`` and
``spread`` (n, C) and ``paths`` (n,): a row for each node or texel, in the order in which they are computed; paths is -1
where nothing is known. The library writes each chunk as a whole; ``paths`` is written last, so that a row counts only
when all of it is there. The attributes identify the run, and record what it had chosen. ``scene`` is a finished run's
folder without light, so that a picture needs nothing else.

A finished run keeps its moments in ``moments.npz``, to which more paths can be added.
"""

import hashlib
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.grid import Channels
from illumgrid.io import disk
from illumgrid.io.identity import MACHINE, Record, differences, take_in
from illumgrid.io.store import MOMENTS
from illumgrid.samplers.direct import NodeQueries
from illumgrid.transport.samples import Queries, Samples
from illumgrid.transport.walk import Answer

FORMAT = 2  # format 1 had nodes that the projection moved in another order
EVERY = 10.0
"""Seconds from one write to the next, and before the first: a shorter run leaves nothing."""
HELD = 1 << 20
"""Largest number of rows that are held until then."""
CHUNK = 4096
"""Rows of a chunk."""
MOMENT_ARRAYS = ("light", "spread", "paths")
SUFFIX, LIGHT, SCENE = ".partial", "light.zarr", "scene"


class Partial:
    """The finished light of a run: keeps it, and returns it to a resumed run; a `illumgrid.transport.walk.Keeper`.

    Parameters
    ----------
    folder : path
        Of the finished run; this one is beside it.
    about : dict
        The `identity` of the run.
    command : str
        The command line, to be shown.
    scene : callable, optional
        Writes the scene to a folder that does not exist yet.
    """

    at_once = False

    def __init__(
        self, folder: Path, about: Record, command: str, scene: Callable[[Path], None] = lambda folder: None
    ) -> None:
        self.place = beside(folder)
        disk.sweep(self.place)  # a short run writes nothing, and would not remove what killed ones left
        self.about, self.command, self.write_scene = about, command, scene
        self.chosen: Record | None = None  # by the run that is resumed: grid, bounces, paths...
        self.moments: list[Answer] = []
        self._before: dict[str, NDArray[Any]] = {}
        self._group: Any = None
        self._lock: int | None = None
        self._new: list[tuple[range, NDArray[Any], Answer]] = []
        self._place: NDArray[Any] = np.zeros(0, np.int64)
        self._last = time.monotonic()
        self._walked: list[range] = []
        self._stored, self._count, self._asked = 0, 0, ""

    # --- what is there -------------------------------------------------------------------------------------------

    def resume(self, finished: Path | None, overwrite: bool, any_machine: bool) -> bool:
        """Read the light of an earlier process, or of a `finished` run; returns whether there is any.

        Raises
        ------
        BadInput
            If it is of another run, or another process is at work on it.
        """
        if not self.place.is_dir():
            return finished is not None and self._resume_finished(finished, any_machine)
        with disk.sentences(f"{self.place} cannot be resumed", "remove it, or choose another folder"):
            group = opened(self.place)
            kept = dict(group.attrs)
        other = self._differences(kept["identity"], any_machine)
        if other and overwrite:
            return False
        if other:
            raise BadInput(
                f"{self.place} holds a part of another run, which differs in {', '.join(other)}; expected the command "
                f"that began it, {kept['command']}, or overwrite=True to start over"
            )
        self._lock = _locked(self.place)
        disk.kept[:] = [f"what {self.place} holds is kept"]
        self._group, self._asked = group, kept["queries"]
        self.chosen = {**kept["chosen"], "walked": [[int(end) for end in name.split("-")] for name in _ranges(group)]}
        return True

    def _resume_finished(self, finished: Path, any_machine: bool) -> bool:
        if not (finished / MOMENTS).is_file():
            return False
        with disk.sentences(f"{finished / MOMENTS} cannot be used", "remove it: all paths are then traced again"):
            with np.load(finished / MOMENTS, allow_pickle=False) as arrays:
                self._before = {name: arrays[name] for name in arrays.files}
            kept = json.loads(str(self._before["about"]))
        if other := self._differences(kept["identity"], any_machine):
            self._before = {}
            raise BadInput(
                f"{finished} holds another run, which differs in {', '.join(other)}; pass overwrite=True to start "
                "over, or choose another folder"
            )
        self._asked = kept["queries"]
        self.chosen = {**kept["chosen"], "walked": [[0, int(self._before["walked"])]]}
        return True

    def _differences(self, kept: Record, any_machine: bool) -> list[str]:
        """The differences between two runs, except for additional paths; fewer paths are another run."""
        free = set(MACHINE) if any_machine else set()
        if None not in (self.about.get("paths"), kept.get("paths")) and self.about["paths"] >= kept["paths"]:
            free.add("paths")
        return [d for d in differences(kept, self.about) if d.partition(" (")[0] not in free]

    # --- what comes in -------------------------------------------------------------------------------------------

    def choose(self, chosen: Record) -> None:
        """Record the choices of the run, for a run that resumes it."""
        self.chosen = dict(json.loads(json.dumps(chosen)))

    def begin(self, targets: Sequence[Queries], order: NDArray[np.int64]) -> None:
        """See `Keeper`."""
        self._count = len(order)
        self._place = np.empty(len(order), np.int32 if len(order) < 1 << 31 else np.int64)
        self._place[order] = np.arange(len(order), dtype=self._place.dtype)
        found = hashlib.sha256()
        for queries in targets:  # the scene, whose digest is stored as well, determines the nodes
            take_in(queries.node if isinstance(queries, NodeQueries) else queries, found.update)
        if self._asked not in ("", found.hexdigest()):
            raise BadInput(f"{self.place} has other points than the sampler chooses now; remove it to start over")
        self._asked, self._last = found.hexdigest(), time.monotonic()

    def known(self, paths: range) -> Answer | None:
        """See `Keeper`."""
        self._walked.append(paths)
        self._stored, name = 0, _name(paths)
        if self._before and name == f"0-{self._before['walked']}":
            light, spread, count = (self._before[key] for key in ("light", "spread", "paths"))
            channels = _channels(json.loads(str(self._before["about"]))["channels"])
            before = Answer(light, spread, count, channels, 0.0)
            self._new.append((paths, self._place, before))
            return before
        if self._group is None or name not in _ranges(self._group):
            return None
        with disk.sentences(f"{self.place} cannot be resumed", "remove it to start over"):
            part = self._group[name]
            light, spread, count = (part[key][:][self._place] for key in ("light", "spread", "paths"))
            self._stored = int((count >= 0).sum())
            self._tell()
            return Answer(light, spread, count, _channels(part.attrs["channels"]), 0.0)

    def keep(self, rows: NDArray[np.int64], answer: Answer) -> None:
        """See `Keeper`."""
        self._new.append((self._walked[-1], self._place[rows], answer))
        if time.monotonic() - self._last >= EVERY or sum(len(new) for _, new, _ in self._new) >= HELD:
            self._write()

    def settle(self) -> None:
        """Write now that the run has started, however short it may be."""
        if self._group is None:
            with disk.sentences(f"{self.place} could not be written", "choose another folder"), disk.held():
                self._create()

    def flush(self) -> None:
        """See `Keeper`."""
        if self._group is not None:
            self._write()

    def end(self, answers: Sequence[Samples]) -> None:
        """See `Keeper`."""
        self.moments = [Answer(a.light, a.spread, a.paths, a.channels, 0.0) for a in answers]  # no copy
        self._before, self._place = {}, np.zeros(0, np.int32)
        self._new.clear()

    def standing(self) -> str:
        """What is kept and where, for a line of progress; empty if nothing is."""
        blocks, of = self._stored // CHUNK, -(-self._count // CHUNK)
        return "" if self._group is None else f"{blocks} of {of} blocks of light are kept in {self.place.name}"

    # --- the disk ------------------------------------------------------------------------------------------------

    def _write(self) -> None:
        if not self._new:
            return
        import zarr

        remedy = "what it holds stays valid, and the same command goes on from there"
        with disk.sentences(f"{self.place} could not be written; the disk may be full", remedy):
            if self._group is None:
                self._create()
            # A chunk of zeros is a file, too: it is brought to the disk like the others.
            with disk.held(), zarr.config.set({"array.write_empty_chunks": True}):
                for paths in dict.fromkeys(p for p, _, _ in self._new):
                    some = [(rows, answer) for p, rows, answer in self._new if p == paths]
                    self._stored = self._add(paths, some) + (self._stored if paths == self._walked[-1] else 0)
                self._new.clear()
                self._last = time.monotonic()
        self._tell()

    def _tell(self) -> None:
        share = f"{self._stored / max(self._count, 1):.0%} of the light is kept in {self.place}"
        disk.kept[:] = [f"{share}; the same command goes on from there"]

    def _add(self, paths: range, some: list[tuple[NDArray[np.int64], Answer]]) -> int:
        """Add answers to some rows of a range of paths; returns their number."""
        part, rows = self._part(paths, some[0][1].channels), np.concatenate([r for r, _ in some])
        order = np.argsort(rows, kind="stable")
        rows = rows[order]
        cuts = [0, *(np.flatnonzero(np.diff(rows // CHUNK)) + 1).tolist(), len(rows)]
        for key, column in (("light", 0), ("spread", 1), ("paths", 2)):  # paths last: they make the other arrays valid
            values = np.concatenate([answer[column] for _, answer in some])[order]
            for a, b in pairwise(cuts):  # each chunk once: its rows may come in any order
                first = int(rows[a]) // CHUNK * CHUNK
                chunk = part[key][first : first + CHUNK]
                chunk[rows[a:b] - first] = values[a:b]
                part[key][first : first + CHUNK] = chunk
            self._sync(part, key, rows)
        return len(rows)

    def _create(self) -> None:
        import zarr

        place = Path(os.path.abspath(self.place))
        disk.make_parents(place)
        with disk.beside(place) as work:
            self.write_scene(work / "new" / SCENE)
            group = zarr.create_group(str(work / "new" / LIGHT), zarr_format=3)
            group.attrs.update(
                {
                    "format": FORMAT, "identity": self.about, "command": self.command, "chosen": self.chosen,
                    "queries": self._asked, "rows": self._count,
                }
            )  # fmt: skip
            if place.is_dir():  # of another run that was to be overwritten
                place.rename(work / "old.part")
            disk.put(work / "new", place, os.rename)
        self._lock = _locked(place)
        self._group = opened(place)

    def _part(self, paths: range, channels: Channels) -> Any:
        from zarr.codecs import Crc32cCodec, ZstdCodec

        name, known = _name(paths), {"names": channels.names, "mix": channels.mix}
        if name in _ranges(self._group):
            if _channels(self._group[name].attrs["channels"]) != channels:
                raise BadInput("the light has other channels than before")
            return self._group[name]
        part = self._group.create_group(name, attributes={"channels": known})
        codecs = {"compressors": [ZstdCodec(level=1), Crc32cCodec()]}
        for key in ("light", "spread"):
            shape = self._count, len(channels)
            part.create_array(key, shape=shape, chunks=(CHUNK, shape[1]), dtype="float32", **codecs)
        part.create_array("paths", shape=(self._count,), chunks=(CHUNK,), dtype="int32", fill_value=-1, **codecs)
        return part

    def _sync(self, part: Any, key: str, rows: NDArray[np.int64]) -> None:
        """Bring the chunks of these rows to the disk: the library renames them, and leaves the rest to the system."""
        for chunk in np.unique(rows // CHUNK).tolist():
            file = Path(self.place, LIGHT, part.path, key, "c", str(chunk), *(() if key == "paths" else ("0",)))
            disk.sync(file)

    def leave(self, finished: Path) -> None:
        """Give the finished run its moments, and remove the partial run."""
        if self.moments:
            walked, channels = self._walked[-1].stop, self.moments[0].channels
            named = {"names": channels.names, "mix": channels.mix}
            about = {"identity": self.about, "chosen": self.chosen, "queries": self._asked, "channels": named}
            texts = {"about": np.array(json.dumps(about)), "walked": np.array(walked)}
            with disk.fresh_file(finished / MOMENTS) as file, ZipFile(file, "w", ZIP_DEFLATED) as packed:
                for key in (*texts, *MOMENT_ARRAYS):  # like `numpy.savez_compressed`, which needs all of them at once
                    with packed.open(f"{key}.npy", "w", force_zip64=True) as member:
                        parts = [texts[key]] if key in texts else [getattr(a, key) for a in self.moments]
                        np.lib.format.write_array(member, parts[0] if len(parts) == 1 else np.concatenate(parts))
            self.moments.clear()
        self.remove()

    def remove(self) -> None:
        """Remove the partial run completely or not at all."""
        place = Path(os.path.abspath(self.place))
        if place.is_dir():  # ours, or that of a run that was to be overwritten
            with disk.beside(place) as work:
                place.rename(work / "new")
        self.close()
        self._group = None
        disk.kept.clear()

    def close(self) -> None:
        """Release the lock, so that other processes can resume it."""
        if self._lock is not None:
            os.close(self._lock)
        self._lock = None


def beside(folder: Path) -> Path:
    """The path of the partial run of a folder."""
    return folder.with_name(folder.name + SUFFIX)


def opened(place: Path, mode: Literal["r", "r+"] = "r+") -> Any:
    """The group of a partial run.

    Raises
    ------
    BadInput
        If it is none.
    """
    import zarr

    group = zarr.open_group(str(place / LIGHT), mode=mode, zarr_format=3)
    if group.attrs.get("format") != FORMAT:
        raise BadInput(f"its format is {group.attrs.get('format')!r}; expected {FORMAT}")
    return group


@dataclass(frozen=True)
class Kept:
    """The content of a partial run: attributes, and for each range of paths arrays and ``channels``, in work order."""

    attributes: Record
    ranges: dict[str, Record]


def is_partial(place: Path) -> bool:
    """Whether a folder looks like a partial run."""
    return (place / LIGHT / "zarr.json").is_file()


def read(place: Path) -> Kept:
    """Read a partial run, which may still be growing."""
    group = opened(place, mode="r")
    found = {}
    for name in _ranges(group):
        part = group[name]
        paths = part["paths"][:]  # first: the rows that it counts are complete
        arrays = {"light": part["light"][:], "spread": part["spread"][:], "paths": paths}
        found[name] = {**arrays, "channels": _channels(part.attrs["channels"])}
    return Kept(dict(group.attrs), found)


def _name(paths: range) -> str:
    return f"{paths.start}-{paths.stop}"


def _ranges(group: Any) -> list[str]:
    """Names of the ranges of paths in a group, in order."""
    return sorted((name for name, _ in group.groups() if "-" in name), key=lambda name: int(name.split("-")[0]))


def _channels(about: Record) -> Channels:
    return Channels(tuple(about["names"]), tuple((float(r), float(g), float(b)) for r, g, b in about["mix"]))


def _locked(place: Path) -> int | None:
    try:
        return disk.lock(place)
    except BlockingIOError:
        raise BadInput(f"another process is at work on {place}; wait for it, or choose another folder") from None
