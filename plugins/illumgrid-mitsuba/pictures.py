"""The pictures of the documentation: ``python pictures.py FOLDER`` writes glass.png and wax.png."""

import sys
from pathlib import Path

import numpy as np
from illumgrid_mitsuba import Mitsuba
from PIL import Image

import illumgrid as ig
from illumgrid.show import fit_camera, render, widest_row

MEDIUM = '{"type": "homogeneous", "albedo": {"type": "rgb", "value": [0.995, 0.97, 0.9]}, "sigma_t": 12.0}'
SOLIDS = {
    "glass": ((0.9, 0.9, 0.9), Mitsuba(bsdf='{"type": "dielectric", "int_ior": 1.5}'), 60, 64, 8),
    "wax": (
        (0.9, 0.75, 0.55),
        Mitsuba('{"type": "roughdielectric", "int_ior": 1.3, "alpha": 0.3}', MEDIUM),
        20,
        128,
        32,
    ),
}
"""Albedo, backend, texels along the floor, paths, bounces."""


def blobs(size=48):
    """Three soft balls."""
    grid = np.meshgrid(*[np.linspace(-1, 1, size)] * 3, indexing="ij")
    parts = ((-0.28, 0.0, 0.05, 1.0), (0.32, 0.12, -0.1, 0.8), (0.05, -0.3, 0.35, 0.6))
    total = sum(w * np.exp(-sum((x - c) ** 2 for x, c in zip(grid, at)) / 0.09) for *at, w in parts)
    return ig.Volume(total.astype(np.float32), origin=(-1, -1, -1), spacing=np.full(3, 2 / (size - 1)))


def stage(albedo, texels):
    """The solid over a floor, under a lamp behind it on the left."""
    floor = ig.Quad("floor", (-2, -2.4, -0.72), (4, 0, 0), (0, 4, 0), ig.Material((0.75,) * 3), texels=(texels, texels))
    at, down = np.array([-0.9, 1.5, 2.2]), np.array([0.9, -1.5, -2.4])
    down /= np.linalg.norm(down)
    u = np.cross(down, [0, 0, 1])
    u *= 0.6 / np.linalg.norm(u)
    v = np.cross(down, u)
    lamp = ig.Quad("lamp", at - (u + v) / 2, u, v, ig.Material((0, 0, 0), (60, 60, 60)), texels=(2, 2))
    solid = ig.Field("solid", blobs(), ig.Material(albedo), (0.25, 0.75))
    return ig.Scene((solid,), (floor, lamp), (0.12, 0.13, 0.15))


def main():
    """Light both solids, and draw each at three isovalues."""
    for name, (albedo, backend, texels, paths, bounces) in SOLIDS.items():
        scene, sampler = stage(albedo, texels), ig.sampler("uniform", count=4, points=500)
        how = {"grid": 20, "paths": paths, "bounces": bounces, "isovalues": 3, "judge": False}
        light = ig.run(scene, sampler=sampler, backend=backend, interpolator="splat", **how)
        camera = fit_camera(scene, widest_row(scene), 4 / 3, (30.0, 42.0), 0.46)
        row = [render(light, isovalue=c, width=480, height=360, camera=camera) for c in (0.27, 0.5, 0.74)]
        Image.fromarray(np.concatenate([np.asarray(p)[..., :3] for p in row], axis=1)).save(
            Path(sys.argv[1]) / f"{name}.png"
        )


if __name__ == "__main__":
    main()
