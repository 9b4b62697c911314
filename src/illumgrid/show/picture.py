"""Pictures: an isosurface lit by lookups, a strip of several, and the illumination grid as a block."""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.bake.accumulator import Progress
from illumgrid.errors import BadInput
from illumgrid.field.upright import axes_of, up_of
from illumgrid.field.volume import box_corners
from illumgrid.light import Illumination
from illumgrid.show import triangles
from illumgrid.show.block import Block
from illumgrid.show.camera import Camera, View, camera_around, fit_camera, outline_of
from illumgrid.show.captions import color_bar, isovalues_of, labelled, scale_bar
from illumgrid.show.cuts import clips_of
from illumgrid.show.engines import choose_engine, gl, software
from illumgrid.show.exact import Exact, Gathering
from illumgrid.show.shade import BACKGROUND, Colors, Shown, opaque
from illumgrid.show.tints import Tint
from illumgrid.show.trust import scale
from illumgrid.tone import decode_srgb, encode_srgb

Picture = NDArray[np.uint8]

LARGEST = 16384  # most pixels along a side; in total, those of a square of half that side
STOPS = 20.0  # largest exposure in EV, up or down


@dataclass(frozen=True, eq=False)
class _Sheet:
    """Size, background and engine of a picture."""

    width: int
    height: int
    background: Colors
    engine: str

    def __post_init__(self) -> None:
        if not (1 <= self.width <= LARGEST and 1 <= self.height <= LARGEST):
            raise BadInput(f"the size is {self.width} x {self.height} pixels; expected 1 to {LARGEST} along each side")
        if self.width * self.height > LARGEST**2 // 4:
            raise BadInput(
                f"the size is {self.width} x {self.height} pixels; expected at most {LARGEST**2 // 4 / 1e6:.0f} million"
            )

    @property
    def ground(self) -> NDArray[np.uint8]:
        """Colour (3,) behind captions, sRGB."""
        color = self.background[:3] if self.background[3] else np.full(3, BACKGROUND)
        return encode_srgb(color)

    def finished(self, picture: Picture) -> Picture:
        """A picture (height, width, 4), without its coverage if everything is covered."""
        return picture[..., :3] if self.background[3] else picture


def render(
    light: Illumination,
    field: str | None = None,
    isovalue: float | None = None,
    *,
    width: int = 960,
    height: int = 720,
    local: bool = False,
    trust: bool = False,
    stops: float = 0.0,
    view: View = None,
    zoom: float = 1.0,
    up: str | None = None,
    roll: float = 0.0,
    background: str | None = None,
    bar: bool = False,
    engine: str = "software",
    camera: Camera | None = None,
    exact: Exact | None = None,
    watch: Callable[[Picture], None] | None = None,
    progress: Progress = lambda what, done, total: None,
    clip: Sequence[str] = (),
    tint: Tint | None = None,
) -> Picture:
    """Picture (height, width, 3), sRGB, of one setting of the sweep; (height, width, 4) on a transparent background.

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
        Use a lamp at the camera instead of the stored light, for comparison.
    trust : bool
        Show relative error bars instead of light, with a scale below; holes are hatched, and walls and caps, which have
        no bar, are grey.
    stops : float
        Exposure in EV beyond the automatic one, `Illumination.exposure`: each doubles the light.
    view : str or (azimuth, elevation), optional
        A name of `VIEWS`, or degrees to the right of the front and upwards.
    zoom : float
        Magnification about the middle of the picture.
    up : str, optional
        World direction that is up: a name of `UPS`.
    roll : float
        Degrees by which the picture is rotated clockwise.
    background : str, optional
        CSS colour around the object: ``"white"``, ``"#202030"``, ``"transparent"``. By default a dark
        grey.
    bar : bool
        Draw a scale bar, valid at the depth of the middle of the object.
    engine : {"software", "auto", "egl", "osmesa"}
        Rendering engine: see `choose_engine`.
    camera : Camera, optional
        Replaces `view`, `zoom`, `up` and `roll`.
    exact : Exact, optional
        Gather light by rays from every pixel, drawn in software: see `illumgrid.show.exact`. Not with `local`, `trust`.
    watch : callable, optional
        Called with each intermediate exact picture, of four times as many rays as the one before, and with the last.
    progress : callable, optional
        Called with (what, done, total) while light is gathered.
    clip : sequence of str
        Planes beyond which only walls are drawn: see `illumgrid.show.cuts.clips_of`. Cuts show the data in grey; the
        light is that of the whole solid.
    tint : Tint, optional
        Colours of a second quantity instead of the fields' own, with a legend.

    Raises
    ------
    BadInput
        On invalid arguments, or an engine that is not available.
    """
    sheet = _sheet(width, height, background, engine)
    if not -STOPS <= stops <= STOPS:
        raise BadInput(f"the exposure is {stops} EV; expected a number from {-STOPS:g} to {STOPS:g}")
    shown = replace(_shown(light, field, isovalue, local, trust, stops), clips=clips_of(clip, light.scene), tint=tint)
    strips = [scale(light, width, height, sheet.ground)] if trust else []
    rows = height - sum(map(len, strips))
    if camera is None:
        camera = fit_camera(light.scene, shown.row, width / rows, view, zoom, up=up, roll=roll)
    if exact is None or local or trust:
        drawn = iter([_drawn(shown, camera, sheet, rows)])
    else:
        made = Gathering(shown, camera, width, height, exact)
        drawn = made.pictures(sheet.background, watch is not None, progress)
    for one in drawn:
        picture = sheet.finished(one)
        if bar:
            outline = outline_of(light.scene, shown.row)
            middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
            picture = scale_bar(picture, camera, middle, light.scene.fields[0].volume)
        if tint is not None and not trust:
            picture = color_bar(picture, tint.table, tint.ends, tint.name)
        if watch is not None:
            watch(picture)
    if strips and picture.shape[2] == 4:
        strips = [np.concatenate([s, np.full((*s.shape[:2], 1), 255, np.uint8)], axis=2) for s in strips]
    return np.concatenate([picture, *strips])


