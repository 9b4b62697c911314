"""Full disks and places that cannot be written: a sentence, nothing torn, and the light is not lost."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import illumgrid as ig
from illumgrid.io import exports, store
from shapes import lit, sky

resource = pytest.importorskip("resource", reason="Windows cannot limit the size of files")

RUN = ("run", "v.npy", "--range", "0.3", "0.9", "--grid", "6", "--paths", "2", "--no-preview")


@pytest.mark.parametrize("ending", [*exports.LATTICES, *exports.SURFACES])
def test_a_full_disk_ends_every_export_in_a_sentence(tmp_path, ending):
    """Also if only the last byte is missing, which the EXR library does not report."""
    write = f"""
import resource, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from illumgrid.errors import BadInput
from illumgrid.io import exports
from shapes import lit, sky
light, file = lit(sky()), {str(tmp_path / "a")!r} + {ending!r}
exports.write(light, file)
size = open(file, "rb").seek(0, 2)
for room in (size // 2, size - 1):
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
    try:
        exports.write(light, file)
    except BadInput as reason:
        print(reason)
"""
    done = subprocess.run([sys.executable, "-c", write], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.count("could not be written") == 2, done.stdout + done.stderr
    assert [p.name for p in tmp_path.iterdir()] == [f"a{ending}"]
    whole = (tmp_path / f"a{ending}").stat().st_size
    exports.write(lit(sky()), tmp_path / f"b{ending}")
    assert whole == (tmp_path / f"b{ending}").stat().st_size


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
