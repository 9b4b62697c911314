"""Synthetic light on an asymmetric, anisotropic lattice, for the tests of exported files."""

import numpy as np

from illumgrid.field.scene import Field, Material, Scene, level_table
from illumgrid.grid import GridSpec, IlluminationGrid, fill_holes
from illumgrid.light import Illumination
from shapes import sampled

ORIGIN, SPACING, SHAPE = (3.0, -40.0, 10.5), (0.5, 1.25, 2.0), (9, 7, 6)


def lopsided(direction, origin=ORIGIN):
    """An off-centre egg without any symmetry."""
    axes = np.asarray(direction)

    def height(world):
        x, y, z = ((world - np.asarray(origin)) @ axes / (SPACING * (np.array(SHAPE) - 1.0))).T
        return 1.0 - np.sqrt((x - 0.4) ** 2 + 1.7 * (y - 0.55) ** 2 + 0.8 * (z - 0.5) ** 2) - 0.2 * x * y

    return sampled(height, SHAPE, origin, SPACING, axes)


def lopsided_light(direction, nodes=5, origin=ORIGIN):
    """Two fields; the first has light that differs at every node, errors, and two holes."""
    volume = lopsided(direction, origin)
    fields = (
        Field("egg", volume, Material((0.8, 0.5, 0.2)), (0.55, 0.85)),
        Field("shell", volume.with_stored(-volume.values), Material((0.2, 0.4, 0.9)), (-0.8, -0.6), "below"),
    )
    scene = Scene(fields, background=np.ones(3))
    grids = []
    for number in range(2):
        spec = GridSpec.over(volume, nodes)
        rng = np.random.default_rng(number)
        values = rng.uniform(0.1, 3.0, (*spec.shape, 3)).astype(np.float32)
        error, support = rng.uniform(0.01, 0.1, (2, *spec.shape)).astype(np.float32)
        support = np.round(support * 100)
        for hole in ((2, 1, 2), (0, 0, 1)):
            error[hole], support[hole] = np.inf, 0
        grids.append(IlluminationGrid(spec, fill_holes(spec.spacing, values, support), error, support))
    return Illumination(scene, level_table(scene, 2), tuple(grids), (), {"seed": 0})
