"""The error that a finished run has reached, and what would lessen it."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from illumgrid.accuracy.around import lattice
from illumgrid.accuracy.points import unseen_in_volume, unseen_on_walls
from illumgrid.accuracy.probe import Probe
from illumgrid.accuracy.reference import Errors, Reference, begin, errors, look_up
from illumgrid.bake.bounces import enough_bounces
from illumgrid.bake.walls import look_up_walls
from illumgrid.errors import BadInput
from illumgrid.field.filters import smooth
from illumgrid.field.lattice import specs_over
from illumgrid.field.scene import Scene
from illumgrid.grid import GridSpec, IlluminationGrid, WallTexture
from illumgrid.rng import shifted_seed
from illumgrid.stages import Backend
from illumgrid.transport.samples import Queries
from illumgrid.transport.tracer import Tracer, prepare

_SMALL = 1 << 26  # voxels


def judge(
    scene: Scene, tracer: Tracer, grids: Sequence[IlluminationGrid], seed: int, queries: int, paths: int, bounces: int
) -> Errors | None:
    """Error of grids at points that no run asks for; None where there is no light or no surface."""
    truth = _reference(scene, tracer, unseen_in_volume, shifted_seed(seed, 2), queries * paths, paths, bounces)
    return errors(look_up(grids, truth.queries)[0], truth) if truth.mean > 0 else None


def judge_walls(
    scene: Scene, tracer: Tracer, walls: Sequence[WallTexture], seed: int, texels: int, paths: int, bounces: int
) -> Errors | None:
    """As `judge`, of the light of walls, at places between texels and rows of the sweep; None without walls to show.

    Walls behind nothing are smooth and many, so that an error at shadows alone counts little: see `Errors.p95`.
    """
    truth = _reference(scene, tracer, unseen_on_walls, shifted_seed(seed, 3), texels * paths, paths, bounces)
    return errors(look_up_walls(scene, walls, truth.queries), truth) if truth.mean > 0 else None


def _reference(
    scene: Scene, tracer: Tracer, unseen: Callable[[Scene, int, int], Queries],
    seed: int, work: int, paths: int, bounces: int,
) -> Reference:  # fmt: skip
    """Light at unseen points.

    For a twentieth of the run's work, or what 1024 points take: as many paths as the grids had, which makes the
    reference as sharp as they are, and the more points, for where the light is rough a few of them carry the error.
    The path count is fixed in advance; stopping once the reference looks sharp enough would bias the estimate.
    """
    followed, _ = enough_bounces(scene, tracer, seed, 1e-3)
    share = work * (bounces + 1) / (20 * (followed + 1))
    points = int(np.clip(share / max(paths, 1), 1024, 4096))
    many = 2 ** round(np.log2(np.clip(share / points, 32, max(32, paths))))
    return begin(tracer, unseen(scene, points, seed), followed, seed, many)


def remedies(scene: Scene, backend: Backend, specs: Sequence[GridSpec], bounces: int, seed: int) -> dict[str, float]:
    """Relative error without noise of grids as they are, of `--grid` with twice the nodes, and of a smoothed field.

    A field of more than `_SMALL` voxels is not smoothed: the copy would be larger than all else of the run; infinite.
    """
    longest = max(max(spec.shape) for spec in specs)
    tried = [("now", scene, specs), ("finer", scene, specs_over(scene, 2 * longest))]
    if all(f.volume.stored.size <= _SMALL for f in scene.fields):
        soft = replace(scene, fields=tuple(replace(f, volume=smooth(f.volume, 1.0)) for f in scene.fields))
        tried.append(("smooth", soft, specs))
    found = {"smooth": np.inf}
    for what, of, nodes in tried:
        try:  # few points and paths: a hint must not cost more than the run
            probe = Probe.start(of, prepare(backend, of), 512, 0.05, seed, most=128)
        except BadInput:  # no light where it looked
            return {}
        part = probe.measure(lattice(nodes, probe.reference.tracer, bounces), 32).parts
        found[what] = float(np.sqrt(max(0.0, part.total - part.noise)))
    return found
