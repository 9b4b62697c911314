"""
First light
===========

Light a scene once, then draw three of its isosurfaces without asking for light again.

The scene is built in: the proton and neutron densities of a small nucleus under a white sky. The settings are coarse,
to be quick.
"""

import matplotlib.pyplot as plt
import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import illumgrid as ig
from illumgrid.demo import nucleus

scene = nucleus()
light = ig.run(scene, grid=24, paths=16)

# %%
# One row of ``scene.levels`` is one setting of all sliders: an isovalue for each field, from the lowest of its range at
# 0 to the highest at 1. Each isosurface is lit by looking up its light at the middle of each of its faces.

settings = [0.1, 0.5, 0.9]
figure, axes = plt.subplots(1, 3, figsize=(9, 3.4), subplot_kw={"projection": "3d"})
for ax, t, row in zip(axes, settings, scene.levels(settings)):
    triangles, colors = [], []
    for field, isovalue in zip(scene.fields, row):
        mesh = ig.isosurface(field.volume, isovalue, inside=field.inside)
        triangles.append(mesh.triangles)
        colors.append(light.color(mesh.triangles_center, field=field.name) / 255)
    corners = np.concatenate(triangles)
    # Each triangle is outlined in its own colour, or the background shines through the seams.
    shades = np.concatenate(colors)
    ax.add_collection3d(Poly3DCollection(corners, facecolors=shades, edgecolors=shades, linewidths=0.2))
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]), title=f"t = {t}")
    ax.set_box_aspect(high - low)
    ax.set_axis_off()
figure.tight_layout()
plt.show()
