"""The nodes that an interpolator fills: each has a position and the level set through it."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.field.lattice import GridSpec
from illumgrid.field.scene import Field
from illumgrid.field.volume import Floats, interpolate, outward_normals, slabs, world_to_index
from illumgrid.grid.channels import Channels
from illumgrid.grid.illumination import IlluminationGrid
from illumgrid.grid.lookup import fill_holes


def _any_corner(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells with a marked voxel among their 8 corners."""
    for axis in range(3):
        line = np.moveaxis(voxels, axis, 0)
        voxels = np.moveaxis(line[1:] | line[:-1], 0, axis)
    return voxels


def _crossed_cells(field: Field, rows: slice) -> NDArray[np.bool_]:
    """Voxel cells (rows, ny - 1, nz - 1) through which some level set of the field's range passes."""
    values, (low, high) = field.volume.stored[rows.start : rows.stop + 1], field.stored_range
    return _any_corner(values >= low) & _any_corner(values <= high)


def _overlapped(cells: int, grid_cells: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The first and the last voxel cell along an axis that overlap each grid cell."""
    numbers = np.arange(grid_cells)
    return numbers * cells // grid_cells, -(-(numbers + 1) * cells // grid_cells) - 1


def _any_between(
    cells: NDArray[np.bool_], first: NDArray[np.int64], last: NDArray[np.int64], axis: int
) -> NDArray[np.bool_]:
    """Whether any cell from each `first` to each `last` is marked, along an axis."""
    found = cells.take(first, axis)
    for more in range(1, int((last - first).max()) + 1):
        found |= cells.take(np.minimum(first + more, last), axis)
    return np.asarray(found)


def reachable(field: Field, spec: GridSpec) -> NDArray[np.int64]:
    """Flat numbers of the nodes that a lookup on some isosurface of the field's range can read: see `reached`."""
    return np.flatnonzero(reached(field, spec))


def reached(field: Field, spec: GridSpec) -> NDArray[np.bool_]:
    """Which nodes (nx, ny, nz) a lookup on some isosurface of the field's range can read.

    These are the corners of all grid cells that overlap a voxel cell crossed by a level set of the range.
    """
    (first, last), *across = (_overlapped(n - 1, m - 1) for n, m in zip(field.volume.shape, spec.shape))
    crossed = np.zeros([n - 1 for n in spec.shape], bool)
    wide = (max(n, m) for n, m in zip(field.volume.shape[1:], spec.shape[1:]))
    for part in slabs((field.volume.shape[0] - 1, *wide)):
        cells = _crossed_cells(field, part)
        for axis, (low, high) in enumerate(across, 1):
            cells = _any_between(cells, low, high, axis)
        rows = slice(int(np.searchsorted(last, part.start)), int(np.searchsorted(first, part.stop)))
        low, high = np.maximum(first[rows], part.start), np.minimum(last[rows], part.stop - 1)
        crossed[rows] |= _any_between(cells, low - part.start, high - part.start, 0)
    nodes = np.zeros(spec.shape, bool)
    for corner in np.ndindex(2, 2, 2):
        nodes[tuple(slice(c, c + n) for c, n in zip(corner, crossed.shape))] |= crossed
    return nodes


@dataclass(frozen=True, eq=False)
class Nodes:
    """Nodes of a grid over a field.

    Parameters
    ----------
    spec : GridSpec
    field : Field
    number : int
        Of the field in its scene: the column of its isovalues in `Queries.level`.
    """

    spec: GridSpec
    field: Field
    number: int = 0

    def __len__(self) -> int:
        return int(np.prod(self.spec.shape))

    def blocks(self, flat: NDArray[np.integer] | None = None, size: int = 1 << 16) -> Iterator["NodeBlock"]:
        """Yield the nodes with these flat C-order numbers, by default all, at most `size` at a time."""
        for first in range(0, len(self) if flat is None else len(flat), size):
            some = np.arange(first, min(first + size, len(self))) if flat is None else flat[first : first + size]
            yield NodeBlock(self, some)

    def grid(
        self,
        light: ArrayLike,
        error: ArrayLike,
        support: ArrayLike,
        channels: Channels | None = None,
        errors: NDArray[np.float32] | None = None,
    ) -> IlluminationGrid:
        """Grid of light (n, C), error (n,) and support (n,) at all nodes; holes get the light of the nearest node.

        `errors` (n, C) are those of each channel, where several layers are mixed later.
        """
        shape = tuple(self.spec.shape)
        values, bars, counts = (np.asarray(array, dtype=np.float32) for array in (light, error, support))
        counts = counts.reshape(shape)
        filled = fill_holes(self.spec.spacing, values.reshape(*shape, -1), counts)
        each = None if errors is None else errors.reshape(filled.shape)
        return IlluminationGrid(self.spec, filled, bars.reshape(shape), counts, channels, each)

    def grid_of(
        self, flat: NDArray[np.integer], found: list[NDArray[np.float32] | None], channels: Channels
    ) -> IlluminationGrid:
        """Grid of light (m, C), error (m,), support (m,) and `errors` at the nodes (m,) with these numbers.

        All other nodes are holes. Arrays are removed from the list as they are spread, so that none is held twice.
        """

        def whole(which: int, empty: float) -> NDArray[np.float32] | None:
            part, found[which] = found[which], None
            if part is None:
                return None
            every = np.full((len(self), *part.shape[1:]), empty, np.float32)
            every[flat] = part
            return every.reshape(*self.spec.shape, *part.shape[1:])

        light, support = whole(0, 0.0), whole(2, 0.0)
        assert light is not None and support is not None
        light = fill_holes(self.spec.spacing, light, support)  # needs the most memory, so first
        return IlluminationGrid(self.spec, light, whole(1, np.inf), support, channels, whole(3, np.inf))


@dataclass(frozen=True, eq=False)
class NodeBlock:
    """Some nodes; their properties are computed on access.

    Parameters
    ----------
    nodes : Nodes
    flat : (m,) int
        Their flat C-order numbers.
    """

    nodes: Nodes
    flat: NDArray[np.integer]

    @cached_property
    def point(self) -> Floats:
        """World positions (m, 3)."""
        return self.nodes.spec.nodes(self.flat)

    @cached_property
    def index(self) -> Floats:
        """Fractional indices (m, 3) in the field's volume."""
        return world_to_index(self.nodes.field.volume, self.point)

    @cached_property
    def level(self) -> Floats:
        """Isovalues (m,) of the level sets through the nodes."""
        return interpolate(self.nodes.field.volume, self.index)

    @cached_property
    def normal(self) -> Floats:
        """World unit gradient normals (m, 3) of those level sets, towards the outside; (0, 0, 0) on a plateau."""
        field = self.nodes.field
        return outward_normals(field.volume, self.index, field.inside) @ field.volume.direction.T
