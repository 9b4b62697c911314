"""Terminals without block characters, names that are no UTF-8: the answer is the same."""

import os
import subprocess
import sys

import numpy as np
import pytest

from illumgrid.io.readers import read_volume, volume_name

BYTES = b"v\xff\xe9.npy"
"""A name that a Latin-1 system wrote."""


@pytest.fixture
def odd(tmp_path):
    np.save(tmp_path / "v.npy", np.random.default_rng(0).random((6, 6, 6)))
    try:
        os.rename(os.fsencode(tmp_path / "v.npy"), os.path.join(os.fsencode(tmp_path), BYTES))
    except OSError:
        pytest.skip("names on this disk are UTF-8")
    return os.fsdecode(os.path.join(os.fsencode(tmp_path), BYTES))


@pytest.mark.parametrize("encoding", ["latin-1", "cp437:strict", "utf-8"])
def test_info_of_a_name_of_other_bytes_in_other_encodings(odd, encoding):
    run = [sys.executable, "-m", "illumgrid", "info", odd]
    done = subprocess.run(run, capture_output=True, env={**os.environ, "PYTHONIOENCODING": encoding})
    assert done.returncode == 0, done.stderr
    line = next(line for line in done.stdout.splitlines() if b"histogram" in line)
    assert (b"#" in line or b"*" in line or b"@" in line) == (encoding != "utf-8")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps the folder that a process works in")
@pytest.mark.parametrize("command", [["info", "v.npy"], ["run", "-o", "out"], ["view", "out"], ["verify"]])
def test_a_working_folder_that_is_gone_is_named(tmp_path, command):
    (tmp_path / "gone").mkdir()
    run = ["sh", "-c", 'rmdir ../gone && exec "$@"', "sh", sys.executable, "-m", "illumgrid", *command]
    done = subprocess.run(run, capture_output=True, text=True, cwd=tmp_path / "gone")
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("illumgrid: the working folder is gone")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere names are texts")
def test_names_of_other_bytes_are_read_and_shown(odd, tmp_path):
    assert read_volume(odd).shape == (6, 6, 6)
    assert volume_name(odd).isprintable() and volume_name(odd).startswith("v")
    missing = os.fsdecode(os.path.join(os.fsencode(tmp_path), b"no\xff.mha"))
    with pytest.raises(ValueError, match=r"^no.\.mha: there is no such file") as caught:
        read_volume(missing)
    assert str(caught.value).encode("utf-8")
