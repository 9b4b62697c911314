"""A lattice of which only some nodes were lit: filtered light at these, interpolated light at the others."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.grid import IlluminationGrid, Nodes
from illumgrid.grid.blocks import answer, beside_coarser, boxes, in_cells, laid_out, put
from illumgrid.grid.illumination import Held
from illumgrid.grid.nested import all_corners, coarser
from illumgrid.interpolators.bilateral import read
from illumgrid.interpolators.neighbours import diagonal
from illumgrid.transport.samples import Samples

NUMBER = np.uint64((1 << 40) - 1)
"""The bits of the id of a query of `direct` that hold the number of its node."""

BLOCKS = 256
"""Blocks whose indices are held at a time."""


@dataclass(frozen=True)
class Nested:
    """Light at some nodes of a lattice: every 2**levels-th along each axis, and finer ones where light is rough.

    A lit node averages the lit nodes of its lattice around it by position, level and normal: see `Bilateral`. Other
    nodes are interpolated linearly from the next coarser lattice.

    Parameters
    ----------
    levels : int
        How often the spacing was halved, 0 to 4.
    """

    name: ClassVar[str] = "nested"
    levels: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.levels <= 4:
            raise BadInput(f"nested.levels is {self.levels}; expected 0 to 4")

    def fill(self, samples: Samples, nodes: Nodes) -> IlluminationGrid:
        """Fill blocks of nodes; the ids of the samples are those of `direct`: see `illumgrid.stages.Interpolator`."""
        number = (samples.queries.id & NUMBER).astype(np.int64)
        place = np.stack(np.unravel_index(number, nodes.spec.shape), axis=1)
        known = Samples(samples.queries[:], samples.light, samples.spread, samples.paths, samples.channels)
        grid: IlluminationGrid | None = None
        for level in range(self.levels, -1, -1):
            on = np.flatnonzero((place % 2**level == 0).all(axis=1))
            grid = _level(known[on], place[on], nodes, level, grid)
        assert grid is not None
        return grid


def _level(
    samples: Samples, place: NDArray[np.int64], nodes: Nodes, level: int, below: IlluminationGrid | None
) -> IlluminationGrid:
    """Grid of the blocks down to one level, from the samples at its nodes (n, 3) and from `below`, the coarser grid."""
    own, step = Nodes(coarser(nodes.spec, level), nodes.field, nodes.number), 2**level
    if below is None:
        return _coarsest(samples, place, nodes, own, step)
    fresh = (place % (2 * step) != 0).any(axis=1)
    held = below.held
    corner = boxes(place[fresh], nodes.spec.shape, step)
    layout = laid_out(
        nodes.spec.shape, np.concatenate([held.layout.corner, corner]),
        np.concatenate([held.layout.step, np.full(len(corner), step)]),
    )  # fmt: skip
    mine = np.flatnonzero(_around(fresh, place, nodes, step))
    mine = mine[~beside_coarser(layout, place[mine], step)]
    # Other nodes are interpolated from the coarser grid, and have the error `bar` of a lookup there.
    old = held.light, held.error, held.support
    light, error, support = (np.empty((len(layout), *array.shape[1:]), np.float32) for array in old)
    for array, below_here in zip((light, error, support), old):
        array[: len(held.layout)] = below_here
    bars = below.bars
    for first in range(len(held.layout), len(layout), BLOCKS):
        some = slice(first, first + BLOCKS)
        between = answer(held.layout, held.light, bars, held.support, layout.place(some))
        for array, here in zip((light, error, support), between):
            array[some] = here.reshape(-1, *array.shape[1:])
    found = read(samples, own, own, np.ravel_multi_index(tuple((place[mine] // step).T), own.spec.shape))[:3]
    lit, low, high = found[2] > 0, *nodes.field.range
    isovalue = samples.queries[mine].level[:, nodes.number]
    hole = mine[~lit & (isovalue > low) & (isovalue < high)]  # has light interpolated from its neighbours
    put(layout, place[mine[lit]], step, (light, error, support), [part[lit] for part in found])
    put(layout, place[hole], step, (error, support), (np.inf, 0.0))
    return IlluminationGrid(nodes.spec, channels=samples.channels, held=Held(layout, light, error, support))


def _coarsest(samples: Samples, place: NDArray[np.int64], nodes: Nodes, own: Nodes, step: int) -> IlluminationGrid:
    """Grid of blocks of the coarsest level, where all corners of a cell were lit."""
    from scipy.spatial import KDTree

    flat = np.ravel_multi_index(tuple((place // step).T), own.spec.shape)
    light, error, support, _ = read(samples, own, own, flat)
    dark, lit = np.flatnonzero(support == 0), np.flatnonzero(samples.paths > 0)
    if len(dark) and len(lit):  # rim nodes without a point of their own have the light of the nearest sample
        tree = KDTree(samples.queries.point[lit] - own.spec.origin)
        far, sample = tree.query(own.spec.nodes(flat[dark]) - own.spec.origin, distance_upper_bound=diagonal(own.spec))
        dark, sample = dark[np.isfinite(far)], lit[sample[np.isfinite(far)]]
        light[dark], error[dark], support[dark] = samples.light[sample], samples.error[sample], 1.0
    whole = own.grid_of(flat, [light, error, support, None], samples.channels)
    asked = np.zeros(own.spec.shape, bool)
    asked.reshape(-1)[flat] = True
    layout = in_cells(nodes.spec.shape, all_corners(asked), step)
    index = np.minimum(layout.place(slice(None)) // step, np.array(own.spec.shape) - 1)
    shape, at = (-1, *layout.side + 1), tuple(np.moveaxis(index, -1, 0))
    light, error, support = (
        array[at].reshape(*shape, *array.shape[3:]) for array in (whole.light, whole.error, whole.support)
    )
    return IlluminationGrid(nodes.spec, channels=samples.channels, held=Held(layout, light, error, support))


def _around(fresh: NDArray[np.bool_], place: NDArray[np.int64], nodes: Nodes, step: int) -> NDArray[np.bool_]:
    """Which nodes (n, 3) are `fresh`, new at this level, or next to one: those of the cells that are refined here."""
    near = np.zeros(np.array(nodes.spec.shape) // step + 1, bool)
    near[tuple((place[fresh] // step).T)] = True
    for axis in range(3):
        line = np.moveaxis(near, axis, 0)
        beside = line.copy()
        beside[1:] |= line[:-1]
        beside[:-1] |= line[1:]
        near = np.moveaxis(beside, 0, axis)
    return np.asarray(near[tuple((place // step).T)])
