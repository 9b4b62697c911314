"""
The grid itself
===============

Figure 6 of Banks and Beason (2007) shows the illumination grid as a block of light. Each of its points has the colour
that the isosurface through that point shows there. A new isovalue only selects another isosurface in this block. Where
no isosurface of the range passes there is no light, and nothing is drawn.
"""

import matplotlib.pyplot as plt
import numpy as np
from gallery_fields import RUNS, command

from illumgrid.field.builtin import spread

density = spread(np.random.default_rng(4).uniform(-0.5, 0.5, (14, 3)), voxels=48, sigma=0.2)
np.save(RUNS / "clumps.npy", density.values**0.2)  # the power spreads the isosurfaces evenly over the volume
command(
    "illumgrid run clumps.npy --scene box --range 0.5 0.98 --grid 48 --paths 32 --bounces 3 --isovalues 4 --no-preview"
)

# %%
# **What to look for:** the red and the green wall colour the block from either side, and the lamp brightens it from
# below, but only where an isosurface sees them: deep in the clefts between the lumps it is dark.

pictures = [
    command(f"illumgrid preview clumps-light {options} --size 480 440 -o block.png")
    for options in ("--grid-volume", "--grid-volume --cut", "--isovalue 0.8")
]
figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.5), facecolor="0.235", layout="constrained")
for ax, picture, title in zip(axes, pictures, ("the block", "cut open", "isovalue 0.8")):
    ax.imshow(picture)
    ax.set_title(title, color="white")
    ax.set_axis_off()
plt.show()
