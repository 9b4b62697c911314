"""Text on a picture: the isovalues it shows, and a scale bar."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import shown
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats, Volume
from illumgrid.show.camera import Camera

Picture = NDArray[np.uint8]

BAR = 0.2  # of the width: the scale bar is the longest round length up to this


def isovalues_of(scene: Scene, row: Floats) -> str:
    """Isovalues (F,) as a line of text; with names where there are several."""
    if len(row) == 1:
        return shown(row[0], scene.fields[0].range)
    return ",  ".join(f"{field.name}: {shown(isovalue, field.range)}" for field, isovalue in zip(scene.fields, row))


def labelled(picture: Picture, text: str) -> Picture:
    """A picture (height, width, 3 or 4) with a line of text in its lower left corner."""
    from PIL import Image, ImageDraw

    height, size = picture.shape[0], _text_size(picture)
    image = Image.fromarray(picture)
    place = size // 2, height - size // 2
    ImageDraw.Draw(image).text(place, text, _ink(picture[-size:, : 4 * size]), _font(size), anchor="ls")
    return np.asarray(image)


def scale_bar(picture: Picture, camera: Camera, middle: Floats, volume: Volume) -> Picture:
    """A picture with a bar of a round length in its lower right corner.

    In perspective a length depends on depth: the bar is valid at the depth of the world point `middle` (3,). The unit
    is that of `volume`, or world units if it has none.
    """
    from PIL import Image, ImageDraw

    height, width = picture.shape[:2]
    size = _text_size(picture)
    unit = float((middle - camera.eye) @ camera.forward) * 2 * camera.tangent / height  # world units per pixel
    length = round_down(BAR * width * unit)
    image = Image.fromarray(picture)
    draw, ink = ImageDraw.Draw(image), _ink(picture[-2 * size :, -width // 4 :])
    right, bottom = width - size, height - size // 2
    left = right - round(length / unit)
    draw.rectangle((left, bottom - max(2, size // 6), right, bottom), fill=ink)
    words = f"{length:g} {volume.unit}" if volume.unit else f"{length:g}"
    draw.text(((left + right) / 2, bottom - size // 2), words, ink, _font(size), anchor="ms")
    return np.asarray(image)


def color_bar(picture: Picture, table: NDArray[np.uint8], ends: tuple[float, float], name: str) -> Picture:
    """A picture with a colormap (n, 3) in its upper right corner, the values at its ends, and a name."""
    from PIL import Image, ImageDraw

    width, size = int(picture.shape[1]), _text_size(picture)
    image, across = Image.fromarray(picture), max(2, round(0.25 * width))
    colors = table[np.linspace(0, len(table) - 1, across).round().astype(int)]
    bar = np.repeat(colors[None], max(4, size // 2), axis=0)
    left, top, ink = width - size - across, size // 2, _ink(picture[: 3 * size, -width // 3 :])
    image.paste(Image.fromarray(bar), (left, top))
    draw, font, below = ImageDraw.Draw(image), _font(size), top + len(bar) + size // 4
    low, high = (shown(end, ends) for end in ends)
    draw.text((left, below), low, ink, font, anchor="lt")
    draw.text((left + across, below), high, ink, font, anchor="rt")
    room = across - sum(font.getlength(f"{end}  ") for end in (low, high))
    if font.getlength(name) <= room:
        draw.text((left + across / 2, below), name, ink, font, anchor="mt")
    else:
        draw.text((left + across, below + size + size // 4), name, ink, font, anchor="rt")
    return np.asarray(image)


def round_down(length: float) -> float:
    """The largest of 1, 2 or 5 times a power of ten up to `length`."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9))


def _text_size(picture: Picture) -> int:
    return max(12, int(picture.shape[0]) // 32)


def _font(size: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size)


def _ink(ground: Picture) -> tuple[int, ...]:
    """Light on a dark ground, dark on a light one, a medium grey where the ground is transparent."""
    if ground.shape[2] == 4 and ground[..., 3].mean() < 128:
        return 128, 128, 128, 255
    tone = 225 if ground[..., :3].mean() < 128 else 40
    return (tone, tone, tone, 255)[: int(ground.shape[2])]
