"""Full disks and places that cannot be written: a sentence, nothing torn, and the light is not lost."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import illumgrid as ig
from illumgrid.io import exports, store

resource = pytest.importorskip("resource", reason="Windows cannot limit the size of files")

RUN = ("run", "v.npy", "--range", "0.3", "0.9", "--grid", "6", "--paths", "2", "--no-preview")


def test_a_disk_that_is_full_at_any_page_ends_every_writing_in_a_sentence(tmp_path):
    """Also if only the last byte is missing, which the EXR library does not report; the older result stays whole."""
    endings = [*exports.LATTICES, *exports.SURFACES, "", ".html"]
    write = f"""
import resource, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from illumgrid.errors import BadInput
from illumgrid.io import disk, exports
from illumgrid.show.viewer import page
from shapes import lit, sky

def write():
    if file.suffix == ".html":
        disk.write_file(file, page(light).encode())
    elif not file.suffix:
        light.save(file, preview=False, overwrite=True)
    else:
        exports.write(light, file)

def held():
    return [part.read_bytes() for part in ([file] if file.is_file() else sorted(file.iterdir()))]

light = lit(sky())
for number, ending in enumerate({endings}):
    file = Path({str(tmp_path)!r}, str(number), "a" + ending)
    file.parent.mkdir()
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    write()
    before, beside = held(), list(file.parent.iterdir())
    size = max(map(len, before))
    rooms = sorted({{*range(0, size, max(4096, size // 16 // 4096 * 4096)), size - 1}})
    print("rooms:", len(rooms), ending)
    for room in rooms:
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
        try:
            write()
        except BadInput as reason:
            print(reason)
        assert held() == before and list(file.parent.iterdir()) == beside
"""
    done = subprocess.run([sys.executable, "-c", write], capture_output=True, text=True, timeout=120, check=True)
    parts = done.stdout.split("rooms: ")[1:]
    assert len(parts) == len(endings), done.stdout + done.stderr
    for part in parts:
        rooms, *said = part.splitlines()
        assert len(said) == int(rooms.split()[0]) >= 2 and all("could not be written" in one for one in said), part


def test_light_that_cannot_go_where_it_was_to_is_kept_elsewhere(call, tmp_path, monkeypatch):
    call(*RUN, "-o", "whole")
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    write = store._write_exr

    def full(path, stored):
        if "temporary" not in str(path):
            raise OSError(28, "No space left on device")
        write(path, stored)

    monkeypatch.setattr(store, "_write_exr", full)
    said = call(*RUN, "-o", "out", code=2).splitlines()
    assert said[-1].startswith("illumgrid: out could not be written; the disk may be full (No space left on device)")
    (kept,) = (tmp_path / "temporary").glob("illumgrid-*/out")
    assert said[-2] == f"the light is kept in {kept}; move that folder to where you want it"
    assert (ig.load(kept).grids[0].values == ig.load(tmp_path / "whole").grids[0].values).all()
    assert not (tmp_path / "out").exists()


def test_light_that_can_be_kept_nowhere_leaves_nothing(call, tmp_path, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setenv("HOME", str(tmp_path / "temporary"))

    def full(path, stored):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store, "_write_exr", full)
    assert "kept" not in call(*RUN, "-o", "out", code=2)
    assert not list((tmp_path / "temporary").iterdir()) and not (tmp_path / "out").exists()


def test_bench_learns_of_a_place_that_cannot_be_written_before_it_computes(refuse, monkeypatch):
    if not os.path.exists("/proc/self"):
        pytest.skip("needs a place that even root cannot write to")
    monkeypatch.setattr("illumgrid.accuracy.chart.bench", lambda *a: pytest.fail("computed"))
    refuse("bench", "v.npy", "-o", "/proc/self/chart", words=["/proc/self/chart", "cannot be written to"])
