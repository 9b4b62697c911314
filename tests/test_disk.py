"""What "wrote" promises: the order of calls that survives a power cut, stops at any moment, folders of dead writers."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from illumgrid.errors import BadInput
from illumgrid.io import disk, store
from test_store import assert_same, example, left_beside


@pytest.fixture
def calls(monkeypatch):
    """fsync and rename in the order of the calls, by the names of the files."""
    made, opened = [], {}
    real = os.open, os.fsync, os.rename, os.replace

    def opening(path, *rest, **more):
        handle = real[0](path, *rest, **more)
        opened[handle] = os.path.basename(os.fspath(path))
        return handle

    def syncing(handle):
        made.append(f"fsync {opened[handle]}")
        real[1](handle)

    def moving(move):
        def moved(old, new, **more):
            move(old, new, **more)
            made.append(f"{os.path.basename(old)} -> {os.path.basename(new)}")

        return moved

    monkeypatch.setattr(os, "open", opening)
    monkeypatch.setattr(os, "fsync", syncing)
    monkeypatch.setattr(os, "rename", moving(real[2]))
    monkeypatch.setattr(os, "replace", moving(real[3]))
    return made


def test_a_run_is_on_the_disk_before_its_name_is(tmp_path, calls):
    above = tmp_path.name
    inside = ["fsync illumination.exr", "fsync preview.png", "fsync run.json", "fsync new"]
    store.write(tmp_path / "out", example(), b"picture", False)
    assert calls == [*inside, "new -> out", f"fsync {above}"]
    calls.clear()
    store.write(tmp_path / "out", example(seed=1), b"picture", True)
    assert calls == [*inside, "out -> old", "new -> out", f"fsync {above}"]
    calls.clear()
    store.amend(tmp_path / "out", {"reached": 0.1})
    assert calls == ["fsync new.json", "new.json -> run.json", "fsync out"]


def test_files_and_folders_of_exports_are_on_the_disk_before_their_names_are(tmp_path, calls):
    disk.write_file(tmp_path / "deep" / "page.html", b"page")
    assert calls == [f"fsync {tmp_path.name}", "fsync new.html", "new.html -> page.html", "fsync deep"]
    calls.clear()
    disk.write_folder(tmp_path / "film", iter([("1.png", b"1"), ("2.png", b"2")]))
    assert calls == ["fsync 1.png", "fsync 2.png", "fsync new", "new -> film", f"fsync {tmp_path.name}"]


def test_a_disk_that_cannot_take_the_bytes_is_noticed(tmp_path, monkeypatch):
    disk.write_file(tmp_path / "page.html", b"old")

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(BadInput, match=r"page\.html could not be written \(No space left on device\)"):
        disk.write_file(tmp_path / "page.html", b"new")
    assert (tmp_path / "page.html").read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("stop", [s for s in disk.STOPS if s != signal.SIGINT])
@pytest.mark.parametrize("overwrite", [False, True])
def test_a_stop_between_two_renames_waits_and_the_new_run_stands(tmp_path, monkeypatch, overwrite, stop):
    out = tmp_path / "out"
    if overwrite:
        store.write(out, example(), None, False)
    look, stopped = store._refuse_foreign, []

    def stopping(place, folder):
        look(place, folder)
        if place.name == "old":
            signal.raise_signal(stop)
            assert not stopped and not out.exists()

    monkeypatch.setattr(store, "_refuse_foreign", stopping)
    before = signal.signal(stop, lambda number, frame: stopped.append(number))
    try:
        store.write(out, example(seed=1), None, overwrite)
    finally:
        signal.signal(stop, before)
    assert stopped == [stop] * overwrite and disk.written[-1] == out
    assert_same(store.read(out), example(seed=1))
    assert not left_beside(out)


def killed(code: str, folder: Path) -> None:
    """Run `code` in a process that kills itself by SIGKILL."""
    head = f"import os, sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\nfrom illumgrid.io import disk, store\n"
    tail = "\nfrom test_store import example\nstore.write('out', example(seed=1), None, True)"
    done = subprocess.run([sys.executable, "-c", head + code + tail], cwd=folder, timeout=60)
    assert done.returncode == -signal.SIGKILL


needs_locks = pytest.mark.skipif(sys.platform == "win32", reason="Windows cannot lock a folder")


@needs_locks
def test_what_a_killed_writer_left_is_removed_by_the_next(tmp_path):
    store.write(tmp_path / "out", example(), None, False)
    killed("store._checksum = lambda *a: os.kill(os.getpid(), 9)", tmp_path)
    (left,) = left_beside(tmp_path / "out")
    with disk.beside(tmp_path / "out") as living:
        assert not (tmp_path / left).exists()
        store.write(tmp_path / "out", example(seed=2), None, True)
        assert living.exists()  # a folder whose process lives stays
    assert not left_beside(tmp_path / "out")


@needs_locks
@pytest.mark.parametrize("again", ["read", "claim"])
def test_a_run_that_a_killed_writer_had_moved_aside_goes_back(tmp_path, again):
    out = tmp_path / "out"
    store.write(out, example(), None, False)
    killed("store._refuse_foreign = lambda place, _: place.name == 'old' and os.kill(os.getpid(), 9)", tmp_path)
    assert not out.exists()
    if again == "claim":
        store.claim(out, True)
    assert_same(store.read(out), example())
    assert not left_beside(out)


@needs_locks
def test_a_hidden_folder_that_is_not_ours_stays(tmp_path):
    for name, file in ((".out-abcdefgh", "thesis.tex"), (".out-x-abcdefgh", "new"), (".out-abc", "new")):
        (tmp_path / name).mkdir()
        (tmp_path / name / file).write_text("years of work")
    before = sorted(tmp_path.rglob("*"))
    store.claim(tmp_path / "out", False)
    assert sorted(tmp_path.rglob("*")) == before
