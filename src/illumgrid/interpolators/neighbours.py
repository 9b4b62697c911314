"""The samples around a node: the nearest ones on both level sets between which it lies."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.volume import Floats, world_to_index
from illumgrid.grid import GridSpec, IlluminationGrid, Nodes
from illumgrid.transport.samples import Samples

_SLAB = 1 << 16  # nodes per search: bounds the memory
_ONE_PLACE = 1e-6  # of a node spacing: closer samples are merged
BETWEEN = 4.0
"""Reach of a node between two level sets: distance to the nearest sample, in cell diagonals."""


def diagonal(spec: GridSpec) -> float:
    """Diagonal of a grid cell plus a margin for rounding: the reach of a sample."""
    return float(np.linalg.norm(spec.spacing)) * (1 + 1e-6)


def near_samples(spec: GridSpec, parts: Iterable[Floats], reach: float) -> NDArray[np.bool_]:
    """Nodes (nx, ny, nz) that may have a world point of some arrays (n, 3) within `reach` along each axis."""
    from scipy.ndimage import maximum_filter

    taken = np.zeros(spec.shape, bool)
    for points in parts:
        index = np.round(world_to_index(spec, points))
        taken[tuple(np.clip(index, 0, np.array(spec.shape) - 1).astype(np.int64).T)] = True
    # A point is at most half a node spacing from the node that it is rounded to.
    width = 2 * np.ceil(reach / spec.spacing + 0.5).astype(int) + 1
    return np.asarray(maximum_filter(taken, size=tuple(width), mode="constant"))


@dataclass(frozen=True, eq=False)
class Sites:
    """Distinct points with their light.

    Parameters
    ----------
    point : (n, 3) float64
        Relative to the grid's origin, along the world's axes: differences of large world coordinates would lose digits.
    normal : (n, 3) float64
    sheet : (n,) int64
        0 or 1, alternating over the isovalues of the run.
    mean, variance : (n, C), (n,) float64
    variances : (n, C) float64 or None
        Of each channel, where several layers are mixed later.
    paths : (n,) float64
    shown : int
        How many of the first channels are light as it is shown; the others are layers of it.
    """

    point: Floats
    normal: Floats
    sheet: NDArray[np.int64]
    mean: Floats
    variance: Floats
    variances: Floats | None
    paths: Floats
    shown: int


def sites(samples: Samples, nodes: Nodes) -> Sites:
    """Samples that are not holes; coincident ones are merged, weighted by their paths."""
    spec, good = nodes.spec, samples[samples.paths > 0]
    point = good.queries.point - spec.origin
    place = np.round(point / (_ONE_PLACE * spec.spacing.min())).astype(np.int64)
    order = np.lexsort(place.T)
    new = np.ones(len(order), bool)
    new[1:] = (np.diff(place[order], axis=0) != 0).any(axis=1)
    group = np.zeros(len(order), np.int64)
    group[order] = np.cumsum(new) - 1
    first = order[new]
    count = len(first)
    paths = good.paths.astype(float)
    total = np.asarray(np.bincount(group, paths, count), float)
    share = paths / total[group]
    mean: Floats = np.stack([np.bincount(group, share * light, count) for light in good.light.T], axis=1)
    variance = np.asarray(np.bincount(group, np.square(share * good.error), count), float)
    variances: Floats | None = None
    if (errors := good.errors) is not None:
        squares = np.square(share[:, None] * errors)
        variances = np.stack([np.bincount(group, square, count).astype(float) for square in squares.T], axis=1)
    levels = np.unique(good.queries.level[:, nodes.number])
    sheet = np.searchsorted(levels, good.queries.level[first, nodes.number]) % 2
    return Sites(
        point[first], good.queries.normal[first], sheet, mean, variance, variances, total, samples.channels.own
    )


class Neighbours(NamedTuple):
    """Sites around nodes within reach: m nodes, k neighbours each, in no particular order."""

    node: NDArray[np.integer]  # (m,) flat numbers
    point: Floats  # (m, 3) relative to the grid's origin
    site: NDArray[np.int64]  # (m, k)
    distance: Floats  # (m, k); infinite for a missing neighbour
    between: NDArray[np.bool_]  # (m,) in front of the nearest site of one sheet, behind that of the other


def neighbours(places: Sites, nodes: Nodes, count: int) -> Iterator[Neighbours]:
    """Up to `count` neighbours of each node within reach, half from each sheet so that neither hides the other.

    Sites that face away from the nearest one are left out: they belong to another surface with different light, such as
    the back of a slab or the wall across a cleft. A node is within reach if a site lies within a cell's diagonal, or if
    it lies in front of the nearest site of one sheet and behind that of the other, within `BETWEEN` diagonals.
    """
    from scipy.spatial import KDTree

    members = [m for sheet in (0, 1) if len(m := np.flatnonzero(places.sheet == sheet))]
    trees = [KDTree(places.point[m]) for m in members]
    each = -(-count // len(members)) if members else count
    spec, near = nodes.spec, diagonal(nodes.spec)
    candidates = np.flatnonzero(near_samples(spec, [places.point + spec.origin], BETWEEN * near))
    for block in nodes.blocks(candidates, _SLAB):
        node, point = block.flat, block.point - spec.origin
        distance, site = np.full((len(node), len(trees), each), np.inf), np.zeros((len(node), len(trees), each), int)
        for number, (member, tree) in enumerate(zip(members, trees)):
            asked = range(1, min(each, len(member)) + 1)
            found, which = tree.query(point, asked, distance_upper_bound=2 * BETWEEN * near, workers=-1)
            distance[:, number, : len(asked)] = found
            site[:, number, : len(asked)] = member[np.where(np.isfinite(found), which, 0)]
        rows = np.arange(len(node))
        closest = distance[:, :, 0].argmin(axis=1)
        facing = places.normal[site[rows, closest, 0]]
        away = np.einsum("mski,mi->msk", places.normal[site], facing) < 0
        distance[away] = np.inf
        ahead = distance.argmin(axis=2)
        first = np.take_along_axis(site, ahead[:, :, None], 2)[:, :, 0]
        side = np.einsum("msi,msi->ms", point[:, None] - places.point[first], places.normal[first])
        nearest = np.take_along_axis(distance, ahead[:, :, None], 2)[:, :, 0]
        between = np.isfinite(nearest).all(axis=1) & (side.min(axis=1) < 0) & (side.max(axis=1) > 0)
        reached = np.flatnonzero(nearest.min(axis=1) <= near * np.where(between, BETWEEN, 1.0))
        site, distance = (a.reshape(len(node), -1)[reached] for a in (site, distance))
        yield Neighbours(node[reached], point[reached], site, distance, between[reached])


def filled(
    samples: Samples, nodes: Nodes, count: int, weigh: Callable[[Sites, Neighbours], tuple[Floats, Floats]]
) -> IlluminationGrid:
    """Grid whose nodes are weighted sums of their neighbours.

    Parameters
    ----------
    count : int
        Maximum number of neighbours per node.
    weigh : callable
        Returns weights (m, k) that add up to 1, with 0 for a missing neighbour, and values (m, C).
    """
    light = np.zeros((len(nodes), samples.light.shape[1]), np.float32)
    error, support = np.full(len(nodes), np.inf, np.float32), np.zeros(len(nodes), np.float32)
    errors = None if samples.errors is None else np.full(light.shape, np.inf, np.float32)
    places = sites(samples, nodes)
    for around in neighbours(places, nodes, count):
        weight, light[around.node] = weigh(places, around)
        # Samples count as independent. If one has no known error (a single path), the node has none either.
        spread = np.where(weight != 0, places.variance[around.site], 0.0)
        square = np.square(weight)
        error[around.node] = np.sqrt((square * spread).sum(axis=1))
        support[around.node] = 1 / square.sum(axis=1)
        if errors is not None and places.variances is not None:
            each = np.where((weight != 0)[..., None], places.variances[around.site], 0.0)
            errors[around.node] = np.sqrt((square[..., None] * each).sum(axis=1))
    return nodes.grid(light, error, support, samples.channels, errors)
