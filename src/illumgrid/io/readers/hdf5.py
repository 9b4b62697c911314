"""Datasets of HDF5, which NetCDF 4 is as well: read some chunks at a time. An image that ITK wrote goes to ITK."""

from importlib.util import find_spec

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.io.readers.arrays import three_axes
from illumgrid.io.readers.chunked import axes_of, by_name, read_box
from illumgrid.io.readers.isolated import Isolated, Part, isolated
from illumgrid.io.readers.limits import check_axes
from illumgrid.io.readers.source import Source, seekable
from illumgrid.io.readers.stored import Note, Stored, Wanted, pick

if find_spec("h5py") is None:
    raise ModuleNotFoundError("No module named 'h5py'", name="h5py")


def read(source: Source, wanted: Wanted) -> Stored:
    """Read the only dataset of three or more axes, or that of `--array`."""
    packed = b""
    if source.packed:
        with seekable(source) as stream:
            packed = stream.read()
    with isolated("hdf5", source.file, packed) as file:
        found = file.ask()
        if found["itk"]:
            return _by_itk(source, wanted)
        if not found["names"]:
            raise BadInput("holds no dataset of numbers with three axes; expected one")
        return _read(file, found["names"][pick(wanted.array, "array", found["names"])], wanted)


def _by_itk(source: Source, wanted: Wanted) -> Stored:
    try:
        from illumgrid.io.readers import itk
    except ImportError:
        raise BadInput(
            "an image that ITK wrote, which SimpleITK reads; expected it to be installed: pip install illumgrid[itk]"
        ) from None
    for option in ("channel", "time", "array"):
        if getattr(wanted, option) is not None:
            raise BadInput(f"--{option} came with an image that ITK wrote, which holds one; leave --{option} out")
    return itk.read(source, wanted)


def _read(file: Isolated, name: str, wanted: Wanted) -> Stored:
    about = file.ask(name=name)
    if about["elsewhere"]:
        raise BadInput("its numbers lie in other files; expected them in this one; copy it with h5repack")
    data, names = Part(file, name, about["shape"], about["dtype"], about["chunks"]), about["names"]
    order, chosen = axes_of(names), {}
    if order is not None:
        chosen = by_name(names, data.shape, wanted)
    else:
        order, spans = three_axes(data.shape, wanted)
        chosen = {axis: span.first for axis, span in enumerate(spans) if axis not in order}
    space = tuple(int(data.shape[axis]) for axis in order)
    check_axes(space)
    sizes, unit = np.array(about["sizes"]), None
    steps, notes = np.ones(3), tuple[Note, ...]()
    if len(sizes) == len(data.shape):
        steps, unit = sizes[order], "µm"
    elif len(sizes) == 3:
        steps, unit = sizes[np.argsort(np.argsort(order))], "µm"
    else:
        notes = (("spacing", "it does not state the distance between voxels: 1 is assumed; give --spacing"),)
    values = read_box(data, data.chunks, order, chosen, wanted.spans(space))
    return Stored(values, np.zeros(3), np.diag(steps), unit=unit, notes=notes, whole=space)
