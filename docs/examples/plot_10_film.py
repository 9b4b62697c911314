"""
A ball inside a film
====================

Figure 8 of Banks and Beason (2007): particles attach themselves to a ball, and an isosurface of their density wraps it
like a film. The film transmits light, so the ball inside is lit through it, and both are shiny.

The density of the particles is a field whose isovalue is swept. The ball is a second field, held at one isovalue: its
light is computed for several positions of the sweep, because it changes with the film around it.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import illumgrid as ig
from illumgrid.field.scene import Field, Material
from illumgrid.show import fit_camera, render, widest_row
from illumgrid.show.exact import Exact

rng = np.random.default_rng(8)
sites = rng.normal(size=(7, 3))  # where particles attach to the ball
sites *= 0.62 / np.linalg.norm(sites, axis=1, keepdims=True)
particles = np.concatenate([site + 0.2 * rng.normal(size=(400, 3)) for site in sites])
density = ig.density(particles, spacing=0.06, sigma=0.16)

index = np.indices(density.shape).reshape(3, -1).T
radius = np.linalg.norm(density.origin + index * density.spacing, axis=1).reshape(density.shape)
ball = ig.Volume(1 - radius, density.origin, density.spacing)

# %%
# The film lets 55 % of the light through and reflects a third. `roughness` is that of a clear coat, for pictures only.

low, high = np.quantile(density.values, [0.90, 0.97])
film = Field("film", density, Material((0.30, 0.35, 0.43), transmission=0.55, roughness=0.12), (low, high))
solid = Field("ball", ball, Material((0.55, 0.27, 0.10), roughness=0.3), isovalue=0.5)
scene = replace(ig.Scene.studio(density), fields=(film, solid))
light = ig.run(scene, grid=32, paths=32)

# %%
# **What to look for:** the ball shines through the film and is tinted by it; the inner side of the far wall of the film
# is visible as well, lit by transmitted light. Highlights are images of the key light, and follow the film as it
# shrinks.

camera = fit_camera(scene, widest_row(scene), 4 / 3)
figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.0), facecolor="0.235", layout="constrained")
for ax, row in zip(axes, scene.levels([0.0, 0.5, 1.0])):
    ax.imshow(render(light, isovalue=row[0], width=360, height=270, camera=camera, exact=Exact(16)))
    ax.set_title(f"isovalue {row[0]:.3g}", color="white")
    ax.set_axis_off()
plt.show()

# %%
# Looks belong to pictures, so they can be changed without a new run: a dull film, and one like a mirror. From a
# terminal, ``illumgrid preview DIR --look film.roughness=0.5 --exact 16 --output dull.png`` does the same.

figure, axes = plt.subplots(1, 2, figsize=(7.0, 3.0), facecolor="0.235", layout="constrained")
for ax, roughness in zip(axes, (0.5, 0.0)):
    shown = light.looking("film", roughness=roughness)
    ax.imshow(render(shown, width=360, height=270, camera=camera, exact=Exact(16)))
    ax.set_title(f"roughness {roughness:g}", color="white")
    ax.set_axis_off()
plt.show()
