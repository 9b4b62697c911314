"""``illumgrid run``: the whole chain, from a volume or a scene to a finished folder."""

import shlex
import sys
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from shutil import rmtree
from tempfile import gettempdir, mkdtemp
from typing import TYPE_CHECKING, Annotated, Any

import typer

from illumgrid.cli.long import check_spread, kept, shared_out, spread
from illumgrid.cli.reading import (
    Array,
    Channel,
    Crop,
    Downsample,
    Follow,
    Label,
    Spacing,
    Time,
    check_inside,
    given,
    labels_of,
)
from illumgrid.cli.terminal import Ignore, omitted_light, progress_bars, reported_warnings, say
from illumgrid.errors import BadInput, shown_range, tell

if TYPE_CHECKING:
    from illumgrid.field.builtin import Preset
    from illumgrid.field.scene import Field, Scene
    from illumgrid.field.volume import Side
    from illumgrid.io.elsewhere import Source
    from illumgrid.light import Illumination


AROUND = ("studio", "sky", "floor", "box")
"""Scenes around a volume, by the names of their constructors; the first is the default."""


@dataclass(frozen=True)
class Input:
    """What is to be lit: a name for the folder of the result, and how the scene is made, blurred by `smooth` voxels.

    `source` is the volume file of such a scene, where it is one.
    """

    name: str
    make: Callable[[float], "Scene"]
    preset: "Preset | None" = None
    source: "Callable[[float], Source] | None" = None


def scene_input(
    source: str | None,
    surroundings: str | None,
    limits: tuple[float, float] | None,
    inside: str | None,
    signed: bool,
    albedo: tuple[float, float, float] | None,
    reading: dict[str, Any],
) -> Input:
    """Tell a volume file from a scene file and a built-in scene; nothing is read yet."""
    from illumgrid.field.builtin import SCENES
    from illumgrid.io.readers import volume_name

    name = "nucleus" if source is None else source
    preset = SCENES.get(name) if source is None or not Path(source).exists() else None
    if preset or name.lower().endswith(".toml"):
        if extra := given(
            scene=surroundings, range=limits, inside=inside, signed=signed or None, albedo=albedo, **reading
        ):
            options = ", ".join(f"--{option}" for option in extra)
            what, todo = ("built-in scene", "leave") if preset else ("scene file", "write them into the file and leave")
            raise BadInput(
                f"{options} came with the {what} {name!r}; expected a volume file with them: {todo} them out"
            )
        return Input(name, partial(_smoothed, preset.make), preset) if preset else _scene_file(name)
    check_inside(inside, reading.get("label"))
    if surroundings not in (None, *AROUND):
        raise BadInput(f"--scene is {surroundings!r}; expected {', '.join(AROUND[:-1])} or {AROUND[-1]}")
    if signed and (also := given(inside=inside, label=reading.get("label"))):
        raise BadInput(
            f"--signed and --{next(iter(also))} came together; expected one of them: --signed lights h >= c and h <= -c"
        )
    side: Side | None = None if signed else "below" if inside == "below" else "above"
    from illumgrid.io.elsewhere import Source

    labels = labels_of(reading.get("label"))
    plain = {key: value for key, value in reading.items() if key != "label"}
    read_as = partial(Source, name, plain, labels, side)
    make = partial(_volume_scene, read_as, surroundings or AROUND[0], albedo, limits)
    return Input(volume_name(name), make, source=read_as)


def _scene_file(name: str) -> Input:
    from illumgrid.io.readers import read_scene

    return Input(Path(name).stem, lambda smooth: read_scene(name, smoothing=smooth))


def _volume_scene(
    read_as: "Callable[[float], Source]", surroundings: str, albedo: Any, limits: Any, smooth: float
) -> "Scene":
    """The fields of a volume with what is around them; both signs of it if its side is None."""
    import numpy as np

    from illumgrid.field.labels import fields_of
    from illumgrid.field.scene import Material, Scene
    from illumgrid.field.signed import signed_pair
    from illumgrid.io.readers import volume_name

    around: Callable[..., Scene] = getattr(Scene, surroundings)
    source = read_as(smooth)
    name, volumes = volume_name(source.path), source.volumes()
    if source.labels:
        each = {label: volume for label, volume in volumes.items() if label is not None}
        return _around_all(around, fields_of(name, each, albedo, limits))
    if source.side is None:
        material = None if albedo is None else Material(np.asarray(albedo))
        return _around_all(around, signed_pair(name, volumes[None], limits, material))
    return around(volumes[None], albedo, limits, source.side, name)


