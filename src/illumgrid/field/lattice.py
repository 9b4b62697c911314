"""Nodes of a grid over a volume: where they lie."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from illumgrid.constants import DENSITY, LONGEST
from illumgrid.errors import BadInput
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats, Lattice, Volume, index_to_world, placement

MOST_NODES = 2**16  # along an axis: such a cube is beyond any memory, and its number of nodes still fits 64 bits


@dataclass(frozen=True, eq=False)
class GridSpec:
    """Where the nodes of a grid lie.

    Parameters
    ----------
    shape : tuple of int
        Number of nodes along x, y, z, at least 2 each.
    origin, spacing, direction
        As of a `Volume`, for nodes in place of voxel centres.
    """

    shape: tuple[int, int, int]
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    spacing: Floats = field(default_factory=lambda: np.ones(3))
    direction: Floats = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        shape = tuple(int(n) for n in self.shape)
        if len(shape) != 3 or min(shape) < 2:
            raise BadInput(f"got a grid of shape {shape}; expected at least 2 nodes along each of three axes")
        object.__setattr__(self, "shape", shape)
        for name, value in zip(
            ("origin", "spacing", "direction"), placement(self.origin, self.spacing, self.direction)
        ):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @classmethod
    def over(cls, lattice: Lattice, longest: int) -> "GridSpec":
        """Nodes from the first to the last voxel centre, `longest` along the axis with most voxels.

        Axis i gets max(2, 1 + round((n_i - 1)(longest - 1)/(n_max - 1))) nodes: `longest` = n_max gives the voxels.
        """
        if not 2 <= longest <= MOST_NODES:
            raise BadInput(
                f"got a grid of {longest} nodes; expected at least 2 and at most {MOST_NODES} along the longest axis"
            )
        voxels = np.array(lattice.shape)
        # floor(x + 1/2): Python and NumPy round halves to even, which is not what a reader of the formula expects.
        nodes = np.maximum(2, 1 + np.floor((voxels - 1) * (longest - 1) / (voxels.max() - 1) + 0.5).astype(int))
        spacing = np.where(nodes == voxels, lattice.spacing, lattice.spacing * (voxels - 1) / (nodes - 1))
        return cls((int(nodes[0]), int(nodes[1]), int(nodes[2])), lattice.origin, spacing, lattice.direction)

    def nodes(self, flat: NDArray[np.integer] | None = None) -> Floats:
        """World positions (n, 3) of the nodes with these flat C-order numbers, by default of all."""
        numbers = np.arange(np.prod(self.shape)) if flat is None else flat
        return index_to_world(self, np.stack(np.unravel_index(numbers, self.shape), axis=-1))


def nodes_over(volume: Volume, longest: int | None = None, density: float = DENSITY) -> GridSpec:
    """Nodes of a volume's grid; see `illumgrid.constants.DENSITY`."""
    usual = max(2, min(round(density * max(volume.shape)), LONGEST))
    return GridSpec.over(volume, usual if longest is None else longest)


def specs_over(scene: Scene, longest: int | None = None, density: float = DENSITY) -> list[GridSpec]:
    """Nodes of every field's grid: see `nodes_over`."""
    return [nodes_over(field.volume, longest, density) for field in scene.fields]


def along_longest(specs: Sequence[GridSpec]) -> int:
    """Nodes along the longest axis of all lattices."""
    return max(max(spec.shape) for spec in specs)
