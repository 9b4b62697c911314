"""Converged light at points that nobody asked for, and how far a grid is from it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.bake import light_left_out
from illumgrid.field.scene import Field, Scene
from illumgrid.field.volume import Floats, cell_gradient, index_to_world, interpolate
from illumgrid.grid import IlluminationGrid
from illumgrid.stages import Backend, on_level_sets
from illumgrid.transport.samples import Queries, Samples, combine, join_queries
from illumgrid.transport.tracer import prepare

MOST_BOUNCES = 128
_STEPS = 64  # of the isovalue, within which points are uniform by area


def apart(seed: int) -> int:
    """A seed whose paths have nothing in common with those of `seed`."""
    return (seed + 2**63) % 2**64


@dataclass(frozen=True, eq=False)
class Truth:
    """Light at unseen points, with its own error: two halves from independent seeds tell it by how they differ.

    The error bars of the samples do not: they are made to cover, and where light comes by few paths that is more.

    Parameters
    ----------
    halves : (Samples, Samples)
        Answers from many paths; no holes.
    bounces : int
        Reflections that were followed.
    surface : str
        The stand-in for the level sets that the light met: "levelset" (trilinear) or "mesh" (marching cubes).
    """

    halves: tuple[Samples, Samples]
    bounces: int
    surface: str = "levelset"

    def __len__(self) -> int:
        return len(self.halves[0])

    def __getitem__(self, rows: Any) -> "Truth":
        """Some of the points, by a slice, numbers or a mask."""
        one, other = self.halves
        return replace(self, halves=(one[rows], other[rows]))

    @property
    def queries(self) -> Queries:
        """The points."""
        return self.halves[0].queries

    @property
    def paths(self) -> int:
        """Paths from each point, of both halves."""
        return 2 * int(self.halves[0].paths[0]) if len(self) else 0

    @property
    def light(self) -> Floats:
        """Irradiance (n, 3)."""
        one, other = self.halves
        return (one.mean.astype(float) + other.mean) / 2

    @property
    def off(self) -> Floats:
        """By how much (n, 3) either half is off their mean: its square has the variance of that for its expectation."""
        one, other = self.halves
        return (one.mean.astype(float) - other.mean) / 2

    @property
    def mean(self) -> float:
        """Mean irradiance over points and colours, to which errors are relative."""
        return float(self.light.mean())

    @property
    def error(self) -> float:
        """Root mean square error of the truth itself, relative to the mean irradiance."""
        return float(np.sqrt((self.off**2).mean())) / self.mean


@dataclass(frozen=True)
class Errors:
    """How far a grid is from the truth, all relative to the mean irradiance.

    Parameters
    ----------
    rmse : float
        Root mean square over points and colours, the truth's own variance subtracted; at least a third of the truth's
        own error, since less could not be told from none.
    median, p95 : float
        Median and 95th percentile over points of the root mean square over colours.
    bias : float
        Mean difference; below 0 the grid is too dark.
    """

    rmse: float
    median: float
    p95: float
    bias: float


def unseen_on_level_sets(scene: Scene, levels: int, points: int, seed: int) -> Queries:
    """Points uniform by area on level sets that are drawn apart: one at random from each of `levels` equal steps.

    Returns
    -------
    Queries
        About `points` in all, on the trilinear level sets; every level set and field has as many.
    """
    random = np.random.default_rng((apart(seed), 1))
    rows = scene.levels((np.arange(levels) + random.random(levels)) / levels)
    each = max(1, round(points / (levels * len(scene.fields))))
    found = join_queries(list(on_level_sets(scene, rows, apart(seed), points=each)))
    return found[np.flatnonzero(found.normal.any(axis=1))]


def unseen_in_volume(scene: Scene, points: int, seed: int) -> Queries:
    """As `unseen_on_level_sets`, but each point on a level set of its own, and no surface is extracted.

    By the co-area formula, points of a volume weighted by |∇h| are uniform by area on the level sets through them;
    weights that add up to the same within each of 64 equal steps of the range make them uniform in the isovalue.
    """
    found = []
    for number, field in enumerate(scene.fields):
        random = np.random.default_rng((apart(seed), 2, number))
        cells, chance = _cells_by_step(field)
        if not len(cells):
            continue
        upto = np.cumsum(chance)
        tried = np.searchsorted(upto, random.random(max(1 << 15, 64 * points)) * upto[-1]).clip(0, len(cells) - 1)
        shape = tuple(n - 1 for n in field.volume.shape)
        index = np.stack(np.unravel_index(cells[tried], shape), axis=1) + random.random((len(tried), 3))
        share = field.place(interpolate(field.volume, index))
        kept = (share >= 0) & (share <= 1)
        index, step = index[kept], np.minimum(share[kept] * _STEPS, _STEPS - 1).astype(int)
        weight = np.linalg.norm(cell_gradient(field.volume, index), axis=1) / chance[tried[kept]]
        total = np.bincount(step, weight, minlength=_STEPS)
        weight = weight / np.where(total > 0, total, 1.0)[step]
        if weight.any():
            # Systematic draws from the points in order of isovalue: the same number from every step, or nearly.
            order = np.argsort(step, kind="stable")
            mass = np.cumsum(weight[order]) / weight.sum()
            chosen = order[np.searchsorted(mass, (np.arange(points) + random.random()) / points).clip(0, len(mass) - 1)]
            world = index_to_world(field.volume, index[np.unique(chosen)])
            found.append(Queries.at(scene, world, field=number, first_id=number << 40))
    if not found:
        return Queries.at(scene, np.zeros((0, 3)))
    asked = join_queries(found)
    return asked[np.flatnonzero(asked.normal.any(axis=1))]


def _cells_by_step(field: Field) -> tuple[NDArray[np.int64], Floats]:
    """Flat numbers (n,) of the voxel cells that the range crosses, and chances (n,) that give every step as many.

    Chosen all alike, the few cells around a small level set would hardly be met.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    lowest, highest = map(float, field.range)
    share = field.volume.values - lowest  # of this size there is one array, single like the field
    share *= _STEPS / (highest - lowest)
    np.clip(np.floor(share, out=share), -1, _STEPS, out=share)
    step = share.astype(np.int8)
    # Of the corners of each cell.
    low, high = (of(step, 2, origin=-1)[:-1, :-1, :-1] for of in (minimum_filter, maximum_filter))
    first, last = np.maximum(low, 0).reshape(-1), np.minimum(high, _STEPS - 1).reshape(-1)
    cells = np.flatnonzero(first <= last)
    first, last = first[cells], last[cells].astype(int) + 1
    many = np.cumsum(np.bincount(first, minlength=_STEPS + 1) - np.bincount(last, minlength=_STEPS + 1))
    rare = np.concatenate([[0.0], np.cumsum(1.0 / np.maximum(many, 1))])
    return cells, rare[last] - rare[first]


