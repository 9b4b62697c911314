"""After the light of a run is computed: save it, measure its error and report."""

import shlex
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from shutil import rmtree
from tempfile import gettempdir, mkdtemp
from typing import TYPE_CHECKING, Any

from illumgrid.cli.heap import return_holes
from illumgrid.cli.stops import answered
from illumgrid.cli.terminal import omitted_light, say
from illumgrid.errors import tell
from illumgrid.io import disk

if TYPE_CHECKING:
    from illumgrid.io.elsewhere import Source
    from illumgrid.io.partial import Partial
    from illumgrid.light import Illumination


def save(light: "Illumination", folder: Path, preview: bool, overwrite: bool, source: "Source | None" = None) -> None:
    """Save the light; where that fails, keep it elsewhere: hours of work are not lost to a full disk."""
    try:
        light.save(folder, preview=preview, overwrite=overwrite, source=source)
    except Exception:
        for place in (gettempdir(), "~"):
            with suppress(Exception):
                work = Path(mkdtemp(prefix="illumgrid-", dir=Path(place).expanduser()))
                disk.begun.append(work)
                try:
                    light.save(work / folder.name, preview=False, source=source)
                except BaseException:
                    rmtree(work, ignore_errors=True)
                    raise
                finally:
                    disk.begun.remove(work)
                say(f"the light is kept in {work / folder.name}; move that folder to where you want it")
                break
        raise


def finished(
    light: "Illumination", folder: Path, keep: "Partial", stages: dict[str, Any], sentences: list[str],
    preview: bool = True, overwrite: bool = False, source: "Source | None" = None,
) -> "Illumination":  # fmt: skip
    """Save the light of a run in place of its DIR.partial; then measure its error."""
    from illumgrid.io import store

    return_holes()
    save(replace(light, recipe={**light.recipe, "warnings": sentences}), folder, preview, overwrite, source)
    keep.leave(folder)
    return_holes()
    light = judged_light(light, stages, folder)
    about = {key: light.recipe[key] for key in ("reached", "reached_uncertain", "reached_on_walls")}
    store.amend(folder, {**about, "warnings": sentences})
    return light


def judged_light(light: "Illumination", stages: dict[str, Any], folder: Path) -> "Illumination":
    """The light with the error reached in its recipe; Ctrl-C ends the measurement, not the finished run."""
    from illumgrid.chain import judged

    try:
        light = judged(light, stages["backend"])
        _advise(light, stages)
    except KeyboardInterrupt:
        answered()
        say(f"stopped before the error was measured; the light itself is complete in {folder}")
    return light


def _advise(light: "Illumination", stages: dict[str, Any]) -> None:
    """If more paths would not reduce the error much, tell which option would."""
    import numpy as np

    from illumgrid.accuracy.judge import remedies

    recipe = light.recipe
    if (stages["sampler"].name, stages["interpolator"].name) != ("direct", "nearest") or not recipe["reached"]:
        return
    noise = max((e or 0.0 for e in recipe["relative_error"]), default=0.0)
    if recipe["reached"] < max(0.05, 1.5 * noise) or recipe.get(
        "by_normal"
    ):  # noisy data: the advice came before the run
        return
    specs = [grid.spec for grid in light.grids]
    try:
        found = remedies(light.scene, stages["backend"], specs, recipe["bounces"], recipe["seed"])
    except Exception as reason:  # failing advice must not fail a finished run
        tell("error", f"what would reduce the error could not be measured ({type(reason).__name__}: {reason})")
        return
    if not found:
        return
    text = f"the interpolation error between nodes is about {found['now']:.1%} at any number of paths"
    if found["finer"] < 0.8 * found["now"] and not recipe.get("refined"):
        text += f"; --grid {2 * recipe['grid']} would reduce it to {found['finer']:.1%}"
    if found["smooth"] < 0.8 * found["now"]:
        smooth = np.hypot(recipe.get("smooth", 0.0), 1.0)  # one more voxel of blur: variances add up
        text += f"; --smooth {smooth:.2g}, which lights a field without its noise, to {found['smooth']:.1%}"
    tell("grid", text)


def again(options: str) -> str:
    """The command line of this process with another blur, which overwrites its result."""
    words = ["illumgrid", *sys.argv[1:]]
    for at in [k for k, word in enumerate(words) if word == "--smooth"][::-1]:
        words[at : at + 2] = []
    words = [word for word in words if not word.startswith("--smooth=") and word not in ("--overwrite", "--resume")]
    return f"{shlex.join(words)} {options} --overwrite"


def report(light: "Illumination", folder: Path, picture: bool) -> None:
    """Report what was computed, in which time, with which error, and where it is."""
    from illumgrid.bake.known import MOST_BIAS

    recipe = light.recipe
    errors = [e for e in recipe["relative_error"] if e is not None]
    what = "error bars" if recipe.get("by_normal") else "noise"
    noise = f", {what} about {max(errors):.1%} of the mean light" if errors else ""
    plan, reached = recipe["plan"], recipe["reached"]
    if plan:
        for sentence in plan["why"]:
            say(f"  {sentence}")
    work = f"{recipe['queries'] - recipe['texels']} queries x {recipe['paths']} paths"
    if refined := recipe.get("refined"):
        say(
            f"{refined['from']} nodes along the longest axis are lit"
            + (f", and up to {recipe['grid']} where the light is rough" if refined["levels"] else "")
        )
    if recipe.get("by_normal"):
        say("noisy data: nodes average their neighbours by level and normal (bilateral); --grid N turns that off")
    if recipe.get("cache"):
        say(f"paths end in a coarse grid: a bias of at most {MOST_BIAS:.1%} of the mean light on tested scenes")
    if recipe["texels"]:
        work += f" and {recipe['texels']} texels of walls x {recipe['texel_paths']} paths"
    say(f"{work} in {sum(recipe['seconds'].values()):.1f} s{noise}{omitted_light(recipe)}")
    if reached:
        predicted = f"; predicted: {plan['error']:.2%}" if plan else ""
        on_walls = recipe["reached_on_walls"]
        walls = f", on walls {on_walls:.2%} of theirs" if on_walls is not None else ""
        say(f"error reached: {reached:.2%} +- {recipe['reached_uncertain']:.2%} of the mean light{walls}{predicted}")
    say(f"wrote {folder}" + (f"; look at {folder / 'preview.png'}" if picture else ""))
