"""A finished run is complete or absent: through exceptions, a full disk, kills, and concurrent runs."""

import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from illumgrid.errors import BadInput
from illumgrid.io import store
from test_store import assert_same, example, left_beside


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A finished run."""
    store.write(tmp_path / "out", example(), None, False)
    return tmp_path / "out"


@pytest.mark.parametrize(
    "trouble", [KeyboardInterrupt, RuntimeError, MemoryError, OSError(28, "No space left on device")]
)
@pytest.mark.parametrize("where", ["_write_exr", "_checksum", "_digest", "_refuse_foreign"])
def test_trouble_leaves_nothing_behind(tmp_path, monkeypatch, where, trouble):
    """Also between the two renames, where the older run is restored."""
    out = tmp_path / "out"
    for old in (None, example()):
        if old:
            store.write(out, old, None, False)
        with monkeypatch.context() as patch:
            real = getattr(store, where)

            def fail(*args, real=real):
                if where == "_refuse_foreign" and args[0].name != "old":
                    return real(*args)
                raise trouble

            patch.setattr(store, where, fail)
            if old or where != "_refuse_foreign":  # without an older run nothing is between two renames
                with pytest.raises(trouble if trouble is KeyboardInterrupt else BadInput):
                    store.write(out, example(seed=1), b"picture", True)
        assert not left_beside(out)
        if old:
            assert_same(store.read(out), old)
        else:
            assert not out.exists()


def write_with_little_room(folder: str, room: int) -> None:
    """Run in its own process: files may not grow beyond `room` bytes."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
    try:
        store.write(folder, example(), None, False)
    except BadInput as reason:
        print(reason)  # noqa: T201
    else:
        print("written")  # noqa: T201


def in_another_process(call: str) -> str:
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import test_store_whole as t; t.{call}"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True).stdout


def test_a_full_disk_is_noticed(out):
    """Also if only the last byte is missing, which the EXR library does not report."""
    size = (out / store.EXR).stat().st_size
    for room in (0, size // 2, size - 1):
        said = in_another_process(f"write_with_little_room({str(out.with_name('full'))!r}, {room})")
        assert "full could not be written; the disk may be full" in said
        assert not left_beside(out)
    assert in_another_process(f"write_with_little_room({str(out.with_name('full'))!r}, {size})") == "written\n"


def write_until_killed(folder: str, rounds: int) -> None:
    """Run in its own process, which has not used the EXR library's threads: forked writers, killed at random moments.

    Every other round waits for the first result, so that the second or a later one is interrupted.
    """
    pick = random.Random(0)
    for number in range(rounds):
        child = os.fork()
        if child == 0:
            for turn in range(10_000):
                store.write(Path(folder) / str(number), example(seed=turn % 2), b"picture", turn > 0)
            os._exit(0)
        while number % 2 and not (Path(folder) / str(number)).exists():
            time.sleep(0.001)
        time.sleep(pick.uniform(0, 0.04))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_a_kill_leaves_a_whole_run_or_none(tmp_path):
    in_another_process(f"write_until_killed({str(tmp_path)!r}, 24)")
    whole = [p for p in tmp_path.iterdir() if not p.name.startswith(".")]
    caught = [p for p in tmp_path.iterdir() if p.name.startswith(".")]  # what was under way
    assert len(whole) >= 10 and caught
    for folder in whole:
        back = store.read(folder)
        assert_same(back, example(seed=back.recipe["seed"] - 2**70))


def test_what_arrives_at_the_last_moment_stays(out, monkeypatch):
    """Between the last look and the rename."""
    look = store.claim

    def look_too_early(folder, overwrite) -> None:
        look(folder, overwrite)
        if left_beside(out):  # the second look
            (out / "late.txt").write_text("late")

    monkeypatch.setattr(store, "claim", look_too_early)
    with pytest.raises(BadInput, match=r"late\.txt"):
        store.write(out, example(seed=1), None, True)
    assert (out / "late.txt").read_text("utf-8") == "late" and not left_beside(out)
    (out / "late.txt").unlink()
    assert_same(store.read(out), example())


def test_of_two_writers_one_wins(tmp_path):
    for turn in range(10):
        folder, lost, start = tmp_path / str(turn), [], threading.Barrier(2)

        def go(seed: int, folder=folder, lost=lost, start=start) -> None:
            start.wait()
            try:
                store.write(folder, example(seed=seed), None, False)
            except BadInput:
                lost.append(seed)

        threads = [threading.Thread(target=go, args=(seed,)) for seed in (0, 1)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(lost) == 1
        assert_same(store.read(folder), example(seed=1 - lost[0]))


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_run_that_arrives_between_look_and_rename_wins(tmp_path, monkeypatch, overwrite):
    out, move = tmp_path / "out", store._move

    def late(fresh, place, old, replace) -> None:
        monkeypatch.setattr(store, "_move", move)
        store.write(place, example(seed=1), None, False)
        move(fresh, place, old, replace)

    monkeypatch.setattr(store, "_move", late)
    if overwrite:
        store.write(out, example(), None, True)
    else:
        with pytest.raises(BadInput, match="taken by another run meanwhile"):
            store.write(out, example(), None, False)
    assert_same(store.read(out), example(seed=0 if overwrite else 1))
    assert not left_beside(out)
