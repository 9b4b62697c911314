"""
A neuron: near or far?
======================

Figure 1 of Banks and Beason (2007) shows a neuron twice. Local light depends only on the orientation of the surface
towards the viewer: the branches could all lie in one plane. Global light casts shadows, and these show which branch
lies above which.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from gallery_fields import neuron

import illumgrid as ig
from illumgrid.show import render

volume, limits, source = neuron()

# %%
# A white floor under the neuron, a dim sky, and a lamp above: a quad that shines downwards.

scene = ig.Scene.floor(volume, albedo=(0.8, 0.62, 0.3), range=limits)
floor = replace(scene.quads[0], texels=(96, 96))
size = np.abs(floor.edge_u).max()
corner = floor.corner + 0.2 * floor.edge_u + 0.7 * floor.edge_v + [0, 0, 0.9 * size]
lamp = ig.Quad(
    "lamp", corner, 0.2 * floor.edge_v, 0.2 * floor.edge_u, ig.Material((0, 0, 0), (40, 38, 34)), texels=(1, 1)
)
scene = replace(scene, quads=(floor, lamp), background=np.full(3, 0.35))
light = ig.run(scene, grid=128, paths=32, bounces=2, isovalues=4)

# %%
# **What to look for:** the left picture does not show how high a branch runs above the floor, or which of two crossing
# branches is nearer. In the right one each branch casts a shadow: the farther the shadow lies from its branch and the
# softer it is, the higher the branch; where both meet, the branch touches the floor. Bundled branches dim each other.

level = limits[0] + (limits[1] - limits[0]) / 6
figure, axes = plt.subplots(1, 2, figsize=(10, 4.6), facecolor="0.235", layout="constrained")
for ax, local in zip(axes, (True, False)):
    ax.imshow(render(light, isovalue=level, width=600, height=560, local=local, view=(-35, 50)))
    ax.set_title("local light" if local else "global light", color="white")
    ax.set_axis_off()
plt.show()

# %%

print("Data:", source)
