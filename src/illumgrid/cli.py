"""The command line: the only place that prints."""

import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from illumgrid.errors import BadInput, IllumgridWarning

if TYPE_CHECKING:
    from illumgrid.bake import Progress
    from illumgrid.demo import Preset
    from illumgrid.grid import WallTexture
    from illumgrid.illumination import Illumination
    from illumgrid.scene import Quad, Scene
    from illumgrid.volume import Side, Volume

app = typer.Typer(
    help="Global illumination for every isosurface of a volume at once.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def say(text: str) -> None:
    """One line to the user, not to a pipe."""
    typer.echo(text, err=True)


@contextmanager
def heard() -> Iterator[list[str]]:
    """Collect the package's warnings as sentences, and say each when it is heard."""
    sentences: list[str] = []

    def show(message: Warning | str, category: type[Warning], *rest: Any) -> None:
        if issubclass(category, IllumgridWarning):
            sentences.append(str(message))
            say(f"note: {message}")

    with warnings.catch_warnings():
        warnings.simplefilter("always", IllumgridWarning)
        warnings.showwarning = show  # type: ignore[assignment]
        yield sentences


@contextmanager
def told_progress() -> Iterator["Progress"]:
    """A bar with the time left, for work that takes longer than a moment."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    bars: dict[str, Any] = {}
    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description:<6}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn(),
        console=console, transient=True, disable=not console.is_terminal,
    ) as progress:  # fmt: skip

        def tell(what: str, done: int, total: int) -> None:
            if what not in bars:
                bars[what] = progress.add_task(what, total=max(total, 1))
            progress.update(bars[what], completed=done)

        yield tell


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"illumgrid {version('illumgrid')}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Global illumination for every isosurface of a volume at once."""


def _given(**options: Any) -> str:
    """Names of the options that were given, as typed."""
    return ", ".join(f"--{name}" for name, value in options.items() if value is not None)


@dataclass(frozen=True)
class Input:
    """What is to be lit: a name for the folder of the result, and how the scene is made, blurred by `smooth` voxels."""

    name: str
    make: Callable[[float], "Scene"]
    preset: "Preset | None" = None


def _input(
    source: str | None,
    surroundings: str | None,
    limits: tuple[float, float] | None,
    inside: str | None,
    albedo: tuple[float, float, float] | None,
) -> Input:
    """Tell a volume file from a scene file and a built-in scene; nothing is read yet."""
    from illumgrid.demo import SCENES
    from illumgrid.readers import volume_name

    name = source or "nucleus"
    preset = SCENES.get(name) if source is None or not Path(source).exists() else None
    if preset or name.lower().endswith(".toml"):
        if extra := _given(scene=surroundings, range=limits, inside=inside, albedo=albedo):
            what, todo = ("built-in scene", "leave") if preset else ("scene file", "write them into the file and leave")
            raise BadInput(f"{extra} came with the {what} {name!r}; expected a volume file with them: {todo} them out")
        return Input(name, partial(_smoothed, preset.make), preset) if preset else _scene_file(name)
    if inside not in (None, "above", "below"):
        raise BadInput(f"--inside is {inside!r}; expected above or below")
    if surroundings not in (None, "sky", "floor", "box"):
        raise BadInput(f"--scene is {surroundings!r}; expected sky, floor or box")
    side: Side = "below" if inside == "below" else "above"
    make = partial(_volume_scene, name, surroundings or "sky", albedo or (0.8, 0.8, 0.8), limits, side)
    return Input(volume_name(name), make)


def _scene_file(name: str) -> Input:
    from illumgrid.readers import read_scene

    return Input(Path(name).stem, lambda smooth: read_scene(name, smoothing=smooth))


def _volume_scene(source: str, surroundings: str, albedo: Any, limits: Any, inside: "Side", smooth: float) -> "Scene":
    from illumgrid.readers import read_volume, volume_name
    from illumgrid.scene import Scene
    from illumgrid.volume import finite
    from illumgrid.volume import smooth as blur

    around = {"sky": Scene.sky, "floor": Scene.floor, "box": Scene.box}[surroundings]
    return around(blur(finite(read_volume(source), inside), smooth), albedo, limits, inside, volume_name(source))


def _smoothed(make: Callable[[], "Scene"], smooth: float) -> "Scene":
    from illumgrid.volume import smooth as blur

    scene = make()
    return replace(scene, fields=tuple(replace(f, volume=blur(f.volume, smooth)) for f in scene.fields))


def _stage_options(settings: list[str]) -> dict[str, dict[str, str]]:
    """`STAGE.OPTION=VALUE` texts, by stage."""
    options: dict[str, dict[str, str]] = {"sampler": {}, "backend": {}, "interpolator": {}}
    for text in settings:
        place, equals, value = text.partition("=")
        stage, dot, option = place.partition(".")
        if not (equals and dot and option) or stage not in options:
            raise BadInput(
                f"--set got {text!r}; expected STAGE.OPTION=VALUE with STAGE one of {', '.join(options)}, "
                "such as sampler.count=40"
            )
        options[stage][option] = value
    return options


@app.command()
def run(
    source: Annotated[
        str | None,
        typer.Argument(
            metavar="[INPUT]",
            help="A volume file, DICOM folder, scene file (.toml) or built-in scene: nucleus. [default: nucleus]",
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Where the result goes. [default: INPUT-light]")
    ] = None,
    sampler: Annotated[str, typer.Option(help="Where to ask for light: direct, uniform.")] = "direct",
    isovalues: Annotated[
        int | None, typer.Option(min=2, metavar="K", help="Rows of the level table; sampler.count too. [default: 32]")
    ] = None,
    limits: Annotated[
        tuple[float, float] | None,
        typer.Option("--range", metavar="LO HI", help="Isovalues to sweep. [default: from the data, as info suggests]"),
    ] = None,
    inside: Annotated[
        str | None, typer.Option(help="Which side of the isovalue is solid: above, below. [default: above]")
    ] = None,
    backend: Annotated[str, typer.Option(help="Light transport: auto, numba, reference.")] = "auto",
    paths: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Light paths from every query. [default: 64]")
    ] = None,
    bounces: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="N",
            help="Reflections. [default: 4 under an open sky; in a closed scene until under 1 % is left out]",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**64 - 1, metavar="N", help="Equal seeds give equal light.")] = 0,
    interpolator: Annotated[str, typer.Option(help="From samples to nodes: nearest.")] = "nearest",
    grid: Annotated[
        int | None,
        typer.Option(min=2, metavar="N", help="Nodes along the longest axis. [default: as voxels, at most 128]"),
    ] = None,
    surroundings: Annotated[
        str | None,
        typer.Option("--scene", help="What is around a volume: sky, floor (and sky), box (and lamp). [default: sky]"),
    ] = None,
    albedo: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="R G B", help="Share of light that the surface reflects. [default: 0.8 0.8 0.8]"),
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="STAGE.OPTION=VALUE", help="Any option of a stage, repeatable.")
    ] = None,
    smooth: Annotated[
        float | None, typer.Option(min=0.0, metavar="SIGMA", help="Gaussian blur in voxels before anything else.")
    ] = None,
    threads: Annotated[int | None, typer.Option(min=1, metavar="N", help="Threads. [default: one a processor]")] = None,
    no_preview: Annotated[bool, typer.Option("--no-preview", help="Leave the picture out.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a finished run in DIR.")] = False,
) -> None:
    """Light a volume, the volumes of a scene file, or a built-in scene, for all isovalues at once.

    DIR then holds illumination.exr, run.json and preview.png, and needs nothing else.
    """
    begun = time.perf_counter()
    from illumgrid import registry, store
    from illumgrid.illumination import run as light_up

    options = _stage_options(settings or [])
    if threads is not None and "threads" in registry.option_names("backend", backend):
        options["backend"].setdefault("threads", str(threads))
    if isovalues is not None and "count" in registry.option_names("sampler", sampler):
        options["sampler"].setdefault("count", str(isovalues))
    stages = {
        kind: registry.make(kind, name, options[kind])
        for kind, name in (("sampler", sampler), ("backend", backend), ("interpolator", interpolator))
    }
    given = _input(source, surroundings, limits, inside, albedo)
    if given.preset:
        grid, paths = grid or given.preset.grid, paths or given.preset.paths
        isovalues = isovalues or given.preset.isovalues
    folder = output or Path(f"{given.name}-light")
    with heard() as sentences:
        store.claim(folder, overwrite)
        scene = given.make(smooth or 0.0)
        for field in scene.fields:
            shape = " x ".join(map(str, field.volume.shape))
            say(f"{field.name}: {shape} voxels, isovalues {field.range[0]:.4g} to {field.range[1]:.4g}")
        with told_progress() as progress:
            light = light_up(
                scene, **stages, grid=grid, paths=paths or 64, bounces=bounces, isovalues=isovalues, seed=seed,
                progress=progress,
            )  # fmt: skip
    recipe = {**light.recipe, "input": source or given.name, "smooth": smooth or 0.0, "warnings": sentences}
    replace(light, recipe=recipe).save(folder, preview=not no_preview, overwrite=overwrite)
    _told_result(light, folder, time.perf_counter() - begun, picture=not no_preview)


