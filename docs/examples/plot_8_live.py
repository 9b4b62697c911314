"""
Sweep it yourself
=================

Figures 7 and 8 of Banks and Beason (2007), interactively: the light was computed when these pages were built, and your
graphics card draws each isosurface. Each page is one file of about a megabyte, as ``illumgrid view DIR --export
page.html`` writes it.
"""

from pathlib import Path

import illumgrid as ig
from illumgrid.field.builtin import SCENES
from illumgrid.show.viewer import page

preset = SCENES["nucleus"]
light = ig.run(preset.make(), grid=preset.grid, paths=preset.paths // 2, isovalues=preset.isovalues)

folder = Path("../live")  # copied with these pages; outside the docs, the file goes to the current folder
file = (folder if folder.is_dir() else Path()) / "nucleus-live.html"
file.write_text(page(light), encoding="utf-8")

# %%
# **Two fields, one sweep** (Figure 7). Drag a slider: both densities follow, and so does the light on the walls. Drag
# the picture to turn it.
#
# .. raw:: html
#
#     <iframe src="../nucleus-live.html" title="Two fields, one sweep: interactive page" loading="lazy"
#       style="width: 100%; height: 560px; border: 1px solid #8886; border-radius: 6px"></iframe>
#
# **Display effects** (Figure 8). The same stored light on a translucent surface, or on a glossy one if you select it.
# These effects are drawn over light that was computed for matte, opaque surfaces.
#
# .. raw:: html
#
#     <iframe src="../nucleus-live.html#isovalue=0.4&amp;look=translucent" loading="lazy"
#       title="A translucent look over stored light: interactive page"
#       style="width: 100%; height: 560px; border: 1px solid #8886; border-radius: 6px"></iframe>
