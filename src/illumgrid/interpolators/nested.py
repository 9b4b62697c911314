"""Nodes that were lit in a lattice of which not all were, and light between the others."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.grid import IlluminationGrid, Nodes
from illumgrid.grid.nested import coarser, doubled
from illumgrid.interpolators.bilateral import read
from illumgrid.interpolators.nearest import Nearest
from illumgrid.transport.samples import Samples

NUMBER = np.uint64((1 << 40) - 1)
"""The bits of the id of a query of `direct` that hold the number of its node."""


@dataclass(frozen=True)
class Nested:
    """Light at some nodes of a lattice: every 2**levels-th along each axis, and finer ones where light is rough.

    A lit node reads the lit nodes of its level around it by place, level and normal: see `Bilateral`. Other nodes take
    the light between those of the next coarser level, linearly.

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
        """Fill every node; the ids of the samples are those of `direct`: see `illumgrid.stages.Interpolator`."""
        number = (samples.queries.id & NUMBER).astype(np.int64)
        place = np.stack(np.unravel_index(number, nodes.spec.shape), axis=1)
        grid: IlluminationGrid | None = None
        for level in range(self.levels, -1, -1):
            own = Nodes(coarser(nodes.spec, level), nodes.field, nodes.number)
            at = np.flatnonzero((place % 2**level == 0).all(axis=1))
            flat = np.ravel_multi_index(tuple((place[at] >> level).T), own.spec.shape)
            grid = _level(samples[at], own, flat, grid)
        assert grid is not None
        return grid


def _level(samples: Samples, nodes: Nodes, flat: NDArray[np.int64], below: IlluminationGrid | None) -> IlluminationGrid:
    """Grid of one level from the samples at its nodes `flat`, and from the level below."""
    light, error, support = read(samples, nodes, nodes, flat)
    errors = None
    if samples.errors is not None:  # of each channel: they shrink as the whole error does
        errors = np.full(light.shape, np.inf, np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            less = np.where(samples.error > 0, error[flat] / samples.error, 1.0)
            errors[flat] = np.nan_to_num(samples.errors * less[:, None], nan=np.inf, posinf=np.inf)
    if below is None:
        rim, there = Nearest().fill(samples, nodes), support == 0  # nodes at the rim, without a point of their own
        light[there], error[there] = rim.light.reshape(light.shape)[there], rim.error.reshape(-1)[there]
        support[there] = rim.support.reshape(-1)[there]
        if errors is not None and rim.errors is not None:
            errors[there] = rim.errors.reshape(errors.shape)[there]
        return nodes.grid(light, error, support, samples.channels, errors)
    own = np.zeros(len(nodes), bool)
    own[flat] = support[flat] > 0  # a hole shows what is between its neighbours
    between, low, high = ~own, *nodes.field.range
    level = samples.queries.level[:, nodes.number]
    hole = flat[(support[flat] == 0) & (level > low) & (level < high)]
    light[between] = doubled(below.light).reshape(light.shape)[between]
    # Between nodes a lookup was as far off as `bar` says; so are nodes that hold what it read.
    error[between] = doubled(below.bar).reshape(-1)[between]
    support[between] = doubled(below.support, least=True).reshape(-1)[between]
    error[hole], support[hole] = np.inf, 0.0
    if errors is not None and below.errors is not None:
        errors[between] = doubled(below.errors).reshape(errors.shape)[between]
        errors[hole] = np.inf
    shape = nodes.spec.shape
    each = None if errors is None else errors.reshape(*shape, -1)
    return IlluminationGrid(
        nodes.spec, light.reshape(*shape, -1), error.reshape(shape), support.reshape(shape), samples.channels, each
    )
