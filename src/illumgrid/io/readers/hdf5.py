"""Datasets of HDF5, which NetCDF 4 is as well: read some chunks at a time. An image that ITK wrote goes to ITK."""

from typing import Any

import h5py
import numpy as np

from illumgrid.errors import BadInput
from illumgrid.io.readers.arrays import three_axes
from illumgrid.io.readers.chunked import axes_of, by_name, read_box
from illumgrid.io.readers.limits import check_axes
from illumgrid.io.readers.source import Source, seekable
from illumgrid.io.readers.stored import Note, Stored, Wanted, pick

_MOST = 10_000
"""Datasets that are looked at."""


def read(source: Source, wanted: Wanted) -> Stored:
    """Read the only dataset of three or more axes, or that of `--array`."""
    with seekable(source) as stream, h5py.File(stream if source.packed else source.file, "r") as file:
        if "ITKImage" in file:
            return _by_itk(source, wanted)
        found = _datasets(file)
        if not found:
            raise BadInput("holds no dataset of numbers with three axes; expected one")
        names = [name for name, _ in found]
        return _read(found[pick(wanted.array, "array", names)][1], wanted)


def _by_itk(source: Source, wanted: Wanted) -> Stored:
    try:
        from illumgrid.io.readers import itk
    except ImportError:
        raise BadInput(
            "an image that ITK wrote, which SimpleITK reads; expected it beside illumgrid: pip install illumgrid[itk]"
        ) from None
    for option in ("channel", "time", "array"):
        if getattr(wanted, option) is not None:
            raise BadInput(f"--{option} came with an image that ITK wrote, which holds one; leave --{option} out")
    return itk.read(source, wanted)


def _datasets(file: Any) -> list[tuple[str, Any]]:
    """Datasets of three or more axes by name; links to other files are not followed."""
    found: list[tuple[str, Any]] = []

    def look(name: str, node: Any) -> bool | None:
        if isinstance(node, h5py.Dataset) and len(node.shape or ()) >= 3 and node.dtype.kind in "biuf":
            found.append((name, node))
        return True if len(found) >= _MOST else None

    file.visititems(look)
    return sorted(found, key=lambda pair: pair[0])


def _read(data: Any, wanted: Wanted) -> Stored:
    if data.is_virtual or data.external:
        raise BadInput("its numbers lie in other files; expected them in this one; copy it with h5repack")
    names = [dim.label.lower() for dim in data.dims]
    order, chosen = axes_of(names), {}
    if order is not None:
        chosen = by_name(names, data.shape, wanted)
    else:
        order, spans = three_axes(data.shape, wanted)
        chosen = {axis: span.first for axis, span in enumerate(spans) if axis not in order}
    space = tuple(int(data.shape[axis]) for axis in order)
    check_axes(space)
    sizes, unit = np.ravel(data.attrs.get("element_size_um", ())), None  # of ilastik and Fiji, in the order of the axes
    steps, notes = np.ones(3), tuple[Note, ...]()
    if sizes.dtype.kind in "iuf" and len(sizes) == len(data.shape):
        steps, unit = sizes[order].astype(float), "µm"
    elif sizes.dtype.kind in "iuf" and len(sizes) == 3:
        steps, unit = sizes[np.argsort(np.argsort(order))].astype(float), "µm"
    else:
        notes = (("spacing", "it does not say the distance between voxels: 1 is taken; give --spacing"),)
    values = read_box(data, data.chunks or (1,) * len(data.shape), order, chosen, wanted.spans(space))
    return Stored(values, np.zeros(3), np.diag(steps), unit=unit, notes=notes, whole=space)
