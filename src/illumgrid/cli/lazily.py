"""Light that is computed while somebody looks: a page with coarse light at once, refined first where it is in view."""

import threading
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from illumgrid.cli.long import kept
from illumgrid.cli.outcome import finished
from illumgrid.cli.scenes import scene_input
from illumgrid.cli.stops import answered
from illumgrid.cli.terminal import reported_warnings, say
from illumgrid.errors import BadInput

if TYPE_CHECKING:
    from illumgrid.field.scene import Scene
    from illumgrid.io.partial import Partial
    from illumgrid.light import Illumination
    from illumgrid.live import Live


def look(
    scene: "Scene", stages: dict[str, Any], keep: "Partial", numbers: Mapping[str, Any], about: Mapping[str, Any],
    folder: Path, sentences: list[str], opened: bool = True, up: str | None = None,
) -> None:  # fmt: skip
    """Serve a page and light the scene until Ctrl-C; the same command then resumes.

    Parameters
    ----------
    scene, stages, keep, numbers
        Of the run: its stages by kind, what keeps it, and grid, paths, bounces, isovalues and seed.
    about : mapping
        What the recipe says of the input.
    folder : path
        Of the finished run.
    sentences : list of str
        Warnings so far.
    opened : bool
        Whether a browser is opened.
    up : str, optional
        See `illumgrid.show.viewer.page`.
    """
    from illumgrid.chain import run
    from illumgrid.field.lattice import specs_over
    from illumgrid.field.scene import level_table
    from illumgrid.live import Live
    from illumgrid.show.viewer import page
    from illumgrid.show.viewer.packing import opening
    from illumgrid.show.viewer.server import serve

    _check(stages, scene)
    grid = keep.chosen["grid"] if keep.chosen else numbers["grid"]
    live = Live(keep, scene, specs_over(scene, grid), level_table(scene, numbers["isovalues"] or 32), dict(about))

    def finish(light: "Illumination") -> "Illumination":
        return finished(replace(light, recipe={**light.recipe, **about}), folder, keep, stages, sentences)

    work = _Work(live, partial(run, scene, **stages, **numbers, judge=False, keep=live), finish)
    with closing(keep), work:
        view = opening(scene, up)  # meanwhile
        if not work.first():
            return
        light, coming = live.light()
        with serve(page(light, up, coming=replace(coming, opening=view)).encode(), live.news) as server:
            work.ready = lambda light: setattr(server, "page", page(light, up).encode())
            work.failed = server.shutdown
            work.served.set()
            say(f"serving {server.address} to this machine only while it computes light; stop with Ctrl-C")
            if opened:
                browse(server.address)
            with suppress(KeyboardInterrupt):
                server.serve_forever()


def look_at(source: str, opened: bool, up: str | None) -> Path | None:
    """Light an input of `run` while somebody looks; return its folder if nothing is left to do."""
    from illumgrid import registry
    from illumgrid.io import store

    asked = scene_input(source, None, None, None, False, None, {})
    folder, preset = Path(f"{asked.name}-light"), asked.preset
    numbers = {key: getattr(preset, key, None) for key in ("grid", "paths", "isovalues")} | {"bounces": None, "seed": 0}
    stages = {
        kind: registry.make(kind, name, {})
        for kind, name in (("sampler", "direct"), ("backend", "auto"), ("interpolator", "nearest"))
    }
    if not store.is_run(folder):
        store.claim(folder, False)
    with reported_warnings() as sentences:
        scene = asked.make(0.0)
        keep = kept(folder, scene, stages, True, False, False, error=None, seconds=None, **numbers)
        if keep is not None:
            about = {"input": source, "reading": {}, "smooth": 0.0}
            look(scene, stages, keep, numbers, about, folder, sentences, opened, up)
    return folder if keep is None else None


def go_on(place: Path, opened: bool, up: str | None) -> bool:
    """Resume the partial run in `place` if it is one that is lit while somebody looks; return whether it is."""
    from illumgrid import registry
    from illumgrid.io import partial as kept_runs
    from illumgrid.io import store
    from illumgrid.io.identity import machine

    attributes = kept_runs.opened(place, "r").attrs
    about, lazy = dict(attributes["identity"]), attributes["chosen"].get("lazy")
    if lazy is None:
        return False
    scene = store.read(place / kept_runs.SCENE).scene
    stages = {
        kind: registry.make(kind, about[kind]["name"], {k: v for k, v in about[kind].items() if k != "name"})
        for kind in registry.KINDS
    }
    folder = place.with_name(place.name.removesuffix(kept_runs.SUFFIX))
    keep = kept_runs.Partial(folder, about | machine(), attributes["command"])
    with reported_warnings() as sentences:
        keep.resume(None, False, False)
        numbers = {key: about[key] for key in ("grid", "paths", "bounces", "isovalues", "seed")}
        look(scene, stages, keep, numbers, lazy, folder, sentences, opened, up)
    return True


def _check(stages: Mapping[str, Any], scene: "Scene") -> None:
    """Refuse stages and lights that cannot be computed node by node."""
    from illumgrid.field.lights import Harmonics

    if (stages["sampler"].name, stages["interpolator"].name) != ("direct", "nearest"):
        names = f"{stages['sampler'].name} and {stages['interpolator'].name}"
        raise BadInput(f"--lazy came with {names}; expected direct and nearest, whose nodes are lit one by one")
    if any(isinstance(light, Harmonics) for light in scene.lights):
        raise BadInput("--lazy came with --lights sh; expected one of them")


def browse(address: str) -> None:
    """Open a browser in a thread: some return only when their window closes, and the page must be served."""
    import webbrowser

    threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()


class _Work:
    """The run, in a thread of its own."""

    def __init__(
        self, live: "Live", run: "Callable[..., Illumination]", finish: "Callable[[Illumination], Illumination]"
    ) -> None:
        self.live, self.run, self.finish = live, run, finish
        self.ready: Callable[[Illumination], None] = lambda light: None
        self.failed: Callable[[], None] = lambda: None
        self.problem: BaseException | None = None
        self.served = threading.Event()
        self.thread = threading.Thread(target=self._light)

    def __enter__(self) -> "_Work":
        self.thread.start()
        return self

    def __exit__(self, *stopped: object) -> None:
        """Wait for the current piece, and keep the finished light."""
        answered()
        self.live.stop.set()
        while self.thread.is_alive():
            with suppress(KeyboardInterrupt):
                self.thread.join(0.2)
        if self.problem:
            raise self.problem
        if not self.live.done:
            share, place = self.live.share, self.live.keeper.place
            kept = f"{share:.0%} of the light is kept in {place}; the same command goes on from there"
            say(kept if place.is_dir() else "stopped before there was light everywhere; nothing is kept")

    def first(self) -> bool:
        """Wait until every fourth node is lit; return whether it is."""
        with suppress(KeyboardInterrupt):
            while self.thread.is_alive() and not self.live.coarse.wait(0.05):
                pass
        return self.live.coarse.is_set() and not self.problem

    def _light(self) -> None:
        from illumgrid.live import Stopped

        try:
            light = self.finish(self.run(progress=self._progress))
            self.ready(light)
            self.live.done = True
        except Stopped:
            pass
        except BaseException as problem:
            self.problem = problem
            self.failed()

    def _progress(self, what: str, done: int, total: int) -> None:
        from illumgrid.live import Stopped

        # Once there is light everywhere, all processors work on the page.
        while self.live.coarse.is_set() and not self.live.stop.is_set() and not self.served.wait(0.05):
            pass
        if self.live.stop.is_set() and not self.live.ended:
            raise Stopped
