"""The code of the page "In PyVista" runs unchanged, in its own process because VTK can crash it."""

import re
import subprocess
import sys
from ctypes.util import find_library
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from illumgrid.io import exports
from shapes import ball, lit, sky

PAGE = (Path(__file__).parents[1] / "docs" / "in_pyvista.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def drawn(tmp_path, code):
    """The picture (h, w, 3) drawn by the page's code, for a run and an isovalue of this test."""
    if not find_library("EGL") and not find_library("OSMesa"):
        pytest.skip("neither EGL nor OSMesa is installed, without which VTK draws nothing off screen")
    code = code.replace("brain-light", str(tmp_path / "light")).replace("brain.vti", str(tmp_path / "ball.vti"))
    code = code.replace("85.0", "0.6")
    code = code.replace("plotter.show()", 'plotter.show(screenshot="shown.png")').replace(
        "surface.plot(", 'surface.plot(screenshot="shown.png", '
    )
    code = 'import pyvista\npyvista.OFF_SCREEN = True\npyvista.global_theme.background = "black"\n' + code
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return np.array(Image.open(tmp_path / "shown.png"))[..., :3]


@pytest.mark.parametrize("block", range(2))
def test_what_is_drawn_is_the_light_and_no_other(tmp_path, block):
    light = lit(sky(ball(24), (0.3, 0.9), albedo=(0.8, 0.5, 0.2)), value=1.0)
    light.save(tmp_path / "light", preview=False)
    exports.write(light, tmp_path / "ball.vti")
    picture = drawn(tmp_path, BLOCKS[block])
    shown = picture[picture.any(axis=2)]
    colors, counts = np.unique(shown, axis=0, return_counts=True)
    ours = light.color([[0.0, 0.0, 0.0]])[0]
    assert len(set(ours.tolist())) == 3
    assert np.abs(colors[np.argmax(counts)].astype(int) - ours).max() <= 1
    # A ball under a lamp would have every tone; here only its antialiased rim has another.
    assert counts.max() > 0.97 * len(shown) and len(shown) > 0.1 * picture[..., 0].size
