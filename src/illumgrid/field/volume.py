"""A scalar field on a lattice of voxels, placed in the world.

Between voxels a volume is trilinear. Every level set in this package is a level set of the trilinear interpolant.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.constants import ON_A_VOXEL
from illumgrid.errors import BadInput, shown_range
from illumgrid.field.storing import as_stored

Floats = NDArray[np.float64]
Side = Literal["above", "below"]

UPWARD: dict[Side, float] = {"above": 1.0, "below": -1.0}
"""Sign with which the solid is where values are high: the solid of c is {UPWARD h >= UPWARD c}."""


class Lattice(Protocol):
    """Points on a lattice with origin, spacing and direction in the world: a Volume, a GridSpec."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of points along x, y, z."""

    @property
    def origin(self) -> Floats:
        """World position of index (0, 0, 0)."""

    @property
    def spacing(self) -> Floats:
        """World distance between neighbours along each axis."""

    @property
    def direction(self) -> Floats:
        """Columns are the world directions of the axes."""


def index_to_world(lattice: Lattice, index: ArrayLike) -> Floats:
    """World positions (n, 3) of fractional indices (n, 3): origin + direction · (spacing · index)."""
    return lattice.origin + (np.asarray(index, float) * lattice.spacing) @ lattice.direction.T


def world_to_index(lattice: Lattice, points: ArrayLike) -> Floats:
    """Fractional indices (n, 3) of world positions (n, 3), snapped to the voxel within `ON_A_VOXEL`."""
    index = ((np.asarray(points, float) - lattice.origin) @ lattice.direction) / lattice.spacing
    nearest = np.round(index)
    return np.where(np.abs(index - nearest) < ON_A_VOXEL, nearest, index)


