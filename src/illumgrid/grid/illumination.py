"""The illumination grid: light at the nodes of a lattice, with its error bar and its support."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.errors import BadInput
from illumgrid.field.lattice import GridSpec
from illumgrid.field.volume import world_to_index
from illumgrid.grid.bars import of_blocks, resolution
from illumgrid.grid.blocks import Layout, answer, read, whole
from illumgrid.grid.channels import Channels, stored

_BLOCK = 1 << 18  # nodes


class Block(NamedTuple):
    """Some consecutive nodes of a grid, and their light."""

    nodes: slice  # flat C-order numbers
    values: NDArray[np.float32]  # (m, 3)
    error: NDArray[np.float32]  # (m,)
    support: NDArray[np.float32]  # (m,)


class Held(NamedTuple):
    """The content of a grid, in blocks of nodes: see `illumgrid.grid.blocks`."""

    layout: Layout
    light: NDArray[np.float32]  # (blocks, i, j, k, C)
    error: NDArray[np.float32]  # (blocks, i, j, k)
    support: NDArray[np.float32]  # (blocks, i, j, k)
    errors: NDArray[np.float32] | None = None  # (blocks, i, j, k, C)

    @property
    def size(self) -> int:
        """Number of nodes; a node on the border of several blocks is counted in each."""
        return self.support.size


@dataclass(frozen=True, eq=False, init=False)
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
        Number of samples from which the node was computed; 0 marks a hole.
    channels : Channels, optional
        By default grey for one channel, RGB for three.
    errors : (nx, ny, nz, C) float32, optional
        Standard error of each channel, for the error of another mix of several layers.
    rows : tuple of IlluminationGrid, optional
        Only for a field whose level is held: one grid for each of some equal steps of the sweep of the other fields.
        The arrays of this grid itself are those at the middle of the sweep.
    held : Held, optional
        Instead of the arrays: nodes in blocks, where `spec` is the finest lattice. The arrays are then made on first
        use, with the result of a lookup at nodes that no block holds; `lookup` and similar methods do not need them.

    Attributes
    ----------
    light : (nx, ny, nz, C) float32
        What is stored: one channel for grey light, whose `values` cost no memory.
    """

    spec: GridSpec
    channels: Channels
    rows: tuple["IlluminationGrid", ...]
    held: Held

    def __init__(
        self, spec: GridSpec, values: ArrayLike | None = None, error: ArrayLike | None = None,
        support: ArrayLike | None = None, channels: Channels | None = None, errors: NDArray[np.float32] | None = None,
        rows: tuple["IlluminationGrid", ...] = (), held: Held | None = None,
    ) -> None:  # fmt: skip
        if held is None or not (values is None and error is None and support is None):
            before = None if held is None else IlluminationGrid(spec, channels=channels, held=held)
            if before is not None:  # so that `replace` can pass on what it does not replace
                errors = before.errors if values is None and errors is None else errors
                values = before.light if values is None else values
                error = before.error if error is None else error
                support = before.support if support is None else support
            held, channels = _dense(spec, values, error, support, channels, errors)
        if tuple(held.layout.shape) != tuple(spec.shape):
            raise BadInput(f"blocks of a lattice of shape {tuple(held.layout.shape)} came; expected {spec.shape}")
        for name, value in (("spec", spec), ("channels", channels), ("rows", rows), ("held", held)):
            object.__setattr__(self, name, value)

    @cached_property
    def _arrays(self) -> tuple[NDArray[np.float32], ...]:
        """Light (nx, ny, nz, C), error and support (nx, ny, nz) of all nodes."""
        held, shape = self.held, tuple(self.spec.shape)
        if held.layout.dense:
            return held.light[0], held.error[0], held.support[0]
        found = tuple(np.empty((*shape, *more), np.float32) for more in ((held.light.shape[4],), (), ()))
        for nodes in self._slabs():
            for whole_of, some in zip(found, self._at(nodes)):
                whole_of.reshape(-1, *whole_of.shape[3:])[nodes] = some
        for array in found:
            array.flags.writeable = False
        return found

    def _slabs(self) -> Iterator[slice]:
        count = int(np.prod(self.spec.shape))
        for first in range(0, count, _BLOCK):
            yield slice(first, min(first + _BLOCK, count))

    def lattice(self) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Light (nx, ny, nz, C) of all nodes, and which have light; from blocks, both are made on each access."""
        held, shape = self.held, tuple(self.spec.shape)
        if held.layout.dense:
            return held.light[0], held.support[0] > 0
        light, lit = np.empty((*shape, held.light.shape[4]), np.float32), np.empty(shape, bool)
        for nodes in self._slabs():
            some, _, support = self._at(nodes)
            light.reshape(-1, light.shape[3])[nodes], lit.reshape(-1)[nodes] = some, support > 0
        return light, lit

    def _at(self, nodes: slice) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Light (m, C), error (m,) and support (m,) of some nodes of the finest lattice."""
        index = np.stack(np.unravel_index(np.arange(nodes.start, nodes.stop), self.spec.shape), axis=-1)
        return answer(*self.held[:4], index)

    @property
    def light(self) -> NDArray[np.float32]:
        """Irradiance (nx, ny, nz, C) in all channels."""
        return self._arrays[0]

    @property
    def error(self) -> NDArray[np.float32]:
        """Standard error (nx, ny, nz) of all nodes."""
        return self._arrays[1]

    @property
    def support(self) -> NDArray[np.float32]:
        """Number of samples (nx, ny, nz) behind all nodes."""
        return self._arrays[2]

    @cached_property
    def values(self) -> NDArray[np.float32]:
        """Irradiance (nx, ny, nz, 3), linear RGB; no copy if it is stored in this form."""
        rgb = self.channels.rgb(self.light).view()
        rgb.flags.writeable = False
        return rgb

    @cached_property
    def errors(self) -> NDArray[np.float32] | None:
        """Standard error (nx, ny, nz, C) of each channel, of several layers."""
        held = self.held
        if held.errors is None or held.layout.dense:
            return None if held.errors is None else held.errors[0]
        found = np.empty((*self.spec.shape, held.errors.shape[4]), np.float32)
        own = IlluminationGrid(self.spec, channels=self.channels, held=held._replace(light=held.errors, errors=None))
        for nodes in self._slabs():
            found.reshape(-1, found.shape[3])[nodes] = own._at(nodes)[0]
        return found

    def showing(self, channels: Channels) -> "IlluminationGrid":
        """The same grid showing another mix of its layers.

        Its error is an upper bound: the sum of each layer's error times the absolute value of its weight.
        """
        held = self.held
        error = np.full(held.error.shape, np.inf, np.float32)
        if held.errors is not None:
            known = np.isfinite(held.errors)  # infinity times 0 is NaN
            bound = np.where(known, held.errors, np.float32(0)) @ np.abs(np.array(channels.mix, np.float32))
            error = np.where(known.all(axis=-1), np.sqrt(np.square(bound).mean(axis=-1)), np.inf).astype(np.float32)
        rows = tuple(row.showing(channels) for row in self.rows)
        return IlluminationGrid(self.spec, channels=channels, rows=rows, held=held._replace(error=error))

    def lookup(self, points: ArrayLike, t: float = 0.5) -> NDArray[np.float32]:
        """Irradiance (n, 3) at world points (n, 3), trilinear between nodes; beyond the border, that of the border.

        Never NaN: coordinates that are not finite read the border. Where no block of nodes lies, the border of the
        nearest one is read.

        Parameters
        ----------
        points : (n, 3) array_like
        t : float
            Position of the other fields in the sweep, 0 to 1, for a field whose level is held; ignored otherwise.
        """
        if self.rows:
            place = float(np.clip(t, 0.0, 1.0)) * (len(self.rows) - 1)
            below = min(int(place), len(self.rows) - 2)
            share = np.float32(place - below)
            one, other = (row.lookup(points) for row in self.rows[below : below + 2])
            return (1 - share) * one + share * other
        found = read(self.held.layout, self.spec, self.held.light, points)
        return np.ascontiguousarray(self.channels.rgb(found))

    def covered(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether (n,) every node that `lookup` mixes at world points (n, 3) has light of its own."""
        return np.asarray(self.certainty(points)[1] > 0)

    def certainty(self, points: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Error and support (n,) of the up to eight nodes that `lookup` mixes at world points (n, 3).

        The error is their weighted mean, an upper bound for any correlation of the nodes' errors, and infinite if one
        is unknown; the support is the smallest.
        """
        held = self.held
        return answer(held.layout, held.light[..., :0], held.error, held.support, world_to_index(self.spec, points))[1:]

    def blocks(self) -> Iterator[Block]:
        """Yield all nodes, some at a time, in C order."""
        for nodes in self._slabs():
            if self.held.layout.dense:
                light, error, support = (a.reshape(-1, *a.shape[3:])[nodes] for a in self._arrays)
            else:
                light, error, support = self._at(nodes)
            yield Block(nodes, self.channels.rgb(light), error, support)

    def dense(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Values (nx, ny, nz, 3), error (nx, ny, nz) and support (nx, ny, nz) of all nodes as arrays."""
        return self.values, self.error, self.support

    def onto(self, spec: GridSpec) -> "IlluminationGrid":
        """Resample the grid on another lattice: light as `lookup` reads it, error and support of the nearest node."""
        held, count = self.held, int(np.prod(spec.shape))
        each = held.light[..., :0] if held.errors is None else held.errors
        light, errors = (np.empty((count, of.shape[4]), np.float32) for of in (held.light, each))
        error, support = np.empty((2, count), np.float32)
        for first in range(0, count, _BLOCK):
            some = slice(first, min(first + _BLOCK, count))
            points = spec.nodes(np.arange(some.start, some.stop))
            light[some] = read(held.layout, self.spec, held.light, points)
            nearest = np.clip(np.round(world_to_index(self.spec, points)), 0, np.array(self.spec.shape) - 1)
            errors[some], error[some], support[some] = answer(held.layout, each, held.error, held.support, nearest)
        return IlluminationGrid(
            spec, light.reshape(*spec.shape, -1), error.reshape(spec.shape), support.reshape(spec.shape), self.channels,
            None if held.errors is None else errors.reshape(*spec.shape, -1),
        )  # fmt: skip

    @property
    def dark(self) -> NDArray[np.bool_]:
        """Which nodes (nx, ny, nz) are stored but have no light of their own."""
        held, shape = self.held, self.spec.shape
        if held.layout.dense:
            return np.asarray(held.support[0] == 0)
        layout, found = held.layout, np.zeros(shape, bool)
        for number, each in enumerate(held.support):
            index = layout.place(slice(number, number + 1))[0][each.reshape(-1) == 0]
            index = index[(index < layout.shape).all(axis=1)]
            box = np.minimum(index // layout.side, np.array(layout.slot.shape) - 1)
            found[tuple(index[layout.slot[tuple(box.T)] == number].T)] = True
        return found

    @cached_property
    def _even(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Light (m, C), error (m,) and support (m,) at evenly spaced places: the nodes of the coarsest blocks."""
        held, shape = self.held, self.spec.shape
        layout = held.layout
        if layout.dense:
            return held.light.reshape(-1, held.light.shape[4]), held.error.reshape(-1), held.support.reshape(-1)
        index = layout.place(layout.step == layout.step[0]).reshape(-1, 3)
        index = index[(index < np.array(shape)).all(axis=1)]
        flat = np.unique(np.ravel_multi_index(tuple(index.T), shape))
        return answer(*held[:4], np.stack(np.unravel_index(flat, shape), axis=-1))

    @property
    def lit(self) -> NDArray[np.float32]:
        """Irradiance (m, 3) of the nodes that have light of their own; of several densities only the coarsest."""
        return np.concatenate(list(self.lit_parts()))

    def lit_parts(self) -> Iterator[NDArray[np.float32]]:
        """Yield `lit` in parts."""
        light, _, support = self._even
        for first in range(0, len(light), _BLOCK):
            some = slice(first, first + _BLOCK)
            yield self.channels.rgb(light[some][support[some] > 0])

    @cached_property
    def mean(self) -> float:
        """Mean irradiance over RGB of the nodes that have light of their own; 0 if none has."""
        lit = self.lit
        return float(lit.mean()) if len(lit) else 0.0

    @cached_property
    def relative_error(self) -> float | None:
        """Root mean square standard error of the nodes over their mean irradiance; None if no error is known."""
        light, error, support = self._even
        known = np.isfinite(error) & (support > 0)
        mean = float(self.channels.rgb(light[known]).mean()) if known.any() else 0.0
        return float(np.sqrt(np.square(error[known], dtype=float).mean())) / mean if mean > 0 else None

    @cached_property
    def bars(self) -> NDArray[np.float32]:
        """Standard error (blocks, i, j, k) of a lookup near each node: see `bar`."""
        layout, light, error, support, _ = self.held
        return of_blocks(layout, light, error, support, self.channels)

    @property
    def bar(self) -> NDArray[np.float32]:
        """Standard error (nx, ny, nz) of a lookup near each node: noise and interpolation; infinite without support.

        Noise: if each node has a sample of its own, a trilinear lookup with weights w keeps the share Σ w² of their
        variance, 8/27 in the mean over a cell; nodes computed from several samples share these with their neighbours,
        and the lookup keeps all of the variance. Interpolation: the error of linear interpolation is at most an eighth
        of the second difference (h²/8 times the largest second derivative), which is measured along each axis from the
        values, with their noise subtracted.
        """
        if self.held.layout.dense:
            return np.asarray(self.bars[0])
        held = self.held._replace(error=self.bars)
        return IlluminationGrid(self.spec, channels=self.channels, held=held).error

    @cached_property
    def resolution(self) -> float:
        """Second differences over two node spacings, relative to those over one: 4 where the light is well resolved.

        Near 1 the light varies irregularly from node to node, and `bar` is a lower bound. Infinite without curvature.
        """
        layout, light, error, support, _ = self.held
        return resolution(layout, light, error, support, self.channels)

    def uncertainty(self, points: ArrayLike) -> NDArray[np.float32]:
        """Standard error (n,) of `lookup` at world points (n, 3); infinite where a node of the cell is a hole."""
        held = self.held
        return answer(held.layout, held.light[..., :0], self.bars, held.support, world_to_index(self.spec, points))[1]


def _dense(
    spec: GridSpec, values: Any, error: Any, support: Any, channels: Channels | None,
    errors: NDArray[np.float32] | None,
) -> tuple[Held, Channels]:  # fmt: skip
    """The arrays of all nodes as one block."""
    shape = tuple(spec.shape)
    if np.shape(values)[:-1] != shape:
        expected = f"{(*shape, 3)} (RGB), {(*shape, 1)} (grey) or as many channels as are named"
        raise BadInput(f"the values of a grid have shape {np.shape(values)}; expected {expected}")
    arrays = []
    for name, array in (("error", error), ("support", support)):
        array = np.ascontiguousarray(array, dtype=np.float32)
        if array.shape != shape:
            raise BadInput(f"the {name} of a grid has shape {array.shape}; expected {shape}")
        arrays.append(array[None])
    kept = stored(values, channels)
    light: NDArray[np.float32] = kept["light"]
    if errors is not None and errors.shape != light.shape:
        raise BadInput(f"the errors of a grid have shape {errors.shape}; expected {light.shape}")
    each = None if errors is None else errors[None]
    return Held(whole(shape), light[None], arrays[0], arrays[1], each), kept["channels"]
