"""``illumgrid run``: the whole chain, from a volume or a scene to a finished folder."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from illumgrid.cli.heap import return_holes
from illumgrid.cli.long import check_spread, kept, shared_out, spread
from illumgrid.cli.outcome import again, finished, report
from illumgrid.cli.reading import NONE, given, with_reading
from illumgrid.cli.scenes import in_harmonics, scene_input
from illumgrid.cli.terminal import Ignore, progress_bars, reported_warnings, say
from illumgrid.errors import BadInput, shown_range, tell

if TYPE_CHECKING:
    pass


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


def _stages(names: dict[str, str], settings: list[str], run_wide: dict[str, int | None]) -> dict[str, Any]:
    """Stages by name; an option given for the whole run goes to the stage that has it, unless --set says otherwise."""
    from illumgrid import registry

    options = _stage_options(settings)
    for place, value in run_wide.items():
        kind, option = place.split(".")
        if value is not None and option in registry.option_names(kind, names[kind]):
            options[kind].setdefault(option, str(value))
    return {kind: registry.make(kind, name, options[kind]) for kind, name in names.items()}


@with_reading
def run(
    source: Annotated[
        str | None,
        typer.Argument(
            metavar="[INPUT]",
            help="A volume file, DICOM folder, scene file (.toml) or built-in scene: nucleus. [default: nucleus]",
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Folder for the result. [default: INPUT-light]")
    ] = None,
    sampler: Annotated[str, typer.Option(help="Where to ask for light: direct, uniform, adaptive.")] = "direct",
    isovalues: Annotated[
        int | None,
        typer.Option(min=2, metavar="K", help="Rows of the level table; sets sampler.count, too. [default: 32]"),
    ] = None,
    limits: Annotated[
        tuple[float, float] | None,
        typer.Option("--range", metavar="LO HI", help="Isovalues to sweep. [default: from the data, as info suggests]"),
    ] = None,
    inside: Annotated[
        str | None, typer.Option(help="Which side of the isosurface is solid: above or below. [default: above]")
    ] = None,
    signed: Annotated[
        bool, typer.Option("--signed", help="Light h >= c and h <= -c, in two colours; --range is that of c, above 0.")
    ] = False,
    backend: Annotated[str, typer.Option(help="Light transport: auto, numba, embree, reference.")] = "auto",
    paths: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Paths per query. [default: 32; under a sky alone 8 to 64; for noisy data 16]"
        ),
    ] = None,
    bounces: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="N",
            help="Reflections per path. [default: until less than 1 % of the light is left out, at least 8]",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**64 - 1, metavar="N", help="Equal seeds give equal light.")] = 0,
    interpolator: Annotated[
        str, typer.Option(help="nearest, bilateral, splat or rbf. For noisy data in the studio: bilateral.")
    ] = "nearest",
    grid: Annotated[
        int | None,
        typer.Option(min=2, metavar="N", help="Nodes along the longest axis. [default: 1.2 per voxel, at most 150]"),
    ] = None,
    surroundings: Annotated[
        str | None,
        typer.Option(
            "--scene", help="Surroundings of a volume: studio, sky, floor, box (with a lamp). [default: studio]"
        ),
    ] = None,
    texels: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=4096,
            metavar="N",
            help="Texels along the longest edge of the walls. [default: of the scene, about one for three voxels]",
        ),
    ] = None,
    albedo: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="R G B", help="Fraction of the light that the surface reflects. [default: a neutral grey]"
        ),
    ] = None,
    lights: Annotated[
        str | None,
        typer.Option(
            help="sh: store the light of a basis of skies, spherical harmonics, for preview --sky and --turn."
        ),
    ] = None,
    degree: Annotated[
        int | None,
        typer.Option(min=0, max=4, metavar="L", help="Degree of these harmonics: (L + 1)² layers. [default: 2]"),
    ] = None,
    reading: dict[str, Any] = NONE,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="STAGE.OPTION=VALUE", help="Set an option of a stage (repeatable)."),
    ] = None,
    error: Annotated[
        float | None,
        typer.Option(metavar="E", help="Choose nodes, paths and bounces for this relative error, such as 0.03."),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(metavar="S", help="Choose them for this computing time; reading and writing are not counted."),
    ] = None,
    smooth: Annotated[
        float | None, typer.Option(min=0.0, metavar="SIGMA", help="Gaussian blur in voxels before anything else.")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Threads. [default: one per processor]")
    ] = None,
    no_preview: Annotated[bool, typer.Option("--no-preview", help="Draw no picture.")] = False,
    no_embed: Annotated[
        bool, typer.Option("--no-embed", help="Store a reference to the volume file, which must stay, and no copy.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a finished run in DIR.")] = False,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Continue a stopped run, or add paths, up to --paths, to a finished one."),
    ] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Use N processes on this machine, by dask.distributed.")
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Use the workers of a dask scheduler, such as tcp://host:8786."),
    ] = None,
    lazy: Annotated[
        bool,
        typer.Option("--lazy", help="Open a page with coarse light at once, and light first what is in view."),
    ] = False,
    any_machine: Annotated[
        bool,
        typer.Option(
            "--any-machine",
            help="Accept workers, or a stopped run, with another processor or other versions of packages; the light "
            "may then differ in its last digits.",
        ),
    ] = False,
    ignore: Ignore = None,
) -> None:
    """Light a volume, the volumes of a scene file, or a built-in scene, for all isovalues at once.

    DIR then holds illumination.exr, run.json and preview.png, and needs nothing else (--no-embed: the volume file).
    A long run keeps its finished light in DIR.partial: after a stop, the same command continues from there.
    """
    from illumgrid.chain import run as light_up
    from illumgrid.cli.lazily import look
    from illumgrid.field.diagnosis import diagnose
    from illumgrid.field.lattice import nodes_over
    from illumgrid.field.scene import with_texels
    from illumgrid.io import store

    with reported_warnings(ignore) as sentences:
        check_spread(workers, dask)
        if lazy and (
            extra := given(error=error, seconds=seconds, workers=workers, dask=dask, no_embed=no_embed or None)
        ):
            raise BadInput(f"--lazy came with --{next(iter(extra)).replace('_', '-')}; expected one of them")
        names = {"sampler": sampler, "backend": backend, "interpolator": interpolator}
        stages = _stages(names, settings or [], {"backend.threads": threads, "sampler.count": isovalues})
        asked = scene_input(source, surroundings, limits, inside, signed, albedo, reading)
        if no_embed and asked.source is None:
            raise BadInput(
                f"--no-embed came with the scene {asked.name!r}; expected a volume file with it; leave the option out"
            )
        if asked.preset and error is None and seconds is None:
            grid, paths = grid or asked.preset.grid, paths or asked.preset.paths
            isovalues = isovalues or asked.preset.isovalues
        folder = output or Path(f"{asked.name}-light")
        if not (resume and store.is_run(folder)):
            store.claim(folder, overwrite)
        scene = in_harmonics(asked.make(smooth or 0.0), lights, degree)
        scene = with_texels(scene, texels) if texels else scene
        numbers: dict[str, Any] = {
            "grid": grid,
            "paths": paths,
            "bounces": bounces,
            "isovalues": isovalues,
            "seed": seed,
        }
        keep = kept(folder, scene, stages, resume, overwrite, any_machine, error=error, seconds=seconds, **numbers)
        if keep is None:
            say(f"{folder} is finished and has that many paths: nothing is left to do")
            return
        about = {"input": asked.name if source is None else source, "reading": reading, "smooth": smooth or 0.0}
        if lazy:
            look(scene, stages, keep, numbers, about, folder, sentences)
            return
        for field in scene.fields:
            shape = " x ".join(map(str, field.volume.shape))
            held = field.isovalue is not None
            swept = f"held at isovalue {field.isovalue:g}" if held else f"isovalues {shown_range(field.range)}"
            say(f"{field.name}: {shape} voxels, {swept}")
            for finding in diagnose(field, nodes_over(field.volume, grid), smooth or 0.0):
                tell(finding.name, finding.sentence)
                if finding.name == "noise" and "noise" not in (ignore or []):
                    say(f"  the command with this blur: {again(finding.options)}")
        if backend == "auto":
            say(_why_auto())
        return_holes()
        with closing(keep), spread(workers, dask, any_machine) as over, progress_bars(keep.standing) as progress:
            light = light_up(
                scene, **shared_out(stages, workers), **numbers, error=error, seconds=seconds, texels=texels,
                judge=False, map=over, progress=progress, keep=keep,
            )  # fmt: skip
        light = replace(light, recipe={**light.recipe, **about})
        elsewhere = asked.source(smooth or 0.0) if no_embed and asked.source else None
        light = finished(light, folder, keep, stages, sentences, not no_preview, overwrite or resume, elsewhere)
    report(light, folder, picture=not no_preview)


def _why_auto() -> str:
    """The sentence that states which backend `auto` selected, and why."""
    from illumgrid import registry

    return f"backend: {registry.auto_backend()} ({registry.WHY_AUTO})"
