"""
Two fields, one sweep
=====================

Figure 7 of Banks and Beason (2007) shows the densities of protons and neutrons in a nucleus, lit together. Each field
has its own grid, and light is reflected between their isosurfaces; one slider moves both. The light textures of the
walls depend on the slider, too.

The built-in scene follows the cluster model of beryllium-10: two clusters, in orange, and the neutrons that orbit both,
in blue. It is lit once; any of its isosurfaces can then be drawn without computing light again. The pictures below
differ only in the isovalue. ``illumgrid preview nucleus --sweep 24 nucleus.webp`` makes a film of the sweep.
"""

import matplotlib.pyplot as plt
from gallery_fields import command

command("illumgrid run nucleus --paths 64 --no-preview -o nucleus")
strip = command("illumgrid preview nucleus --isovalues 0.32,0.45,0.58 --size 480 360 -o fig7.png")

# %%
# **What to look for:** the shadow on the floor, and the red and green light that the walls reflect, follow the surfaces
# from left to right, while the dumbbell separates. The ring tints the cluster within it.

figure, ax = plt.subplots(figsize=(10.5, 2.8), facecolor="0.235", layout="constrained")
ax.imshow(strip)
ax.set_axis_off()
plt.show()

# %%
# With only a lamp at the camera (left), the picture shows neither how far the ring is from the walls nor that light
# comes from above.

split = command("illumgrid preview nucleus --split --size 720 540 -o split.png")
figure, ax = plt.subplots(figsize=(5.2, 3.9), facecolor="0.235", layout="constrained")
ax.imshow(split)
ax.set_axis_off()
plt.show()
