"""Mutated files: earlier findings, and a short search for more (see `fuzz.py`)."""

import shutil
import sys

import pytest

import fuzz

forks = pytest.mark.skipif(sys.platform == "win32", reason="cases run in forked processes, which Windows has not")


@forks
@pytest.mark.parametrize("kept", sorted(fuzz.CORPUS.iterdir()), ids=lambda file: file.name)
def test_what_was_found_once_is_refused(kept, tmp_path):
    target = next(t for t in fuzz.TARGETS if t.name.replace(" ", "-") == kept.name.partition("@")[0])
    file = target.make(tmp_path)
    shutil.copyfile(kept, file)
    assert fuzz.alone(target, file) == ""


@forks
@pytest.mark.parametrize("target", fuzz.TARGETS, ids=lambda target: target.name)
def test_a_moment_of_fuzzing(target):
    assert list(fuzz.batch(target, 1_000_000, target.moment)) == []


@forks
def test_the_harness_detects_a_crash_a_hang_and_an_exception(monkeypatch, tmp_path):
    import os
    import time

    def make(folder):
        (folder / "a").write_bytes(b"abc")
        return folder / "a"

    def read(file):
        data = file.read_bytes()
        if data[:1] != b"a":
            os.abort()
        if data[1:2] != b"b":
            while time.monotonic():
                pass
        if data[2:3] != b"c":
            raise KeyError("c")

    monkeypatch.setattr(fuzz, "SECONDS", 1)
    found = {what for _, what in fuzz.batch(fuzz.Target("broken", make, read), 0, 12)}
    assert found == {"the process ended with status 6", "hung: 1 s of work", "KeyError: 'c'"}
