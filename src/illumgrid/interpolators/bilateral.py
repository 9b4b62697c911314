"""Each node is a fit to the samples around it by position, level and normal: a joint bilateral filter."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.lattice import GridSpec
from illumgrid.field.volume import Floats, world_to_index
from illumgrid.grid import IlluminationGrid, Nodes
from illumgrid.grid.nodes import reached
from illumgrid.stages import Interpolator, hookimpl
from illumgrid.transport.samples import Samples

_BLOCK = 1 << 14  # samples whose queries are held
_SLAB, _CHUNK = 1 << 18, 1 << 12  # approximate number of sorted samples held, and nodes that one thread fills at a time
_ON_A_NODE = 1e-6  # of a node spacing


class Sorted(NamedTuple):
    """Samples of some planes of the lit lattice, in the order of their nearest nodes."""

    near: NDArray[np.integer]  # (m,) flat numbers of those nodes
    place: NDArray[np.float32]  # (m, 8): see `illumgrid.grid.reading.estimate`
    light: NDArray[np.float32]  # (m, C)
    variance: NDArray[np.float32]  # (m,)
    each: NDArray[np.float32]  # (m, C) of each channel where they are mixed later, else (m, 0)
    dark: NDArray[np.int64]  # flat numbers of the holes of the lit lattice, in order


def _next_to(spec: GridSpec, points: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Index (n, 3) of world points in a lattice, and the nearest nodes."""
    index = world_to_index(spec, points)
    return index, np.clip(np.round(index), 0, np.array(spec.shape) - 1).astype(np.int64)


def _planes(samples: Samples, spec: GridSpec) -> NDArray[np.integer]:
    """The plane (n,) along the first axis of the node nearest to each sample."""
    plane = np.empty(len(samples), np.min_scalar_type(spec.shape[0]))  # one byte each, usually
    for first in range(0, len(samples), _BLOCK):
        some = slice(first, first + _BLOCK)
        plane[some] = _next_to(spec, samples.queries[some].point)[1][:, 0]
    return plane


def _in_order(samples: Samples, rows: NDArray[np.integer], nodes: Nodes) -> Sorted:
    """Sort some of the samples into the nodes' lattice; holes are left out and recorded."""
    from illumgrid.grid.reading import slopes

    spec, volume = nodes.spec, nodes.field.volume
    lit = samples.paths[rows] > 0
    index, closest = _next_to(spec, samples.queries[rows[~lit]].point)
    on_a_node = (np.abs(index - closest) < _ON_A_NODE).all(axis=1)
    dark = np.unique(np.ravel_multi_index(tuple(closest[on_a_node].T), spec.shape))
    rows = rows[lit]
    scale, shift = _level_units(nodes)
    channels = samples.light.shape[1] if samples.channels.mixable else 0
    near: NDArray[np.integer] = np.empty(len(rows), np.int32 if len(nodes) < 1 << 31 else np.int64)
    ids = np.empty(len(rows), np.uint64)
    place, variance = np.empty((len(rows), 8), np.float32), np.empty(len(rows), np.float32)
    each = np.empty((len(rows), channels), np.float32)
    for first in range(0, len(rows), _BLOCK):
        here = slice(first, first + _BLOCK)
        part = samples[rows[here]]  # queries are computed here if only numbers of nodes are kept
        queries, (index, closest) = part.queries, _next_to(spec, part.queries.point)
        near[here], ids[here] = np.ravel_multi_index(tuple(closest.T), spec.shape), queries.id
        slope = np.zeros(len(part))
        slopes(volume.stored, volume.spacing, spec.spacing, world_to_index(volume, queries.point), slope)
        place[here] = np.column_stack(
            [
                index, (volume.to_stored(queries.level[:, nodes.number]) - shift) * scale,
                queries.normal @ volume.direction, slope * scale,
            ]
        )  # fmt: skip
        variance[here] = np.square(part.error, dtype=np.float64)
        if (errors := part.errors) is not None:
            each[here] = np.square(errors)
    order = np.lexsort((ids, near))
    light = np.asarray(samples.light[rows[order]], np.float32)
    return Sorted(near[order], place[order], light, variance[order], each[order], dark)


