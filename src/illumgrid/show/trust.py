"""Display of error bars: the relative error of each lookup, and the holes, as colours on the surface.

The still picture and the page share one definition. The relative error of a lookup is its standard error over the mean
light of the grid's supported nodes; a hole is a lookup that mixes at least one node without light of its own.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats
from illumgrid.grid import IlluminationGrid
from illumgrid.light import Illumination
from illumgrid.tone import decode_srgb, encode_srgb

LOW, HIGH = 0.003, 0.3  # relative errors at the ends of the scale
TICKS = {0.003: "< 0.3 %", 0.01: "1 %", 0.03: "3 %", 0.1: "10 %", 0.3: "> 30 %"}
RESOLVED = 1.5  # `IlluminationGrid.resolution` below which bars are a lower bound
SMALLEST = 240, 180  # pixels of a picture with a legible scale
# Five colours of viridis (S. van der Walt and N. Smith, 2015), even steps, from certain to uncertain.
SCALE = decode_srgb(np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], np.uint8))
HATCH = decode_srgb(np.array([(214, 48, 60), (128, 16, 30)], np.uint8))  # reds: neither the scale nor walls have any
_STRIPES = 60  # of a hole, along the longest axis of the grid
_FLOOR = 0.4  # brightness of a surface that is seen edge-on, so that its shape shows


def scale_colors(bars: Floats) -> NDArray[np.float32]:
    """Display-linear colours (n, 3) of relative errors (n,) on a logarithmic scale."""
    share = np.clip(np.log(np.maximum(bars, 1e-9) / LOW) / np.log(HIGH / LOW), 0, 1)
    return np.stack([np.interp(share, np.linspace(0, 1, len(SCALE)), SCALE[:, c]) for c in range(3)], axis=1).astype(
        np.float32
    )


def relative(grid: IlluminationGrid, error: NDArray[np.floating]) -> Floats:
    """Standard errors over the mean light of the grid; unchanged if that is 0, infinite in holes."""
    return np.asarray(error, dtype=float) / (grid.mean or 1.0)


def trust_colors(grid: IlluminationGrid, points: Floats, facing: Floats) -> NDArray[np.float32]:
    """Display-linear colours (n, 3) of a surface at world points (n, 3): relative error bars, holes hatched."""
    bars = relative(grid, grid.uncertainty(points))
    hole = ~np.isfinite(bars)
    colors = scale_colors(np.where(hole, 0.0, bars))
    if hole.any():
        spec = grid.spec
        across = (points[hole] - spec.origin).sum(axis=1) * _STRIPES / (spec.spacing * (np.array(spec.shape) - 1)).max()
        colors[hole] = HATCH[np.floor(across).astype(int) % 2]
    shape = _FLOOR + (1 - _FLOOR) * np.clip(facing, 0, 1)
    return (colors * shape[:, None]).astype(np.float32)


def doubts(light: Illumination) -> list[str]:
    """Where the error bars of a run are incomplete, and why; each text ends a sentence."""
    names, found = [field.name for field in light.scene.fields], []
    rough = [name for name, grid in zip(names, light.grids) if grid.resolution < RESOLVED]
    if rough:
        found.append(f"lower bounds only: the grid does not resolve the light of {', '.join(rough)}")
    silent = [name for name, g in zip(names, light.grids) if not np.isfinite(g.held.error[g.held.support > 0]).all()]
    if silent:
        found.append(f"too few paths to estimate the error of {', '.join(silent)}, which is hatched like a hole")
    return found


def scale(light: Illumination, width: int, height: int, ground: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The strip (rows, width, 3) below a picture of this size: the scale of its colours, and the `doubts`.

    Parameters
    ----------
    light : Illumination
    width, height : int
        Pixels of the whole picture.
    ground : (3,) uint8
        Its background.

    Raises
    ------
    BadInput
        If the picture is too small for words.
    """
    from PIL import Image, ImageDraw, ImageFont

    if width < SMALLEST[0] or height < SMALLEST[1]:
        least = f"{SMALLEST[0]} x {SMALLEST[1]}"
        raise BadInput(f"the size is {width} x {height} pixels; expected at least {least} for the scale of error bars")
    text, bar = max(11, min(height // 40, width // 53)), max(8, height // 45)
    font = ImageFont.load_default(text)
    sentences = ["standard error of the light, relative to its mean", *doubts(light)]
    lines = [line for one in sentences for line in _wrapped(one, lambda line: font.getlength(line) <= width - 2 * text)]
    line, wide = text + text // 3, int(0.55 * width)
    left, top = int(0.17 * width), text + len(lines) * line
    image = Image.new("RGB", (width, top + bar + text // 4 + line + 2 * text), tuple(int(c) for c in ground))
    draw, tone = ImageDraw.Draw(image), (225,) * 3 if ground.mean() < 128 else (40,) * 3
    for number, words in enumerate(lines):
        draw.text((width / 2, text // 2 + number * line), words, tone, font, anchor="mt")
    _paste(image, scale_colors(np.geomspace(LOW, HIGH, wide)), left, top, bar)
    for value, label in TICKS.items():
        x = left + wide * np.log(value / LOW) / np.log(HIGH / LOW)
        draw.text((x, top + bar + text // 4), label, tone, font, anchor="mt")
    patch = HATCH[np.arange(5 * bar) * 2 // bar % 2]
    x = int(0.86 * width) - len(patch) // 2
    _paste(image, patch, x, top, bar)
    draw.text((x + len(patch) / 2, top + bar + text // 4), "hole", tone, font, anchor="mt")
    return np.asarray(image)


def _wrapped(text: str, fits: Callable[[str], bool]) -> list[str]:
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if fits(longer) or not lines[-1]:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def _paste(image: Any, colors: NDArray[np.float32], left: int, top: int, rows: int) -> None:
    """A line of display-linear colours (n, 3), `rows` high."""
    from PIL import Image

    image.paste(Image.fromarray(np.repeat(encode_srgb(colors)[None], rows, axis=0)), (left, top))
