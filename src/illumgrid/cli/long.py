"""For long runs of ``illumgrid run``: finished light that is kept, and many processes or machines."""

import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from illumgrid.cli.terminal import say
from illumgrid.errors import BadInput

if TYPE_CHECKING:
    from illumgrid.field.scene import Scene
    from illumgrid.io.partial import Partial
    from illumgrid.light import Illumination


def loaded(folder: Path) -> "Illumination":
    """The light of a finished or unfinished run; of an unfinished one, print the finished share."""
    from illumgrid import unfinished
    from illumgrid.chain import load

    place = unfinished.place_of(folder)
    if place is None:
        return load(folder)
    light, share = unfinished.load(place)
    say(
        f"note: {place} holds {share:.0%} of a run: the light between finished nodes is coarse, stripes are not lit yet"
    )
    return light


def check_spread(workers: int | None, dask: str | None) -> None:
    """Refuse options from which no cluster can be made, before anything is read."""
    from importlib.util import find_spec

    if workers is not None and dask is not None:
        raise BadInput("--workers and --dask came together; expected one: a new local cluster, or one that exists")
    if (workers is not None or dask is not None) and find_spec("distributed") is None:
        raise BadInput("several workers need dask.distributed; pip install 'illumgrid[dask]'")


def kept(
    folder: Path, scene: "Scene", stages: Mapping[str, Any], resume: bool, overwrite: bool, any_machine: bool,
    **numbers: Any,
) -> "Partial | None":  # fmt: skip
    """What keeps the light of a run on the way, with all that an earlier one left; None if nothing is left to do."""
    from illumgrid.chain import usual_paths
    from illumgrid.constants import PATHS
    from illumgrid.io import store
    from illumgrid.io.identity import identity
    from illumgrid.io.partial import Partial

    planned, asked = numbers["error"] is not None or numbers["seconds"] is not None, numbers["paths"]
    numbers["paths"] = None if planned else numbers["paths"] or PATHS
    about = identity(scene, stages, **numbers)
    command = shlex.join(["illumgrid", *sys.argv[1:]])
    partial = Partial(folder, about, command, lambda place: _write_scene(place, scene))
    finished = resume and store.is_run(folder)
    if not partial.resume(folder if finished else None, overwrite, any_machine):
        if finished:
            say(f"{folder} holds no moments of its paths; all paths are traced again")
        return partial
    done = max((stop for _, stop in (partial.chosen or {})["walked"]), default=0)
    if partial.place.is_dir():
        say(f"going on with {partial.place}")
    elif planned or done >= (asked or usual_paths(partial.chosen or {})):
        return None
    else:
        say(f"continuing after the {done} paths of {folder}")
    return partial


def _write_scene(place: Path, scene: "Scene") -> None:
    """Write a folder of a run in which nothing is lit, for pictures of the unfinished run."""
    import numpy as np

    from illumgrid.field.scene import level_table
    from illumgrid.grid import GridSpec, IlluminationGrid, WallTexture
    from illumgrid.io import store
    from illumgrid.io.record import Stored

    grids, walls = [], []
    for field in scene.fields:
        spec = GridSpec.over(field.volume, 2)
        none = np.zeros(spec.shape, np.float32)
        grids.append(IlluminationGrid(spec, none[..., None], none + np.inf, none))
    for quad in scene.quads:
        none = np.zeros((2, *quad.texels[::-1]), np.float32)
        walls.append(WallTexture(none[..., None], none))
    store.write(place, Stored(scene, level_table(scene, 2), tuple(grids), tuple(walls), {}), None, False)


def shared_out(stages: Mapping[str, Any], workers: int | None) -> dict[str, Any]:
    """The stages, with the threads of the backend divided among several processes on one machine."""
    import os

    backend = stages["backend"]
    if workers is None or getattr(backend, "threads", None) != 0:
        return dict(stages)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return {**stages, "backend": replace(backend, threads=max(1, cores // workers))}


@contextmanager
def spread(workers: int | None, dask: str | None, any_machine: bool) -> Iterator[Callable[..., Any]]:
    """The map function over this process, `workers` processes, or the workers of the scheduler `dask`."""
    if workers is None and dask is None:
        yield map
        return
    from illumgrid.cluster import cluster

    with cluster(workers, dask, any_machine=any_machine) as (spread_map, about):
        say(about)
        yield spread_map