def _level_units(nodes: Nodes) -> tuple[float, float]:
    """Scale and origin that map stored values to shares of the range, for which single precision is enough."""
    low, high = nodes.field.stored_range
    return 1.0 / float(high - low), float(low)


@dataclass(frozen=True)
class Bilateral:
    """Moving least squares with the weights of a joint bilateral filter, on a grid denser than the samples.

    Weights fall with the distance of a sample, of its level set from the node's, and with the angle between the
    normals. Made for `direct`: lit nodes are read once, at the nodes of a denser grid, which is displayed trilinearly.

    Parameters
    ----------
    density : float
        Stored nodes along an axis for each lit one, 1 to 8.

    References
    ----------
    .. [1] E. Eisemann, F. Durand, "Flash photography enhancement via intrinsic relighting", ACM TOG 23(3), 2004.
    .. [2] G. Petschnigg et al., "Digital photography with flash and no-flash image pairs", ACM TOG 23(3), 2004.
    .. [3] P. Lancaster, K. Salkauskas, "Surfaces generated by moving least squares methods", Mathematics of Computation
           37, 1981.
    """

    name: ClassVar[str] = "bilateral"
    density: float = 2.0

    def __post_init__(self) -> None:
        if not 1 <= self.density <= 8:
            raise BadInput(f"bilateral.density is {self.density}; expected 1 to 8 stored nodes for each lit one")

    def fill(self, samples: Samples, nodes: Nodes) -> IlluminationGrid:
        """Fill a grid of `density` times the nodes: see `illumgrid.stages.Interpolator`."""
        dense = Nodes(denser(nodes.spec, self.density), nodes.field, nodes.number)
        wanted = reached(nodes.field, dense.spec).reshape(-1)

        def within(ends: slice) -> tuple[NDArray[np.intp], NDArray[np.integer]]:
            flat = ends.start + np.flatnonzero(wanted[ends])
            return flat, flat

        found = _empty(len(dense), samples)
        _read(samples, nodes, dense, within, found)
        light, error, support, errors = found
        return dense.grid(light, error, support, samples.channels, errors if errors.shape[1] else None)


