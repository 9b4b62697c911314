"""The illumination grid: light at the nodes of a lattice, with its error bar and its support."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.errors import BadInput
from illumgrid.field.lattice import GridSpec
from illumgrid.field.volume import Floats, corners, world_to_index
from illumgrid.grid.channels import Channels, stored
from illumgrid.grid.lookup import read_lattice

_BLOCK = 1 << 18  # nodes


class Block(NamedTuple):
    """Some nodes of a grid, one after the other, and what they hold."""

    nodes: slice  # of the flat C-order numbers
    values: NDArray[np.float32]  # (m, 3)
    error: NDArray[np.float32]  # (m,)
    support: NDArray[np.float32]  # (m,)


@dataclass(frozen=True, eq=False)
class IlluminationGrid:
    """Light at every node, for the level set that passes through it.

    Parameters
    ----------
    spec : GridSpec
    values : (nx, ny, nz, C) array_like
        Irradiance in C channels; kept as `light`. The attribute `values` is its linear RGB, (nx, ny, nz, 3) float32,
        read-only. A node without support holds the value of the nearest supported one.
    error : (nx, ny, nz) float32
        Standard error of the node, root mean square over RGB; infinite without support.
    support : (nx, ny, nz) float32
        Number of samples that the node rests upon; 0 marks a hole.
    channels : Channels, optional
        By default grey for one channel, RGB for three.
    errors : (nx, ny, nz, C) float32, optional
        Standard error of each channel, for the error of another mix of several layers.
    rows : tuple of IlluminationGrid, optional
        Of a field whose level is held: the same at equal steps of the sweep of the other fields. The arrays of the grid
        itself are those in its middle.

    Attributes
    ----------
    light : (nx, ny, nz, C) float32
        What is stored: one channel for grey light, whose `values` cost no memory.
    """

    spec: GridSpec
    values: NDArray[np.float32]
    error: NDArray[np.float32]
    support: NDArray[np.float32]
    channels: Channels = None  # type: ignore[assignment]
    errors: NDArray[np.float32] | None = None
    rows: tuple["IlluminationGrid", ...] = ()
    light: NDArray[np.float32] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        shape = tuple(self.spec.shape)
        if np.shape(self.values)[:-1] != shape:
            expected = f"{(*shape, 3)} (RGB), {(*shape, 1)} (grey) or as many channels as are named"
            raise BadInput(f"the values of a grid have shape {np.shape(self.values)}; expected {expected}")
        arrays = {name: np.ascontiguousarray(getattr(self, name), dtype=np.float32) for name in ("error", "support")}
        for name, array in arrays.items():
            if array.shape != shape:
                raise BadInput(f"the {name} of a grid has shape {array.shape}; expected {shape}")
        for name, value in (arrays | stored(self.values, self.channels)).items():
            object.__setattr__(self, name, value)
        if self.errors is not None and self.errors.shape != self.light.shape:
            raise BadInput(f"the errors of a grid have shape {self.errors.shape}; expected {self.light.shape}")

    def showing(self, channels: Channels) -> "IlluminationGrid":
        """The same grid showing another mix of its layers.

        Its error is an upper bound: the sum of each layer's error times the absolute value of its weight.
        """
        error = np.full(self.error.shape, np.inf, np.float32)
        if self.errors is not None:
            known = np.isfinite(self.errors)  # infinite times 0 is no number
            bound = np.where(known, self.errors, np.float32(0)) @ np.abs(np.array(channels.mix, np.float32))
            error = np.where(known.all(axis=-1), np.sqrt(np.square(bound).mean(axis=-1)), np.inf)
        rows = tuple(row.showing(channels) for row in self.rows)
        return replace(self, values=self.light, channels=channels, error=error, rows=rows)

    def lookup(self, points: ArrayLike, t: float = 0.5) -> NDArray[np.float32]:
        """Irradiance (n, 3) at world points (n, 3), trilinear between nodes; beyond the border, that of the border.

        Never NaN: coordinates that are not finite read the border.

        Parameters
        ----------
        points : (n, 3) array_like
        t : float
            Place in the sweep, 0 to 1, of the fields beside one whose level is held; without meaning for others.
        """
        if self.rows:
            place = float(np.clip(t, 0.0, 1.0)) * (len(self.rows) - 1)
            below = min(int(place), len(self.rows) - 2)
            share = np.float32(place - below)
            one, other = (row.lookup(points) for row in self.rows[below : below + 2])
            return (1 - share) * one + share * other
        return np.ascontiguousarray(self.channels.rgb(read_lattice(self.spec, self.light, points)))

    def covered(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether (n,) every node that `lookup` mixes at world points (n, 3) has light of its own."""
        hole = (self.support == 0)[..., None].astype(np.float32)
        return np.asarray(read_lattice(self.spec, hole, points)[:, 0] == 0)

    def certainty(self, points: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Error and support (n,) of the up to eight nodes that `lookup` mixes at world points (n, 3).

        The error is their weighted mean, which holds however the nodes' errors are correlated, and infinite where one
        has none; the support is the smallest.
        """
        index = world_to_index(self.spec, points)
        error, support = np.zeros(len(index), np.float32), np.full(len(index), np.inf, np.float32)
        for corner, share in corners(self.spec, index):
            node, weight = tuple(corner.T), share.astype(np.float32)
            mixed = weight > 0
            error[mixed] += weight[mixed] * self.error[node][mixed]
            support[mixed] = np.minimum(support, self.support[node])[mixed]
        return error, support

    def blocks(self) -> Iterator[Block]:
        """Yield all nodes, some at a time, in C order."""
        light = self.light.reshape(-1, len(self.channels))
        error, support = self.error.reshape(-1), self.support.reshape(-1)
        for first in range(0, len(light), _BLOCK):
            nodes = slice(first, min(first + _BLOCK, len(light)))
            yield Block(nodes, self.channels.rgb(light[nodes]), error[nodes], support[nodes])

    def dense(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Values (nx, ny, nz, 3), error (nx, ny, nz) and support (nx, ny, nz) of all nodes as arrays."""
        return self.values, self.error, self.support

    def onto(self, spec: GridSpec) -> "IlluminationGrid":
        """Grid on another lattice: light as `lookup` reads it, error and support those of the nearest node."""
        points, last = spec.nodes(), np.array(self.spec.shape) - 1
        nearest = tuple(np.clip(np.round(world_to_index(self.spec, points)), 0, last).astype(np.int64).T)
        light = read_lattice(self.spec, self.light, points).reshape(*spec.shape, -1)
        error, support = (array[nearest].reshape(spec.shape) for array in (self.error, self.support))
        errors = None if self.errors is None else self.errors[nearest].reshape(light.shape)
        return IlluminationGrid(spec, light, error, support, self.channels, errors)

    @property
    def lit(self) -> NDArray[np.float32]:
        """Irradiance (m, 3) of the nodes that have light of their own."""
        return np.concatenate([block.values[block.support > 0] for block in self.blocks()])

    @cached_property
    def mean(self) -> float:
        """Mean irradiance over RGB of the nodes that have light of their own; 0 if none has."""
        lit = self.lit
        return float(lit.mean()) if len(lit) else 0.0

    @cached_property
    def relative_error(self) -> float | None:
        """Root mean square standard error of the nodes over their mean irradiance; None where none is known."""
        known = np.isfinite(self.error) & (self.support > 0)
        mean = float(self.values[known].mean()) if known.any() else 0.0
        return float(np.sqrt(np.square(self.error[known], dtype=float).mean())) / mean if mean > 0 else None

    @cached_property
    def _alone(self) -> NDArray[np.bool_]:
        """Nodes (nx, ny, nz) that rest on one sample, which no other node has, and holes."""
        return (self.support <= 1) | ~np.isfinite(self.error)

    def _bend(self, axis: int, step: int) -> Floats:
        """Mean square over RGB of second differences along an axis, `step` nodes apart, less the noise in them."""
        light, error = (np.moveaxis(a, axis, 0) for a in (self.channels.shown(self.light), self.error))
        after, here, before = slice(2 * step, None), slice(step, -step), slice(None, -2 * step)
        square = np.square(light[after] - 2 * light[here] + light[before], dtype=float).mean(axis=-1)
        # Infinite at holes. Noise that neighbours share, as they rest on the same samples, cancels in the differences.
        noise = np.where(np.moveaxis(self._alone, axis, 0), np.square(error, dtype=float), 0.0)
        return np.moveaxis(square - (noise[after] + 4 * noise[here] + noise[before]), 0, axis)

    @cached_property
    def bar(self) -> NDArray[np.float32]:
        """Standard error (nx, ny, nz) of a lookup near each node: noise and interpolation; infinite without support.

        Noise: of the variance of nodes with a sample each a trilinear lookup keeps Σ w² of its weights w, 8/27 in the
        mean over a cell; nodes that rest on several samples share them with their neighbours, and it keeps all.
        Interpolation: between nodes a straight line is off by at most an eighth of the second difference (h²/8 times
        the largest second derivative), which is taken along each axis from the values themselves, less their noise.
        """
        known = (self.support > 0) & np.isfinite(self.error)
        if not known.any():
            return np.full(known.shape, np.inf, np.float32)
        kept = np.where(self._alone, 8 / 27, 1.0)
        square = np.where(known, kept * np.square(self.error, where=known, out=np.zeros(known.shape)), np.inf)
        for axis in range(3):
            if self.spec.shape[axis] > 2:  # two nodes show no curvature
                bend = np.nan_to_num(self._bend(axis, 1), neginf=0.0)  # next to a hole only the other axes count
                edges = [(1, 1) if a == axis else (0, 0) for a in range(3)]
                square += np.pad(np.maximum(bend, 0.0), edges, mode="edge") / 64
        return np.sqrt(square).astype(np.float32)

    @cached_property
    def resolution(self) -> float:
        """Second differences over twice the distance, over those from node to node: 4 on light that is well resolved.

        Near 1 the light changes from node to node without a law, and `bar` is a lower bound. Infinite without bends.
        """
        near, far = 0.0, 0.0
        for axis in range(3) if np.isfinite(self.error).any() else ():
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
