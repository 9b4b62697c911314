"""The pictures of the documentation: ``python pictures.py FOLDER [SHARE]`` writes glass.png and wax.png.

With a SHARE, such as 0.1, of the paths and texels for a look.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from illumgrid_mitsuba import Mitsuba
from PIL import Image

import illumgrid as ig
from illumgrid.show import fit_camera, render, widest_row

MEDIUM = '{"type": "homogeneous", "albedo": {"type": "rgb", "value": [0.995, 0.97, 0.9]}, "sigma_t": 12.0}'
SOLIDS = {
    # albedo, backend, texels along the floor, paths, bounces
    "glass": ((0.9, 0.9, 0.9), Mitsuba(bsdf='{"type": "dielectric", "int_ior": 1.5}'), 180, 1280, 8),
    "wax": ((0.9, 0.75, 0.55), Mitsuba(medium=MEDIUM), 108, 640, 32),
}
ROWS = 4
"""Of the sweep, and pictures: each shows the floor of its own row, and no mixture of two."""


def blobs(size=64):
    """Three soft balls."""
    grid = np.meshgrid(*[np.linspace(-1, 1, size)] * 3, indexing="ij")
    parts = ((-0.28, 0.0, 0.05, 1.0), (0.32, 0.12, -0.1, 0.8), (0.05, -0.3, 0.35, 0.6))
    total = sum(w * np.exp(-sum((x - c) ** 2 for x, c in zip(grid, at)) / 0.09) for *at, w in parts)
    return ig.Volume(total.astype(np.float32), origin=(-1, -1, -1), spacing=np.full(3, 2 / (size - 1)))


def stage(albedo, texels):
    """The solid over a floor, under a lamp above it on the left."""
    white = ig.Material((0.75,) * 3)
    floor = ig.Quad("floor", (-2.5, -2.5, -0.7), (5.4, 0, 0), (0, 5.4, 0), white, texels=(texels, texels))
    at = np.array([-0.7, 0.9, 2.4])
    down = np.array([0.1, -0.1, 0.0]) - at
    down /= np.linalg.norm(down)
    u = np.cross(down, [0, 0, 1])
    u *= 0.9 / np.linalg.norm(u)
    v = np.cross(down, u)
    lamp = ig.Quad("lamp", at - (u + v) / 2, u, v, ig.Material((0, 0, 0), (24, 24, 24)), texels=(2, 2))
    solid = ig.Field("solid", blobs(), ig.Material(albedo), (0.25, 0.67))
    return ig.Scene((solid,), (floor, lamp), (0.12, 0.13, 0.15))


def main():
    """Light both solids, and draw each at four isovalues."""
    share = float(sys.argv[2]) if len(sys.argv) > 2 else 1.0
    for name in sys.argv[3:] or SOLIDS:
        albedo, backend, texels, paths, bounces = SOLIDS[name]
        scene = stage(albedo, max(8, round(texels * share**0.5)))
        sampler = ig.sampler("uniform", count=ROWS, points=max(300, round(2500 * share)))
        how = {"grid": 36, "paths": max(16, round(paths * share)), "bounces": bounces, "isovalues": ROWS}
        light = ig.run(scene, sampler=sampler, backend=backend, interpolator="splat", judge=False, **how)
        camera = fit_camera(scene, widest_row(scene), 1.0, (20.0, 50.0), 0.62)
        camera = replace(camera, eye=camera.eye - 0.42 * camera.up + 0.1 * camera.right)
        shown = np.linspace(*scene.fields[0].range, ROWS)
        row = [render(light, isovalue=c, width=480, height=480, camera=camera, stops=-0.4) for c in shown]
        whole = np.concatenate([np.asarray(p)[..., :3] for p in row], axis=1)
        Image.fromarray(whole).save(Path(sys.argv[1]) / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