def _around_all(around: Callable[..., "Scene"], fields: "Sequence[Field]") -> "Scene":
    """Several fields of one lattice with what `around` puts around the first."""
    first = fields[0]
    scene = around(first.volume, first.material.albedo, first.range, first.inside, first.name)
    return replace(scene, fields=tuple(fields))


def _in_harmonics(scene: "Scene", lights: str | None, degree: int | None) -> "Scene":
    if lights not in (None, "sh"):
        raise BadInput(f"--lights is {lights!r}; expected sh, or leave it out to keep each light of the scene")
    if lights is None and degree is not None:
        raise BadInput("--degree came without --lights sh; expected both")
    return scene if lights is None else scene.in_harmonics(2 if degree is None else degree)


def _smoothed(make: Callable[[], "Scene"], smooth: float) -> "Scene":
    from illumgrid.field.volume import smooth as blur

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


def _stages(names: dict[str, str], settings: list[str], run_wide: dict[str, int | None]) -> dict[str, Any]:
    """Stages by name; an option given for the whole run goes to the stage that has it, unless --set says otherwise."""
    from illumgrid import registry

    options = _stage_options(settings)
    for place, value in run_wide.items():
        kind, option = place.split(".")
        if value is not None and option in registry.option_names(kind, names[kind]):
            options[kind].setdefault(option, str(value))
    return {kind: registry.make(kind, name, options[kind]) for kind, name in names.items()}


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
    sampler: Annotated[str, typer.Option(help="Where to ask for light: direct, uniform, adaptive.")] = "direct",
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
    signed: Annotated[
        bool, typer.Option("--signed", help="Light h >= c and h <= -c, in two colours; --range is that of c, above 0.")
    ] = False,
    backend: Annotated[str, typer.Option(help="Light transport: auto, numba, embree, reference.")] = "auto",
    paths: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Light paths from every query. [default: 32]")
    ] = None,
    bounces: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="N",
            help="Reflections. [default: until under 1 % is left out, at least 4]",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**64 - 1, metavar="N", help="Equal seeds give equal light.")] = 0,
    interpolator: Annotated[str, typer.Option(help="nearest, bilateral, splat or rbf.")] = "nearest",
    grid: Annotated[
        int | None,
        typer.Option(min=2, metavar="N", help="Nodes along the longest axis. [default: 1.2 per voxel, at most 150]"),
    ] = None,
    surroundings: Annotated[
        str | None,
        typer.Option("--scene", help="What is around a volume: studio, sky, floor, box (and lamp). [default: studio]"),
    ] = None,
    texels: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=4096,
            metavar="N",
            help="Texels along the longest edge of the walls. [default: those of the scene: one for three voxels]",
        ),
    ] = None,
    albedo: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="R G B", help="Share of light that the surface reflects. [default: a neutral grey]"),
    ] = None,
    lights: Annotated[
        str | None,
        typer.Option(help="sh: keep the answer to spherical harmonics of distant light, for preview --sky and --turn."),
    ] = None,
    degree: Annotated[
        int | None, typer.Option(min=0, max=4, metavar="L", help="Of those harmonics: (L + 1)² layers. [default: 2]")
    ] = None,
    spacing: Spacing = None,
    channel: Channel = None,
    time_step: Time = None,
    array: Array = None,
    label: Label = None,
    crop: Crop = None,
    downsample: Downsample = None,
    follow: Follow = False,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="STAGE.OPTION=VALUE", help="Any option of a stage, repeatable.")
    ] = None,
    error: Annotated[
        float | None,
        typer.Option(metavar="E", help="Choose nodes, paths and bounces for this relative error, such as 0.03."),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(metavar="S", help="Choose them for this much computing time. Reading and writing come on top."),
    ] = None,
    smooth: Annotated[
        float | None, typer.Option(min=0.0, metavar="SIGMA", help="Gaussian blur in voxels before anything else.")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Threads. [default: one per processor]")
    ] = None,
    no_preview: Annotated[bool, typer.Option("--no-preview", help="Leave the picture out.")] = False,
    no_embed: Annotated[
        bool, typer.Option("--no-embed", help="Refer to the volume file, which must stay, in place of a copy in DIR.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a finished run in DIR.")] = False,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on: with what a stopped run left, or with more --paths on a finished DIR."),
    ] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="So many processes on this machine, by dask.distributed.")
    ] = None,
    dask: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="The workers of a dask scheduler, such as tcp://host:8786.")
    ] = None,
    any_machine: Annotated[
        bool,
        typer.Option(
            "--any-machine",
            help="Accept another processor or other versions, among workers or since a run was stopped: the same light "
            "then, but for its last digits.",
        ),
    ] = False,
    ignore: Ignore = None,
) -> None:
    """Light a volume, the volumes of a scene file, or a built-in scene, for all isovalues at once.

    DIR then holds illumination.exr, run.json and preview.png, and needs nothing else (--no-embed: the volume file).
    A long run keeps what it has finished in DIR.partial: after a stop the same command goes on from there.
    """
    from illumgrid.chain import run as light_up
    from illumgrid.field.diagnosis import diagnose
    from illumgrid.field.lattice import nodes_over
    from illumgrid.field.scene import with_texels
    from illumgrid.io import store

    with reported_warnings(ignore) as sentences:
        check_spread(workers, dask)
        names = {"sampler": sampler, "backend": backend, "interpolator": interpolator}
        stages = _stages(names, settings or [], {"backend.threads": threads, "sampler.count": isovalues})
        reading = given(
            spacing=spacing,
            channel=channel,
            time=time_step,
            array=array,
            label=label,
            crop=crop,
            downsample=downsample,
            follow=follow or None,
        )
        asked = scene_input(source, surroundings, limits, inside, signed, albedo, reading)
        if no_embed and asked.source is None:
            raise BadInput(
                f"--no-embed came with the scene {asked.name!r}; expected a volume file with it; leave it out"
            )
        if asked.preset and error is None and seconds is None:
            grid, paths = grid or asked.preset.grid, paths or asked.preset.paths
            isovalues = isovalues or asked.preset.isovalues
        folder = output or Path(f"{asked.name}-light")
        if not (resume and store.is_run(folder)):
            store.claim(folder, overwrite)
        scene = _in_harmonics(asked.make(smooth or 0.0), lights, degree)
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
            say(f"{folder} is finished, and holds as many paths: nothing is left to do")
            return
        for field in scene.fields:
            shape = " x ".join(map(str, field.volume.shape))
            say(f"{field.name}: {shape} voxels, isovalues {shown_range(field.range)}")
            for finding in diagnose(field, nodes_over(field.volume, grid), smooth or 0.0):
                tell(finding.name, finding.sentence)
                if finding.name == "noise" and "noise" not in (ignore or []):
                    say(f"  smoothed that far: {_again(finding.options)}")
        if backend == "auto":
            say(_why_auto())
        with closing(keep), spread(workers, dask, any_machine) as over, progress_bars(keep.standing) as progress:
            light = light_up(
                scene, **shared_out(stages, workers), **numbers, error=error, seconds=seconds, judge=False,
                map=over, progress=progress, keep=keep,
            )  # fmt: skip
        about = {"input": asked.name if source is None else source, "reading": reading, "smooth": smooth or 0.0}
        light = replace(light, recipe={**light.recipe, **about, "warnings": sentences})
        elsewhere = asked.source(smooth or 0.0) if no_embed and asked.source else None
        _save(light, folder, not no_preview, overwrite or resume, elsewhere)
        keep.leave(folder)
        light = _judged(light, stages, folder)
        about = {key: light.recipe[key] for key in ("reached", "reached_uncertain", "reached_on_walls")}
        store.amend(folder, {**about, "warnings": sentences})
    _report(light, folder, picture=not no_preview)


