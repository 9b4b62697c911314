"""``illumgrid preview``: pictures and films of a finished run."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from illumgrid.cli.terminal import progress_bars, say
from illumgrid.errors import BadInput

if TYPE_CHECKING:
    from illumgrid.light import Illumination


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
        str | None, typer.Option(metavar="NAME", help="Field that --isovalue belongs to. [default: the first]")
    ] = None,
    isovalue: Annotated[
        float | None, typer.Option(metavar="C", help="Isovalue to show. [default: the middle of the range]")
    ] = None,
    local: Annotated[
        bool, typer.Option("--local", help="A lamp at the camera in place of the computed light.")
    ] = False,
    trust: Annotated[
        bool, typer.Option("--trust", help="In place of light, how sure it is: its relative error bar, and the holes.")
    ] = False,
    split: Annotated[bool, typer.Option("--split", help="Both side by side: local left, global right.")] = False,
    grid_volume: Annotated[
        bool, typer.Option("--grid-volume", help="The illumination grid itself, as a block.")
    ] = False,
    cut: Annotated[bool, typer.Option("--cut", help="With --grid-volume: cut a corner out, to look inside.")] = False,
    view: Annotated[
        str | None,
        typer.Option(
            metavar="VIEW",
            help="front, back, left, right, top, bottom, iso, or azimuth,elevation in degrees. [default: 30,18]",
        ),
    ] = None,
    zoom: Annotated[float, typer.Option(metavar="Z", help="2 shows the middle twice as large.")] = 1.0,
    size: Annotated[tuple[int, int], typer.Option(metavar="W H", help="Pixels.")] = (960, 720),
    background: Annotated[
        str | None, typer.Option(metavar="COLOR", help="As CSS writes it: white, #202030. [default: a dark grey]")
    ] = None,
    engine: Annotated[str, typer.Option(help="What draws: auto, egl, osmesa, software.")] = "auto",
) -> None:
    """Draw one isosurface of a finished run, or a sweep through many."""
    from illumgrid import show as pictures
    from illumgrid.chain import load
    from illumgrid.io import store

    _check(output, sweep, isovalue, local, trust, split, grid_volume, cut)
    drawn_by, why = pictures.choose_engine(engine)
    light = load(folder)
    options: dict[str, Any] = {"view": view, "zoom": zoom, "background": background, "engine": drawn_by, "trust": trust}
    if size != (960, 720):
        options |= {"width": size[0], "height": size[1]}
    if sweep is not None:
        _sweep(light, field, sweep, local, split, options)
        wrote = f"wrote {sweep[1]}, {sweep[0]} isovalues"
    else:
        assert output is not None
        if grid_volume:
            del options["trust"]
            picture = pictures.grid_volume(light, field, cut=cut, **options)
        else:
            _told_outside(light, field, isovalue)
            picture = _drawn(light, field, local, split, options)(isovalue)
        store.write_file(output, pictures.png(picture))
        wrote = f"wrote {output}"
    if trust:
        from illumgrid.show.trust import doubts

        for doubt in doubts(light):
            say(f"note: {doubt}")
    say(wrote + ("" if local or trust else f" at exposure {light.exposure:.4g}"))
    if engine == "auto":
        say(f"drawn by the engine {drawn_by}: {why}")


def _check(
    output: Path | None, sweep: tuple[int, Path] | None, isovalue: float | None, local: bool, trust: bool,
    split: bool, grid_volume: bool, cut: bool,
) -> None:  # fmt: skip
    """Refuse options that do not go together, or are out of range, before anything is read."""
    if (output is None) == (sweep is None):
        came = "neither --output nor --sweep" if output is None else "both --output and --sweep"
        raise BadInput(f"{came} came; expected --output PNG for a picture, or --sweep N FILE for a film")
    if output is not None and output.suffix.lower() != ".png":
        raise BadInput(f"--output is {output.name!r}; expected a file name that ends in .png")
    if isovalue is not None and not math.isfinite(isovalue):
        raise BadInput(f"--isovalue is {isovalue}; expected a finite number")
    alone = {"--sweep": sweep is not None, "--isovalue": isovalue is not None, "--local": local, "--trust": trust,
             "--split": split}  # fmt: skip
    if grid_volume and any(alone.values()):
        raise BadInput(f"{next(o for o in alone if alone[o])} came with --grid-volume, which has no isovalue and one "
                       "light; leave one of the two out")  # fmt: skip
    if cut and not grid_volume:
        raise BadInput("--cut came without --grid-volume; expected both, or neither")
    if trust and (local or split):
        raise BadInput(f"--trust came with {'--local' if local else '--split'}; expected one: bars are of global light")
    if local and split:
        raise BadInput("--local and --split came together; expected one: --split shows the local light on its left")
    if sweep is not None:
        if isovalue is not None:
            raise BadInput("--isovalue came with --sweep, which shows the whole range; leave one of the two out")
        if not 2 <= sweep[0] <= 10000:
            raise BadInput(f"--sweep got {sweep[0]} isovalues; expected 2 to 10000")
        from illumgrid.show.film import check_ending

        check_ending(sweep[1].name, sweep[1].suffix.lower())
        if sweep[1].suffix and sweep[1].is_dir():
            raise BadInput(f"{sweep[1]} is a folder; expected the name of a file")


def _told_outside(light: "Illumination", field: str | None, isovalue: float | None) -> None:
    number = light.scene.number_of(field)
    if isovalue is not None:
        low, high = light.scene.fields[number].range
        if not low <= isovalue <= high:
            say(f"note: the isovalue {isovalue:g} lies outside the range {low:g} to {high:g} of the light")


def _drawn(
    light: "Illumination", field: str | None, local: bool, split: bool, options: dict[str, Any]
) -> Callable[[float | None], Any]:
    """What draws an isovalue: one picture, or two side by side."""
    import numpy as np

    from illumgrid.show import render

    def draw(isovalue: float | None) -> Any:
        lights = (True, False) if split else (local,)
        return np.concatenate([render(light, field, isovalue, local=one, **options) for one in lights], axis=1)

    return draw


def _sweep(
    light: "Illumination", field: str | None, sweep: tuple[int, Path], local: bool, split: bool, options: dict[str, Any]
) -> None:
    from illumgrid.io import store
    from illumgrid.show import fit_camera, png, render, widest_row
    from illumgrid.show.film import film, frames

    count, path = sweep
    width, height = (options.get(side, (render.__kwdefaults__ or {})[side]) for side in ("width", "height"))
    view, zoom = options.pop("view"), options.pop("zoom")
    options["camera"] = fit_camera(light.scene, widest_row(light.scene), width / height, view, zoom)
    draw = _drawn(light, field, local, split, options)
    with progress_bars() as progress:

        def told() -> Iterator[Any]:
            for number, picture in enumerate(frames(light, field, count, draw), 1):
                progress("draw", number, count)
                yield picture

        if path.suffix:
            store.write_file(path, film(list(told()), path.suffix.lower()))
        else:
            store.write_folder(path, ((f"{number:04}.png", png(picture)) for number, picture in enumerate(told())))