def enough(scene: Scene, backend: Backend, tolerance: float, seed: int) -> int:
    """Reflections beyond which less than `tolerance` of all light is left out."""
    bounces, tracer = 8, prepare(backend, scene)
    while bounces < MOST_BOUNCES and light_left_out(scene, tracer, bounces, seed) > tolerance:
        bounces *= 2
    return bounces


def trace(
    scene: Scene, backend: Backend, asked: Queries, paths: range, bounces: int, seed: int
) -> tuple[Samples, Samples]:
    """Answers from two seeds, by paths that no run of `seed` walks; holes (points inside another solid) stay in.

    Each seed walks half of the paths, whose limits are even.
    """
    half = range(paths.start // 2, paths.stop // 2)
    one, other = (
        backend.solve(scene, asked, paths=half, bounces=bounces, seed=(apart(seed) + k * 2**61) % 2**64) for k in (0, 1)
    )
    return one, other


def begin(scene: Scene, backend: Backend, asked: Queries, bounces: int, seed: int, paths: int = 64) -> Truth:
    """Trace a few paths from each point; points inside another field's solid are left out."""
    found = Truth(trace(scene, backend, asked, range(paths), bounces, seed), bounces)
    return found[found.halves[0].paths > 0]


def converge(truth: Truth, scene: Scene, backend: Backend, seed: int, error: float, paths: int = 1 << 14) -> Truth:
    """Go on until the truth's own relative error is at most `error`, or `paths` paths from each point are spent."""
    while len(truth) and truth.error > error and truth.paths < paths:
        more = trace(scene, backend, truth.queries, range(truth.paths, 2 * truth.paths), truth.bounces, seed)
        one, other = (combine(before, after) for before, after in zip(truth.halves, more))
        truth = replace(truth, halves=(one, other))
    return truth


def look_up(grids: Sequence[IlluminationGrid], asked: Queries) -> Floats:
    """Light (n, 3) that the grids hold at the points of queries, each in the grid of its field."""
    light = np.zeros((len(asked), 3))
    for number, grid in enumerate(grids):
        own = asked.target == number
        light[own] = grid.lookup(asked.point[own])
    return light


def errors(light: Floats, truth: Truth) -> Errors:
    """How far `light` (n, 3), looked up at the points of a truth, is from it."""
    off = (light - truth.light) / truth.mean
    each = np.sqrt((off**2).mean(axis=1))
    return Errors(
        rmse=float(np.sqrt(max(truth.error**2 / 9, (off**2).mean() - truth.error**2))),
        median=float(np.median(each)),
        p95=float(np.quantile(each, 0.95)),
        bias=float(off.mean()),
    )