def _told_result(light: "Illumination", folder: Path, seconds: float, picture: bool) -> None:
    recipe = light.recipe
    errors = [e for e in recipe["relative_error"] if e is not None]
    noise = f", noise about {max(errors):.1%} of the mean light" if errors else ""
    say(f"{recipe['queries']} queries x {recipe['paths']} paths in {seconds:.1f} s{noise}{_told_left_out(recipe)}")
    say(f"wrote {folder}" + (f"; look at {folder / 'preview.png'}" if picture else ""))


def _told_left_out(recipe: Mapping[str, Any]) -> str:
    left = recipe.get("left_out")
    if left is None:
        return ""
    share = f"about {left:.1%}" if left >= 0.0005 else "less than 0.1%"
    return f", bounces beyond {recipe['bounces']} would add {share}"


@app.command()
def preview(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A finished run.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="PNG", help="The picture to write.")],
    field: Annotated[
        str | None, typer.Option(metavar="NAME", help="Field that --isovalue belongs to. [default: the first]")
    ] = None,
    isovalue: Annotated[
        float | None, typer.Option(metavar="C", help="Isovalue to show. [default: the middle of the range]")
    ] = None,
    local: Annotated[
        bool, typer.Option("--local", help="A lamp at the camera in place of the computed light.")
    ] = False,
) -> None:
    """Draw one isosurface of a finished run."""
    from illumgrid import preview as pictures
    from illumgrid import store
    from illumgrid.illumination import load

    if output.suffix.lower() != ".png":
        raise BadInput(f"--output is {output.name!r}; expected a file name that ends in .png")
    if isovalue is not None and not math.isfinite(isovalue):
        raise BadInput(f"--isovalue is {isovalue}; expected a finite number")
    light = load(folder)
    number = 0 if field is None else light.scene.number_of(field)
    if isovalue is not None:
        low, high = light.scene.fields[number].range
        if not low <= isovalue <= high:
            say(f"note: the isovalue {isovalue:g} lies outside the range {low:g} to {high:g} of the light")
    store.write_file(output, pictures.png(pictures.render(light, field, isovalue, local=local)))
    say(f"wrote {output}" + ("" if local else f" at exposure {light.exposure:.4g}"))


