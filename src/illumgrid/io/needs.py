"""Estimates of a command's memory, by which it is refused before it takes any.

Bytes are peaks measured by `benchmarks/memory.py`, in addition to what is held at the time of the check.
"""

from collections.abc import Sequence
from math import prod
from typing import TYPE_CHECKING

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.lattice import GridSpec, along_longest
from illumgrid.grid import channels_of
from illumgrid.grid.nested import finer, halvings
from illumgrid.io.readers.limits import free_memory, gigabytes

if TYPE_CHECKING:
    from illumgrid.field.scene import Field, Levels, Scene

TO_DESCRIBE = 21
"""Bytes per voxel for the histogram, plateaus and warnings of a volume; for a large one, see `of_field`."""
TO_LIGHT = 44
"""Bytes per voxel for diagnosis, preparation and writing of a field; for a large one, see `of_field`."""
_WHOLE, _IN_PARTS = 1 << 24, 3e8
"""Voxels of a field of which all are looked at together; bytes for the parts of a larger one (0.25 GB of 512³ and of
1024³). The field itself is there, or paged, and so are its bricks when a run asks."""
TO_DEPOSIT = 18
"""Bytes per voxel for the density of points."""
TO_EXTRACT = 16
"""Bytes per voxel for the extraction of an isosurface."""
_CROSSING = 270
"""Bytes in a file of an isosurface per edge between voxels that it crosses."""
_QUERY, _CHANNEL, _PIECE = 300, 20, 1 << 16
"""Bytes a query, and for each channel of its answer; queries held at a time where they are those of nodes."""
_IN_BLOCKS, _SPARE = 25.0, 1.63
"""Nodes that blocks hold for each lit node of the coarse lattice, at most (4 to 23 on seven volumes), and for each
node of the finest lattice: 9³ for 8³ nodes, and those of the coarser levels."""
_BLOCK, _BLOCK_CHANNEL, _FINEST = 80, 8, 4
"""Bytes for each node of the blocks, and for each of its channels, while they are filled, with the moments of lit nodes
(`aquarius-A2`: 88 with one channel, 101 with three); bytes for each node of the finest lattice, for marks."""
_SOME, _NEAR = 50_000, 1_000
"""Voxels that are looked at to learn what share of the nodes is asked about, and those whose surroundings are looked at
together."""


def check(what: str, need: float, todo: str) -> None:
    """Refuse a command that needs more bytes of memory than are free."""
    if need > (free := free_memory()):
        raise BadInput(f"{what} needs {gigabytes(int(need))} of memory, {gigabytes(free)} are free; {todo}")


def of_field(voxels: int, each: int) -> float:
    """Bytes for a field that takes `each` per voxel; a large one is examined in parts."""
    return each * voxels if voxels <= _WHOLE else _IN_PARTS


def check_run(
    scene: "Scene", specs: Sequence[GridSpec], levels: "Levels", density: float = 1.0, *, at_nodes: bool = False,
    refining: bool = False,
) -> None:  # fmt: skip
    """Refuse a run whose nodes, walls and fields do not fit into memory, and name a grid that would.

    Parameters
    ----------
    density : float
        The interpolator stores so many times the nodes along each axis.
    at_nodes : bool
        Whether queries are those of the nodes, which need not be held.
    refining : bool
        Whether `specs` are coarse lattices, of more nodes where light is rough.
    """
    channels = len(channels_of(scene))
    each = _QUERY + _CHANNEL * channels
    fixed = sum(of_field(prod(field.volume.shape), TO_LIGHT) for field in scene.fields)
    walls = each * len(levels.table) * sum(prod(quad.texels) for quad in scene.quads)
    fixed += walls + each * at_nodes * _PIECE
    nodes = finer_nodes = 0.0
    for spec, field in zip(specs, scene.fields):
        share, moments = _share(field, spec), 8 + 8 * channels if at_nodes else each
        # Light, error and support; errors of each light, or light a second time while holes are filled from the nodes
        # nearest to them. A denser grid has no errors of single lights.
        stored = 4 * channels + 8 + (4 * channels if share < 1 or density == 1 else 0) + (12 if share < 1 else 0)
        nodes += prod(spec.shape) * (stored * density**3 + moments * share)
        finest = prod(finer(spec, halvings(specs)).shape)
        held = min(_IN_BLOCKS * prod(spec.shape) * share, _SPARE * finest)
        finer_nodes += (_BLOCK + _BLOCK_CHANNEL * channels) * held + _FINEST * finest
    longest, room = along_longest(specs), 0.8 * free_memory() - fixed
    fits = int(longest * (max(room, 0.0) / nodes) ** (1 / 3))
    todo = "use fewer isovalues or texels" if walls > fixed / 2 else "cut or downsample the volume"
    if fits >= 8:
        todo = f"grid={fits} would need {gigabytes(int(fixed + nodes * (fits / longest) ** 3))}"
    check("the run", fixed + (finer_nodes if refining else nodes), todo)


def check_surface(field: "Field", isovalue: float, todo: str) -> None:
    """Refuse the extraction of an isosurface whose triangles do not fit into memory; counts the edges it crosses."""
    values, level = field.volume.stored, float(field.volume.to_stored(isovalue))
    crossed = 0
    for k in range(0, len(values), 16):  # some slices at a time: comparisons take memory, too
        above = values[k : k + 17] >= level
        for axis, part in enumerate((above, above[:16], above[:16])):
            crossed += int(np.count_nonzero(np.diff(part, axis=axis)))
    check("the surface", TO_EXTRACT * values.size + _CROSSING * crossed, todo)


def _share(field: "Field", spec: GridSpec) -> float:
    """Approximate share of the nodes that lie within a cell of isosurfaces of the range, and are lit."""
    values = field.volume.stored
    last = np.array(values.shape) - 1
    cell = np.ceil(last / np.maximum(np.array(spec.shape) - 1, 1)).astype(np.int64)
    some = np.arange(0, values.size, max(1, values.size // _SOME))
    (low, high), met = sorted(field.stored_range), 0
    for first in range(0, len(some), _NEAR):  # all directions at a time: a field that is paged is read once
        index = np.stack(np.unravel_index(some[first : first + _NEAR], values.shape), axis=1)
        least, most = (np.full(len(index), end, float) for end in (np.inf, -np.inf))
        for way in np.ndindex(3, 3, 3):
            near = values[tuple(np.clip(index + (np.array(way) - 1) * cell, 0, last).T)]
            least, most = np.fmin(least, near), np.fmax(most, near)
        met += int(((most >= low) & (least <= high)).sum())
    return met / len(some)
