"""The memory that a command is going to take, refused before any of it is taken.

Bytes are peaks measured by `benchmarks/memory.py`, above what is held when the question is asked.
"""

from collections.abc import Sequence
from math import prod
from typing import TYPE_CHECKING

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.bricks import LARGE
from illumgrid.field.lattice import GridSpec
from illumgrid.grid import channels_of
from illumgrid.io.readers.limits import free_memory, gigabytes

if TYPE_CHECKING:
    from illumgrid.field.scene import Field, Levels, Scene

TO_DESCRIBE = 21
"""Bytes a voxel for the histogram, plateaus and warnings of a volume that is read; of a large one, see `of_field`."""
TO_LIGHT = 44
"""Bytes a voxel for diagnosis, preparation and writing of a field; of a large one, see `of_field`."""
_PARTS, _BRICKS, _WIDE_BRICKS = 1 << 24, 3.0, 0.5
"""Voxels of a field of which all are looked at together; bytes for each further one, those of its bricks and a little:
of bricks as wide again where the field is `LARGE`. The field itself is there, or paged."""
TO_DEPOSIT = 18
"""Bytes a voxel for the density of points."""
TO_EXTRACT = 16
"""Bytes a voxel for the extraction of an isosurface."""
_CROSSING = 270
"""Bytes, in a file of an isosurface, for each edge between voxels that it crosses."""
_QUERY, _CHANNEL = 300, 20
"""Bytes a query, and for each channel of its answer."""
_SOME = 50_000
"""Voxels that are looked at to learn what share of the nodes is asked about."""


def check(what: str, need: float, todo: str) -> None:
    """Refuse what needs more bytes of memory than are free."""
    if need > (free := free_memory()):
        raise BadInput(f"{what} needs {gigabytes(int(need))} of memory, {gigabytes(free)} are free; {todo}")


def of_field(voxels: int, each: int) -> float:
    """Bytes for a field that takes `each` a voxel: a large one is looked at in parts."""
    return each * min(voxels, _PARTS) + (_WIDE_BRICKS if voxels >= LARGE else _BRICKS) * max(0, voxels - _PARTS)


def check_run(
    scene: "Scene", specs: Sequence[GridSpec], levels: "Levels", density: float = 1.0, lit: float = 1.0
) -> None:
    """Refuse a run whose nodes, walls and fields do not fit, and say which grid would.

    The interpolator stores `density` times the nodes along each axis; at most `lit` times as many are lit.
    """
    channels = len(channels_of(scene))
    each = _QUERY + _CHANNEL * channels
    fixed = sum(of_field(prod(field.volume.shape), TO_LIGHT) for field in scene.fields)
    fixed += each * len(levels.table) * sum(prod(quad.texels) for quad in scene.quads)
    nodes = 0.0
    for spec, field in zip(specs, scene.fields):
        share = _share(field, spec)
        # Light, error and support; errors of each light, or light a second time while holes are filled from the nodes
        # nearest to them. A denser grid has no errors of single lights.
        stored = 4 * channels + 8 + (4 * channels if share < 1 or density == 1 else 0) + (12 if share < 1 else 0)
        nodes += prod(spec.shape) * (stored * density**3 + each * lit * share)
    longest, room = max(max(spec.shape) for spec in specs), 0.8 * free_memory() - fixed
    fits = int(longest * (max(room, 0.0) / nodes) ** (1 / 3))
    todo = "cut or downsample the volume"
    if fits >= 8:
        todo = f"grid={fits} would need {gigabytes(int(fixed + nodes * (fits / longest) ** 3))}"
    check("the run", fixed + nodes, todo)


def check_surface(field: "Field", isovalue: float, todo: str) -> None:
    """Refuse the extraction of an isosurface whose triangles do not fit; counts what it crosses."""
    values, level = field.volume.stored, float(field.volume.to_stored(isovalue))
    crossed = 0
    for k in range(0, len(values), 16):  # some slices at a time: what is compared takes memory, too
        above = values[k : k + 17] >= level
        for axis, part in enumerate((above, above[:16], above[:16])):
            crossed += int(np.count_nonzero(np.diff(part, axis=axis)))
    check("the surface", TO_EXTRACT * values.size + _CROSSING * crossed, todo)


def _share(field: "Field", spec: GridSpec) -> float:
    """Share of the nodes that lie within a cell of isosurfaces of the range, about: they are asked about."""
    values = field.volume.stored
    last = np.array(values.shape) - 1
    cell = np.ceil(last / np.maximum(np.array(spec.shape) - 1, 1)).astype(np.int64)
    some = np.arange(0, values.size, max(1, values.size // _SOME))
    index = np.stack(np.unravel_index(some, values.shape), axis=1)
    low, high = sorted(field.stored_range)
    least, most = (np.full(len(some), end, float) for end in (np.inf, -np.inf))
    for way in np.ndindex(3, 3, 3):
        near = values[tuple(np.clip(index + (np.array(way) - 1) * cell, 0, last).T)]
        least, most = np.fmin(least, near), np.fmax(most, near)
    return float(((most >= low) & (least <= high)).mean())