BLOCKS = " ▁▂▃▄▅▆▇█"


def histogram_line(volume: "Volume", width: int = 64) -> str:
    """Histogram of the finite values in a line of block characters; heights are logarithmic."""
    import numpy as np

    finite = volume.values[np.isfinite(volume.values)]
    counts, _ = np.histogram(finite, width, (np.float64(finite.min()), np.float64(finite.max())))
    height = np.log1p(counts) / max(np.log1p(counts.max()), 1e-9)
    return "".join(BLOCKS[int(np.ceil(h * 8))] for h in height)


@app.command()
def info(
    source: Annotated[
        str, typer.Argument(metavar="DIR|VOLUME", help="A finished run, a volume file or a DICOM folder.")
    ],
) -> None:
    """Tell what is inside a volume or a finished run."""
    from illumgrid import store

    with heard():
        if store.is_run(source):
            _told_run(source)
        else:
            _told_volume(source)


def _told_volume(source: str) -> None:
    from illumgrid.readers import read_volume, volume_name
    from illumgrid.scene import suggest_range
    from illumgrid.volume import finite

    volume = finite(read_volume(source), "above")
    _told_lattice(volume_name(source), volume)
    low, high, why = suggest_range(volume)
    typer.echo(f"  suggested range  {low:.4g} to {high:.4g}: {why}")


def three(numbers: Any) -> str:
    """Coordinates or a colour as text."""
    return ", ".join(f"{x + 0.0:.6g}" for x in numbers)  # no -0


