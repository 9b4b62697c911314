"""The error that a finished run has reached, and what would reduce it."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from illumgrid.accuracy.probe import Probe
from illumgrid.accuracy.reference import Errors, begin, errors
from illumgrid.bake.ahead import lattice
from illumgrid.bake.bounces import enough_bounces
from illumgrid.errors import BadInput
from illumgrid.field.filters import smooth
from illumgrid.field.lattice import along_longest, specs_over
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats
from illumgrid.grid import GridSpec
from illumgrid.rng import shifted_seed
from illumgrid.stages import Backend
from illumgrid.transport.samples import Queries
from illumgrid.transport.tracer import Tracer, prepare

_SMALL = 1 << 26  # voxels


def judge(
    scene: Scene, tracer: Tracer, unseen: Callable[[Scene, int, int], Queries], held: Callable[[Queries], Floats],
    seed: int, queries: int, paths: int, bounces: int,
) -> Errors | None:  # fmt: skip
    """Error of the light of grids or walls at points that no run samples; None without light or without such points.

    `unseen` makes points from a scene, a number and a seed; `held` looks up light (n, 3) at them. Light is smooth
    on most of the area of walls, so that an error in shadows alone counts little there: see `Errors.p95`.

    Takes a twentieth of the run's work, or that of 1024 points if it is more: up to as many paths per point as the run
    had, which makes the reference as accurate, and more points, since a few carry the error where light is rough.
    The path count is fixed in advance: stopping once the reference looks accurate enough would bias the estimate.
    """
    seed = shifted_seed(seed, 2)
    followed, _ = enough_bounces(scene, tracer, seed, 1e-3)
    share = queries * paths * (bounces + 1) / (20 * (followed + 1))
    points = int(np.clip(share / max(paths, 1), 1024, 4096))
    many = 2 ** round(np.log2(np.clip(share / points, 32, max(32, paths))))
    truth = begin(tracer, unseen(scene, points, seed), followed, seed, many)
    return errors(held(truth.queries), truth) if truth.mean > 0 else None


def remedies(scene: Scene, backend: Backend, specs: Sequence[GridSpec], bounces: int, seed: int) -> dict[str, float]:
    """Relative error without noise of the present grids, of `--grid` with twice the nodes, and of a smoothed field.

    The last is infinite for more than `_SMALL` voxels: the smoothed copy would take more memory than the whole run.
    """
    tried = [("now", scene, specs), ("finer", scene, specs_over(scene, 2 * along_longest(specs)))]
    if all(f.volume.stored.size <= _SMALL for f in scene.fields):
        soft = replace(scene, fields=tuple(replace(f, volume=smooth(f.volume, 1.0)) for f in scene.fields))
        tried.append(("smooth", soft, specs))
    found = {"smooth": np.inf}
    for what, of, nodes in tried:
        try:  # few points and paths: a hint must not cost more than the run
            probe = Probe.start(of, prepare(backend, of), 512, 0.05, seed)
        except BadInput:  # no light at these points
            return {}
        part = probe.measure(lattice(nodes, probe.reference.tracer, bounces), 32).parts
        found[what] = float(np.sqrt(max(0.0, part.total - part.noise)))
    return found
