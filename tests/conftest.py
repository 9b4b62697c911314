"""The command line as a function, shared by all its tests; kernels that one worker compiles for all."""

import contextlib
import functools
import hashlib
import os
import signal
import sys
import time

import numpy as np
import pytest
import typer

import illumgrid as ig
from illumgrid import chain, cli
from illumgrid import show as preview
from illumgrid.compiled import _Cache
from shapes import ball

try:
    import fcntl
except ImportError:  # on Windows every worker compiles
    fcntl = None

# Some 200 processes start below, each of which would translate the package anew; Numba writes into the same folders.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Typer makes all commands anew for each call, which takes longer than most of what 2,000 calls below ask for.
typer.main.get_command = functools.cache(typer.main.get_command)

# Only a power cut could tell whether what is written is on the disk: test_disk watches the calls.
os.fsync = lambda handle: None

# A judgement takes longer than the runs of most tests: those that are about it ask for it, or have the mark `judged`.
chain.run.__kwdefaults__["judge"] = False

# A shell ignores Ctrl-C for its background jobs, nohup SIGHUP, and a process takes over what is ignored.
for stop, action in (("SIGINT", signal.default_int_handler), ("SIGHUP", signal.SIG_DFL)):
    if hasattr(signal, stop) and signal.getsignal(getattr(signal, stop)) is signal.SIG_IGN:
        signal.signal(getattr(signal, stop), action)


@pytest.fixture
def call(capsys, tmp_path, monkeypatch, request):
    """Run a command in its own folder, with small pictures; returns its output. Errors are measured for `judged`."""
    if not request.node.get_closest_marker("judged"):
        monkeypatch.setattr(chain, "judged", lambda light, *about: light)
    monkeypatch.setattr(preview.render, "__kwdefaults__", {**preview.render.__kwdefaults__, "width": 64, "height": 48})
    monkeypatch.chdir(tmp_path)
    np.save(tmp_path / "v.npy", ball(10).values)

    def call(*args, code=0):
        result = cli.guarded(lambda: cli.app([str(a) for a in args], standalone_mode=False))
        said = "".join(capsys.readouterr())
        assert result == code, said
        assert "Traceback" not in said
        return said

    return call


@pytest.fixture
def refuse(call, tmp_path):
    """A command is refused in one sentence that contains these words, and writes nothing."""

    def refuse(*args, words):
        before = sorted(tmp_path.rglob("*"))
        said = call(*args, code=2).strip()
        assert said.count("\n") == 0 and said.startswith("illumgrid: ") and ". " not in said, said
        for word in words:
            assert word in said, said
        assert sorted(tmp_path.rglob("*")) == before

    return refuse


@pytest.fixture(scope="session", autouse=True)
def compiled_once(request, tmp_path_factory):
    """Of several workers that need a kernel one compiles it, and the others take it from the disk."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")
    if not worker or fcntl is None:
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        share_compilation(patch, tmp_path_factory.getbasetemp().parent)
        if any("test_meshes" in item.nodeid for item in request.session.items):  # the two largest kernels, side by side
            surface = ("levelset", "mesh")[int(worker.removeprefix("gw")) % 2]
            scene = ig.Scene.sky(ball(6), range=(0.4, 0.6))
            ask = ig.Queries.at(scene, np.zeros((1, 3)))
            ig.backend("numba", surface=surface).solve(scene, ask, paths=range(1), bounces=0, seed=0)
        yield


def share_compilation(patch, folder):
    """Hold a lock while a kernel is compiled. Its file is in `folder`; after ten minutes nobody waits any more."""
    load, save, held = _Cache.load_overload, _Cache.save_overload, {}

    def load_overload(self, signature, context):
        found = load(self, signature, context)
        name = hashlib.sha256(f"{self._py_func.__qualname__}{signature}".encode()).hexdigest()[:20]
        if found is not None or name in held:
            return found
        lock, waited, until = os.open(folder / name, os.O_CREAT | os.O_RDWR), False, time.monotonic() + 600
        while time.monotonic() < until:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError:
                waited = True
                time.sleep(0.05)
        held[name] = lock
        return load(self, signature, context) if waited else None

    def save_overload(self, signature, compiled):
        try:
            save(self, signature, compiled)
        finally:
            name = hashlib.sha256(f"{self._py_func.__qualname__}{signature}".encode()).hexdigest()[:20]
            if name in held:
                with contextlib.suppress(OSError):
                    os.close(held.pop(name))

    patch.setattr(_Cache, "load_overload", load_overload)
    patch.setattr(_Cache, "save_overload", save_overload)