def _shown(
    light: Illumination, field: str | None, isovalue: float | None, local: bool, trust: bool, stops: float
) -> Shown:
    scene = light.scene
    number = scene.number_of(field)
    row = scene.levels(0.5)[0] if isovalue is None else scene.levels_through(number, isovalue)[0]
    t = float(np.clip(scene.fields[number].place(row[number]), 0.0, 1.0))
    return Shown(light, row, t, local, trust, stops)


def _drawn(shown: Shown, camera: Camera, sheet: _Sheet, rows: int) -> Picture:
    if sheet.engine == "software" or not shown.plain:
        return software.draw(shown, camera, sheet.width, rows, sheet.background)
    parts = triangles.seen(shown, camera.eye)
    return gl.draw(parts, camera, sheet.width, rows, sheet.background, sheet.engine)


def strip(
    light: Illumination,
    isovalues: Sequence[float],
    field: str | None = None,
    *,
    width: int = 960,
    height: int = 720,
    view: View = None,
    zoom: float = 1.0,
    up: str | None = None,
    roll: float = 0.0,
    camera: Camera | None = None,
    **options: object,
) -> Picture:
    """Pictures of several isovalues side by side in one frame, by one camera that holds them all, each labelled.

    Parameters are those of `render`; `width` and `height` are those of each panel.
    """
    number = light.scene.number_of(field)
    rows = light.scene.levels_through(number, isovalues)
    if camera is None:
        camera = fit_camera(light.scene, rows, width / height, view, zoom, up=up, roll=roll)
    panels = []
    for row in rows:
        panel = render(light, field, float(row[number]), width=width, height=height, camera=camera, **options)  # type: ignore[arg-type]
        panels.append(labelled(panel, isovalues_of(light.scene, row)))
    return np.concatenate(panels, axis=1)


def grid_volume(
    light: Illumination,
    field: str | None = None,
    *,
    width: int = 960,
    height: int = 720,
    cut: bool = False,
    stops: float = 0.0,
    view: View = None,
    zoom: float = 1.0,
    up: str | None = None,
    roll: float = 0.0,
    background: str | None = None,
    engine: str = "software",
    camera: Camera | None = None,
) -> Picture:
    """Picture, sRGB, of the illumination grid of a field as a block (Figure 6 of the paper).

    Each point has the colour that the level set through that point has there, at the exposure of all pictures.
    Parameters are those of `render`; `cut` leaves out the octant towards the eye, which shows the inside.
    """
    sheet = _sheet(width, height, background, engine)
    number = light.scene.number_of(field)
    spec = light.grids[number].spec
    if camera is None:
        axes = axes_of(spec.direction, up_of(light.scene) if up is None else up)
        camera = camera_around(box_corners(spec), axes, width / height, view or (30.0, 24.0), zoom, roll)
    block = Block(_shown(light, field, None, False, False, stops), number, camera.eye, cut)
    return sheet.finished(block.draw(camera, width, height, sheet.background))


def _sheet(width: int, height: int, background: str | None, engine: str) -> _Sheet:
    return _Sheet(width, height, _background(background), choose_engine(engine)[0])


def _background(color: str | None) -> Colors:
    """Display-linear colour and coverage (4,) of a CSS colour."""
    if color is None:
        return opaque(np.full(3, BACKGROUND, dtype=np.float32))
    if color == "transparent":
        return np.zeros(4, np.float32)
    from PIL import ImageColor

    try:
        return opaque(decode_srgb(np.array(ImageColor.getrgb(color)[:3], dtype=np.uint8)))
    except ValueError:
        raise BadInput(
            f"the background is {color!r}; expected a colour as CSS writes it, such as white, #202030 or transparent"
        ) from None


def png(picture: ArrayLike, about: dict[str, str] | None = None) -> bytes:
    """A picture (height, width, 3 or 4) as the bytes of a PNG file; its text states the version, and `about`.

    Parameters
    ----------
    picture : (height, width, 3 or 4) uint8
    about : dict of str, optional
        Text chunks by keyword, such as the command.
    """
    from PIL import Image, PngImagePlugin

    text = PngImagePlugin.PngInfo()
    for keyword, value in {"Software": f"illumgrid {version('illumgrid')}", **(about or {})}.items():
        text.add_itxt(keyword, value)
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(picture, np.uint8)).save(buffer, "PNG", optimize=True, pnginfo=text)
    return buffer.getvalue()
