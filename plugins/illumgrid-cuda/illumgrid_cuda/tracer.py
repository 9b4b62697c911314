"""A scene on a device, and light at queries in launches of millions of paths."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import cuda

from illumgrid.field.levelset import Marchable
from illumgrid.field.scene import Scene
from illumgrid.grid.cache import NO_CACHE, Cache
from illumgrid.grid.channels import Channels
from illumgrid.stages import Samples
from illumgrid.transport.samples import in_frame, in_turn
from illumgrid.transport.tracer import prepare
from illumgrid_cuda.kernels import launchers

PATHS = 1 << 22
"""Paths of a launch: 100 MB for what they are worth in three channels."""


class Asked(NamedTuple):
    """Queries in the frame of the scene."""

    id: Any
    point: Any
    normal: Any
    level: Any
    target: Any


@dataclass(frozen=True, eq=False)
class CudaTracer:
    """A scene set up for `Cuda`; its arrays go to the device with the first query, and stay there."""

    backend: Any
    scene: Scene
    channels: Channels
    fields: Marchable
    cache: Cache = NO_CACHE
    _there: dict = field(default_factory=dict)

    def __reduce__(self):
        return prepare, (self.backend, self.scene, self.cache)

    @in_turn
    def solve(self, queries, *, paths, bounces, seed):
        """Trace paths from every query: see `illumgrid.stages.Backend`."""
        n, count, channels = len(queries), len(paths), len(self.channels)
        mean, m2 = np.zeros((2, n, channels), np.float32)
        done = np.zeros(n, np.int32)
        if n and count:
            point, normal, level = in_frame(self.scene, queries)
            target = queries.target.astype(np.int64)
            asked = [np.ascontiguousarray(part) for part in (queries.id, point, normal, level, target)]
            size = max(1, PATHS // count)
            with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # of the simulator, which is NumPy
                for first in range(0, n, size):
                    rows = slice(first, first + size)
                    part = Asked(*(array[rows] for array in asked))
                    mean[rows], m2[rows], done[rows] = self._launch(part, paths, bounces, seed)
        return Samples(queries, mean, m2, done, self.channels)

    def _launch(self, asked, paths, bounces, seed):
        to, new, back = _device(self.backend.device)
        if "scene" not in self._there:
            self._there["scene"] = type(self.fields)(*map(to, self.fields))
        if self._there.get("of") is not self.cache:
            parts = (to(part) if isinstance(part, np.ndarray) else part for part in self.cache)
            self._there.update(of=self.cache, cache=type(self.cache)(*parts))
        scene, cache = self._there["scene"], self._there["cache"]
        n, count, channels = len(asked.id), len(paths), len(self.channels)
        launch = launchers(self.backend.device, channels)
        asked = Asked(*map(to, asked))
        start, face, within = new((n, 3), float), new(n, np.int64), new(n, np.int64)
        place, key = new(n, float), new(n, np.uint64)
        done, worth = to(np.zeros(n, np.int32)), new((n, count, channels), float)
        mean, m2 = to(np.zeros((n, channels), np.float32)), to(np.zeros((n, channels), np.float32))
        launch.begin(n, scene, cache, asked, np.uint64(seed), start, face, within, place, key, done, count)
        launch.walk(
            n * count, scene, cache, asked, start, face, within, place, key, done, paths.start, bounces, worth
        )  # fmt: skip
        launch.judge(n * channels, scene, done, paths.start, worth, mean, m2)
        return back(mean), back(m2), back(done)


def _device(name):
    """How arrays get to a device, are made there, and come back."""
    if name == "processor" or numba.config.ENABLE_CUDASIM:
        return np.asarray, np.empty, np.asarray
    return _to_card, cuda.device_array, lambda array: array.copy_to_host()


def _to_card(array):
    """A copy on the card; an array without elements, which a card does not take, gets room of one there."""
    array = np.ascontiguousarray(array)
    if array.size:
        return cuda.to_device(array)
    room = cuda.device_array(tuple(max(1, n) for n in array.shape), array.dtype)
    return room[tuple(slice(0, n) for n in array.shape)]