def _why_auto() -> str:
    """Which backend `auto` took, and why."""
    from illumgrid import registry

    return f"backend: {registry.auto_backend()} ({registry.WHY_AUTO})"


def _save(light: "Illumination", folder: Path, preview: bool, overwrite: bool, source: "Source | None" = None) -> None:
    """Save the light; where that fails, keep it elsewhere: hours of work are not lost to a full disk."""
    try:
        light.save(folder, preview=preview, overwrite=overwrite, source=source)
    except Exception:
        for place in (gettempdir(), "~"):
            with suppress(Exception):
                work = Path(mkdtemp(prefix="illumgrid-", dir=Path(place).expanduser()))
                try:
                    light.save(work / folder.name, preview=False, source=source)
                except BaseException:
                    rmtree(work, ignore_errors=True)
                    raise
                say(f"the light is kept in {work / folder.name}; move that folder to where you want it")
                break
        raise


def _judged(light: "Illumination", stages: dict[str, Any], folder: Path) -> "Illumination":
    """With the error that was reached; Ctrl-C ends the judgement, not the finished run."""
    from illumgrid.chain import judged

    try:
        light = judged(light, stages["backend"])
        _advise(light, stages)
    except KeyboardInterrupt:
        say(f"stopped before the error was measured; the light itself is complete in {folder}")
    return light


