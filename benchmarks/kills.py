"""Kills at random moments of ``illumgrid run``: ``python benchmarks/kills.py [--kills N] [--seed N]``.

Each kill starts a run of a tiny volume in a process of its own and ends it by SIGKILL, at a moment drawn evenly from
the run's duration. Half of them go to a DIR that is not there, half, with ``--overwrite``, to one that holds a finished
run. As most of a run is imports and light, which write nothing, every other moment is drawn from the time of writing:
it begins when the hidden folder ``.DIR-...`` beside DIR appears, and lasts as long as in a run that nobody killed.

Afterwards DIR must be absent or whole (it is read back and compared with what its seed gives; with ``--overwrite`` the
old result counts as whole), nothing may lie beside it but hidden folders, and the next run into the same DIR must work.
Between the two renames of ``--overwrite`` DIR is absent, and both results are whole in the hidden folder: that is told.
Exit code 1 if anything else is found.
"""

import argparse
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

import illumgrid as ig

OLD, NEW = 1, 2  # seeds of what is there and of what is on its way
OPTIONS = ("--range", "0.3", "0.9", "--grid", "24", "--paths", "4", "--threads", "1")
STEP = 0.0002  # seconds between two looks


def start(folder, seed):
    command = [sys.executable, "-m", "illumgrid", "run", "v.npy", *OPTIONS, "-o", "out", "--seed", str(seed)]
    if (folder / "out").exists():
        command.append("--overwrite")
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def hidden(folder, prefix=".out-"):
    return [p for p in folder.iterdir() if p.name.startswith(prefix)]


def writing(folder, process):
    """Wait until the process has begun to write, or is over."""
    while not hidden(folder) and process.poll() is None:
        time.sleep(STEP)


def durations(folder):
    """Seconds from start to writing, of writing, and from there to the end, of a run that nobody kills."""
    begun = time.perf_counter()
    process = start(folder, OLD)
    writing(folder, process)
    at = time.perf_counter()
    while hidden(folder):
        time.sleep(STEP)
    over = time.perf_counter()
    assert process.wait() == 0
    return at - begun, over - at, time.perf_counter() - over


def same(out, light):
    """DIR is whole: it is read, by its checksum, and holds this light."""
    back = ig.load(out)
    return all(np.array_equal(a.values, b.values) for a, b in zip(back.grids, light.grids, strict=True))


def whole(out, lights):
    """Seed of the result that DIR holds, None if it is absent; raises if it is anything else."""
    if not out.exists():
        return None
    found = [seed for seed, light in lights.items() if same(out, light)]
    assert len(found) == 1 and {p.name for p in out.iterdir()} == {"illumination.exr", "run.json", "preview.png"}
    return found[0]


def kill(folder, finished, lights, chance, durations, late):
    """One kill; what was found."""
    out = folder / "out"
    if finished:
        shutil.copytree(finished, out)
    before, during, after = durations
    process = start(folder, NEW)
    if late:
        writing(folder, process)
        time.sleep(chance.uniform(0, during))
    else:
        time.sleep(chance.uniform(0, before + during + after))
    process.send_signal(signal.SIGKILL)
    ended = process.wait()
    seed, left = whole(out, lights), hidden(folder, ".")
    strangers = {p.name for p in folder.iterdir()} - {"v.npy", "out", *(p.name for p in left)}
    assert not strangers, strangers
    if ended == 0:
        found = "over before the kill"
        assert seed == NEW
    elif seed is None and finished:
        found = "absent between two renames, both results whole beside it"
        (place,) = left
        assert whole(place / "old", lights) == OLD and whole(place / "new", lights) == NEW
    else:
        found = {None: "absent", OLD: "the old result, whole", NEW: "the new result, whole"}[seed]
        assert seed in ((OLD, NEW) if finished else (None, NEW))
    if left:
        found += ", a hidden folder left beside it"
    again = start(folder, NEW)
    assert again.wait() == 0 and whole(out, lights) == NEW
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    chance, tally, wrong = random.Random(asked.seed), Counter(), 0
    with tempfile.TemporaryDirectory() as work:
        place = Path(work) / "first"
        place.mkdir()
        x = np.indices((24, 24, 24)).reshape(3, -1).T / 11.5 - 1
        np.save(place / "v.npy", (1.2 - np.linalg.norm(x, axis=1)).reshape(24, 24, 24))
        durations(place)  # compiles
        lights = {}
        for seed in (NEW, OLD):
            assert start(place, seed).wait() == 0
            lights[seed] = ig.load(place / "out")
        shutil.copytree(place / "out", place / "kept")
        times = durations(place)
        told = "before it writes, {:.3f} s while it writes and {:.2f} s from there to its end".format(*times[1:])
        print(f"a run takes {times[0]:.2f} s {told}", flush=True)
        for number in range(asked.kills):
            over, late = number % 2 == 1, number // 2 % 2 == 1
            folder = Path(work) / str(number)
            folder.mkdir()
            shutil.copy(place / "v.npy", folder)
            try:
                found = kill(folder, place / "kept" if over else None, lights, chance, times, late)
            except (AssertionError, ig.BadInput) as trouble:
                found, wrong = f"WRONG: {trouble}", wrong + 1
            tally[("with --overwrite: " if over else "to a new DIR: ") + found] += 1
            shutil.rmtree(folder)
            if number % 10 == 9:
                print(f"{number + 1} kills", flush=True)
    for found, count in sorted(tally.items()):
        print(f"{count:4}  {found}")
    raise SystemExit(wrong > 0)


if __name__ == "__main__":
    main()
