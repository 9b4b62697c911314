"""Light in a notebook while it is computed: coarse at once, then refined where somebody looks."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qs

import numpy as np
from numpy.typing import NDArray

from illumgrid.chain import run
from illumgrid.field.lattice import specs_over
from illumgrid.field.scene import Scene, level_table
from illumgrid.light import Illumination
from illumgrid.live import Live, Stopped
from illumgrid.show.viewer.widget import follow, widget
from illumgrid.transport.samples import Queries, Samples
from illumgrid.transport.walk import Answer


@dataclass
class _Nothing:
    """A keeper for runs that are not kept."""

    at_once: bool = True
    chosen: dict[str, Any] | None = None

    def choose(self, chosen: dict[str, Any]) -> None:
        """See `illumgrid.transport.walk.RunKeeper`."""

    def begin(self, targets: Sequence[Queries], order: NDArray[np.int64]) -> None:
        """See `illumgrid.transport.walk.Keeper`."""

    def known(self, paths: range) -> None:
        """See `illumgrid.transport.walk.Keeper`."""

    def keep(self, rows: NDArray[np.int64], answer: Answer) -> None:
        """See `illumgrid.transport.walk.Keeper`."""

    def settle(self) -> None:
        """Nothing is waiting to be kept."""

    def flush(self) -> None:
        """See `illumgrid.transport.walk.Keeper`."""

    def end(self, answers: Sequence[Samples]) -> None:
        """See `illumgrid.transport.walk.Keeper`."""


class Lighting:
    """A run in a thread, and the widget that shows it.

    Parameters
    ----------
    scene : Scene
    grid, paths, isovalues, seed
        As of `illumgrid.run`.
    look : dict
        Further arguments of the widget.

    Attributes
    ----------
    view : anywidget.AnyWidget
    light : Illumination or None
        All of it, once it is there.
    """

    def __init__(
        self, scene: Scene, grid: int | None, paths: int | None, isovalues: int | None, seed: int, look: dict[str, Any]
    ) -> None:
        self.light: Illumination | None = None
        self._live = Live(_Nothing(), scene, specs_over(scene, grid), level_table(scene, isovalues or 32), {})
        self._problem: BaseException | None = None
        self._made, self._up = threading.Event(), look["up"]
        numbers = {"grid": grid, "paths": paths, "isovalues": isovalues, "seed": seed}
        self._thread = threading.Thread(target=self._run, args=(scene, numbers), daemon=True)
        self._thread.start()
        try:
            while self._thread.is_alive() and not self._live.coarse.wait(0.05):
                pass
            if self._problem:
                raise self._problem
            self.view = widget(*self._live.light(), news=self._news, **look)
        except BaseException:  # Ctrl-C, too
            self.stop()
            raise
        self._made.set()

    def _run(self, scene: Scene, numbers: dict[str, Any]) -> None:
        try:
            light = run(scene, **numbers, judge=False, progress=self._wait, keep=self._live)
            self._made.wait()
            follow(self.view, light, self._up)
            self.light, self._live.done = light, True
        except Stopped:
            pass
        except BaseException as problem:
            self._problem = problem

    def _wait(self, what: str, done: int, total: int) -> None:
        """Wait until the view is made, by all processors, before more nodes are lit."""
        while self._live.coarse.is_set() and not self._live.stop.is_set() and not self._made.wait(0.05):
            pass
        if self._live.stop.is_set() and not self._live.ended:
            raise Stopped

    def _news(self, question: str) -> bytes:
        """The answer to a view's question."""
        if self._problem:
            raise self._problem
        return self._live.news(parse_qs(question))

    def wait(self) -> Illumination:
        """Wait for all light, and return it; views go on showing what is there.

        Raises
        ------
        BadInput
            If the run failed, as `illumgrid.run` does.
        """
        self._thread.join()
        if self._problem or self.light is None:
            raise self._problem or Stopped("this was stopped before all light was there")
        return self.light

    def stop(self) -> None:
        """Stop the run; the finished light stays visible."""
        self._live.stop.set()
        self._made.set()
        self._thread.join()

    def _repr_mimebundle_(self, **options: Any) -> Any:
        return self.view._repr_mimebundle_(**options)


def show(
    scene: Scene, *, grid: int | None = None, paths: int | None = None, isovalues: int | None = None, seed: int = 0,
    isovalue: float | None = None, height: int = 520, up: str | None = None,
) -> Lighting:  # fmt: skip
    """Light a scene while one looks at it in a notebook.

    It returns as soon as there is coarse light everywhere; the rest is computed in a thread, what the view shows first.

    Parameters
    ----------
    scene : Scene
    grid : int, optional
        Nodes along the longest axis; by default as many as voxels, at most 150.
    paths, isovalues, seed
        As of `illumgrid.run`, whose light is the same in the end, bit for bit, for the same `grid`.
    isovalue, height, up
        As of `illumgrid.Illumination.show`.

    Returns
    -------
    Lighting
        Shown by a notebook. `wait` returns the `Illumination` when all of it is there; `stop` ends the run; `view` is
        the widget.

    Raises
    ------
    BadInput
        On options out of range, and if the package anywidget is missing: ``illumgrid[notebook]`` brings it.
    """
    return Lighting(scene, grid, paths, isovalues, seed, {"isovalue": isovalue, "height": height, "up": up})
