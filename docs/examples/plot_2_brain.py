"""
A brain: how deep is a fold?
============================

Figure 2 of Banks and Beason (2007) shows the folds of a brain. Local light draws every fold, deep or shallow, as the
same dark line. Global light reaches the bottom of a wide valley and not that of a narrow one.
"""

import matplotlib.pyplot as plt
from gallery_fields import command, folds, has

# %%
# One line in a terminal, on magnetic resonance images of one brain (neurolabusc/VolumeRenderingData, stroke/T1, MIT
# licence), at half their resolution to be quick.

FIGURE_2 = (
    "illumgrid run stroke_T1.nii.gz --downsample 2 --range 60 105 --albedo 0.8 0.66 0.6 --no-preview -o brain && "
    "illumgrid preview brain --isovalue 85 --split -o fig2.png"
)

# %%
# If that volume is missing, the gallery shows a folded ball.

MADE_UP = (
    "illumgrid run folds.npy --range 0.15 0.45 --albedo 0.8 0.66 0.6 --no-preview -o brain && "
    "illumgrid preview brain --isovalue 0.3 --split -o fig2.png"
)
if not (real := has("stroke_T1.nii.gz")):
    folds()
split = command(FIGURE_2 if real else MADE_UP)

# %%
# **What to look for:** the clefts between the hemispheres and above the temple are the deepest. In the left half they
# are lines like all others; in the right one they are dark valleys, and the gap below, where the brain faces itself,
# is darkest.

figure, ax = plt.subplots(figsize=(10.5, 4), facecolor="0.235", layout="constrained")
ax.imshow(split)
ax.set_axis_off()
plt.show()
