"""The illumination grid: light at the nodes of a lattice, read between them by trilinear interpolation."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.errors import BadInput
from illumgrid.volume import ON_A_VOXEL, Floats, Lattice, index_to_world, placement

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
            raise BadInput(f"a grid of shape {shape} was asked for; expected at least 2 nodes along each of three axes")
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
                f"a grid of {longest} nodes was asked for; expected at least 2 and at most {MOST_NODES} along the "
                "longest axis"
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


@dataclass(frozen=True, eq=False)
class WallTexture:
    """Light on the front of a quad, for every row of the level table.

    Parameters
    ----------
    values : (K, nv, nu, 3) float32
        Irradiance, linear RGB, at the middles of the texels: u along edge_u, v along edge_v.
    support : (K, nv, nu) float32
        1, or 0 for a texel inside a solid, which holds the value of the nearest one outside.
    """

    values: NDArray[np.float32]
    support: NDArray[np.float32]

    def lookup(self, u: ArrayLike, v: ArrayLike, t: ArrayLike) -> NDArray[np.float32]:
        """Irradiance (n, 3) at shares u, v (n,) of the edges and t (n,) of the sweep, all 0 to 1; trilinear."""
        from scipy.ndimage import map_coordinates

        rows, nv, nu, _ = self.values.shape
        place = np.broadcast_arrays(np.asarray(t) * (rows - 1), np.asarray(v) * nv - 0.5, np.asarray(u) * nu - 0.5)
        result = np.zeros((place[0].size, 3), dtype=np.float32)
        for channel in range(3):
            light = self.values[..., channel]
            map_coordinates(light, [p.ravel() for p in place], output=result[:, channel], order=1, mode="nearest")
        return result


def read_lattice(spec: Lattice, values: NDArray[np.float32], points: ArrayLike) -> NDArray[np.float32]:
    """Trilinear `values` (nx, ny, nz, m) at world points (n, 3), clamped to the border: (n, m)."""
    from illumgrid.trilinear import read

    world = np.ascontiguousarray(points, dtype=float).reshape(-1, 3)
    result = np.zeros((len(world), values.shape[3]), dtype=np.float32)
    place = (np.ascontiguousarray(x, dtype=float) for x in (spec.origin, spec.direction, spec.spacing))
    read(np.ascontiguousarray(values, np.float32), *place, ON_A_VOXEL, world, result)
    return result


def fill_holes(spacing: ArrayLike, values: NDArray[np.float32], support: NDArray[np.float32]) -> NDArray[np.float32]:
    """Give nodes of support 0 the value of the nearest supported node, so that lookup is never black and never NaN."""
    holes = support == 0
    if not holes.any() or holes.all():
        return values
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(holes, sampling=np.asarray(spacing), return_distances=False, return_indices=True)
    return np.asarray(values[tuple(nearest)])
