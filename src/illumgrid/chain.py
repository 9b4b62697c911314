"""`run` and `load`: from a scene or a folder to its light; names of stages become objects here."""

import operator
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np

from illumgrid import registry
from illumgrid.accuracy.choose import JUDGED, planned
from illumgrid.accuracy.judge import judge as measure_error
from illumgrid.accuracy.points import unseen_in_volume, unseen_on_walls
from illumgrid.accuracy.probe import FEWEST_PATHS, MOST_PATHS
from illumgrid.accuracy.reference import Errors
from illumgrid.bake import Baked, bake
from illumgrid.bake.accumulator import Map, Progress
from illumgrid.bake.ahead import BY_NORMAL, Ahead, by_normal_in, light_ahead, refinable_by
from illumgrid.bake.around import look_up
from illumgrid.bake.bounces import enough_bounces, has_long_paths, light_left_out
from illumgrid.bake.walls import look_up_walls
from illumgrid.constants import BASE, PATHS
from illumgrid.errors import BadInput, tell, tell_after
from illumgrid.field.lattice import along_longest, specs_over
from illumgrid.field.layers import layers_of
from illumgrid.field.scene import Levels, Scene, finer_texels, level_table, with_texels
from illumgrid.grid import GridSpec
from illumgrid.io import needs, store
from illumgrid.light import Illumination
from illumgrid.stages import Backend, Interpolator, Sampler
from illumgrid.transport.stages import capabilities
from illumgrid.transport.tracer import Tracer, prepare
from illumgrid.transport.walk import RunKeeper


def load(folder: str | os.PathLike[str]) -> Illumination:
    """Read what `Illumination.save` or ``illumgrid run`` wrote."""
    stored = store.read(folder)
    return Illumination(
        stored.scene, stored.levels, stored.grids, stored.walls, stored.recipe, stored.recipe.get("weights", {})
    )


def _stage(kind: str, given: Any, options: dict[str, Any] | None = None) -> Any:
    return registry.make(kind, given, options or {}) if isinstance(given, str) else given


def _stages(sampler: Any, backend: Any, interpolator: Any, isovalues: int | None) -> tuple[Any, Any, Any]:
    """The three stages; `isovalues`, if given, sets the count of a sampler that is given by name and has one."""
    named = isovalues is not None and isinstance(sampler, str)
    options = {"count": isovalues} if named and "count" in registry.option_names("sampler", sampler) else {}
    return _stage("sampler", sampler, options), _stage("backend", backend), _stage("interpolator", interpolator)


def _check_needs(
    scene: Scene, specs: Sequence[GridSpec], levels: Levels, chosen: tuple[Any, Any, Any], *, held: bool, refining: bool
) -> None:
    """Refuse a run that needs more memory than is free."""
    at_nodes = not held and chosen[0].name == "direct" and chosen[2].name in ("nearest", "bilateral")
    density = getattr(chosen[2], "density", 1.0)
    needs.check_run(scene, specs, levels, density, at_nodes=at_nodes, refining=refining)


def _described(stage: Any) -> dict[str, Any]:
    return {"name": stage.name, **asdict(stage)}


