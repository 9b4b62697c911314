"""Where the error comes from, over grids and paths: what to buy next."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from illumgrid.accuracy.parts import Split
from illumgrid.accuracy.probe import Pilot
from illumgrid.field.scene import Scene
from illumgrid.stages import Backend

PATHS = (16, 64, 256)
FEWEST, MOST = 512, 4096  # points
TRUTH = 256  # paths, at most


@dataclass(frozen=True)
class Bar:
    """The parts of the error of `Direct` with `Nearest` on one grid with so many paths."""

    grid: int
    paths: int
    split: Split


def bars(
    scene: Scene, backend: Backend, sizes: Sequence[int], bounces: int, seed: int, seconds: float, path: float
) -> list[Bar]:
    """Measure the parts on grids of these sizes, cheapest first, as far as the time goes, of which a path takes `path`.

    At as many points as half of the time allows: where a few of them carry the error, few points miss those.
    """
    begun = time.perf_counter()
    each = path * (2 * 8 * sum(PATHS) * len(sizes) + 2 * TRUTH)
    points = int(np.clip(seconds / 2 / each, FEWEST, MOST))
    pilot = Pilot.start(scene, backend, points, 0.004, seed + 1, TRUTH)
    fewer = pilot.fewer(bounces)
    found: list[Bar] = []
    last = 0.0
    for paths in PATHS:
        for size in sizes:
            now = time.perf_counter()
            if now - begun + last > seconds and found:
                break
            found.append(Bar(size, paths, pilot.measure(size, fewer, bounces, paths).split))
            last = (time.perf_counter() - now) * (4 if size == sizes[-1] else 1.5)
    return sorted(found, key=lambda bar: (bar.grid, bar.paths))
