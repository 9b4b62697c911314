"""Grids of light: at nodes over a volume, and on walls."""

from illumgrid.field.lattice import GridSpec
from illumgrid.grid.channels import GREY, RGB, Channels, channels_of
from illumgrid.grid.illumination import IlluminationGrid
from illumgrid.grid.lookup import fill_holes, read_lattice
from illumgrid.grid.nodes import Nodes
from illumgrid.grid.walls import WallTexture

__all__ = [
    "GREY",
    "RGB",
    "Channels",
    "GridSpec",
    "IlluminationGrid",
    "Nodes",
    "WallTexture",
    "channels_of",
    "fill_holes",
    "read_lattice",
]
