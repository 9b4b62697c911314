"""A sweep through the isovalues as a film: one exposure, one camera, the isovalue in a corner of each frame."""

import importlib.util
import io
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.light import Illumination
from illumgrid.show.captions import Picture, isovalues_of, labelled

SECONDS, SHORTEST, LONGEST = 4.0, 0.04, 0.5
"""Seconds that a film lasts, and bounds on those of each frame."""
ENDINGS = (".gif", ".webp", ".mp4")


def frames(light: Illumination, field: str | None, count: int, draw: Callable[[float], Picture]) -> Iterator[Picture]:
    """`count` pictures by `draw`, called with equal steps of the isovalue of `field` through its range."""
    scene = light.scene
    number = scene.number_of(field)
    for row in scene.levels(np.linspace(0.0, 1.0, count)):
        yield labelled(draw(float(row[number])), isovalues_of(scene, row))


def check_ending(name: str, ending: str) -> None:
    """Raise BadInput unless a film with this ending can be written here; none is a folder of PNG."""
    if ending and ending not in ENDINGS:
        raise BadInput(
            f"the sweep goes to {name!r}; expected a name that ends in {', '.join(ENDINGS)}, "
            "or one without an ending for a folder of PNG"
        )
    if ending == ".mp4" and not importlib.util.find_spec("imageio_ffmpeg"):
        raise BadInput(
            f"{name!r} needs imageio and ffmpeg, which are not installed; expected them for .mp4: "
            "pip install 'illumgrid[mp4]', or choose .webp"
        )


def film(pictures: list[Picture], ending: str) -> bytes:
    """Pictures of one size as a film that starts again at its end: ``.gif``, ``.webp`` or ``.mp4``."""
    shown_for = min(max(SECONDS / len(pictures), SHORTEST), LONGEST)
    if ending == ".mp4":
        return _mp4(pictures, 1 / shown_for)
    from PIL import Image

    options: dict[str, Any]
    if ending == ".gif":
        images, options = _one_palette(pictures), {"optimize": False, "disposal": 1}
    else:
        images, options = [Image.fromarray(p) for p in pictures], {"quality": 88, "method": 4}
    buffer = io.BytesIO()
    images[0].save(
        buffer, ending[1:], save_all=True, append_images=images[1:], duration=round(1000 * shown_for), loop=0, **options
    )
    return buffer.getvalue()


def _one_palette(pictures: list[Picture]) -> list[Any]:
    """Reduce to 256 colours that all frames share: a palette for each would flicker."""
    from PIL import Image

    some = pictures[:: max(1, len(pictures) // 8)]
    together = Image.fromarray(np.concatenate([p[::2, ::2] for p in some]))
    palette = together.quantize(256, method=Image.Quantize.FASTOCTREE)
    return [Image.fromarray(p).quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for p in pictures]


def _mp4(pictures: list[Picture], rate: float) -> bytes:
    import imageio.v3 as imageio

    height, width = pictures[0].shape[:2]
    odd = (0, height % 2), (0, width % 2), (0, 0)  # H.264 halves its colours: sides are even
    even = np.stack([np.pad(p, odd, mode="edge") for p in pictures])
    return bytes(
        imageio.imwrite(
            "<bytes>", even, extension=".mp4", plugin="FFMPEG", fps=rate, codec="libx264", quality=8,
            macro_block_size=2, pixelformat="yuv420p",
        )
    )  # fmt: skip
