"""``illumgrid preview``: pictures and films of a finished run."""

import math
import shlex
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from illumgrid.cli.lights import SkyImage, Turn, Weights, relit
from illumgrid.cli.long import loaded
from illumgrid.cli.looks import Clips, Color, ColorMap, ColorRange, Look, looking, tint_of
from illumgrid.cli.terminal import progress_bars, reported_warnings, say
from illumgrid.errors import BadInput, shown, shown_range

if TYPE_CHECKING:
    from illumgrid.light import Illumination
    from illumgrid.show import Camera
    from illumgrid.show.exact import Exact

SIZE = 960, 720
MOST_PANELS = 32
FULL_PATHS = 256

CONFLICTS = {
    "--sweep": {"--isovalue": "a sweep shows the whole range", "--isovalues": "a sweep shows the whole range"},
    "--isovalues": {
        "--isovalue": "--isovalues names all of them", "--split": "a strip shows one kind of light",
        "--trust": "a strip has no room for the scale of error bars",
    },
    "--grid-volume": dict.fromkeys(
        ("--sweep", "--isovalue", "--isovalues", "--local", "--trust", "--split", "--scale-bar"),
        "the grid has no isovalue and only its own light",
    ),
    "--trust": {"--local": "error bars are those of global light", "--split": "error bars are those of global light",
                "--exposure": "exposure does not change error bars"},
    "--split": {"--local": "--split shows local light on the left"},
    "--exact": {
        "--local": "a lamp at the camera needs no rays", "--trust": "error bars are those of lookups",
        "--grid-volume": "the grid is drawn as it is stored", "--engine": "rays are traced in software",
    },
    "--watch": {"--sweep": "a film is written once", "--isovalues": "a strip is written once",
                "--split": "two pictures are written once"},
    "--clip": {"--grid-volume": "the grid has a cut of its own, --cut"},
    "--color": {"--grid-volume": "the grid shows its own light", "--trust": "error bars have their own colours"},
    "--camera": dict.fromkeys(("--view", "--zoom", "--up", "--roll"), "the camera of the picture sets all of these"),
}  # fmt: skip
"""Options that exclude each other, and the reason."""


