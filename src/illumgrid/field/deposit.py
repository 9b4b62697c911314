"""A field from points: each point mass is shared among the voxels around it, then spread by a Gaussian."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.compiled import njit
from illumgrid.errors import BadInput
from illumgrid.field.cells import Brick
from illumgrid.field.lattice import GridSpec
from illumgrid.field.volume import Floats, Volume

REACH = 4.0
"""Standard deviations at which the Gaussian ends; it is scaled so that its sum is 1."""

_MOST = 2**21  # voxels along an axis: such a cube is beyond any memory, and its number of voxels still fits 64 bits


def checked_points(points: ArrayLike, weights: ArrayLike | None) -> tuple[Floats, Floats]:
    """Points (n, 3) and weights (n,), by default 1 each, in double precision."""
    try:
        at = np.asarray(points, dtype=float)
        mass = np.ones(len(at)) if weights is None else np.asarray(weights, dtype=float)
    except (TypeError, ValueError):
        raise BadInput("the points or weights are not numbers; expected arrays (n, 3) and (n,)") from None
    if at.ndim != 2 or at.shape[1:] != (3,) or not len(at):
        raise BadInput(f"the points have shape {at.shape}; expected (n, 3): x, y, z of at least one point")
    if mass.shape != (len(at),):
        raise BadInput(f"the weights have shape {mass.shape}; expected ({len(at)},), one for each point")
    for what, array in (("point", at), ("weight", mass)):
        if not np.isfinite(array).all():
            first = int(np.argmin(np.isfinite(array).reshape(len(array), -1).all(axis=1)))
            raise BadInput(f"{what} {first} is {array[first].tolist()}; expected finite numbers; leave it out")
    return at, mass


def lattice_for(points: Floats, spacing: ArrayLike, sigma: float, cell: ArrayLike | None = None) -> GridSpec:
    """Voxels for the density of points (n, 3).

    Without a cell, they reach `REACH` standard deviations beyond the points and lie at whole multiples of the spacing,
    so that densities of one spacing share their lattice. In a periodic cell, from 0 to its lengths, a whole number of
    voxels fills it, with centres half a voxel from its faces; the spacing is rounded accordingly.
    """
    try:
        step = np.broadcast_to(np.asarray(spacing, float), 3)
        sides = None if cell is None else np.broadcast_to(np.asarray(cell, float), 3)
    except (TypeError, ValueError):
        raise BadInput(
            f"spacing is {spacing!r}, cell {cell!r}; expected positive numbers, one or three for each"
        ) from None
    if not (np.isfinite(step).all() and (step > 0).all()):
        raise BadInput(f"spacing is {np.asarray(spacing).tolist()}; expected a positive number, or three")
    if not 0 <= sigma < np.inf:
        raise BadInput(f"sigma is {sigma}; expected the standard deviation of the Gaussian, a number from 0 up")
    if sides is None:
        margin = REACH * sigma + step
        first = np.floor((points.min(axis=0) - margin) / step)
        count = np.ceil((points.max(axis=0) + margin) / step) - first + 1
        origin = first * step
    else:
        if not (np.isfinite(sides).all() and (sides > 0).all()):
            raise BadInput(f"cell is {np.asarray(cell).tolist()}; expected three positive lengths")
        if sigma > sides.min():
            raise BadInput(f"sigma is {sigma}; expected at most {sides.min():g}, the shortest side of the cell")
        count = np.maximum(2, np.rint(sides / step))
        step = sides / count
        origin = step / 2
    if count.max() > _MOST:
        raise BadInput(
            f"{count.max():.3g} voxels along an axis came of this spacing; expected at most {_MOST}; choose it larger"
        )
    return GridSpec((int(count[0]), int(count[1]), int(count[2])), origin, step)


def deposit(points: Floats, weights: Floats, lattice: GridSpec, sigma: float, periodic: bool) -> Volume:
    """Density, weight per volume, of points (n, 3) with weights (n,) on a lattice along the axes of the world.

    Each weight is shared trilinearly among the eight voxels around its point ("cloud in cell" [1]_), which keeps total
    and centre of mass, and widens the point by a variance of spacing²/6 on average; a Gaussian with the rest of
    sigma² follows.

    References
    ----------
    .. [1] R. W. Hockney, J. W. Eastwood, Computer Simulation Using Particles, 1981, section 5-2.
    """
    from scipy.ndimage import gaussian_filter

    grid = np.zeros(lattice.shape)
    _share(points, weights, lattice.origin, lattice.spacing, periodic, grid)
    grid /= np.prod(lattice.spacing)
    width = np.sqrt(np.maximum(sigma**2 - lattice.spacing**2 / 6, 0.0)) / lattice.spacing
    values = np.zeros(lattice.shape, np.float32)
    gaussian_filter(grid, width, output=values, mode="wrap" if periodic else "constant", truncate=REACH)
    return Volume(values, lattice.origin, lattice.spacing)


def deposit_in(brick: Brick, points: Floats, weights: Floats, lattice: GridSpec, sigma: float) -> Volume:
    """Density of points (n, 3), world units, in a periodic cell whose edges are not all upright.

    Images of the points are shared among voxels within and around the `lattice` of its brick, whose rim is then cut
    off. The total is preserved as exactly as elsewhere: a row of voxels receives a point's whole weight wherever its
    image lies between them, so rows, and then planes, add up even though images lie elsewhere between voxels.
    """
    more = np.ceil(REACH * sigma / lattice.spacing).astype(int) + 2
    shape = lattice.shape + 2 * more
    wide = GridSpec(
        (int(shape[0]), int(shape[1]), int(shape[2])), lattice.origin - more * lattice.spacing, lattice.spacing
    )
    at, mass = brick.images(points, weights, (more - 1) * lattice.spacing)
    values = deposit(at, mass, wide, sigma, periodic=False).stored
    inner = tuple(slice(m, m + n) for m, n in zip(more, lattice.shape))
    axes = brick.axes.T
    return Volume(np.ascontiguousarray(values[inner]), axes @ lattice.origin, lattice.spacing, axes)


@njit()
def _share(
    points: NDArray[np.float64],
    weights: NDArray[np.float64],
    origin: NDArray[np.float64],
    spacing: NDArray[np.float64],
    periodic: bool,
    grid: NDArray[np.float64],
) -> None:
    """Add weights to the voxels around their points; one thread, so that sums have one order."""
    nx, ny, nz = grid.shape
    for n in range(len(points)):
        x = (points[n, 0] - origin[0]) / spacing[0]
        y = (points[n, 1] - origin[1]) / spacing[1]
        z = (points[n, 2] - origin[2]) / spacing[2]
        floor_x, floor_y, floor_z = np.floor(x), np.floor(y), np.floor(z)
        fx, fy, fz = x - floor_x, y - floor_y, z - floor_z
        if periodic:
            floor_x -= nx * np.floor(floor_x / nx)
            floor_y -= ny * np.floor(floor_y / ny)
            floor_z -= nz * np.floor(floor_z / nz)
        i, j, k = int(floor_x), int(floor_y), int(floor_z)
        i1, j1, k1 = i + 1, j + 1, k + 1
        if periodic:
            i, j, k, i1, j1, k1 = i % nx, j % ny, k % nz, i1 % nx, j1 % ny, k1 % nz
        w = weights[n]
        near, far = w * (1 - fx), w * fx
        grid[i, j, k] += near * (1 - fy) * (1 - fz)
        grid[i, j, k1] += near * (1 - fy) * fz
        grid[i, j1, k] += near * fy * (1 - fz)
        grid[i, j1, k1] += near * fy * fz
        grid[i1, j, k] += far * (1 - fy) * (1 - fz)
        grid[i1, j, k1] += far * (1 - fy) * fz
        grid[i1, j1, k] += far * fy * (1 - fz)
        grid[i1, j1, k1] += far * fy * fz
