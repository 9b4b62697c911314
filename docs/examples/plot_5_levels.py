"""
Levels and samples: from isosurfaces to a grid
==============================================

Figure 5 of Banks and Beason (2007) shows how a grid is computed: light is sampled at points scattered over some
isosurfaces (the sampler ``uniform``), and each node of the grid takes the light of the nearest point. Few isosurfaces
leave gaps, whose nodes take light from another isosurface than their own; many isosurfaces close the gaps. The sampler
``direct`` places its queries at the nodes themselves, each on the isosurface through it.

The scene is that of the paper: one blob in a box, with a red wall on the left, a green one on the right, and a
luminaire at the bottom.
"""

import warnings

import matplotlib.pyplot as plt
import numpy as np
from gallery_fields import RUNS, command

import illumgrid as ig
from illumgrid.field.builtin import spread
from illumgrid.show import render

random = np.random.default_rng(4)
volume = spread(random.uniform(-0.55, 0.55, (14, 3)), voxels=48, sigma=0.17)
scene = ig.Scene.box(volume, range=(0.25, 0.85))

# %%
# Top: the isosurfaces that three settings sample, in the slice through the middle of the field. Bottom: the resulting
# pictures, all at one isovalue that none of them sampled.
#
# **What to look for:** with three levels the surface is blotched, because its nodes take light from isosurfaces with
# other positions and orientations. With twelve levels the blotches shrink. ``direct`` has none; only the noise of 64
# paths remains.

warnings.simplefilter("ignore", ig.IllumgridWarning)  # nodes without a sample within reach: the subject of this figure
samplers = {
    "3 levels": ig.sampler("uniform", count=3),
    "12 levels": ig.sampler("uniform", count=12),
    "direct": ig.sampler("direct"),
}
figure, axes = plt.subplots(2, 3, figsize=(10, 6.6), height_ratios=(1, 1.05), layout="constrained")
low, high = scene.fields[0].range
for (name, sampler), top, bottom in zip(samplers.items(), *axes):
    light = ig.run(scene, sampler=sampler, grid=40, paths=64, bounces=4, isovalues=6)
    slice_ = volume.values[:, :, volume.shape[2] // 2].T
    top.imshow(slice_, origin="lower", cmap="gray")
    if name == "direct":
        nodes = light.grids[0].spec.nodes()
        inside = np.abs(nodes[:, 2] - volume.origin[2] - volume.spacing[2] * 24) < 0.6 * volume.spacing[2]
        x, y = ((nodes[inside] - volume.origin) / volume.spacing)[:, :2].T
        at = light.grids[0].support.ravel()[inside] > 0
        top.scatter(x[at], y[at], s=1.5, color="tab:orange")
    else:
        top.contour(slice_, levels=np.linspace(low, high, sampler.count), colors="tab:orange", linewidths=0.9)
    top.set_title(name)
    top.set_axis_off()
    bottom.imshow(render(light, isovalue=0.47, width=420, height=380))
    bottom.set_axis_off()
plt.show()

# %%
# The same from the command line, with blobs from ten points: tints on either side, and on the ceiling a shadow that the
# luminaire at the bottom casts upwards.

points = [
    "-.45,-.1,.1", "-.2,.25,.35", "-.05,-.3,.2", ".1,.15,-.1", ".35,-.15,.3", ".45,.2,0", ".2,-.35,-.3",
    "-.25,-.2,-.35", "-.4,.3,-.15", ".05,0,.5",
]  # fmt: skip
(RUNS / "blobs.csv").write_text("\n".join(points))
command("illumgrid density blobs.csv -o blobs.nrrd --spacing 0.05 --sigma 0.16")
command("illumgrid run blobs.nrrd --scene box --range 4 12 --grid 40 --isovalues 6 --no-preview -o blobs")
picture = command("illumgrid preview blobs --isovalue 7 --view 0,-12 --size 640 480 -o fig5.png")
figure, ax = plt.subplots(figsize=(6.4, 4.8), facecolor="0.235", layout="constrained")
ax.imshow(picture)
ax.set_axis_off()
plt.show()
