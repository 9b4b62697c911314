"""Pictures: an isosurface lit by a lookup, by OpenGL where there is one, else marched in software."""

import io
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.errors import BadInput
from illumgrid.field.volume import box_corners
from illumgrid.show import gl, meshes, software
from illumgrid.show.block import Block
from illumgrid.show.camera import VIEWS, Camera, View, camera_around, fit_camera, widest_row
from illumgrid.show.shade import BACKGROUND, CAP_TONE, Colors, Shown
from illumgrid.show.trust import scale
from illumgrid.tone import decode_srgb, encode_srgb

if TYPE_CHECKING:
    from illumgrid.light import Illumination

__all__ = [
    "BACKGROUND", "CAP_TONE", "ENGINES", "VIEWS", "Camera", "choose_engine", "fit_camera", "grid_volume", "png",
    "render", "widest_row",
]  # fmt: skip

ENGINES = ("auto", "egl", "osmesa", "software")


def choose_engine(name: str) -> tuple[str, str]:
    """Engine that draws when `name` is asked for, and why.

    Raises
    ------
    BadInput
        If it is unknown, or not here.
    """
    if name not in ENGINES:
        raise BadInput(f"the engine is {name!r}; expected one of {', '.join(ENGINES)}")
    if name == "software":
        return name, "as asked"
    reasons = []
    for platform in gl.PACKAGES if name == "auto" else (name,):
        reason = gl.unavailable(platform)
        if reason is None:
            return platform, "as asked" if name == platform else f"OpenGL answers by {platform.upper()}"
        reasons.append(f"no {platform.upper()} ({reason})")
    if name == "auto":
        return "software", f"{' and '.join(reasons)}; apt-get install {' '.join(gl.PACKAGES.values())} brings OpenGL"
    raise BadInput(
        f"the engine {name} was asked for, but there is {reasons[0]}; install it (apt-get install {gl.PACKAGES[name]} "
        "on Debian and Ubuntu) or choose --engine software"
    )


@dataclass(frozen=True, eq=False)
class _Sheet:
    """What every engine draws upon."""

    width: int
    height: int
    background: Colors

    def __post_init__(self) -> None:
        if not (1 <= self.width <= gl.LARGEST and 1 <= self.height <= gl.LARGEST):
            raise BadInput(
                f"the size is {self.width} x {self.height} pixels; expected 1 to {gl.LARGEST} along each side"
            )


def render(
    light: "Illumination",
    field: str | None = None,
    isovalue: float | None = None,
    *,
    width: int = 960,
    height: int = 720,
    local: bool = False,
    trust: bool = False,
    view: View = None,
    zoom: float = 1.0,
    background: str | None = None,
    engine: str = "software",
    camera: Camera | None = None,
) -> NDArray[np.uint8]:
    """Picture (height, width, 3), sRGB, of one setting of the sweep.

    Parameters
    ----------
    light : Illumination
    field : str, optional
        The field that `isovalue` belongs to, by default the first; the others follow the common sweep.
    isovalue : float, optional
        By default the middle of the range.
    width, height : int
        Pixels.
    local : bool
        Light by a lamp at the camera only, for comparison.
    trust : bool
        In place of light its relative error bar, with a scale below; holes are hatched, walls and caps, which have no
        bar, are grey.
    view : str or (azimuth, elevation), optional
        A name of `VIEWS`, or degrees to the right of the front and upwards.
    zoom : float
        Enlarges the middle of the picture.
    background : str, optional
        Colour around the object, as CSS writes it: ``"white"``, ``"#202030"``. By default a dark grey.
    engine : {"software", "auto", "egl", "osmesa"}
        What draws: see `choose_engine`.
    camera : Camera, optional
        In place of `view` and `zoom`.

    Raises
    ------
    BadInput
        On what cannot be understood, or an engine that is not here.
    """
    drawn_by, _ = choose_engine(engine)
    sheet = _Sheet(width, height, _background(background))
    below = [scale(light, width, height, encode_srgb(sheet.background))] if trust else []
    sheet = replace(sheet, height=height - sum(map(len, below)))
    scene = light.scene
    number = scene.number_of(field)
    row = scene.levels(0.5)[0] if isovalue is None else scene.levels_through(number, isovalue)[0]
    shown = Shown(light, row, float(np.clip(scene.fields[number].place(row[number]), 0.0, 1.0)), local, trust)
    if camera is None:
        camera = fit_camera(scene, row, sheet.width / sheet.height, view, zoom)
    return np.concatenate([encode_srgb(_drawn(shown, camera, sheet, drawn_by)), *below])


def _drawn(shown: Shown, camera: Camera, sheet: _Sheet, engine: str) -> Colors:
    paper = sheet.width, sheet.height, sheet.background
    if engine == "software":
        return software.draw(shown, camera, *paper)
    return gl.draw(meshes.triangles(shown, camera.eye), camera, *paper, engine)


def grid_volume(
    light: "Illumination",
    field: str | None = None,
    *,
    width: int = 960,
    height: int = 720,
    cut: bool = False,
    view: View = None,
    zoom: float = 1.0,
    background: str | None = None,
    engine: str = "software",
) -> NDArray[np.uint8]:
    """Picture (height, width, 3), sRGB, of the illumination grid of a field as a block (Figure 6 of the paper).

    Each point of it has the colour that the level set through that point shows there, at the exposure of all pictures.
    Parameters are those of `render`; `cut` leaves out the octant towards the eye, so that one looks inside.
    """
    drawn_by, _ = choose_engine(engine)
    sheet = _Sheet(width, height, _background(background))
    number = light.scene.number_of(field)
    spec = light.grids[number].spec
    camera = camera_around(box_corners(spec), spec.direction, width / height, view or (30.0, 24.0), zoom)
    shown = Shown(light, light.scene.levels(0.5)[0], 0.5, local=False)
    block, paper = Block(shown, number, camera.eye, cut), (sheet.width, sheet.height, sheet.background)
    if drawn_by == "software":
        return encode_srgb(block.draw(camera, *paper))
    return encode_srgb(gl.draw(block.sheets(), camera, *paper, drawn_by))


def _background(color: str | None) -> Colors:
    """Display-linear (3,) of a colour in the words of CSS."""
    if color is None:
        return np.full(3, BACKGROUND, dtype=np.float32)
    from PIL import ImageColor

    try:
        return decode_srgb(np.array(ImageColor.getrgb(color)[:3], dtype=np.uint8))
    except ValueError:
        raise BadInput(
            f"the background is {color!r}; expected a colour as CSS writes it, such as white or #202030"
        ) from None


def png(picture: ArrayLike) -> bytes:
    """A picture (height, width, 3) as a PNG file."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.asarray(picture, np.uint8)).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()
