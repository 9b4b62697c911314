"""VTK image data (``.vti``), read by VTK: an optional package, imported only here."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.io.readers.limits import CHUNK, DEFLATE, check_axes, check_size
from illumgrid.io.readers.source import AGAIN, Source, opened
from illumgrid.io.readers.stored import Stored, Wanted

NEEDED = "is VTK image data, which only VTK reads; expected the package vtk beside illumgrid: pip install vtk"


def read(source: Source, wanted: Wanted) -> Stored:
    """Read the scalar field of an image data file."""
    if not source.packed:
        return _read(source.file, source.size * DEFLATE)
    with TemporaryDirectory(prefix="illumgrid-") as folder, opened(source) as packed:
        inner = Path(folder) / source.name
        inner.write_bytes(packed.read(source.most))
        return _read(inner, source.size * DEFLATE)


def _read(file: Path, most: int) -> Stored:
    """Read a file whose data, if packed, unpack to at most `most` bytes."""
    try:
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkIOXML import vtkXMLImageDataReader
    except ImportError as problem:
        raise BadInput(NEEDED) from problem
    size = file.stat().st_size
    with open(file, "rb") as stream:
        head = stream.read(min(size, CHUNK))
        stream.seek(max(0, size - 256))
        if b"</VTKFile>" not in stream.read():
            raise BadInput(f"does not end like a .vti file; {AGAIN}")
    with _quiet():
        reader = vtkXMLImageDataReader()
        reader.SetFileName(str(file))
        if not reader.CanReadFile(str(file)):
            raise BadInput("does not begin like a .vti file; expected VTK image data; save the volume as that")
        reader.UpdateInformation()
        extent, arrays, active = _promised(reader)
        shape = tuple(extent[2 * axis + 1] - extent[2 * axis] + 1 for axis in range(3))
        check_axes(shape)
        name = _the_field(arrays, active)
        voxels, width = math.prod(shape), arrays[name][1]
        packed = b"compressor" in head.partition(b"<VTKFile")[2].partition(b">")[0]
        # As text a number takes at least two bytes, whatever its width.
        check_size(voxels * (width if packed else min(width, 2)), most if packed else size, voxels * (width + 4))
        selection = reader.GetPointDataArraySelection()
        selection.DisableAllArrays()
        selection.EnableArray(name)
        reader.Update()
        image = reader.GetOutput()
        values = image.GetPointData().GetArray(name)
        if reader.GetErrorCode() or image.GetDimensions() != shape or values is None:
            raise BadInput(f"its array {name!r} cannot be read; {AGAIN}")
        matrix = image.GetDirectionMatrix()
        direction = np.array([[matrix.GetElement(row, axis) for axis in range(3)] for row in range(3)])
        spacing = np.array(image.GetSpacing())
        origin = np.array(image.GetOrigin()) + direction @ (spacing * np.array(image.GetExtent()[::2]))
        return Stored(vtk_to_numpy(values).reshape(shape, order="F"), origin, direction * spacing)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep VTK's messages off stderr."""
    from vtkmodules.vtkCommonCore import vtkObject

    shown = vtkObject.GetGlobalWarningDisplay()
    vtkObject.SetGlobalWarningDisplay(0)
    try:
        yield
    finally:
        vtkObject.SetGlobalWarningDisplay(shown)


def _promised(reader: Any) -> tuple[tuple[int, ...], dict[str, tuple[int, int]], str | None]:
    """What the header promises: extent, components and bytes of a number of each point array, the active scalars."""
    from vtkmodules.vtkCommonCore import vtkDataArray
    from vtkmodules.vtkCommonDataModel import vtkDataObject
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline as Pipeline

    about = reader.GetOutputInformation(0)
    if not about.Has(Pipeline.WHOLE_EXTENT()):
        raise BadInput(f"its header cannot be read; {AGAIN}")
    vector = about.Get(vtkDataObject.POINT_DATA_VECTOR())
    entries = [vector.GetInformationObject(k) for k in range(vector.GetNumberOfInformationObjects())] if vector else []
    arrays, active = {}, None
    for entry in entries:
        name, kind = entry.Get(vtkDataObject.FIELD_NAME()), entry.Get(vtkDataObject.FIELD_ARRAY_TYPE())
        made = vtkDataArray.CreateDataArray(kind)
        if name is not None and made is not None:  # text is no data array
            arrays[name] = entry.Get(vtkDataObject.FIELD_NUMBER_OF_COMPONENTS()), made.GetDataTypeSize()
            if entry.Get(vtkDataObject.FIELD_ACTIVE_ATTRIBUTE()) & 1:  # bit 0: scalars
                active = name
    return tuple(about.Get(Pipeline.WHOLE_EXTENT())), arrays, active


def _the_field(arrays: dict[str, tuple[int, int]], active: str | None) -> str:
    """Name of the array to read: the active scalars, or the only one with one number a point."""
    scalars = [name for name, (components, _) in arrays.items() if components == 1]
    if active in scalars:
        return str(active)
    if len(scalars) != 1:
        found = ", ".join(f"{name} ({components})" for name, (components, _) in arrays.items()) or "none"
        raise BadInput(
            f"its point arrays, with their components, are: {found[:200]}; expected one array of one component, or one "
            "that is marked as the scalars; save only the right one, as point data"
        )
    return scalars[0]
