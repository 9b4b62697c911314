"""Densities of points, from arrays and from files, and the check of their memory."""

import os
from collections.abc import Sequence
from math import prod

import numpy as np
from numpy.typing import ArrayLike

from illumgrid.errors import BadInput
from illumgrid.field.cells import Brick
from illumgrid.field.deposit import checked_points, deposit, deposit_in, lattice_for
from illumgrid.field.volume import Volume
from illumgrid.io import needs

FILE = "file"
"""In place of a periodic cell: use that of the file of the points."""


def density(
    points: ArrayLike,
    *,
    spacing: float | Sequence[float],
    sigma: float,
    weights: ArrayLike | None = None,
    cell: ArrayLike | None = None,
) -> Volume:
    """Density of points: point masses spread by a Gaussian, as a field to light.

    Parameters
    ----------
    points : (n, 3) array_like
        Positions, world units.
    spacing : float or (3,) sequence of float
        Distance between voxels; in a periodic cell, rounded so that a whole number of voxels fills it.
    sigma : float
        Standard deviation of the Gaussian, world units. It ends at 4 sigma; 0 leaves the points as narrow as a voxel.
    weights : (n,) array_like, optional
        Mass of each point, by default 1; charges may be negative.
    cell : float, (3,) or (3, 3) array_like, optional
        Periodic cell that begins at 0: its lengths where its angles are right and its edges along x, y and z, or any
        three edges, row by row. Points outside enter at the opposite face. The field of a cell without right angles
        fills the brick of the same volume and repetition: see `illumgrid.field.cells`. By default the points stand
        alone, and the volume reaches 4 sigma beyond them.

    Returns
    -------
    volume : Volume
        Weight per volume: the sum of the values times the volume of a voxel is the sum of the weights.

    Raises
    ------
    BadInput
        If an argument is invalid, or the voxels need more memory than is free.
    """
    at, mass = checked_points(points, weights)
    brick = None if cell is None or np.ndim(cell) != 2 else Brick.of(cell)
    lattice = lattice_for(at, spacing, sigma, cell if brick is None else brick.sides)
    todo = "choose a larger spacing, or leave far points out"
    needs.check("the density", needs.TO_DEPOSIT * prod(lattice.shape), todo)
    if brick is not None:
        return deposit_in(brick, at, mass, lattice, sigma)
    return deposit(at, mass, lattice, sigma, cell is not None)


def density_of_file(
    path: str | os.PathLike[str],
    *,
    spacing: float | Sequence[float],
    sigma: float,
    weights: str | None = None,
    columns: Sequence[str] | None = None,
    cell: str | ArrayLike | None = None,
) -> Volume:
    """Density of the points in a file: see `density`, and `illumgrid.io.readers.points.read_points`.

    Parameters
    ----------
    path : str or path-like
    spacing, sigma
        As of `density`.
    weights : str, optional
        Column of the masses, by name or by number from 0.
    columns : (3,) sequence of str, optional
        Columns of the coordinates.
    cell : "file", float, (3,) or (3, 3) array_like, optional
        A periodic cell, or that of the file.
    """
    from illumgrid.io.readers.points import read_points

    cloud = read_points(path, weights=weights, columns=columns)
    if isinstance(cell, str):
        if cell != FILE:
            raise BadInput(f"cell is {cell!r}; expected {FILE!r}, three lengths or three edges")
        cell = cloud.periodic()
    volume = density(cloud.points, spacing=spacing, sigma=sigma, weights=cloud.weights, cell=cell)
    return Volume(volume.stored, volume.origin, volume.spacing, volume.direction, unit=cloud.unit)