def _advise(light: "Illumination", stages: dict[str, Any]) -> None:
    """Where more paths would not help much, say what would."""
    import numpy as np

    from illumgrid.accuracy.judge import remedies

    recipe = light.recipe
    if (stages["sampler"].name, stages["interpolator"].name) != ("direct", "nearest") or not recipe["reached"]:
        return
    noise = max((e or 0.0 for e in recipe["relative_error"]), default=0.0)
    if recipe["reached"] < max(0.05, 1.5 * noise):
        return
    specs = [grid.spec for grid in light.grids]
    try:
        found = remedies(light.scene, stages["backend"], specs, recipe["bounces"], recipe["seed"])
    except Exception as reason:  # a finished run is worth more than advice
        tell("error", f"what would reduce the error could not be measured ({type(reason).__name__}: {reason})")
        return
    if not found:
        return
    text = f"interpolation between nodes is off by about {found['now']:.1%} at any number of paths"
    if found["finer"] < 0.8 * found["now"]:
        text += f"; --grid {2 * recipe['grid']} would reduce that to {found['finer']:.1%}"
    if found["smooth"] < 0.8 * found["now"]:
        smooth = np.hypot(recipe.get("smooth", 0.0), 1.0)  # by a voxel more: variances of blurs add up
        text += f"; --smooth {smooth:.2g}, which lights a field without its noise, to {found['smooth']:.1%}"
    tell("grid", text)


def _again(options: str) -> str:
    """The command line of this process, with another blur, in place of its result."""
    words = ["illumgrid", *sys.argv[1:]]
    for at in [k for k, word in enumerate(words) if word == "--smooth"][::-1]:
        words[at : at + 2] = []
    words = [word for word in words if not word.startswith("--smooth=") and word != "--overwrite"]
    return f"{shlex.join(words)} {options} --overwrite"


def _report(light: "Illumination", folder: Path, picture: bool) -> None:
    recipe = light.recipe
    errors = [e for e in recipe["relative_error"] if e is not None]
    noise = f", noise about {max(errors):.1%} of the mean light" if errors else ""
    plan, reached = recipe["plan"], recipe["reached"]
    if plan:
        for sentence in plan["why"]:
            say(f"  {sentence}")
    work = f"{recipe['queries'] - recipe['texels']} queries x {recipe['paths']} paths"
    if recipe["texels"]:
        work += f" and {recipe['texels']} texels of walls x {recipe['texel_paths']} paths"
    say(f"{work} in {sum(recipe['seconds'].values()):.1f} s{noise}{omitted_light(recipe)}")
    if reached:
        predicted = f"; predicted: {plan['error']:.2%}" if plan else ""
        on_walls = recipe["reached_on_walls"]
        walls = f", on walls {on_walls:.2%} of theirs" if on_walls is not None else ""
        say(f"error reached: {reached:.2%} +- {recipe['reached_uncertain']:.2%} of the mean light{walls}{predicted}")
    say(f"wrote {folder}" + (f"; look at {folder / 'preview.png'}" if picture else ""))
