"""Built-in synthetic scenes, which need no data."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from illumgrid.field.rooms import box_around
from illumgrid.field.scene import Field, Material, Scene
from illumgrid.field.volume import Floats, Volume

_VOXELS = 48  # along each axis of the volumes, which span -1 to 1
_AXIS = np.array([0.5, -0.35, 0.8]) / np.linalg.norm([0.5, -0.35, 0.8])  # tilted, so that one sees through the ring
_APART, _SPREAD = 0.36, 0.21  # of a cluster from the centre, and its standard deviation
_RING, _FLAT = 0.66, 0.22  # radius of the ring at its largest density, and its extent along the axis


def spread(points: Floats, voxels: int = _VOXELS, sigma: float = _SPREAD) -> Volume:
    """Density of point masses (n, 3) smoothed by a Gaussian kernel, on [-1, 1]³, scaled to a maximum of 1."""
    axis = np.linspace(-1.0, 1.0, voxels)
    # A Gaussian is a product over the axes.
    along = [np.exp(-((axis[:, None] - points[:, a]) ** 2) / (2 * sigma**2)) for a in range(3)]
    return _scaled(np.einsum("in,jn,kn->ijk", *along))


def _scaled(density: Floats) -> Volume:
    """A density on [-1, 1]³, with a maximum of 1."""
    step = 2.0 / (len(density) - 1)
    return Volume(density / density.max(), origin=np.full(3, -1.0), spacing=np.full(3, step))


def _ring() -> Volume:
    """Density of an orbital around the axis: no node but the axis itself, on which it vanishes."""
    x = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, _VOXELS)] * 3, indexing="ij"), axis=-1)
    along = x @ _AXIS
    round_ = ((x**2).sum(axis=-1) - along**2) / _RING**2
    return _scaled((round_ * np.exp(-round_)) ** 2 * np.exp(-((along / _FLAT) ** 2)))


def nucleus() -> Scene:
    """Two clusters of protons, and the neutrons that orbit both, in a box whose ceiling shines.

    After Figure 7 of Banks & Beason (2007), two fields in a box, and the cluster model of beryllium-10: two alpha
    particles share two neutrons (W. von Oertzen, M. Freer and Y. Kanada-En'yo, Physics Reports 432, 2006).
    """
    protons, neutrons = Material(np.array([0.9, 0.45, 0.22])), Material(np.array([0.35, 0.55, 0.85]))
    limits = np.array([0.3, 0.6])
    fields = (
        Field("protons", spread(_APART * np.stack([_AXIS, -_AXIS])), protons, limits),
        Field("neutrons", _ring(), neutrons, limits),
    )
    walls = {quad.name: quad for quad in box_around(fields[0].volume, margin=0.3)}
    shining = Material(np.zeros(3), np.full(3, 2.5))
    walls["lamp"] = replace(walls.pop("ceiling"), name="lamp", material=shining, texels=(1, 1))
    return Scene(fields, tuple(walls.values()))


@dataclass(frozen=True)
class Preset:
    """A built-in scene with options chosen for speed."""

    make: Callable[[], Scene]
    grid: int
    paths: int
    isovalues: int


SCENES = {"nucleus": Preset(nucleus, grid=36, paths=128, isovalues=5)}
