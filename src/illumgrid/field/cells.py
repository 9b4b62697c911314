"""Periodic cells of any shape: the upright brick of the same volume that repeats by the same edges.

With the first edge along x and the second in the plane of x and y, edges are a = (a₁, 0, 0), b = (b₁, b₂, 0) and c. The
brick a₁ × b₂ × c₃ and its images fill space as the cell and its images do: what leaves it through a face enters through
the opposite one, shifted by the remaining components of the edge.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats


@dataclass(frozen=True, eq=False)
class Brick:
    """A periodic cell in its own axes.

    Parameters
    ----------
    edges : (3, 3) float64
        a, b, c, row by row: lower triangular, with a positive diagonal.
    axes : (3, 3) float64
        The axes of the brick in the world, row by row: a rotation.
    """

    edges: Floats
    axes: Floats

    @classmethod
    def of(cls, cell: ArrayLike) -> "Brick":
        """The brick of a cell with these edges (3, 3), row by row, world units."""
        edges = np.array(cell, float)
        volume = np.linalg.det(edges) if edges.shape == (3, 3) and np.isfinite(edges).all() else 0.0
        if not abs(volume) > 1e-9 * np.prod(np.linalg.norm(edges, axis=1)):
            raise BadInput(f"the edges of the cell are {edges.tolist()}; expected three that span a volume")
        edges[2] *= np.sign(volume)  # replacing an edge by its opposite keeps the repetition
        axes, upper = np.linalg.qr(edges.T)
        signs = np.sign(np.diag(upper))
        return cls(upper.T * signs, signs[:, None] * axes.T)

    @property
    def sides(self) -> Floats:
        """Lengths (3,) of the brick."""
        return np.diag(self.edges).copy()

    def images(self, points: Floats, weights: Floats, margin: Floats) -> tuple[Floats, Floats]:
        """Points (n, 3), world units, in the axes of the brick, once for each image within `margin` (3,) of it."""
        at = points @ self.axes.T
        for axis in (2, 1, 0):  # c moves an image along all axes, b along two, a along one
            edge = self.edges[axis]
            at = at - np.floor(at[:, axis] / edge[axis])[:, None] * edge
            reach = int(np.ceil(margin[axis] / edge[axis]))
            moved = [at + step * edge for step in range(-reach, reach + 1)]
            near = [(m[:, axis] >= -margin[axis]) & (m[:, axis] <= edge[axis] + margin[axis]) for m in moved]
            at = np.concatenate([m[keep] for m, keep in zip(moved, near)])
            weights = np.concatenate([weights[keep] for keep in near])
        return at, weights
