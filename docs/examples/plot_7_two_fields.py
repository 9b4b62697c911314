"""
Two fields, one sweep
=====================

Figure 7 of Banks and Beason (2007): the densities of protons and neutrons in a nucleus, lit together. Each field has
its own grid, and light is reflected between their isosurfaces; one slider moves both. The light textures of the walls
depend on the slider, too.

The scene is lit once; any of its isosurfaces can then be drawn without computing light again. The pictures below differ
only in the isovalue. ``illumgrid preview nucleus-light --sweep 24 nucleus.webp`` makes a film of the sweep.
"""

import matplotlib.pyplot as plt

import illumgrid as ig
from illumgrid.field.builtin import nucleus
from illumgrid.show import fit_camera, render, widest_row

scene = nucleus()
light = ig.run(scene, grid=28, paths=48, isovalues=5)

# %%
# **What to look for:** the shadows on the walls, and the red and green light that the walls reflect, follow the
# surfaces from left to right. Blue surfaces tint the orange ones next to them.

camera = fit_camera(scene, widest_row(scene), 4 / 3)
figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.0), facecolor="0.235", layout="constrained")
for ax, row in zip(axes, scene.levels([0.05, 0.45, 0.95])):
    ax.imshow(render(light, isovalue=row[0], width=480, height=360, camera=camera))
    ax.set_title(f"isovalue {row[0]:.2f}", color="white")
    ax.set_axis_off()
plt.show()

# %%
# With a lamp at the camera only, the picture does not show which surface is nearer unless their outlines overlap.

figure, ax = plt.subplots(figsize=(3.9, 3.0), facecolor="0.235", layout="constrained")
ax.imshow(render(light, width=480, height=360, local=True))
ax.set_axis_off()
plt.show()