@reported_warnings()
def preview(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A finished run.")],
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="PNG", help="The picture to write.")] = None,
    sweep: Annotated[
        tuple[int, Path] | None,
        typer.Option(
            metavar="N FILE",
            help="Instead of --output: N isovalues through the range, as .gif, .webp, .mp4, or a folder of PNG.",
        ),
    ] = None,
    field: Annotated[
        str | None, typer.Option(metavar="NAME", help="Field that the isovalue belongs to. [default: the first]")
    ] = None,
    isovalue: Annotated[
        float | None, typer.Option(metavar="C", help="Isovalue to show. [default: the middle of the range]")
    ] = None,
    isovalues: Annotated[
        str | None,
        typer.Option(metavar="C,C,...", help="Several isovalues side by side in one picture, seen by one camera."),
    ] = None,
    local: Annotated[
        bool, typer.Option("--local", help="Light by a lamp at the camera instead of the computed light.")
    ] = False,
    trust: Annotated[
        bool, typer.Option("--trust", help="Show relative error bars instead of light; holes are hatched.")
    ] = False,
    split: Annotated[bool, typer.Option("--split", help="Local light left, global light right.")] = False,
    exposure: Annotated[
        float, typer.Option(metavar="EV", help="Brighten (or darken, below 0) by this many stops.")
    ] = 0.0,
    grid_volume: Annotated[
        bool, typer.Option("--grid-volume", help="The illumination grid itself, as a block.")
    ] = False,
    cut: Annotated[
        bool, typer.Option("--cut", help="With --grid-volume: cut out the corner nearest to the viewer.")
    ] = False,
    exact: Annotated[
        str | None,
        typer.Option(
            metavar="N|full[:N]",
            help="Gather light by N rays from every pixel, which end in the stored light: sharp shadows. full or "
            "full:N: N paths of every length, without the grid, as a reference. [default of N: 256]",
        ),
    ] = None,
    watch: Annotated[
        bool,
        typer.Option("--watch", help="With --exact: write the picture also after 4, 16, 64... rays."),
    ] = False,
    view: Annotated[
        str | None,
        typer.Option(
            metavar="VIEW",
            help="front, back, left, right, top, bottom, iso, or azimuth,elevation in degrees. [default: 30,18]",
        ),
    ] = None,
    zoom: Annotated[float, typer.Option(metavar="Z", help="Magnification: 2 shows the middle twice as large.")] = 1.0,
    up: Annotated[
        str | None,
        typer.Option(metavar="AXIS", help="World axis that points up: x, y, z, -x, -y, -z. [default: z, see docs]"),
    ] = None,
    roll: Annotated[float, typer.Option(metavar="DEG", help="Turn the picture clockwise.")] = 0.0,
    camera: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Use the camera of this picture, which preview wrote.")
    ] = None,
    size: Annotated[
        tuple[int, int], typer.Option(metavar="W H", help="Pixels of the picture, or of each panel.")
    ] = SIZE,
    scale_bar: Annotated[
        bool, typer.Option("--scale-bar", help="A bar of known length, valid at the depth of the middle of the object.")
    ] = False,
    background: Annotated[
        str | None,
        typer.Option(metavar="COLOR", help="CSS colour: white, #202030, transparent. [default: a dark grey]"),
    ] = None,
    weights: Weights = None,
    sky: SkyImage = None,
    turn: Turn = 0.0,
    look: Look = None,
    clip: Clips = None,
    color: Color = None,
    cmap: ColorMap = "viridis",
    color_range: ColorRange = None,
    engine: Annotated[str, typer.Option(help="Rendering engine: auto, egl, osmesa, software.")] = "auto",
) -> None:
    """Draw an isosurface of a finished run, several side by side, or a sweep through the range."""
    from illumgrid import show
    from illumgrid.show.cuts import clips_of

    given = {
        "--sweep": sweep is not None, "--isovalue": isovalue is not None, "--isovalues": isovalues is not None,
        "--local": local, "--trust": trust, "--split": split, "--grid-volume": grid_volume, "--scale-bar": scale_bar,
        "--exposure": exposure != 0, "--view": view is not None, "--zoom": zoom != 1, "--up": up is not None,
        "--roll": roll != 0, "--camera": camera is not None, "--exact": exact is not None, "--watch": watch,
        "--clip": bool(clip), "--color": color is not None,
        "--engine": engine not in ("auto", "software"),
    }  # fmt: skip
    _check(given, output, sweep, isovalue, cut, background)
    several = None if isovalues is None else _numbers(isovalues)
    engine_used, why = show.choose_engine(engine if exact is None else "software")
    gathered = None if exact is None else _exact(exact)
    light = looking(relit(loaded(folder), weights, sky, turn), look)
    if engine == "auto" and engine_used != "software" and show.too_large_for_meshes(light.scene):
        engine_used, why = "software", "the field is large, and rays need no mesh of it"
    tint = tint_of(light, color, cmap, color_range)
    if engine_used != "software" and (clip or any(not f.material.plain for f in light.scene.fields)):
        if engine != "auto":
            raise BadInput(f"--engine is {engine}; expected software: coats, films and cuts are drawn by rays")
        engine_used, why = "software", "coats, films and cuts are drawn by rays"
    options: dict[str, Any] = {"background": background, "engine": engine_used, "stops": exposure}
    if size != SIZE:
        options |= {"width": size[0], "height": size[1]}
    seen_from: dict[str, Any] = {"view": view, "zoom": zoom, "up": up, "roll": roll}
    seen_by = None if camera is None else _camera_in(camera)
    if grid_volume:
        _write(output, show.grid_volume(light, field, cut=cut, camera=seen_by, **options, **seen_from), seen_by)
    else:
        asked = several or ([] if isovalue is None else [isovalue])
        _note_outside(light, field, asked)
        seen_by = seen_by or _fitted(light, field, asked, sweep is not None, options, seen_from)
        options |= {"trust": trust, "bar": scale_bar, "camera": seen_by, "clip": clip or (), "tint": tint}
        if gathered is not None:
            options |= {"exact": gathered}
            if watch:
                options |= {"watch": lambda picture: _write(output, picture, seen_by)}
        if sweep is not None:
            _film(light, field, sweep, _drawn(light, field, local, split, options), seen_by)
        else:
            if trust and camera is None:  # the scale below leaves the picture another aspect
                options |= seen_from | {"camera": None}
            with progress_bars() as progress:
                options |= {"progress": progress}
                if several:
                    picture = show.strip(light, several, field, local=local, **options)
                else:
                    picture = _drawn(light, field, local, split, options)(isovalue)
            _write(output, picture, seen_by)
    if trust:
        _say_doubts(light)
    if clips_of(clip or (), light.scene):
        say("note: cuts show the data in grey, and the light is that of the whole solid")
    wrote = f"wrote {output}" if sweep is None else f"wrote {sweep[1]}, {sweep[0]} isovalues"
    say(wrote + ("" if local or trust else f" at exposure {light.exposure * 2**exposure:.4g}"))
    if engine == "auto" and exact is None and not grid_volume:
        say(f"drawn by the engine {engine_used}: {why}")


