"""
A brain: how deep is a fold?
============================

Figure 2 of Banks and Beason (2007): the folds of a brain. Local light draws every fold, deep or shallow, as the same
dark line. Global light reaches the bottom of a wide valley and not that of a narrow one.
"""

import matplotlib.pyplot as plt
import numpy as np
from gallery_fields import brain

import illumgrid as ig
from illumgrid.show import render

volume, limits, source = brain()
light = ig.run(ig.Scene.studio(volume, albedo=(0.8, 0.66, 0.6), range=limits), paths=24)

# %%
# **What to look for:** the clefts between the hemispheres and above the temple are the deepest. In the left picture
# they are lines like all others; in the right one they are dark valleys, and the gap below, where the brain faces
# itself, is darkest.

figure, axes = plt.subplots(1, 2, figsize=(10, 4.4), facecolor="0.235", layout="constrained")
for ax, local in zip(axes, (True, False)):
    ax.imshow(render(light, isovalue=np.mean(limits), width=600, height=520, local=local))
    ax.set_title("local light" if local else "global light", color="white")
    ax.set_axis_off()
plt.show()

# %%

print("Data:", source)
