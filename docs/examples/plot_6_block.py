"""
The grid itself
===============

Figure 6 of Banks and Beason (2007): the illumination grid as a block of light. Each of its points has the colour that
the isosurface through that point shows there. A new isovalue only cuts another isosurface out of this block.

``illumgrid preview DIR --grid-volume --cut --output block.png`` draws the same picture.
"""

import matplotlib.pyplot as plt
import numpy as np

import illumgrid as ig
from illumgrid.field.builtin import spread
from illumgrid.show import grid_volume, render

density = spread(np.random.default_rng(4).uniform(-0.5, 0.5, (14, 3)), voxels=48, sigma=0.2)
volume = density.with_values(density.values**0.2)  # spreads the isosurfaces evenly over the volume
light = ig.run(ig.Scene.box(volume, range=(0.5, 0.98)), grid=48, paths=32, bounces=3)

# %%
# **What to look for:** the red and the green wall colour the block from either side, and the lamp brightens it from
# below, but only where an isosurface sees them: deep in the clefts between the lumps it is dark. Dim parts belong to no
# isosurface of the range; their nodes hold the light of the nearest node that does.

figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.5), facecolor="0.235", layout="constrained")
for ax, picture, title in zip(
    axes,
    (
        grid_volume(light, width=480, height=440),
        grid_volume(light, width=480, height=440, cut=True),
        render(light, isovalue=0.8, width=480, height=440),
    ),
    ("the block", "cut open", "isovalue 0.8"),
):
    ax.imshow(picture)
    ax.set_title(title, color="white")
    ax.set_axis_off()
plt.show()