def _check(
    given: dict[str, bool], output: Path | None, sweep: tuple[int, Path] | None, isovalue: float | None, cut: bool,
    background: str | None,
) -> None:  # fmt: skip
    """Refuse options that do not go together, or are out of range, before anything is read."""
    if (output is None) == (sweep is None):
        came = "neither --output nor --sweep" if output is None else "both --output and --sweep"
        raise BadInput(f"{came} came; expected --output PNG for a picture, or --sweep N FILE for a film")
    if output is not None and output.suffix.lower() != ".png":
        raise BadInput(f"--output is {output.name!r}; expected a file name that ends in .png")
    if isovalue is not None and not math.isfinite(isovalue):
        raise BadInput(f"--isovalue is {isovalue}; expected a finite number")
    for one, others in CONFLICTS.items():
        for other, why in others.items():
            if given[one] and given[other]:
                raise BadInput(f"{other} came with {one}; expected one of the two: {why}")
    if given["--watch"] and not given["--exact"]:
        raise BadInput("--watch came without --exact; expected both, or neither")
    if cut and not given["--grid-volume"]:
        raise BadInput("--cut came without --grid-volume; expected both, or neither")
    if sweep is not None:
        if not 2 <= sweep[0] <= 10000:
            raise BadInput(f"--sweep got {sweep[0]} isovalues; expected 2 to 10000")
        from illumgrid.show.film import check_ending

        check_ending(sweep[1].name, sweep[1].suffix.lower())
        if sweep[1].suffix and sweep[1].is_dir():
            raise BadInput(f"{sweep[1]} is a folder; expected the name of a file")
        if sweep[1].suffix and background == "transparent":
            raise BadInput(
                "--background is transparent; expected a colour for a film, or a folder of PNG to sweep into"
            )


def _exact(text: str) -> "Exact":
    """Parse --exact: a number of rays, or `full` with an optional number of paths."""
    from illumgrid.show.exact import Exact

    first, _, number = text.rpartition(":") if text != "full" else ("full", "", str(FULL_PATHS))
    if first not in ("", "full") or not (number.isascii() and number.isdigit() and len(number) < 9):
        raise BadInput(f"--exact is {text[:60]!r}; expected a number of rays per pixel, full, or full:256")
    return Exact(int(number), first == "full")


