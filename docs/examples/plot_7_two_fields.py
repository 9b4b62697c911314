"""
Two fields, one sweep
=====================

Figure 7 of Banks and Beason (2007): the densities of protons and neutrons in a nucleus, lit together. Each field has a
grid of its own, and light passes between their isosurfaces; one slider moves both. The walls have textures that know
the place of the slider too.

Light a scene once, then draw any of its isosurfaces without asking for light again: the pictures below differ in
nothing but the isovalue. ``illumgrid preview nucleus-light --sweep 24 nucleus.webp`` makes a film of it.
"""

import matplotlib.pyplot as plt

import illumgrid as ig
from illumgrid.field.builtin import nucleus
from illumgrid.show.render import fit_camera, render, widest_row

scene = nucleus()
light = ig.run(scene, grid=28, paths=48, isovalues=5)

# %%
# **What to look for:** the shadows on the walls, and the red and green that the walls throw back, follow the surfaces
# from left to right. Blue surfaces tint the orange ones next to them.

camera = fit_camera(scene, widest_row(scene), 4 / 3)
figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.0), facecolor="0.235", layout="constrained")
for ax, row in zip(axes, scene.levels([0.05, 0.45, 0.95])):
    ax.imshow(render(light, isovalue=row[0], width=480, height=360, camera=camera))
    ax.set_title(f"isovalue {row[0]:.2f}", color="white")
    ax.set_axis_off()
plt.show()

# %%
# Under a lamp at the camera alone, which surface is nearer cannot be told where their outlines do not overlap.

figure, ax = plt.subplots(figsize=(3.9, 3.0), facecolor="0.235", layout="constrained")
ax.imshow(render(light, width=480, height=360, local=True))
ax.set_axis_off()
plt.show()
