"""Built-in synthetic scenes, which need no data."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from illumgrid.field.scene import Field, Material, Scene, box_around, with_texels
from illumgrid.field.volume import Floats, Volume

_VOXELS = 64
_RADIUS = 0.62  # of the sphere that carries the nucleons of one kind; the volume spans -1 to 1
_SPREAD = 0.16  # standard deviation of the kernel


def spread(points: Floats, voxels: int = _VOXELS, sigma: float = _SPREAD) -> Volume:
    """Density of point masses (n, 3) smoothed by a Gaussian kernel, on [-1, 1]³, scaled to a maximum of 1."""
    axis = np.linspace(-1.0, 1.0, voxels)
    # A Gaussian is a product over the axes.
    along = [np.exp(-((axis[:, None] - points[:, a]) ** 2) / (2 * sigma**2)) for a in range(3)]
    density = np.einsum("in,jn,kn->ijk", *along)
    step = 2.0 / (voxels - 1)
    return Volume(density / density.max(), origin=np.full(3, -1.0), spacing=np.full(3, step))


def nucleons(count: int, turn: float) -> Floats:
    """Point masses (count, 3) distributed uniformly over a sphere (a Fibonacci lattice), and one at its centre."""
    k = np.arange(count - 1) + 0.5
    height, angle = 1 - 2 * k / (count - 1), np.pi * (1 + 5**0.5) * k + turn
    ring = np.sqrt(1 - height**2)
    return np.vstack(
        [_RADIUS * np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1), np.zeros((1, 3))]
    )


def nucleus() -> Scene:
    """Densities of eight protons and eight neutrons in a box with a lamp (after Figure 7 of Banks & Beason 2007)."""
    protons = Material(np.array([0.85, 0.42, 0.28]))
    neutrons = Material(np.array([0.35, 0.55, 0.82]))
    limits = np.array([0.15, 0.75])
    fields = (
        Field("protons", spread(nucleons(8, 0.0)), protons, limits),
        Field("neutrons", spread(nucleons(9, 1.2)[:8]), neutrons, limits),
    )
    return with_texels(Scene(fields, box_around(fields[0].volume)), 16)  # as many texels as nodes, or fewer


@dataclass(frozen=True)
class Preset:
    """A built-in scene with options chosen for speed."""

    make: Callable[[], Scene]
    grid: int
    paths: int
    isovalues: int


SCENES = {"nucleus": Preset(nucleus, grid=28, paths=64, isovalues=5)}
