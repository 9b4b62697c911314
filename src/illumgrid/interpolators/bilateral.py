"""Each node reads the samples around it by place, level and normal: a joint bilateral filter, linear in space."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.lattice import GridSpec
from illumgrid.field.volume import world_to_index
from illumgrid.grid import IlluminationGrid, Nodes
from illumgrid.grid.nodes import reachable
from illumgrid.stages import Interpolator, hookimpl
from illumgrid.transport.samples import Samples

_BLOCK = 1 << 14
_ON_A_NODE = 1e-6  # of a spacing


class Bins(NamedTuple):
    """Samples of one field sorted by the node of the lit lattice that they are next to."""

    start: NDArray[np.int64]  # (rows + 1,) of each row of nodes along z
    column: NDArray[np.int32]  # (m,) node in the row
    place: NDArray[np.float32]  # (m, 8): see `illumgrid.grid.reading.estimate`
    light: NDArray[np.float32]  # (m, C)
    variance: NDArray[np.float32]  # (m,)
    each: NDArray[np.float32]  # (m, C) of each channel where they are mixed later, else (m, 0)
    dark: NDArray[np.int64]  # flat numbers of the holes of the lit lattice, in order


def bins(samples: Samples, nodes: Nodes) -> Bins:
    """Sort samples into the nodes' lattice, some at a time; holes are left out, and marked."""
    from illumgrid.grid.reading import slopes

    spec, volume = nodes.spec, nodes.field.volume
    rows, nz = spec.shape[0] * spec.shape[1], spec.shape[2]
    scale, shift = _level_units(nodes)
    count, channels = len(samples), samples.light.shape[1] if samples.channels.mixable else 0
    flat, dark = np.empty(count, np.int32 if len(nodes) < 1 << 31 else np.int64), [np.zeros(0, np.int64)]
    place, variance = np.empty((count, 8), np.float32), np.empty(count, np.float32)
    each = np.empty((count, channels), np.float32)
    for first in range(0, count, _BLOCK):
        part = samples[first : first + _BLOCK]  # its queries are computed here, where only numbers of nodes are kept
        queries, index = part.queries, world_to_index(spec, part.queries.point)
        closest = np.clip(np.round(index), 0, np.array(spec.shape) - 1).astype(np.int64)
        nearest = np.ravel_multi_index(tuple(closest.T), spec.shape)
        lit = part.paths > 0
        dark.append(nearest[~lit & (np.abs(index - closest) < _ON_A_NODE).all(axis=1)])
        good = np.flatnonzero(lit)
        slope, here = np.zeros(len(good)), first + good
        slopes(volume.stored, volume.spacing, spec.spacing, world_to_index(volume, queries.point[good]), slope)
        place[here] = np.column_stack(
            [
                index[good], (volume.to_stored(queries.level[good, nodes.number]) - shift) * scale,
                queries.normal[good] @ volume.direction, slope * scale,
            ]
        )  # fmt: skip
        flat[first : first + _BLOCK] = nearest
        variance[here] = np.square(part.error[good], dtype=np.float64)
        if (errors := part.errors) is not None:
            each[here] = np.square(errors[good])
    good = np.flatnonzero(samples.paths > 0)
    good = good[np.lexsort((samples.queries.id[good], flat[good]))]
    start, near = np.zeros(rows + 1, np.int64), flat[good]
    np.cumsum(np.bincount(near // nz, minlength=rows), out=start[1:])
    light = np.ascontiguousarray(samples.light[good], np.float32)
    place, variance, each = (_in_order(array, good) for array in (place, variance, each))
    return Bins(start, (near % nz).astype(np.int32), place, light, variance, each, np.unique(np.concatenate(dark)))


def _in_order(array: NDArray[np.float32], rows: NDArray[np.integer]) -> NDArray[np.float32]:
    """Rows of an array in this order, sorted where they are, one column at a time."""
    for column in np.atleast_2d(array.T):
        column[: len(rows)] = column[rows]
    return array[: len(rows)]


def _level_units(nodes: Nodes) -> tuple[float, float]:
    """What turns stored values into shares of the range, in which single precision is enough."""
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
        flat = reachable(nodes.field, dense.spec)
        return dense.grid_of(flat, list(read(samples, nodes, dense, flat)), samples.channels)


def read(
    samples: Samples, nodes: Nodes, dense: Nodes, flat: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32] | None]:
    """Light (n, C), error (n,) and support (n,) at the nodes (n,) of `dense` with the numbers `flat`, and `errors`.

    The samples lie around `nodes`, the lattice that was lit. `errors` (n, C) are those of each channel where several
    layers are mixed later, else None.
    """
    from illumgrid.grid.reading import fill

    sorted_ = bins(samples, nodes)
    spec, field = nodes.spec, nodes.field
    light = np.zeros((len(flat), samples.light.shape[1]), np.float32)
    error, support = np.full(len(flat), np.inf, np.float32), np.zeros(len(flat), np.float32)
    errors = np.full((len(flat), sorted_.each.shape[1]), np.inf, np.float32)
    volume, (scale, shift) = field.volume, _level_units(nodes)
    ratio = (np.array(spec.shape) - 1.0) / (np.array(volume.shape) - 1.0)

    def chunk(some: slice) -> None:
        index = np.unravel_index(flat[some], dense.spec.shape)
        fill(
            volume.stored, volume.spacing, field.upward, field.stored_range, scale, shift, *sorted_,
            np.array(spec.shape), ratio, np.stack(index, axis=1) * (dense.spec.spacing / volume.spacing),
            light[some], error[some], errors[some], support[some],
        )  # fmt: skip

    chunk(slice(0, 0))  # compiles once, in the main thread, which Ctrl-C interrupts
    with ThreadPoolExecutor(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None) as pool:
        list(pool.map(chunk, (slice(i, i + _BLOCK) for i in range(0, len(flat), _BLOCK))))
    return light, error, support, errors if errors.shape[1] else None


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