Found = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""Light (n, C), error (n,), support (n,); error of each channel, (n, C) where they are mixed later, else (n, 0)."""


def _empty(count: int, samples: Samples) -> Found:
    """Nodes without light."""
    channels = samples.light.shape[1]
    each = np.full((count, channels if samples.channels.mixable else 0), np.inf, np.float32)
    light, support = np.zeros((count, channels), np.float32), np.zeros(count, np.float32)
    return light, np.full(count, np.inf, np.float32), support, each


def read(
    samples: Samples, nodes: Nodes, dense: Nodes, flat: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32] | None]:
    """Light (n, C), error (n,) and support (n,) at the nodes (n,) of `dense` with the numbers `flat`, and `errors`.

    The samples lie around `nodes`, the lattice that was lit. `errors` (n, C) are those of each channel where several
    layers are mixed later, else None.
    """

    def within(ends: slice) -> tuple[NDArray[np.intp], NDArray[np.integer]]:
        rows = np.flatnonzero((flat >= ends.start) & (flat < ends.stop))
        return rows, flat[rows]

    found = _empty(len(flat), samples)
    _read(samples, nodes, dense, within, found)
    light, error, support, errors = found
    return light, error, support, errors if errors.shape[1] else None


def _read(
    samples: Samples, nodes: Nodes, dense: Nodes,
    within: Callable[[slice], tuple[NDArray[np.intp], NDArray[np.integer]]], out: Found,
) -> None:  # fmt: skip
    """Read slab by slab; `within` says which nodes of `dense` to read among some, and in which rows of `out`.

    Only the samples around a slab are held in order; those that the next one reads as well are kept.
    """
    from illumgrid.grid.reading import MOVED

    spec, stored = nodes.spec, dense.spec.shape
    none, done = np.zeros(0, np.intp), 0
    around: list[NDArray[Any]] = [*_in_order(samples, none, nodes)]
    ratio = (spec.shape[0] - 1) / (stored[0] - 1)
    reach = 2.5 + MOVED * (spec.shape[0] - 1) / (nodes.field.volume.shape[0] - 1) + 1e-6
    each = stored[1] * stored[2]
    thick = max(1, _SLAB * stored[0] // max(len(samples), 1))
    plane = _planes(samples, spec) if thick < stored[0] else np.zeros(len(samples), np.int16)
    with ThreadPoolExecutor(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None) as pool:
        for first in range(0, stored[0], thick):
            last = min(first + thick, stored[0]) - 1
            rows, flat = within(slice(first * each, (last + 1) * each))
            if not len(rows):
                continue
            low = max(0, int(np.ceil(first * ratio - reach)))
            high = min(int(np.floor(last * ratio + reach)) + 1, spec.shape[0])
            fresh = [  # a mask of all would take as much as their planes
                k + np.flatnonzero((plane[k : k + _BLOCK] >= max(done, low)) & (plane[k : k + _BLOCK] < high))
                for k in range(0, len(plane), _BLOCK)
            ]
            some = _in_order(samples, np.concatenate([none, *fresh]), nodes)
            _go_on(around, some, low * spec.shape[1] * spec.shape[2])
            done = high
            for whole, here in zip(out, _read_slab(Sorted(*around), nodes, dense, flat, pool)):
                whole[rows] = here


def _go_on(around: list[NDArray[Any]], fresh: Sorted, flat: int) -> None:
    """Leave out the samples next to nodes before this number, and add those of later planes, an array at a time."""
    first, first_dark = np.searchsorted(around[0], flat), np.searchsorted(around[-1], flat)
    for k, array in enumerate(fresh):
        around[k] = np.concatenate([around[k][first_dark if k == len(fresh) - 1 else first :], array])


def _read_slab(
    around: Sorted, nodes: Nodes, dense: Nodes, flat: NDArray[np.integer], pool: ThreadPoolExecutor
) -> Found:
    """What is found at some nodes of `dense` among the samples around them."""
    from illumgrid.grid.reading import fill

    near, place, light, variance, each, dark = around
    spec, field = nodes.spec, nodes.field
    start = np.zeros(spec.shape[0] * spec.shape[1] + 1, np.int64)
    np.cumsum(np.bincount(near // spec.shape[2], minlength=len(start) - 1), out=start[1:])
    column = (near % spec.shape[2]).astype(np.int32)
    volume, (scale, shift) = field.volume, _level_units(nodes)
    ratio = (np.array(spec.shape) - 1.0) / (np.array(volume.shape) - 1.0)
    out = np.zeros((len(flat), light.shape[1]), np.float32)
    error, support = np.full(len(flat), np.inf, np.float32), np.zeros(len(flat), np.float32)
    errors = np.full((len(flat), each.shape[1]), np.inf, np.float32)

    def chunk(some: slice) -> None:
        index = np.unravel_index(flat[some], dense.spec.shape)
        fill(
            volume.stored, volume.spacing, field.upward, field.stored_range, scale, shift,
            start, column, place, light, variance, each, dark,
            np.array(spec.shape), ratio, np.stack(index, axis=1) * (dense.spec.spacing / volume.spacing),
            out[some], error[some], errors[some], support[some],
        )  # fmt: skip

    chunk(slice(0, 0))  # compiles once, in the main thread, which Ctrl-C interrupts
    list(pool.map(chunk, (slice(i, i + _CHUNK) for i in range(0, len(flat), _CHUNK))))
    return out, error, support, errors


def denser(spec: GridSpec, density: float) -> GridSpec:
    """The lattice over the same box with `density` times as many steps along each axis."""
    steps = np.array(spec.shape) - 1
    more = np.maximum(1, np.round(density * steps)).astype(int)
    shape = (int(more[0]) + 1, int(more[1]) + 1, int(more[2]) + 1)
    return GridSpec(shape, spec.origin, spec.spacing * steps / more, spec.direction)


@hookimpl
def register_interpolators() -> list[type[Interpolator]]:
    """Register the stage of this file, as a plugin does."""
    return [Bilateral]
