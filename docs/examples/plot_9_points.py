"""
From points to a field
======================

Figures 7 and 8 of Banks and Beason (2007) show densities of point masses: nucleons, and the particles of a molecular
dynamics run. :func:`illumgrid.density` makes such fields from lists of points; on the command line
``illumgrid density`` does, and a scene file takes ``points = "atoms.xyz"``.
"""

import matplotlib.pyplot as plt
import numpy as np

import illumgrid as ig
from illumgrid.field.presets import studio_lights
from illumgrid.show import render

# %%
# Figure 7: eight protons and eight neutrons, each a point spread by a Gaussian. Both fields share one sweep, here of
# densities up to four fifths of the smaller maximum, in the light of the studio.


def nucleons(count, turn):
    """Points spread uniformly over a sphere (a Fibonacci lattice), and one at its centre."""
    k = np.arange(count - 1) + 0.5
    height, angle = 1 - 2 * k / (count - 1), np.pi * (1 + 5**0.5) * k + turn
    ring = np.sqrt(1 - height**2)
    return np.vstack([0.62 * np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1), np.zeros((1, 3))])


protons, neutrons = (
    ig.density(points, spacing=1 / 20, sigma=0.16) for points in (nucleons(8, 0.0), nucleons(9, 1.2)[:8])
)
limits = 0.8 * np.array([0.2, 1.0]) * min(protons.extremes[1], neutrons.extremes[1])
fields = (
    ig.Field("protons", protons, ig.Material((0.85, 0.42, 0.28)), limits),
    ig.Field("neutrons", neutrons, ig.Material((0.35, 0.55, 0.82)), limits),
)
lights = studio_lights(ig.Scene(fields))
nucleus = ig.run(ig.Scene(fields, lights=lights), grid=28, paths=32, bounces=4, isovalues=2)

# %%
# Figure 8: particles in a periodic cell. No two are nearer than 0.9, as in a liquid; what leaves the cell at one face
# enters at the opposite one.

random, cell, particles = np.random.default_rng(3), 6.0, np.zeros((0, 3))
while len(particles) < 130:
    point = random.random(3) * cell
    apart = np.abs(particles - point)
    if (np.linalg.norm(np.minimum(apart, cell - apart), axis=1) >= 0.9).all():
        particles = np.vstack([particles, point])
liquid = ig.density(particles, spacing=0.2, sigma=0.45, cell=cell)
print(f"{liquid.values.sum() * np.prod(liquid.spacing):.4f} particles in {liquid.shape} voxels")
fluid = ig.run(ig.Scene.studio(liquid, range=(0.6, 1.1)), grid=30, paths=32, bounces=4, isovalues=2)

# %%
# **What to look for:** which balls stand in front of others, and how deep the holes between the particles are. Grey
# planes are the faces of the cell.

figure, axes = plt.subplots(1, 2, figsize=(8, 3.2), facecolor="0.235", layout="constrained")
axes[0].imshow(render(nucleus, isovalue=limits @ [0.6, 0.4], width=480, height=380))
axes[1].imshow(render(fluid, isovalue=0.7, width=480, height=380))
for ax in axes:
    ax.set_axis_off()
plt.show()