def run(
    scene: Scene,
    *,
    sampler: str | Sampler = "direct",
    backend: str | Backend = "auto",
    interpolator: str | Interpolator = "nearest",
    grid: int | None = None,
    paths: int | None = None,
    bounces: int | None = None,
    isovalues: int | None = None,
    texels: int | None = None,
    seed: int = 0,
    error: float | None = None,
    seconds: float | None = None,
    judge: bool = True,
    map: Map = map,
    progress: Progress = lambda what, done, total: None,
    keep: RunKeeper | None = None,
) -> Illumination:
    """Light a scene: one illumination grid for each field.

    Parameters
    ----------
    scene : Scene
    sampler, backend, interpolator : str or stage
        Names, or stage objects such as ``illumgrid.sampler("uniform", count=64)``. For noisy data
        (`illumgrid.field.diagnosis.noisy`) under several lights, without `grid` and walls, ``bilateral`` of density 1
        replaces ``nearest``.
    grid : int, optional
        Nodes along the axis with most voxels; every node near an isosurface of the range is lit. By default 1.2 per
        voxel, at most 150; under a sky alone 0.85, with half or a quarter of that spacing where a first look finds
        rough light: see `illumgrid.bake.refined.chosen`.
    paths : int, optional
        Light paths per query; by default 32; 8 to 64 if a first look chooses the nodes, 16 for noisy data with
        ``bilateral``.
    bounces : int, optional
        Reflections; 0 is light straight from background and lamps. By default as many as leave out less than 1 % of
        the light, and at least 8; paths may then end in the light of the first look, or, where light needs more than 4
        bounces, in a coarse grid that is lit first: see `illumgrid.bake.known.light_known_first`. If a number is given,
        every path is followed for that many reflections.
    isovalues : int, optional
        Rows of the level table, 32 by default; if given, also the count of a sampler that is named and has one.
    texels : int, optional
        Texels along the longest edge of all walls; by default those of the scene, or with `error` as many as it
        needs.
    seed : int
        Equal seeds give bit-identical grids, on any number of threads.
    error : float, optional
        Relative root mean square error to reach: a short pilot chooses `grid`, `paths` and `bounces`, as far as they
        are not given, for the least time. Needs the sampler `direct`, the interpolator `nearest` and a backend that
        marches level sets, whose error is known before the grid is built.
    seconds : float, optional
        Instead of `error`: computing time in seconds, used for the least error.
    judge : bool
        Whether to measure the error reached at the end: see `judged`.
    map : callable, optional
        Applies a function to pieces of work, like the built-in ``map``: see `illumgrid.bake.bake`.
    progress : callable, optional
        Called with (what, done, total).
    keep : RunKeeper, optional
        Keeps finished light. A resumed run takes over what the earlier one had chosen.

    Returns
    -------
    Illumination

    Raises
    ------
    BadInput
        On options out of range, or unknown names.

    Warns
    -----
    IllumgridWarning
        When the scene has no light, or nodes within the range are holes.
    """
    paths, bounces, seed = _whole_numbers(paths, bounces, seed)
    scene = scene if texels is None else with_texels(scene, texels)
    levels = level_table(scene, 32 if isovalues is None else isovalues)
    chosen = _stages(sampler, backend, interpolator, isovalues)
    begun, tracer = time.perf_counter(), prepare(chosen[1], scene)
    before = None if keep is None else keep.chosen
    at_once = bool(keep and keep.at_once)
    if error is not None or seconds is not None:
        _check_plannable(error, seconds, *chosen)
    cached, left_out = bool(before and before.get("cache")), 0.0
    plan: Any = None
    ahead: Ahead | None = None
    refinable = not at_once and grid is None and refinable_by(scene, *chosen)
    if before:
        grid, bounces, left_out, plan = (before[key] for key in ("grid", "bounces", "left_out", "plan"))
    elif error is not None or seconds is not None:
        plan, ahead = _planned(
            scene, tracer, levels, progress, error=error, seconds=seconds, grid=grid, paths=paths, bounces=bounces,
            texels=texels, looking=refinable, seed=seed,
        )  # fmt: skip
        grid, bounces = plan["grid"], plan["bounces"]
    scene = finer_texels(scene, plan.get("finer", 1.0)) if plan else scene
    if not _shines(scene):
        tell("dark", "no background, lamp or surface of this scene emits light: all of it will be 0", stacklevel=2)
    refining = before.get("refined") if before else plan["looked"] if plan else refinable
    by_normal = before.get("by_normal") if before else grid is None and not at_once and by_normal_in(scene, *chosen)
    if by_normal:
        chosen = chosen[0], chosen[1], BY_NORMAL[0]
    specs = specs_over(scene, grid, BASE) if refining else specs_over(scene, grid)
    held = any(field.isovalue is not None for field in scene.fields)  # the rows of a held level are in no cache's sweep
    _check_needs(scene, specs, levels, chosen, held=held, refining=bool(refining))
    automatic = bounces is None or cached
    if bounces is None:
        bounces, left_out = enough_bounces(scene, tracer, seed)
        marches = capabilities(chosen[1]).surface == "levelset" and hasattr(tracer, "cache")
        cached = marches and not at_once and not held and has_long_paths(scene, tracer, seed)
    elif not before:
        left_out = light_left_out(scene, tracer, bounces, seed)
    clock = time.perf_counter()
    ahead = ahead or light_ahead(
        scene, specs, levels, tracer, chosen, refining=bool(refining), cached=cached, automatic=automatic,
        bounces=bounces, seed=seed, map=map, progress=lambda what, done, total: progress("first light", done, total),
    )  # fmt: skip
    first = {ahead.name: time.perf_counter() - clock} if ahead.name else {}
    if ahead.cached and not before:
        left_out = light_left_out(scene, ahead.tracer, bounces, seed)
    walked = _paths_of(before, plan, paths, error, seconds, begun, BY_NORMAL[1] if by_normal else ahead.paths)
    if keep is not None:
        fixed = None if isinstance(walked, Iterator) else max(r.stop for r in walked)
        about = {"cache": ahead.cached, "grid": grid, "bounces": bounces, "left_out": left_out, "paths": fixed}
        keep.choose({**about, "refined": ahead.refined, "by_normal": bool(by_normal), "plan": plan})
    ending, ahead = [ahead.tracer], replace(ahead, tracer=tracer)  # frees the light that paths end in
    baked = bake(
        scene, ahead.specs, levels, ahead.sampler, ending.pop(), ahead.interpolator,
        paths=walked, bounces=bounces, seed=seed, map=map, progress=progress, keep=keep,
    )  # fmt: skip
    _note_holes(scene, baked)
    said = {"bounces": bounces, "left_out": left_out, "by_normal": bool(by_normal), "seed": seed, "plan": plan}
    recipe = {**_chosen(chosen, ahead, specs), **said, "isovalues": len(levels.table), **_measured(baked, first)}
    light = Illumination(scene, levels, baked.grids, baked.walls, recipe)
    return judged(light, chosen[1], tracer) if judge else light


