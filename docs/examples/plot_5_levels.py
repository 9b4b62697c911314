"""
Levels and samples: from isosurfaces to a grid
==============================================

Figure 5 of Banks and Beason (2007) shows how a grid is made: light is asked for at points strewn over some isosurfaces
(the sampler ``uniform``), and the nodes of the grid take it from the points nearest to them. Few isosurfaces leave gaps
between them, whose nodes take light from a surface that is not theirs; many close the gaps. The sampler ``direct`` asks
at the nodes themselves, each on the isosurface through it.

The scene is the paper's: one blob in a box, red wall left, green wall right, a luminaire at the bottom.
"""

import warnings

import matplotlib.pyplot as plt
import numpy as np

import illumgrid as ig
from illumgrid.field.builtin import spread
from illumgrid.show.render import render

random = np.random.default_rng(4)
volume = spread(random.uniform(-0.55, 0.55, (14, 3)), voxels=48, sigma=0.17)
scene = ig.Scene.box(volume, range=(0.25, 0.85))

# %%
# The isosurfaces that three settings ask at, in the slice through the middle of the field, and the picture that comes
# of it, all at one isovalue that none of them asked at.
#
# **What to look for:** with three levels the surface is blotched: its nodes have the light of isosurfaces that lie
# elsewhere and face elsewhere. With twelve the blotches shrink. ``direct`` has none of them: what is left is the noise
# of sixteen paths.

warnings.simplefilter("ignore", ig.IllumgridWarning)  # nodes without a sample in reach: here that is the subject
samplers = {
    "3 levels": ig.sampler("uniform", count=3),
    "12 levels": ig.sampler("uniform", count=12),
    "direct": ig.sampler("direct"),
}
figure, axes = plt.subplots(2, 3, figsize=(10, 6.6), height_ratios=(1, 1.05), layout="constrained")
low, high = scene.fields[0].range
for (name, sampler), top, bottom in zip(samplers.items(), *axes):
    light = ig.run(scene, sampler=sampler, grid=40, paths=64, bounces=4)
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
