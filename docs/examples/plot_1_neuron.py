"""
A neuron: near or far?
======================

Figure 1 of Banks and Beason (2007) shows a neuron twice. Local light depends only on the orientation of the surface
towards the viewer: the branches could all lie in one plane. Global light casts shadows, and these show which branch
lies above which.
"""

import matplotlib.pyplot as plt
from gallery_fields import arms, command, has

# %%
# One line in a terminal, on a microscopy stack of one neuron (RivuletStudio/rivuletpy, BSD-3 licence): its middle,
# blurred by about one voxel, on the ground of the studio.

FIGURE_1 = (
    "illumgrid run rivulet_neuron.nrrd --crop 45 195 80 335 0 105 --smooth 1.2 --range 10 40 --scene floor "
    "--albedo 0.8 0.62 0.3 --grid 128 --no-preview -o neuron && "
    "illumgrid preview neuron --isovalue 15 --split --view -35,50 -o fig1.png"
)

# %%
# If that volume is missing, the gallery shows arms made of points.

MADE_UP = (
    "illumgrid density arms.csv -o arms.nrrd --spacing 0.025 --sigma 0.035 && illumgrid run arms.nrrd --scene floor "
    "--albedo 0.8 0.62 0.3 --grid 64 --no-preview -o neuron && "
    "illumgrid preview neuron --split --view -35,50 -o fig1.png"
)
if not (real := has("rivulet_neuron.nrrd")):
    arms()
split = command(FIGURE_1 if real else MADE_UP)

# %%
# **What to look for:** the left half does not show how high a branch runs above the ground, or which of two crossing
# branches is nearer. In the right one each branch casts a shadow: the farther the shadow lies from its branch and the
# softer it is, the higher the branch; where both meet, the branch touches the ground. Bundled branches dim each other.

figure, ax = plt.subplots(figsize=(10.5, 4), facecolor="0.235", layout="constrained")
ax.imshow(split)
ax.set_axis_off()
plt.show()
