"""The nodes that an interpolator fills: each knows its place, and the level set through itself."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.field.lattice import GridSpec
from illumgrid.field.scene import Field
from illumgrid.field.volume import Floats, interpolate, outward_normals, world_to_index
from illumgrid.grid.channels import Channels
from illumgrid.grid.illumination import IlluminationGrid
from illumgrid.grid.lookup import fill_holes


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
        self, light: ArrayLike, error: ArrayLike, support: ArrayLike, channels: Channels | None = None
    ) -> IlluminationGrid:
        """Grid of light (n, C), error (n,) and support (n,) at all nodes; holes get the light of the nearest node."""
        shape = tuple(self.spec.shape)
        values, bars, counts = (np.asarray(array, dtype=np.float32) for array in (light, error, support))
        counts = counts.reshape(shape)
        filled = fill_holes(self.spec.spacing, values.reshape(*shape, -1), counts)
        return IlluminationGrid(self.spec, filled, bars.reshape(shape), counts, channels)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class NodeBlock:
    """Some nodes; what they know is computed when it is asked for.

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