def _planned(
    scene: Scene, tracer: Tracer, levels: Levels, progress: Progress, **asked: Any
) -> tuple[dict[str, Any], Ahead | None]:
    """What a pilot chooses for an error or a time, see `planned`; warns of what the user should know."""
    progress("pilot", 0, 1)
    plan, ahead = planned(scene, tracer, levels, **asked)
    progress("pilot", 1, 1)
    if plan.outlook:
        tell("plan", plan.outlook, stacklevel=3)
    return asdict(plan), ahead


def _paths_of(
    before: dict[str, Any] | None, plan: Any, paths: int | None, error: float | None, seconds: float | None,
    begun: float, few: int,
) -> Iterable[range]:  # fmt: skip
    """Ranges of paths to trace: `few` unless something else is requested."""
    if before:
        return _gone_on_with(before, None if error or seconds else paths or usual_paths(before))
    if plan and seconds is not None and paths is None:
        return rounds(plan["paths"], plan["fill"], begun + seconds)
    return [range(plan["paths"] if plan else paths or few)]


def usual_paths(before: dict[str, Any]) -> int:
    """Paths of a resumed run if no number is requested: those that it had chosen by itself, or the default."""
    chosen: int = before["paths"] if before.get("refined") or before.get("by_normal") else PATHS
    return chosen


def _whole_numbers(paths: Any, bounces: Any, seed: Any) -> tuple[int | None, int | None, int]:
    """Check these options; numbers of any integer type become those of Python."""
    if paths is not None:
        paths = _whole(paths, 1, 2**31, "got {} paths; expected a whole number, at least 1 and fewer than 2**31")
    if bounces is not None:
        bounces = _whole(bounces, 0, 2**31, "got {} bounces; expected 0 (light straight from the lamps) to 2**31 - 1")
    return paths, bounces, _whole(seed, 0, 2**64, "the seed is {}; expected a whole number from 0 to 2**64 - 1")


def _whole(number: Any, least: int, limit: int, sentence: str) -> int:
    """A whole number of any integer type, at least `least` and below `limit`; otherwise `BadInput`."""
    try:
        whole = operator.index(number)
    except TypeError:
        raise BadInput(sentence.format(repr(number))) from None
    if not least <= whole < limit:
        raise BadInput(sentence.format(whole))
    return whole


def _note_holes(scene: Scene, baked: Baked) -> None:
    for field, holes in zip(scene.fields, baked.holes):
        if holes:
            tell_after(
                "holes",
                f"{holes} nodes within the range of field {field.name!r} got no light of their own (no normal, or no "
                "sample in reach); they show that of the nearest node",
                stacklevel=3,
            )


def _chosen(stages: Sequence[Any], ahead: Ahead, looked_at: Sequence[GridSpec]) -> dict[str, Any]:
    """The part of the recipe about the stages and the nodes, which a first look at a lattice may have chosen."""
    kinds = zip(("sampler", "backend", "interpolator"), (*stages[:2], ahead.interpolator))
    return {
        **{kind: _described(stage) for kind, stage in kinds},
        "grid": along_longest(ahead.specs),
        "cache": ahead.cached,
        "refined": ahead.refined and {"from": along_longest(looked_at), "levels": ahead.levels},
    }


