"""Stops: within deep work, by every signal, at any moment; and progress within one batch."""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from illumgrid import cli
from illumgrid.backends.mesh import bvh
from illumgrid.backends.numba_ import Numba
from illumgrid.bake.accumulator import Bake
from illumgrid.bake.walls import wall_queries
from illumgrid.field import cubes
from illumgrid.field.levelset import isosurface
from illumgrid.field.scene import Scene, level_table
from illumgrid.io import disk
from illumgrid.transport.tracer import prepare
from shapes import ball
from test_cli_process import COMMAND, start


@pytest.fixture(scope="module")
def box():
    """A closed room of white walls, and queries on them."""
    scene = Scene.box(ball(10), albedo=(0.8, 0.8, 0.8), range=(0.3, 0.9))
    return scene, wall_queries(scene, level_table(scene, 2))[0]


@pytest.mark.parametrize("threads", [1, 2])
def test_ctrl_c_ends_a_chunk_and_does_not_wait_for_its_paths(box, threads, monkeypatch):
    """The queries are a single chunk of 2^20 paths."""
    scene, queries = box
    tracer = prepare(Numba(threads=threads), scene)
    tracer.solve(queries[:1], paths=range(1), bounces=1, seed=0)
    from illumgrid.backends import kernels

    stops, real = [], kernels.solve_queries

    def solving(*arguments):
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
        real(*arguments)
        stops.append((arguments[-1][0], arguments[-2].copy()))

    solving.signatures = getattr(real, "signatures", None)
    monkeypatch.setattr(kernels, "solve_queries", solving)
    with pytest.raises(KeyboardInterrupt):
        tracer.solve(queries[:16], paths=range(1 << 16), bounces=100_000, seed=0)
    assert stops and all(stop == 1 and not paths.all() for stop, paths in stops)


