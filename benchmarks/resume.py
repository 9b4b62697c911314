"""Stops a long run at random moments and goes on with it: ``python benchmarks/resume.py [--kills N] [--seed N]``.

Each kill starts ``illumgrid run`` in its own process and ends it by SIGKILL, SIGTERM or SIGHUP in turn, at a moment
drawn uniformly from the run's duration. The same command then goes on. Its ``illumination.exr`` must be, byte for byte,
that of a run that was never stopped, and neither ``DIR.partial`` nor a hidden folder may be left. So that a run of a
second is killed in all of its phases, it writes what is finished every 0.1 s in place of every 10 s, in pieces of
0.02 s, and its process is a fork of one in which everything is imported and compiled. The exit code is 1 if anything
else is found. Not for Windows, which has no fork.
"""

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

import illumgrid as ig
from illumgrid import chain, cli
from illumgrid.io import partial
from illumgrid.transport import walk

OPTIONS = (
    "--range",
    "0.3",
    "0.9",
    "--grid",
    "20",
    "--paths",
    "32",
    "--no-preview",
    "--scene",
    "floor",
    "--threads",
    "1",
)


def start(folder):
    """Process id of a run."""
    if (child := os.fork()) == 0:
        os.chdir(folder)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores it
        with open(folder / "said", "w") as said:
            os.dup2(said.fileno(), 2)
            os.dup2(said.fileno(), 1)
        sys.argv = ["illumgrid", "run", "v.npy", *OPTIONS, "-o", "out"]
        try:
            cli.main()
        except SystemExit as end:
            sys.stderr.flush()
            os._exit(int(end.code or 0))
        finally:
            os._exit(1)
    return child


def ended(folder, child):
    """Exit code, or minus the signal, and what was said."""
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    said = (folder / "said").read_text() if (folder / "said").exists() else ""
    (folder / "said").unlink(missing_ok=True)
    return code, said


def finished(folder):
    code, said = ended(folder, start(folder))
    assert code == 0, said
    return said


def kill(folder, seconds, chance, stop, whole):
    """Kill one run, go on with it, and say where it was."""
    child = start(folder)
    time.sleep(chance.uniform(0, seconds))
    os.kill(child, stop)
    code, said = ended(folder, child)
    assert code in (0, 130, -stop), said
    assert "Traceback" not in said, said
    where = "before anything was kept"
    if (folder / "out").exists():
        where = "after DIR was written"
        shutil.rmtree(folder / "out")  # the same command would refuse it
    elif (folder / "out.partial").exists():
        where = "with a part kept"
    went_on = "going on with" in finished(folder)
    assert went_on or where != "with a part kept"
    assert (folder / "out" / "illumination.exr").read_bytes() == whole
    left = {p.name for p in folder.iterdir()} - {"v.npy", "out"}
    assert not left, left
    return where


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    partial.EVERY, partial.CHUNK, walk.PIECE, walk.SECONDS = 0.1, 1024, 1 << 12, 0.02
    chain.judged = lambda light, *about: light  # which comes after all that is written
    chance, tally, wrong = random.Random(asked.seed), Counter(), 0
    with tempfile.TemporaryDirectory() as work:
        place = Path(work) / "whole"
        place.mkdir()
        x = np.indices((24, 24, 24)).reshape(3, -1).T / 11.5 - 1
        values = (1.2 - np.linalg.norm(x, axis=1)).reshape(24, 24, 24)
        np.save(place / "v.npy", values)
        ig.run(ig.Scene.floor(ig.Volume(values)), grid=8, paths=1)  # compiles
        finished(place)
        whole = (place / "out" / "illumination.exr").read_bytes()
        shutil.rmtree(place / "out")
        seconds = float("inf")
        for _ in range(3):
            begun = time.perf_counter()
            finished(place)
            seconds = min(seconds, time.perf_counter() - begun)
            shutil.rmtree(place / "out")
        print(f"a run takes {seconds:.2f} s", flush=True)
        for number in range(asked.kills):
            stop = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP)[number % 3]
            folder = Path(work) / str(number)
            folder.mkdir()
            shutil.copy(place / "v.npy", folder)
            try:
                found = kill(folder, seconds, chance, stop, whole)
            except AssertionError as trouble:
                found, wrong = f"WRONG: {trouble}", wrong + 1
            tally[f"{stop.name}: {found}"] += 1
            shutil.rmtree(folder)
            if number % 10 == 9:
                print(f"{number + 1} kills", flush=True)
    for found, count in sorted(tally.items()):
        print(f"{count:4}  {found}")
    raise SystemExit(wrong > 0)


if __name__ == "__main__":
    main()