def _measured(baked: Baked, first: dict[str, float]) -> dict[str, Any]:
    """The part of the recipe about the computation; `first` is the time spent before the bake."""
    return {
        "paths": baked.paths,
        "queries": baked.queries,
        "texels": baked.texels,
        "texel_paths": baked.texel_paths,
        "holes": list(baked.holes),
        "seconds": {stage: round(seconds, 3) for stage, seconds in {**first, **baked.seconds}.items()},
        "relative_error": [grid.relative_error for grid in baked.grids],
        **dict.fromkeys(("reached", "reached_uncertain", "reached_on_walls")),  # error not measured
        "versions": {name: version(name) for name in ("illumgrid", "numpy", "numba", "scipy")},
    }


def judged(light: Illumination, backend: Backend, tracer: Tracer | None = None) -> Illumination:
    """The same light with the error that it reached in its recipe; never raises.

    ``reached`` is the relative root mean square error at points that the run did not ask for, ``reached_uncertain`` its
    standard error, and ``reached_on_walls`` that error on walls. The error is measured on the trilinear surface only:
    all three are None for a backend that traces meshes or computes no light transport, and for a scene without light.

    Parameters
    ----------
    light : Illumination
        From `run`.
    backend : Backend
        The one that computed it.
    tracer : Tracer, optional
        That backend with the scene set up, if the caller still has it.
    """
    recipe = light.recipe
    try:
        can = capabilities(backend)
        if not can.transport or can.surface != "levelset":
            return light
        quick = registry.backend("auto")  # on the same surface
        if tracer is None or quick != backend:
            tracer = prepare(quick, light.scene)

        def off(unseen: Any, held: Any, *work: str) -> Errors | None:
            about = (recipe[key] for key in ("seed", *work, "bounces"))
            return measure_error(light.scene, tracer, unseen, held, *about)

        found = off(unseen_in_volume, lambda asked: look_up(light.grids, asked)[0], "queries", "paths")
        held = partial(look_up_walls, light.scene, light.walls)
        on_walls = off(unseen_on_walls, held, "texels", "texel_paths") if light.walls else None
    except Exception as reason:  # a failing measurement must not fail a finished run
        tell_after(
            "error", f"the error reached could not be measured ({type(reason).__name__}: {reason})", stacklevel=2
        )
        return light
    if found is None:
        return light
    reached = {"reached": found.rmse, "reached_uncertain": found.uncertain}
    walls = None if on_walls is None else on_walls.rmse
    return replace(light, recipe={**recipe, **reached, "reached_on_walls": walls})


def _gone_on_with(before: dict[str, Any], paths: int | None) -> list[range]:
    """Ranges of paths of an earlier run, stopped or finished, and those that are requested in addition."""
    ranges = [range(start, stop) for start, stop in before.get("walked", ())]
    done, asked = max((r.stop for r in ranges), default=0), paths or before["paths"] or 0
    return [*ranges, range(done, asked)] if asked > done else ranges


def _shines(scene: Scene) -> bool:
    return any(any(layer.color) for layer in layers_of(scene))


def rounds(paths: int, fill: float, until: float, clock: Callable[[], float] = time.perf_counter) -> Iterator[range]:
    """Ranges of paths for a run with a time limit: a quarter of the plan, then as many as the pace leaves time for.

    The probe times a few thousand paths, which is good enough to choose a grid but, on a machine that does other things
    as well, not to promise a time.
    """
    begun, done, more = clock(), 0, max(FEWEST_PATHS, 2 * (paths // 8))
    after = fill + (1 - JUDGED) * (until - begun)
    while more >= max(2, done // 16) and done < MOST_PATHS:
        yield range(done, done + more)
        done += more
        now = clock()
        more = 2 * int((until - after - now) * done / (now - begun) / 2)


def _check_plannable(error: float | None, seconds: float | None, sampler: Any, backend: Any, interpolator: Any) -> None:
    """Refuse a request for which no pilot can plan."""
    if error is not None and seconds is not None:
        raise BadInput("got both an error and a time; expected one of them")
    if error is not None and not 0 < error < 1:
        raise BadInput(f"got an error of {error:g}; expected a share of the mean light, such as 0.03")
    if seconds is not None and not 0 < seconds < np.inf:
        raise BadInput(f"got {seconds:g} seconds; expected a positive number")
    if (sampler.name, interpolator.name) != ("direct", "nearest") or capabilities(backend).surface == "mesh":
        raise BadInput(
            f"got an error or a time with {sampler.name}, {backend.name} and {interpolator.name}; expected "
            "direct, a backend that marches level sets, and nearest: 'illumgrid bench' measures the others"
        )