def _told_wall(quad: "Quad", texture: "WallTexture") -> None:
    rows, nv, nu = texture.values.shape[:3]
    typer.echo(f"{quad.name} (wall)")
    typer.echo(f"  corner           {three(quad.corner)}")
    typer.echo(f"  edges            {three(quad.edge_u)}; {three(quad.edge_v)}")
    glow = f", emission {three(quad.material.emission)}" if quad.material.emission.any() else ""
    typer.echo(f"  albedo           {three(quad.material.albedo)}{glow}")
    typer.echo(f"  light            {nu} x {nv} texels, {rows} isovalues")


def _told_lattice(name: str, volume: "Volume") -> None:
    low, high = float(volume.values.min()), float(volume.values.max())
    typer.echo(f"{name}")
    typer.echo(f"  shape            {' x '.join(map(str, volume.shape))} voxels (x, y, z)")
    typer.echo(f"  spacing          {three(volume.spacing)}")
    typer.echo(f"  origin           {three(volume.origin)} (world; for medical formats LPS millimetres)")
    typer.echo(f"  axes             {'; '.join(three(volume.direction[:, axis]) for axis in range(3))}")
    typer.echo(f"  values           {low:.6g} to {high:.6g}")
    typer.echo(f"  histogram        |{histogram_line(volume)}| (logarithmic)")


def _told_run(source: str) -> None:
    from illumgrid.illumination import load

    light = load(source)
    for field, grid in zip(light.scene.fields, light.grids):
        _told_lattice(field.name, field.volume)
        typer.echo(f"  range            {field.range[0]:.6g} to {field.range[1]:.6g}, inside {field.inside}")
        supported = float((grid.support > 0).mean())
        typer.echo(
            f"  light            {' x '.join(map(str, grid.spec.shape))} nodes, {supported:.1%} with light of their own"
        )
    for quad, texture in zip(light.scene.quads, light.walls):
        _told_wall(quad, texture)
    recipe = light.recipe
    names = ", ".join(
        f"{kind} {recipe[kind]['name']}" for kind in ("sampler", "backend", "interpolator") if kind in recipe
    )
    typer.echo(
        f"recipe: {names}, {recipe.get('paths')} paths, {recipe.get('bounces')} bounces, seed {recipe.get('seed')}"
        f"{_told_left_out(recipe)}"
    )
    for sentence in recipe.get("warnings", []):
        typer.echo(f"note: {sentence}")


@app.command()
def verify(
    backends: Annotated[
        list[str] | None,
        typer.Option("--backend", metavar="NAME", help="Backend, repeatable. [default: all there are]"),
    ] = None,
    paths: Annotated[
        int, typer.Option(min=1, metavar="N", help="Light paths a scene, shared by its queries; reference takes fewer.")
    ] = 1 << 18,
    seed: Annotated[int, typer.Option(min=0, max=2**64 - 1, metavar="N", help="Equal seeds give equal paths.")] = 0,
) -> None:
    """Judge the backends by scenes whose light has a closed form; exit 1 if one disagrees.

    z is the mean difference over the queries in units of its standard error and of a derived bound on what the cells of
    the surface do; max |z| is that of a single query.
    """
    from illumgrid.verify import HEADER, check, line

    typer.echo(HEADER)
    rows = []
    for row in check(backends or None, paths, seed):
        typer.echo(line(row))
        rows.append(row)
    wrong = sum(not row.agrees for row in rows)
    typer.echo(f"{len(rows) - wrong} of {len(rows)} agree")
    if wrong:
        raise typer.Exit(1)


def main() -> None:
    """Run the command line: exit 2 and one sentence on bad input, 130 on Ctrl-C."""
    sys.exit(guarded(lambda: app(standalone_mode=False)))


def guarded(command: Callable[[], Any]) -> int:
    """Exit code of a command."""
    try:
        code = command()
        if code == 130:  # what typer makes of Ctrl-C
            raise KeyboardInterrupt
        return code if isinstance(code, int) else 0
    except (typer.Abort, KeyboardInterrupt):
        say("illumgrid: stopped; nothing was written")
        return 130
    except BadInput as error:
        say(f"illumgrid: {error}")
    except MemoryError:
        say("illumgrid: the memory of this machine is too small for this; choose a coarser --grid or a smaller volume")
    except OSError as error:
        say(f"illumgrid: {error.strerror or error}{f': {error.filename}' if error.filename else ''}")
    except Exception as error:
        if not hasattr(
            error, "show"
        ):  # a usage error: of click's, or of typer's own copy of click, as its release has it
            raise
        error.show()
    return 2
