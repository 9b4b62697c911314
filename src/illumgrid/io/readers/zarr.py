"""Zarr of versions 2 and 3, and OME-Zarr: folders of chunks, which are read some at a time.

References
----------
.. [1] https://ngff.openmicroscopy.org/0.5/
"""

import json
import math
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats
from illumgrid.io.readers.arrays import three_axes
from illumgrid.io.readers.chunked import UNITS, axes_of, by_name, read_box
from illumgrid.io.readers.isolated import Part, isolated
from illumgrid.io.readers.limits import check_axes
from illumgrid.io.readers.stored import Note, Stored, Wanted, pick
from illumgrid.io.readers.windows import Span

_MOST = 1000
"""Largest number of members of a group that are examined."""
_DEEP = 3
"""Depth of groups within groups that are examined."""
_SAFE = {"bytes", "zstd", "gzip", "zlib", "crc32c", "transpose", "sharding_indexed"}
"""Codecs that fuzzing did not crash; arrays with others, such as blosc, are decoded in a process of their own."""


def read_folder(folder: Path, wanted: Wanted) -> Stored:
    """Read one array of a folder: of an image in several resolutions one, by default the finest."""
    import zarr

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about metadata that are no part of the specification
        node = zarr.open(str(folder), mode="r")
        if isinstance(node, zarr.Group) and _image(node) is None:
            node, wanted = _chosen(node, wanted), replace(wanted, array=None)
        if isinstance(node, zarr.Group):
            return _read_image(node, wanted)
        return _read_array(node, wanted)


def _image(group: Any) -> Mapping[str, Any] | None:
    """The image in several resolutions that a group describes."""
    about = group.attrs.asdict()
    several = about.get("ome", about).get("multiscales") if isinstance(about.get("ome", about), dict) else None
    return several[0] if isinstance(several, list) and several and isinstance(several[0], dict) else None


def _chosen(group: Any, wanted: Wanted) -> Any:
    """The image or array of a group that the user wants."""
    found = dict(_within(group, "", _DEEP))
    if not found:
        raise BadInput("holds no array of three axes; expected one; give the folder of the array itself")
    names = list(found)
    return found[names[pick(wanted.array, "array", names)]]


def _within(group: Any, before: str, deep: int) -> Iterator[tuple[str, Any]]:
    """Arrays of three or more axes, and images, by name."""
    import zarr

    for name, node in sorted(islice(group.members(), _MOST)):
        if isinstance(node, zarr.Array):
            if len(node.shape) >= 3 and node.dtype.kind in "biuf":
                yield f"{before}{name}", node
        elif _image(node) is not None:
            yield f"{before}{name}", node
        elif deep > 1:
            yield from _within(node, f"{before}{name}/", deep - 1)


def _read_image(group: Any, wanted: Wanted) -> Stored:
    about: Any = _image(group)
    levels = [str(level["path"]) for level in about["datasets"]]
    axes = [axis if isinstance(axis, dict) else {"name": axis} for axis in about.get("axes") or "tczyx"]
    names = [str(axis.get("name")) for axis in axes]
    order = axes_of(names)
    if order is None:
        raise BadInput(f"its axes are {', '.join(names)}; expected x, y and z among them")
    for level in levels:
        if len(names) != len(group[level].shape):
            raise BadInput(
                f"its axes are {', '.join(names)}, its array has {len(group[level].shape)}; correct its metadata"
            )
    number = _level(group, levels, order, wanted)
    array = group[levels[number]]
    steps, origin = np.ones(len(names)), np.zeros(len(names))
    for change in (about["datasets"][number], about):
        steps, origin = _transformed(steps, origin, change.get("coordinateTransformations") or ())
    units = {axes[axis].get("unit") for axis in order}
    unit = UNITS.get(str(units.pop()).lower()) if len(units) == 1 else None
    notes: tuple[Note, ...] = ()
    if len(levels) > 1 and wanted.array is None:
        sizes = [f"{k} {'x'.join(str(group[path].shape[axis]) for axis in order)}" for k, path in enumerate(levels[:8])]
        which = (
            f"{number}, in whose means noise, plateaus and thin parts of 0 are lost," if number else "0, the finest,"
        )
        notes = (("choice", f"holds one image in {len(levels)} resolutions ({', '.join(sizes)}): {which} was "
                  "read; --array N (array=N) reads another"),)  # fmt: skip
    elif not _spaced(about, number):
        notes = (("spacing", "its metadata do not state the distance between voxels: 1 is assumed; give --spacing"),)
    chosen = by_name(names, array.shape, wanted)
    return _box(array, order, chosen, wanted, steps[order], origin[order], unit, notes)