def test_ctrl_c_does_not_wait_for_compilation(box, monkeypatch):
    scene, queries = box
    from illumgrid.backends import kernels

    begun, over = threading.Event(), threading.Event()

    def compiling(*_):
        begun.set()
        over.wait()

    compiling.signatures = []
    monkeypatch.setattr(kernels, "solve_queries", compiling)
    threading.Thread(target=lambda: begun.wait() and os.kill(os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        prepare(Numba(threads=1), scene).solve(queries[:4], paths=range(1), bounces=1, seed=0)
    over.set()


def test_ctrl_c_ends_the_building_of_a_tree(monkeypatch):
    faces = np.arange(3 * 40).reshape(-1, 3)
    real, ended = bvh.grow, []

    def growing(bounds, order, halt):
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
        while not halt[0]:
            time.sleep(0.001)
        ended.append([len(part) for part in real(bounds, order, halt)])  # no node is made any more
        return real(bounds, order, np.zeros(1, np.uint8))

    monkeypatch.setattr(bvh, "grow", growing)
    with pytest.raises(KeyboardInterrupt):
        bvh.build(np.random.default_rng(0).random((120, 3)), faces)
    assert ended == [[1, 1, 1]]


def test_ctrl_c_ends_marching_cubes_after_a_slab(monkeypatch):
    real, slabs = cubes._cubes, []

    def marching(values, *more):
        slabs.append(values.shape)
        os.kill(os.getpid(), signal.SIGINT)
        return real(values, *more)

    monkeypatch.setattr(cubes, "_cubes", marching)
    monkeypatch.setattr(cubes, "AT_ONCE", 200)
    with pytest.raises(KeyboardInterrupt):
        isosurface(ball(12), 0.5)
    assert len(slabs) == 1


def test_tracers_of_a_process_share_their_threads(box):
    scene, _ = box
    one, other, fewer = (prepare(Numba(threads=n), scene).threads for n in (2, 2, 1))
    assert one is other and one is not fewer


def test_a_batch_shows_progress_within_it(box):
    scene, queries = box
    shown = []
    tracer = prepare(Numba(threads=1), scene)
    bake = Bake.of([queries], 1, 0).walk(tracer, range(2), progress=lambda *about: shown.append(about))
    done = [about[1] for about in shown]
    assert done == sorted(done) and done[0] == 0 and done[-1] == len(bake.samples)
    assert len(set(done)) > 8 and {about[2] for about in shown} == {len(queries)}


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals")
@pytest.mark.parametrize("stop", ["SIGTERM", "SIGHUP"])
def test_other_signals_are_like_ctrl_c(tmp_path, stop):
    np.save(tmp_path / "v.npy", ball(12).values)
    args = ("run", "v.npy", "--range", "0.3", "0.9", "--paths", "50000", "-o", "out")
    with start(*args, cwd=tmp_path, said=subprocess.PIPE) as process:
        try:
            while "voxels" not in process.stderr.readline():
                assert process.poll() is None
            time.sleep(0.5)
            process.send_signal(getattr(signal, stop))
            _, said = process.communicate(timeout=30)
        finally:
            process.kill()
    assert process.returncode == 130 and said.splitlines()[-1] == "illumgrid: stopped; nothing was written"
    assert "Traceback" not in said and [p.name for p in tmp_path.iterdir()] == ["v.npy"]


def native(folder, stop, work):
    """A command that does some native work beside its result is stopped; returns its exit code and what it said."""
    (folder / "command.py").write_text(
        "import hashlib, pathlib, sys\n"
        "from illumgrid import cli\n"
        "from illumgrid.io import disk\n"
        "def command(**_):\n"
        "    with disk.beside(pathlib.Path('a.html').absolute()) as work:\n"
        "        (work / 'new').write_text('half')\n"
        f"        {work}\n"
        "cli.app = command\n"
        "cli.main()\n"
    )
    with subprocess.Popen(
        [sys.executable, "command.py"], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout.readline() == "begun\n"
            process.send_signal(stop)
            _, said = process.communicate(timeout=60)
        finally:
            process.kill()
    return process.returncode, said, sorted(p.name for p in folder.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="Windows waits for no pipe")
@pytest.mark.parametrize("stop", disk.STOPS)
def test_a_library_that_does_not_look_for_signals_is_not_waited_for(tmp_path, stop):
    """A filter, a search tree, a sort: one call without the interpreter's lock. This one takes ten minutes."""
    work = "print('begun', flush=True), hashlib.pbkdf2_hmac('sha256', b'', b'', 1 << 30)"
    code, said, left = native(tmp_path, stop, work)
    assert (code, said, left) == (130, "illumgrid: stopped; nothing was written\n", ["command.py"])


@pytest.mark.skipif(sys.platform == "win32", reason="Windows waits for no pipe")
def test_a_server_that_a_library_or_a_busy_machine_holds_up_ends_normally(tmp_path):
    work = "from illumgrid.cli.stops import ends_normally\n        with ends_normally(): "
    work += "print('begun', flush=True), hashlib.pbkdf2_hmac('sha256', b'', b'', 1 << 30)"
    assert native(tmp_path, signal.SIGINT, work) == (0, "", ["command.py"])


@pytest.mark.skipif(sys.platform == "win32", reason="Windows waits for no pipe")
def test_a_stop_within_a_callback_is_not_lost(tmp_path):
    """Libraries in C drop what a callback raises: LLVM calls one for each function that is compiled."""
    call = "lambda: (print('begun', flush=True), time.sleep(1000))"
    work = f"import ctypes, time; ctypes.CFUNCTYPE(None)({call})(); time.sleep(1000)"
    code, said, left = native(tmp_path, signal.SIGTERM, work)
    assert code == 130 and said.endswith("illumgrid: stopped; nothing was written\n") and left == ["command.py"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows waits for no pipe")
def test_between_two_renames_nobody_ends_a_process(tmp_path):
    """The disk takes longer than the patience with a library."""
    code, said, left = native(
        tmp_path, signal.SIGINT, "disk.put(work / 'new', pathlib.Path('a.html').absolute(), lambda *both: "
        "(print('begun', flush=True), hashlib.pbkdf2_hmac('sha256', b'', b'', 3 << 20), both[0].rename(both[1])))",
    )  # fmt: skip
    assert code == 130 and said.endswith("a.html is written and complete\n") and left == ["a.html", "command.py"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows waits for no pipe")
def test_a_stop_of_which_a_library_makes_another_exception_is_one(tmp_path):
    work = "import time; print('begun', flush=True)"
    work += "\n        try: time.sleep(999)\n        except BaseException: raise ImportError('half a module') from None"
    code, said, left = native(tmp_path, signal.SIGHUP, work)
    assert (code, said, left) == (130, "illumgrid: stopped; nothing was written\n", ["command.py"])


WAYS = {
    "alone": "{}",
    "in an exec, after which Python ends by SIGINT": "exec({!r})",
    "as another exception": "try: exec({!r})\nexcept BaseException: raise ImportError('half a module') from None",
}


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
@pytest.mark.parametrize("stop", disk.STOPS)
def test_a_stop_during_the_imports_has_no_traceback(tmp_path, stop, way):
    (tmp_path / "typer.py").write_text(way.format(f"import os, time; os.kill(os.getpid(), {int(stop)}); time.sleep(9)"))
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [*COMMAND, "--version"], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}
    )
    assert (done.returncode, done.stderr) == (130, "illumgrid: stopped; nothing was written\n")


def test_a_stop_before_the_command_begins_has_no_traceback(tmp_path):
    (tmp_path / "early.py").write_text(
        "from illumgrid import __main__, cli\n"
        "def stop(_):\n    raise KeyboardInterrupt\n"
        "cli.listen = stop\n__main__.main()\n"
    )
    done = subprocess.run([sys.executable, "early.py"], capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (130, "illumgrid: stopped; nothing was written\n")


def test_a_stop_after_the_rename_says_what_stands(tmp_path, capsys):
    def stopped_late():
        disk.write_file(tmp_path / "page.html", b"page")
        raise KeyboardInterrupt

    assert cli.guarded(stopped_late) == 130
    assert capsys.readouterr().err == f"illumgrid: stopped; {tmp_path / 'page.html'} is written and complete\n"

    def refused():
        raise KeyboardInterrupt

    assert cli.guarded(refused) == 130 and "nothing was written" in capsys.readouterr().err
