"""The illumination grid: light at the nodes of a lattice, with its error bar and its support."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.errors import BadInput
from illumgrid.field.lattice import GridSpec
from illumgrid.field.volume import Floats
from illumgrid.grid.lookup import read_lattice


@dataclass(frozen=True, eq=False)
class IlluminationGrid:
    """Light at every node, for the level set that passes through it.

    Parameters
    ----------
    spec : GridSpec
    values : (nx, ny, nz, 3) float32
        Irradiance, linear RGB. A node without support holds the value of the nearest supported one.
    error : (nx, ny, nz) float32
        Standard error of the node, root mean square over RGB; infinite without support.
    support : (nx, ny, nz) float32
        Number of samples that the node rests upon; 0 marks a hole.
    """

    spec: GridSpec
    values: NDArray[np.float32]
    error: NDArray[np.float32]
    support: NDArray[np.float32]

    def __post_init__(self) -> None:
        shape = tuple(self.spec.shape)
        for name, expected in (("values", (*shape, 3)), ("error", shape), ("support", shape)):
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float32)
            if array.shape != expected:
                raise BadInput(f"the {name} of a grid have shape {array.shape}; expected {expected}")
            object.__setattr__(self, name, array)

    def lookup(self, points: ArrayLike) -> NDArray[np.float32]:
        """Irradiance (n, 3) at world points (n, 3), trilinear between nodes; beyond the border, that of the border.

        Never NaN: coordinates that are not finite read the border.
        """
        return read_lattice(self.spec, self.values, points)

    def _bend(self, axis: int, step: int) -> Floats:
        """Mean square over RGB of second differences along an axis, `step` nodes apart, less the noise in them."""
        light, error = (np.moveaxis(a, axis, 0) for a in (self.values, self.error))
        after, here, before = slice(2 * step, None), slice(step, -step), slice(None, -2 * step)
        square = np.square(light[after] - 2 * light[here] + light[before], dtype=float).mean(axis=-1)
        noise = np.square(error, dtype=float)  # infinite at holes
        return np.moveaxis(square - (noise[after] + 4 * noise[here] + noise[before]), 0, axis)

    @cached_property
    def bar(self) -> NDArray[np.float32]:
        """Standard error (nx, ny, nz) of a lookup near each node: noise and interpolation; infinite without support.

        Noise: of the nodes' variance a trilinear lookup keeps Σ w² of its weights w, 8/27 in the mean over a cell.
        Interpolation: between nodes a straight line is off by at most an eighth of the second difference (h²/8 times
        the largest second derivative), which is taken along each axis from the values themselves, less their noise.
        """
        known = (self.support > 0) & np.isfinite(self.error)
        square = np.where(known, 8 / 27 * np.square(self.error, dtype=float), np.inf)
        for axis in range(3):
            if self.spec.shape[axis] > 2:  # of two nodes nothing tells a curve
                bend = np.nan_to_num(self._bend(axis, 1), neginf=0.0)  # next to a hole only the other axes tell
                edges = [(1, 1) if a == axis else (0, 0) for a in range(3)]
                square += np.pad(np.maximum(bend, 0.0), edges, mode="edge") / 64
        return np.sqrt(square).astype(np.float32)

    @cached_property
    def resolution(self) -> float:
        """Second differences over twice the distance, over those from node to node: 4 on light that is well resolved.

        Near 1 the light changes from node to node without a law, and `bar` is a lower bound. Infinite without bends.
        """
        near, far = 0.0, 0.0
        for axis in range(3):
            if self.spec.shape[axis] > 4:
                bends = (self._bend(axis, step) for step in (1, 2))
                one, two = (bend[np.isfinite(bend)] for bend in bends)
                near += float(one.mean()) if one.size else 0.0
                far += float(two.mean()) if two.size else 0.0
        return float(np.sqrt(far / near)) if near > 0 and far > 0 else np.inf

    def uncertainty(self, points: ArrayLike) -> NDArray[np.float32]:
        """Standard error (n,) of `lookup` at world points (n, 3); infinite where a node of the cell is a hole."""
        bar = np.where(np.isfinite(self.bar), self.bar, 0.0).astype(np.float32)
        hole = (~np.isfinite(self.bar)).astype(np.float32)
        found = read_lattice(self.spec, np.stack([bar, hole], axis=-1), points)
        return np.where(found[:, 1] > 0, np.inf, found[:, 0]).astype(np.float32)
