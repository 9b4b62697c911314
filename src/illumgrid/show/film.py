"""A sweep through the isovalues as a film: one exposure, one camera, the isovalue in a corner of each frame."""

import importlib.util
import math
from collections.abc import Callable, Iterable, Iterator
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.light import Illumination
from illumgrid.show.captions import Picture, isovalues_of, labelled

SECONDS, SHORTEST, LONGEST = 4.0, 0.04, 0.5
"""Duration of a film, and bounds on that of each frame, in seconds."""
ENDINGS = (".gif", ".webp", ".mp4")


def frames(light: Illumination, field: str | None, count: int, draw: Callable[[float], Picture]) -> Iterator[Picture]:
    """`count` pictures by `draw`, called with equal steps of the isovalue of `field` through its range."""
    scene = light.scene
    number = scene.number_of(field)
    for row in scene.levels(np.linspace(0.0, 1.0, count)):
        yield labelled(draw(float(row[number])), isovalues_of(scene, row))


def check_ending(name: str, ending: str) -> None:
    """Raise BadInput unless a film with this ending can be written here; no ending means a folder of PNG."""
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


def film(pictures: Iterable[Picture], count: int, ending: str, out: IO[bytes]) -> None:
    """Write `count` pictures of one size as a looping film: ``.gif``, ``.webp`` or ``.mp4``.

    Each is encoded when it is drawn and then freed: only the encoded film grows in memory.
    """
    shown_for = min(max(SECONDS / count, SHORTEST), LONGEST)
    if ending == ".mp4":
        out.write(_mp4(pictures, 1 / shown_for))
    elif ending == ".gif":
        _gif(pictures, count, round(1000 * shown_for), out)
    else:
        from PIL import Image

        later = _Later(iter(pictures), count - 1)
        later.seek(0)
        options: dict[str, Any] = {"quality": 88, "method": 4, "duration": round(1000 * shown_for), "loop": 0}
        Image.fromarray(later.picture).save(out, "WEBP", save_all=True, append_images=[later] * (count > 1), **options)


class _Later:
    """The pictures after the first as an image of several frames, each drawn when Pillow seeks it."""

    def __init__(self, pictures: Iterator[Picture], count: int) -> None:
        self.pictures, self.n_frames = pictures, count

    def seek(self, number: int) -> None:
        """Advance to the next picture."""
        self.picture = next(self.pictures)

    def __getattr__(self, name: str) -> Any:
        from PIL import Image

        return getattr(Image.fromarray(self.picture), name)


def _gif(pictures: Iterable[Picture], count: int, duration: int, out: IO[bytes]) -> None:
    """Frames with a common palette of 256 colours, for which they wait on the disk; separate palettes would flicker."""
    from PIL import Image, ImageChops
    from PIL.GifImagePlugin import getdata, getheader

    some: list[Picture] = []
    with TemporaryFile(prefix="illumgrid-") as waiting:
        for number, picture in enumerate(pictures):
            waiting.write(np.ascontiguousarray(picture).data)
            if number % max(1, count // 8) == 0:
                some.append(picture[::2, ::2].copy())
        shape = picture.shape
        del picture
        palette = Image.fromarray(np.concatenate(some)).quantize(256, method=Image.Quantize.FASTOCTREE)
        waiting.seek(0)

        def frames_of() -> Iterator[Image.Image]:
            for _ in range(count):
                now = np.frombuffer(waiting.read(math.prod(shape)), np.uint8).reshape(shape)
                yield Image.fromarray(now).quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)

        later = frames_of()
        before = part = next(later)
        corner, lasts = (0, 0), duration
        out.writelines(getheader(part.copy(), info={"loop": 0, "duration": duration, "optimize": False})[0])
        for frame in later:
            if (box := ImageChops.subtract_modulo(frame, before).getbbox()) is None:
                lasts += duration  # nothing has changed
                continue
            out.writelines(getdata(part, corner, duration=lasts, disposal=1))
            before, part, corner, lasts = frame, frame.crop(box), box[:2], duration
        out.writelines(getdata(part, corner, duration=lasts, disposal=1))
        out.write(b";")


def _mp4(pictures: Iterable[Picture], rate: float) -> bytes:
    import imageio.v3 as imageio

    def even() -> Iterator[Picture]:  # H.264 subsamples colour: sides must be even
        for picture in pictures:
            height, width = picture.shape[:2]
            yield np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")

    each: Any = even()  # iterated once, contrary to the types of imageio
    return bytes(
        imageio.imwrite(
            "<bytes>", each, is_batch=True, extension=".mp4", plugin="FFMPEG", fps=rate, codec="libx264", quality=8,
            macro_block_size=2, pixelformat="yuv420p",
        )
    )  # fmt: skip