def _level(group: Any, levels: list[str], order: list[int], wanted: Wanted) -> int:
    """Which resolution is read."""
    if wanted.array is not None:
        return pick(wanted.array, "array", levels)
    if wanted.most is None:
        return 0
    sizes = [math.prod(group[level].shape[axis] for axis in order) for level in levels]
    return next((k for k, size in enumerate(sizes) if size <= wanted.most), len(levels) - 1)


def _spaced(about: Mapping[str, Any], number: int) -> bool:
    changes = [*(about["datasets"][number].get("coordinateTransformations") or ()),
               *(about.get("coordinateTransformations") or ())]  # fmt: skip
    return any(change.get("type") == "scale" for change in changes)


def _transformed(steps: Floats, origin: Floats, changes: Any) -> tuple[Floats, Floats]:
    """Step and origin along each axis after one change of coordinates after the other."""
    for change in changes:
        kind = change.get("type")
        if kind == "identity":
            continue
        numbers = np.asarray(change.get(kind), float) if kind in ("scale", "translation") else None
        if numbers is None or numbers.shape != steps.shape or not np.isfinite(numbers).all():
            raise BadInput(
                f"its change of coordinates {str(change)[:80]} came; expected a scale or translation of "
                f"{len(steps)} numbers; correct its metadata"
            )
        steps, origin = (steps * numbers, origin * numbers) if kind == "scale" else (steps, origin + numbers)
    return steps, origin


def _read_array(array: Any, wanted: Wanted) -> Stored:
    if wanted.array is not None:
        raise BadInput("--array came with a single array; leave --array out")
    if len(array.shape) < 3:
        check_axes(array.shape)
    names = getattr(array.metadata, "dimension_names", None) or ()
    order, chosen = axes_of(names), {}
    if order is not None:
        chosen = by_name([str(name).lower() for name in names], array.shape, wanted)
    else:
        order, spans = three_axes(array.shape, wanted)
        chosen = {axis: span.first for axis, span in enumerate(spans) if axis not in order}
    note = ("spacing", "its metadata do not state the distance between voxels: 1 is assumed; give --spacing")
    return _box(array, order, chosen, wanted, np.ones(3), np.zeros(3), None, (note,))


def _safe(array: Any) -> bool:
    """Whether the array's codecs validate what they read."""
    about = array.metadata.to_dict()
    codecs = json.dumps([about.get(key) for key in ("codecs", "compressor", "filters")], default=str)
    return set(re.findall(r'"(?:name|id)": "([^"]*)"', codecs)) <= _SAFE


def _box(
    array: Any, order: list[int], chosen: Mapping[int, int], wanted: Wanted, steps: Floats, origin: Floats,
    unit: str | None, notes: tuple[Note, ...],
) -> Stored:  # fmt: skip
    space = tuple(int(array.shape[axis]) for axis in order)
    check_axes(space)
    spans: list[Span] = wanted.spans(space)
    if _safe(array):
        values = read_box(array, array.chunks, order, chosen, spans)
    else:
        with isolated("zarr", Path(array.store.root)) as opened:
            other = Part(opened, array.path, array.shape, array.dtype, array.chunks)
            values = read_box(other, array.chunks, order, chosen, spans)
    if (there := array.nchunks_initialized) < array.nchunks:
        of = f"{array.nchunks - there} of its {array.nchunks} chunks are not there"
        notes = (*notes, ("file", f"{of}: their voxels are {array.fill_value}, as its metadata say"))
    return Stored(values, origin, np.diag(steps), unit=unit, notes=notes, whole=space)
