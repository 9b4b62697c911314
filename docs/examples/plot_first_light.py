"""
First light
===========

Light a scene once, then draw any of its isosurfaces without asking for light again.

The scene is built in: the proton and neutron densities of a small nucleus. The settings are coarse, to be quick.
"""

import matplotlib.pyplot as plt

import illumgrid as ig
from illumgrid import preview
from illumgrid.demo import nucleus

scene = nucleus()
light = ig.run(scene, grid=40, paths=64)

# %%
# One row of ``scene.levels`` is one setting of all sliders: an isovalue for each field, from the lowest of its range at
# 0 to the highest at 1. The pictures differ in nothing but that setting: the light was computed before.

figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.2))
for ax, row in zip(axes, scene.levels([0.1, 0.5, 0.9])):
    ax.imshow(preview.render(light, isovalue=row[0], width=480, height=360))
    ax.set_title(f"isovalue {row[0]:.2f}")
    ax.set_axis_off()
figure.tight_layout()
plt.show()

# %%
# Under a lamp at the camera alone, near and far look alike.

figure, ax = plt.subplots(figsize=(3.6, 2.8))
ax.imshow(preview.render(light, width=480, height=360, local=True))
ax.set_axis_off()
plt.show()