def _numbers(text: str) -> list[float]:
    """Isovalues from a list with commas."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not 2 <= len(numbers) <= MOST_PANELS or not all(map(math.isfinite, numbers)):
        raise BadInput(
            f"--isovalues is {text[:60]!r}; expected 2 to {MOST_PANELS} numbers with commas, such as 20,40,80"
        )
    return numbers


def _write(output: Path | None, picture: Any, camera: "Camera | None") -> None:
    from illumgrid.io import disk
    from illumgrid.show import png

    assert output is not None  # _check has refused that
    disk.write_file(output, png(picture, _about(camera)))


def _say_doubts(light: "Illumination") -> None:
    from illumgrid.show.trust import doubts

    for doubt in doubts(light):
        say(f"note: {doubt}")


def _camera_in(file: Path) -> "Camera":
    """The camera of a picture, from the text of its PNG."""
    from PIL import Image, UnidentifiedImageError

    from illumgrid.show.camera import camera_of

    try:
        with Image.open(file) as picture:
            text = picture.info.get("Camera")
    except UnidentifiedImageError:
        text = None
    if not isinstance(text, str):
        raise BadInput(f"{file} holds no camera; expected a picture that 'illumgrid preview' wrote")
    return camera_of(text)


def _about(camera: "Camera | None") -> dict[str, str]:
    """The text of a PNG: the command, and the camera."""
    from illumgrid.show.camera import camera_text

    about = {"Command": shlex.join(["illumgrid", *sys.argv[1:]])}
    return about if camera is None else about | {"Camera": camera_text(camera)}


def _note_outside(light: "Illumination", field: str | None, isovalues: list[float]) -> None:
    low, high = light.scene.fields[light.scene.number_of(field)].range
    for isovalue in isovalues:
        if not low <= isovalue <= high:
            said = shown(isovalue, (low, high), 6)
            say(f"note: the isovalue {said} lies outside the range {shown_range((low, high), 6)} of the light")


def _fitted(
    light: "Illumination", field: str | None, isovalues: list[float], sweep: bool,
    options: dict[str, Any], look: dict[str, Any],
) -> "Camera":  # fmt: skip
    """The camera that holds everything that will be drawn."""
    from illumgrid.show import fit_camera, render, widest_row

    scene = light.scene
    if sweep:
        rows = widest_row(scene)
    elif isovalues:
        rows = scene.levels_through(scene.number_of(field), isovalues)
    else:
        rows = scene.levels(0.5)
    width, height = (options.get(side, (render.__kwdefaults__ or {})[side]) for side in ("width", "height"))
    return fit_camera(scene, rows, max(width, 1) / max(height, 1), **look)


def _drawn(
    light: "Illumination", field: str | None, local: bool, split: bool, options: dict[str, Any]
) -> Callable[[float | None], Any]:
    """A function that draws an isovalue: one picture, or two side by side."""
    import numpy as np

    from illumgrid.show import render

    def draw(isovalue: float | None) -> Any:
        lights = (True, False) if split else (local,)
        return np.concatenate([render(light, field, isovalue, local=one, **options) for one in lights], axis=1)

    return draw


def _film(
    light: "Illumination", field: str | None, sweep: tuple[int, Path], draw: Callable[[float | None], Any],
    camera: "Camera",
) -> None:  # fmt: skip
    from illumgrid.io import disk
    from illumgrid.show import png
    from illumgrid.show.film import film, frames

    count, path = sweep
    with progress_bars() as progress:

        def reported() -> Iterator[Any]:
            for number, picture in enumerate(frames(light, field, count, draw), 1):
                progress("draw", number, count)
                yield picture

        if path.suffix:
            with disk.fresh_file(path) as fresh, fresh.open("wb") as file:
                film(reported(), count, path.suffix.lower(), file)
        else:
            about = _about(camera)
            pictures = ((f"{number:04}.png", png(picture, about)) for number, picture in enumerate(reported()))
            disk.write_folder(path, pictures)
