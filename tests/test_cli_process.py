"""The command line as a process: its imports, its errors, and what remains when it is stopped or killed."""

import os
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import typer

import illumgrid as ig
from illumgrid import cli
from illumgrid.cli import terminal
from illumgrid.errors import BadInput
from illumgrid.io import store
from shapes import ball

COMMAND = (sys.executable, "-m", "illumgrid")


def start(*args, cwd, said=subprocess.DEVNULL):
    def hear() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell's background jobs are born deaf to Ctrl-C

    out = subprocess.DEVNULL
    return subprocess.Popen([*COMMAND, *args], cwd=cwd, stdout=out, stderr=said, text=True, preexec_fn=hear)


@pytest.fixture
def folder(tmp_path):
    np.save(tmp_path / "v.npy", ball(12).values)
    return tmp_path


def test_the_module_runs_as_the_command_does(tmp_path):
    done = subprocess.run([*COMMAND, "--version"], capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, f"illumgrid {ig.__version__}", "")
    done = subprocess.run([*COMMAND, "run", "nowhere.nrrd"], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2 and not done.stdout and done.stderr.startswith("illumgrid: nowhere.nrrd: ")
    assert done.stderr.count("\n") == 1 and not list(tmp_path.iterdir())


def test_closed_streams_are_no_trouble(folder):
    line = "{0} info v.npy >&- && {0} --version <&- >&- 2>&-".format(f"{sys.executable} -m illumgrid")
    done = subprocess.run(line, shell=True, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0 and "Traceback" not in done.stderr and not done.stdout


def test_help_is_quick_because_it_loads_nothing_heavy():
    code = """
import sys
from illumgrid.cli import app
for args in ([], ["run"], ["preview"], ["info"]):
    app([*args, "--help"], standalone_mode=False)
heavy = {"numba", "numpy", "scipy", "skimage", "trimesh", "OpenEXR", "SimpleITK", "PIL"} & set(sys.modules)
sys.exit(f"loaded {heavy}" if heavy else 0)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stderr and "--isovalues" in done.stdout


def test_ctrl_c_stops_with_a_sentence_and_leaves_nothing(folder):
    args = ("run", "v.npy", "--range", "0.3", "0.9", "--paths", "50000", "-o", "out")
    with start(*args, cwd=folder, said=subprocess.PIPE) as process:
        try:
            while "voxels" not in process.stderr.readline():
                assert process.poll() is None
            time.sleep(1.0)  # into the kernels
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=30)
        finally:
            process.kill()
    # what `auto` chose may be printed before or after the line waited for
    assert process.returncode == 130 and said.splitlines()[-1] == "illumgrid: stopped; nothing was written"
    assert "Traceback" not in said
    assert [p.name for p in folder.iterdir()] == ["v.npy"]


def test_a_kill_at_any_moment_leaves_a_whole_run_or_none(folder):
    args = ("run", "v.npy", "--range", "0.3", "0.9", "--grid", "12", "--paths", "4", "--no-preview", "-o")
    begun = time.monotonic()
    assert start(*args, "first", cwd=folder).wait() == 0
    whole = time.monotonic() - begun
    chance = random.Random(os.getpid())  # other moments each time; benchmarks/kills.py tries more
    moments = [whole * chance.uniform(0.4, 1.1) for _ in range(2)]
    fresh = start(*args, "out", cwd=folder)
    again = start(*args, "first", "--overwrite", "--seed", "1", cwd=folder)
    begun = time.monotonic()
    for moment, process in sorted(zip(moments, (fresh, again)), key=lambda pair: pair[0]):
        time.sleep(max(0.0, begun + moment - time.monotonic()))
        process.kill()
        process.wait()
    if (folder / "out").exists():
        assert ig.load(folder / "out").recipe["seed"] == 0
    assert ig.load(folder / "first").recipe["seed"] in (0, 1)


@pytest.mark.parametrize("overwrite", [(), ("--overwrite",)])
def test_of_two_runs_into_one_folder_one_wins_and_the_other_is_refused(
    folder, overwrite, tmp_path_factory, monkeypatch
):
    monkeypatch.setenv("TMPDIR", str(tmp_path_factory.mktemp("kept")))  # where the loser keeps its light
    args = ("run", "v.npy", "--range", "0.3", "0.9", "--grid", "6", "--paths", "2", "--no-preview", "-o", "out")
    both = [start(*args, "--seed", str(seed), *overwrite, cwd=folder, said=subprocess.PIPE) for seed in (0, 1)]
    said = [process.communicate(timeout=120)[1].splitlines()[-1] for process in both]
    codes = [process.returncode for process in both]
    winners = [seed for seed in (0, 1) if codes[seed] == 0]
    assert sorted(codes) == [0, 2] or (overwrite and codes == [0, 0]), said
    for code, last in zip(codes, said):
        assert last == "wrote out" if code == 0 else last.startswith("illumgrid: ") and last.endswith("with -o"), said
    assert ig.load(folder / "out").recipe["seed"] in winners
    assert sorted(p.name for p in folder.iterdir()) == ["out", "v.npy"]


@pytest.mark.parametrize(
    "trouble, code, word",
    [
        (KeyboardInterrupt(), 130, "stopped"),
        (typer.Abort(), 130, "stopped"),
        (BadInput("what came"), 2, "what came"),
        (MemoryError(), 2, "memory"),
        (OSError(28, "No space left on device", "here"), 2, "No space left on device: here"),
    ],
)
def test_trouble_is_an_exit_code_and_a_sentence(capsys, trouble, code, word):
    def fail():
        raise trouble

    assert cli.guarded(fail) == code
    said = capsys.readouterr().err
    assert said.startswith("illumgrid: ") and word in said and said.count("\n") == 1


def test_a_mistake_of_ours_is_not_dressed_up_as_bad_input():
    with pytest.raises(ZeroDivisionError):
        cli.guarded(lambda: 1 / 0)
    assert cli.guarded(lambda: None) == 0 and cli.guarded(lambda: 3) == 3


def test_redirected_output_reports_progress_at_intervals(capsys, monkeypatch):
    clock = iter([0.0, 1.0, terminal.INTERVAL + 1, terminal.INTERVAL + 2])
    monkeypatch.setattr(terminal.time, "monotonic", lambda: next(clock))
    with terminal.progress_bars(lambda: "kept here") as progress:
        for done in (1, 2, 3):
            progress("bake", done, 4)
    assert capsys.readouterr().err.splitlines() == ["bake: 50%, about 20 s left, kept here"]


def test_what_a_run_says_of_itself_does_not_command_the_terminal(call, tmp_path):
    call("run", "v.npy", "--range", "0.3", "0.9", "--grid", "6", "--paths", "2", "--no-preview", "-o", "out")
    store.amend(tmp_path / "out", {"input": "a\x1b]0;owned\x07\u202e", "sampler": {"name": "\x1b[2J\x9b2J"}})
    said = call("info", "out")
    assert "\\x1b[2J" in said and not {"\x1b", "\x07", "\x9b", "\u202e"} & set(said)