def placement(origin: ArrayLike, spacing: ArrayLike, direction: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Validate the placement of a lattice; the returned direction is exactly orthonormal.

    Raises
    ------
    BadInput
        Unless the origin is finite, the spacing positive and the direction orthonormal (within 1e-3).
    """
    at, step, axes = (np.array(x, dtype=float) for x in (origin, spacing, direction))
    if at.shape != (3,) or not np.isfinite(at).all():
        raise BadInput(f"origin is {at.tolist()}; expected three finite numbers")
    if step.shape != (3,) or not np.isfinite(step).all() or not (step > 0).all():
        raise BadInput(f"spacing is {step.tolist()}; expected three positive numbers (a flip belongs in direction)")
    if axes.shape != (3, 3) or not np.isfinite(axes).all() or np.abs(axes.T @ axes - np.eye(3)).max() > 1e-3:
        raise BadInput(f"direction is {axes.tolist()}; expected a 3x3 matrix whose columns are orthonormal")
    u, _, v = np.linalg.svd(axes)
    nearest = u @ v
    # A direction that is orthonormal up to rounding is kept, so that round trips to disk do not change a volume.
    return at, step, axes if np.abs(axes @ axes.T - np.eye(3)).max() < 1e-14 else nearest


def states_place(origin: Floats, direction: Floats) -> bool:
    """Whether a file states a place or an orientation: without one, readers take identity axes at the origin."""
    return bool(origin.any() or (direction != np.eye(3)).any())


AT_ONCE = 1 << 22
"""Voxels that are examined together: bounds the memory."""


def slabs(shape: tuple[int, ...], most: int = AT_ONCE) -> Iterator[slice]:
    """Slices of the first axis, each of about `most` voxels, that together cover the whole array."""
    rows = max(1, most // max(1, int(np.prod(shape[1:]))))
    for first in range(0, shape[0], rows):
        yield slice(first, min(first + rows, shape[0]))


@dataclass(frozen=True, eq=False, init=False)
class Volume:
    """A scalar field h = slope · stored + intercept, sampled at voxel centres, compared by identity.

    Values of 8 or 16 bits and of single precision are stored as given, without a copy if they are in C order and equal
    h. If slope and intercept are whole numbers and h fits into as many bits, h is stored. Values of other types are
    stored in single precision. If rounding would then cost more than 1e-5 of the span of h (a large offset), or if h is
    beyond the range of single precision, values are mapped onto about -1 to 1; slope and intercept undo that.

    Parameters
    ----------
    values : (nx, ny, nz) array_like of real numbers
        At the voxel centres, axes x, y, z. At least two voxels along each axis.
    origin : (3,) array_like
        World position of voxel (0, 0, 0).
    spacing : (3,) array_like
        World distance between neighbouring voxels along each axis.
    direction : (3, 3) array_like
        Columns are the world directions of the axes, orthonormal; a determinant of -1 mirrors.
    slope, intercept : float
        h = slope · values + intercept. All isovalues are in the units of h.
    unit : str, optional
        Of the world coordinates, such as "mm" or "µm".
    stored : array_like, optional
        Used by ``dataclasses.replace`` in place of `values`.
    oriented : bool, optional
        Whether origin and direction determine which way is up. By default False if both are those of a file without
        orientation: identity axes at the world's origin. A part of such a file has another origin, but no orientation.

    Attributes
    ----------
    values : (nx, ny, nz) array
        h at the voxel centres, read-only: the stored array if the slope is 1 and the intercept 0, otherwise computed on
        each access, in double precision.
    stored : (nx, ny, nz) array
        The array that is kept, of one of the types `storing.NATIVE`, in C order, read-only.
    slope, intercept : float
        h = slope · stored + intercept; the slope is positive.

    Raises
    ------
    BadInput
        If the values are not real, not 3D, too few, or all not finite; or if the placement is invalid.
    """

    stored: NDArray[Any]
    origin: Floats
    spacing: Floats
    direction: Floats
    slope: float
    intercept: float
    unit: str | None
    oriented: bool

    def __init__(
        self,
        values: ArrayLike | None = None,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        spacing: ArrayLike = (1.0, 1.0, 1.0),
        direction: ArrayLike = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        slope: float = 1.0,
        intercept: float = 0.0,
        unit: str | None = None,
        *,
        stored: NDArray[Any] | None = None,
        oriented: bool | None = None,
    ) -> None:
        if (values is None) == (stored is None):
            raise BadInput("values and `stored` came both or not at all; expected one of them: give values alone")
        given = np.asarray(stored if values is None else values)  # `stored` comes from dataclasses.replace
        if given.dtype.kind not in "biuf":
            raise BadInput(f"the values have dtype {given.dtype}; expected real numbers")
        if given.ndim != 3 or min(given.shape) < 2:
            raise BadInput(f"the values have shape {given.shape}; expected three axes of at least 2 voxels each")
        slope, intercept = float(slope), float(intercept)
        if not (np.isfinite([slope, intercept]).all() and slope):
            raise BadInput(f"slope and intercept are {slope} and {intercept}; expected finite numbers, the first not 0")
        kept, slope, intercept = as_stored(given, slope, intercept)
        kept = np.ascontiguousarray(kept).view()
        if not any(np.isfinite(kept[slab]).any() for slab in slabs(kept.shape)):
            raise BadInput("the values are all NaN or infinite; expected finite numbers")
        kept.setflags(write=False)
        places = placement(origin, spacing, direction)
        for place in places:
            place.setflags(write=False)
        if oriented is None:
            oriented = states_place(places[0], places[2])
        names = ("stored", "slope", "intercept", "unit", "oriented", "origin", "spacing", "direction")
        for name, value in zip(names, (kept, slope, intercept, unit, oriented, *places)):
            object.__setattr__(self, name, value)
        if not (self.plain or np.isfinite(self.extremes).all()):
            raise BadInput(
                f"slope and intercept are {slope} and {intercept}, which lead from values up to "
                f"{max(map(abs, self.stored_extremes)):g} beyond the numbers of double precision; expected smaller ones"
            )

    @property
    def values(self) -> NDArray[Any]:
        """The field h at the voxel centres, (nx, ny, nz), read-only: the stored array, or computed on each access."""
        if self.plain:
            return self.stored
        values = np.empty(self.shape)
        for slab in slabs(self.shape):
            values[slab] = self.in_units(self.stored[slab])
        values.setflags(write=False)
        return values

    @property
    def plain(self) -> bool:
        """Whether the stored values are h."""
        return self.slope == 1 and self.intercept == 0

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along x, y, z."""
        nx, ny, nz = self.stored.shape
        return nx, ny, nz

    @cached_property
    def gaps(self) -> int:
        """Number of voxels that are not finite."""
        if self.stored.dtype.kind != "f":
            return 0
        return int(sum(np.count_nonzero(~np.isfinite(self.stored[slab])) for slab in slabs(self.shape)))

    @cached_property
    def stored_extremes(self) -> tuple[np.float64, np.float64]:
        """Lowest and highest stored value, among the finite ones."""
        low, high = self.stored.min(), self.stored.max()
        if not (np.isfinite(low) and np.isfinite(high)):
            good = [part[np.isfinite(part)] for part in (self.stored[slab] for slab in slabs(self.shape))]
            low, high = min(part.min() for part in good if part.size), max(part.max() for part in good if part.size)
        return np.float64(low), np.float64(high)

    @cached_property
    def tally(self) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Stored values of 8 or 16 bits that occur, and the number of voxels with each."""
        width, counts = self.stored.itemsize, np.zeros(1 << 8 * self.stored.itemsize, np.int64)
        for slab in slabs(self.shape):
            counts += np.bincount(self.stored[slab].reshape(-1).view(f"u{width}"), minlength=len(counts))
        numbers = np.arange(len(counts), dtype=f"u{width}").view(self.stored.dtype)
        there = np.flatnonzero(counts)
        there = there[np.argsort(numbers[there])]
        return numbers[there], counts[there]

    @property
    def extremes(self) -> tuple[float, float]:
        """Lowest and highest h, among the finite ones."""
        low, high = self.stored_extremes
        with np.errstate(over="ignore"):
            return float(self.in_units(low)), float(self.in_units(high))

    def in_units(self, stored: ArrayLike) -> Floats:
        """Values of h for these stored values."""
        return np.asarray(stored) if self.plain else np.asarray(stored, float) * self.slope + self.intercept

    def to_stored(self, isovalues: ArrayLike) -> Floats:
        """Stored values, in double precision, for these isovalues of h."""
        here = np.asarray(isovalues)
        return here if self.plain else (np.asarray(here, float) - self.intercept) / self.slope

    def __repr__(self) -> str:
        return (
            f"Volume({'x'.join(map(str, self.shape))}, {shown_range(self.extremes, 6)}, "
            f"origin={self.origin.tolist()}, spacing={self.spacing.tolist()}, direction={self.direction.tolist()})"
        )

    def with_stored(self, stored: NDArray[Any]) -> "Volume":
        """Other stored values on the same lattice, with the same slope and intercept."""
        return replace(self, stored=stored)


def histogram(volume: Volume, bins: int, ends: tuple[float, float] | None = None) -> tuple[NDArray[np.int64], Floats]:
    """Counts of the stored values in even bins between stored `ends`, by default the extremes, and the bins' edges."""
    # np.float64, not float: for float32 values NumPy would compute the edges in float32, too coarse far from 0.
    low, high = (np.float64(x) for x in (volume.stored_extremes if ends is None else ends))
    if volume.stored.dtype.kind == "f":
        return np.histogram(volume.stored, bins, (low, high))  # NumPy leaves out values that are not finite
    values, counts = volume.tally  # many times faster than a pass over all voxels
    _, edges = np.histogram(values[:0], bins, (low, high))
    found, _ = np.histogram(values, bins, (low, high), weights=counts)
    return found.astype(np.int64), edges


class Shaped(Protocol):
    """Anything with a shape (nx, ny, nz): a `Lattice` or an array."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of points along x, y, z."""


def cells(lattice: Shaped, index: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Cell (n, 3) that contains each fractional index (n, 3), and the position within it, 0 to 1."""
    cell = np.clip(np.floor(index), 0, np.array(lattice.shape) - 2).astype(np.int64)
    return cell, np.clip(index - cell, 0.0, 1.0)


def corners(lattice: Shaped, index: Floats) -> Iterator[tuple[NDArray[np.int64], Floats]]:
    """The eight lattice points (n, 3) around fractional indices (n, 3), one by one, with trilinear weights (n,)."""
    cell, f = cells(lattice, index)
    for corner in np.ndindex(2, 2, 2):
        yield cell + corner, np.where(corner, f, 1 - f).prod(axis=1)


def box_corners(lattice: Lattice) -> Floats:
    """World positions (8, 3) of the outermost points of a lattice."""
    return index_to_world(lattice, np.array(list(np.ndindex(2, 2, 2))) * (np.array(lattice.shape) - 1))


def interpolate(volume: Volume, index: Floats) -> Floats:
    """Trilinear h (n,) at fractional indices (n, 3), which are clamped to the border."""
    return volume.in_units(_interpolate_stored(volume, index))


def _interpolate_stored(volume: Volume, index: Floats) -> Floats:
    from scipy.ndimage import map_coordinates

    return np.asarray(map_coordinates(volume.stored, index.T, output=np.float64, order=1, mode="nearest"))


def cell_gradient(volume: Volume, index: Floats) -> Floats:
    """Gradient (n, 3) of the stored values in the cell of each index (n, 3), per world unit, along the axes."""
    cell, f = cells(volume, index)
    result = np.zeros((len(index), 3))
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, f, 1 - f)
        value = volume.stored[tuple((cell + corner).T)]
        for axis in range(3):
            sign = 1.0 if corner[axis] else -1.0
            result[:, axis] += sign * (weight[:, axis - 1] * weight[:, axis - 2]) * value
    return result / volume.spacing


def central_differences(values: NDArray[Any], index: Floats) -> Floats:
    """Slopes (n, 3) per index step at fractional indices (n, 3): differences of neighbours, interpolated trilinearly.

    They are one-sided at the border.
    """
    top = np.array(values.shape) - 1
    result = np.zeros((len(index), 3))
    for voxel, weight in corners(values, index):
        for axis in range(3):
            after, before = voxel.copy(), voxel.copy()
            after[:, axis] = np.minimum(voxel[:, axis] + 1, top[axis])
            before[:, axis] = np.maximum(voxel[:, axis] - 1, 0)
            rise = values[tuple(after.T)].astype(float) - values[tuple(before.T)]
            result[:, axis] += weight * rise / (after[:, axis] - before[:, axis])
    return result


def smooth_gradient(volume: Volume, index: Floats) -> Floats:
    """Central differences of the stored values, interpolated: (n, 3), per world unit, along the volume's axes."""
    return central_differences(volume.stored, index) / volume.spacing


def unit(vectors: Floats) -> Floats:
    """Vectors (n, 3) of length 1; 0 where they are 0. Scaled first: the square of a tiny gradient would underflow."""
    largest = np.abs(vectors).max(axis=1, keepdims=True, initial=0.0)
    vectors = vectors / np.where(largest > 0, largest, 1.0)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1.0))


