"""Grids of light: at nodes over a volume, and on walls."""

from illumgrid.field.lattice import GridSpec
from illumgrid.grid.illumination import IlluminationGrid
from illumgrid.grid.lookup import fill_holes, read_lattice
from illumgrid.grid.walls import WallTexture

__all__ = ["GridSpec", "IlluminationGrid", "WallTexture", "fill_holes", "read_lattice"]
