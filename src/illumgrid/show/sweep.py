"""A sweep through the isovalues as a film: one exposure, one camera, the isovalue in a corner of each frame."""

import importlib.util
import io
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput

if TYPE_CHECKING:
    from illumgrid.field.scene import Scene
    from illumgrid.light import Illumination

Picture = NDArray[np.uint8]

SECONDS, SHORTEST, LONGEST = 4.0, 0.04, 0.5
"""A film lasts this long, as far as no frame stands shorter or longer than this many seconds."""
ENDINGS = (".gif", ".webp", ".mp4")


def frames(light: "Illumination", field: str | None, count: int, draw: Callable[[float], Picture]) -> Iterator[Picture]:
    """`count` pictures by `draw`, called with equal steps of the isovalue of `field` through its range."""
    scene = light.scene
    number = scene.number_of(field)
    for row in scene.levels(np.linspace(0.0, 1.0, count)):
        yield labelled(draw(float(row[number])), isovalues_of(scene, row))


def isovalues_of(scene: "Scene", row: NDArray[np.float64]) -> str:
    """Isovalues (F,) as a line of text; with names where there are several."""
    if len(row) == 1:
        return f"{row[0]:.4g}"
    return ",  ".join(f"{field.name}: {isovalue:.4g}" for field, isovalue in zip(scene.fields, row))


def labelled(picture: Picture, text: str) -> Picture:
    """A picture (height, width, 3) with a line of text in its lower left corner, light or dark as its ground wants."""
    from PIL import Image, ImageDraw, ImageFont

    height = picture.shape[0]
    size = max(12, height // 32)
    image = Image.fromarray(picture)
    tone = 225 if picture[-size:, : 4 * size].mean() < 128 else 40
    place = size // 2, height - size // 2
    ImageDraw.Draw(image).text(place, text, (tone,) * 3, ImageFont.load_default(size), anchor="ls")
    return np.asarray(image)


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
    stands = min(max(SECONDS / len(pictures), SHORTEST), LONGEST)
    if ending == ".mp4":
        return _mp4(pictures, 1 / stands)
    from PIL import Image

    options: dict[str, Any]
    if ending == ".gif":
        images, options = _one_palette(pictures), {"optimize": False, "disposal": 1}
    else:
        images, options = [Image.fromarray(p) for p in pictures], {"quality": 88, "method": 4}
    buffer = io.BytesIO()
    images[0].save(
        buffer, ending[1:], save_all=True, append_images=images[1:], duration=round(1000 * stands), loop=0, **options
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
