"""How far the light can be trusted, painted onto the surface: the error bar of each lookup, and the holes."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from illumgrid.grid import IlluminationGrid
from illumgrid.tone import decode_srgb
from illumgrid.volume import Floats

if TYPE_CHECKING:
    from illumgrid.illumination import Illumination

LOW, HIGH = 0.003, 0.3  # bars, relative to the mean light, at the ends of the scale
RESOLVED = 1.5  # `IlluminationGrid.resolution` below which bars are a lower bound
# Five colours of viridis (S. van der Walt and N. Smith, 2015), even steps, from sure to unsure.
_SCALE = decode_srgb(np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], np.uint8))
_HATCH = decode_srgb(np.array([(214, 40, 120), (40, 8, 24)], np.uint8))  # stripes of a hole
_FLOOR = 0.4  # brightness of a surface that is seen edge-on, so that its shape shows


def scale_colors(bars: Floats) -> NDArray[np.float32]:
    """Display-linear colours (n, 3) of bars (n,) relative to the mean light; the scale is logarithmic."""
    share = np.clip(np.log(np.maximum(bars, 1e-9) / LOW) / np.log(HIGH / LOW), 0, 1)
    return np.stack([np.interp(share, np.linspace(0, 1, len(_SCALE)), _SCALE[:, c]) for c in range(3)], axis=1).astype(
        np.float32
    )


def trust_colors(grid: IlluminationGrid, points: Floats, facing: Floats) -> NDArray[np.float32]:
    """Display-linear colours (n, 3) of a surface at world points (n, 3): its relative bars, holes hatched."""
    lit = grid.support > 0
    mean = float(grid.values[lit].mean()) if lit.any() else 1.0
    bars = grid.uncertainty(points).astype(float)
    hole = ~np.isfinite(bars)
    colors = scale_colors(np.where(hole, 0.0, bars / max(mean, 1e-30)))
    if hole.any():
        across = (points[hole] - grid.spec.origin).sum(axis=1) / (2 * grid.spec.spacing.max())
        colors[hole] = _HATCH[np.floor(across).astype(int) % 2]
    shape = _FLOOR + (1 - _FLOOR) * np.clip(facing, 0, 1)
    return (colors * shape[:, None]).astype(np.float32)


def with_scale(picture: NDArray[np.uint8], light: "Illumination") -> NDArray[np.uint8]:
    """A picture (height, width, 3) with the scale below it, and a word where bars are only a lower bound."""
    from PIL import Image, ImageDraw, ImageFont

    from illumgrid.tone import encode_srgb

    height, width = picture.shape[:2]
    text = max(11, height // 40)
    wide, bar = int(width * 0.5), max(8, height // 45)
    left, top = (width - wide) // 2, height - 3 * text - bar
    ramp = encode_srgb(scale_colors(np.geomspace(LOW, HIGH, wide)))
    picture = picture.copy()
    picture[top - 2 * text :] = picture[top - 2 * text :] // 3  # the scale is read on any ground
    image = Image.fromarray(picture)
    image.paste(Image.fromarray(np.repeat(ramp[None], bar, axis=0)), (left, top))
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(text)
    tone = (225,) * 3
    for value in (0.003, 0.01, 0.03, 0.1, 0.3):
        x = left + wide * np.log(value / LOW) / np.log(HIGH / LOW)
        draw.text((x, top + bar + text // 4), f"{100 * value:g} %", tone, font, anchor="mt")
    rough = [f.name for f, g in zip(light.scene.fields, light.grids) if g.resolution < RESOLVED]
    line = "standard error of the light, relative to its mean; holes are hatched"
    if rough:
        line = f"at least this far off: the grid does not resolve the light of {', '.join(rough)}; holes are hatched"
    draw.text((width / 2, top - text // 3), line, tone, font, anchor="mb")
    return np.asarray(image)