def outward_normals(volume: Volume, index: Floats, inside: Side) -> Floats:
    """Unit gradient normals (n, 3) along the volume's axes, pointing outside; (0, 0, 0) on a plateau.

    Where the central differences cancel, the normal of the trilinear cell is used.
    """
    from illumgrid.field import newton

    result = np.empty((len(index), 3))
    newton.normals(*_compilable(volume), -UPWARD[inside], np.ascontiguousarray(index, float), result)
    return result


def project(volume: Volume, index: Floats, isovalues: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Move fractional indices (n, 3) onto the level sets of `isovalues` (n,), by Newton steps along the gradient.

    Returns
    -------
    index : (n, 3) float64
        The projected indices.
    arrived : (n,) bool
        False where the steps did not converge within one cell of the start, or left the volume.
    """
    from illumgrid.field import newton

    at, arrived = np.empty_like(index), np.zeros(len(index), bool)
    levels = np.ascontiguousarray(volume.to_stored(isovalues))
    newton.project(*_compilable(volume), levels, np.ascontiguousarray(index), at, arrived)
    return at, arrived


def _compilable(volume: Volume) -> tuple[NDArray[Any], tuple[float, ...]]:
    """Values and spacing for a kernel, always of the same two types: otherwise Numba compiles again."""
    values = volume.stored.view()
    values.flags.writeable = False
    return values, tuple(volume.spacing.tolist())
