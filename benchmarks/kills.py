"""Stops ``illumgrid run`` at random moments: ``python benchmarks/kills.py [--kills N] [--seconds S] [--seed N]``.

Each starts a run of a tiny volume in its own process and ends it by SIGKILL, SIGTERM or SIGHUP in turn, at a moment
drawn uniformly from the run's duration. Half of the runs write to a new DIR, half, with ``--overwrite``, to one that
holds a finished run. Most of a run is imports and light, which write nothing, so every other moment is drawn from the
time of writing: it begins when the result appears in a hidden folder ``.DIR-...`` beside DIR, and lasts as long as in
an uninterrupted run.

Afterwards DIR must be absent or complete (it is read back and compared with the result of its seed; with
``--overwrite`` the old result counts as complete), only after SIGKILL may hidden folders lie beside it, and the next
run into the same DIR must work and remove them. Between the two renames of ``--overwrite``, DIR is absent and both
results are complete in the hidden folder, from which the next run puts the old one back; the summary counts this
case. The exit code is 1 if anything else is found.
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

OLD, NEW = 1, 2  # seeds of the existing result and of the one being written
OPTIONS = ("--range", "0.3", "0.9", "--grid", "24", "--paths", "4", "--threads", "1")
STEP = 0.0002  # seconds between polls


def start(folder, seed, overwrite=False):
    command = [sys.executable, "-m", "illumgrid", "run", "v.npy", *OPTIONS, "-o", "out", "--seed", str(seed)]
    if overwrite or (folder / "out").exists():
        command.append("--overwrite")
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def hidden(folder, prefix=".out-"):
    return [p for p in folder.iterdir() if p.name.startswith(prefix)]


def writing(folder, process):
    """Wait until the process has begun to write, or has ended."""
    while not any((p / "new").is_dir() for p in hidden(folder)) and process.poll() is None:
        time.sleep(STEP)


def durations(folder):
    """Seconds from start to writing, of writing, and from there to the end, for an uninterrupted run."""
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
    """Whether DIR is complete: it can be read, with its checksum, and holds this light."""
    back = ig.load(out)
    return all(np.array_equal(a.values, b.values) for a, b in zip(back.grids, light.grids, strict=True))


def whole(out, lights):
    """Seed of the result in DIR, None if DIR is absent; raises for anything else."""
    if not out.exists():
        return None
    found = [seed for seed, light in lights.items() if same(out, light)]
    assert len(found) == 1, found
    must, may = {"illumination.exr", "run.json", "preview.png"}, {"moments.npz"}  # the last to be written
    assert must <= {p.name for p in out.iterdir()} <= must | may
    return found[0]


def kill(folder, finished, lights, chance, durations, late, signals):
    """Kill one run and classify what it left."""
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
    process.send_signal(signals)
    ended = process.wait()
    seed, left = whole(out, lights), hidden(folder, ".")
    unexpected = {p.name for p in folder.iterdir()} - {"v.npy", "out", *(p.name for p in left)}
    assert not unexpected, unexpected
    if ended == 0:
        found = "ended before the kill"
        assert seed == NEW
    elif seed is None and finished:
        found = "absent between two renames, both results complete beside it"
        (place,) = left
        assert whole(place / "old", lights) == OLD and whole(place / "new", lights) == NEW
    else:
        found = {None: "absent", OLD: "the old result, complete", NEW: "the new result, complete"}[seed]
        assert seed in ((OLD, NEW) if finished else (None, NEW))
    if left:
        found += ", a hidden folder left beside it"
    if signals != signal.SIGKILL:
        assert not left, left
    again = start(folder, NEW, overwrite=finished is not None)  # which puts back what was moved aside
    assert again.wait() == 0 and whole(out, lights) == NEW
    assert not hidden(folder, "."), "a folder of a dead process"
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no kill after so long")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    until = time.monotonic() + asked.seconds
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
        before, during, after = times
        print(f"a run takes {before:.2f} s before, {during:.3f} s during and {after:.2f} s after writing", flush=True)
        for number in range(asked.kills):
            if time.monotonic() > until:
                break
            over, late = number % 2 == 1, number // 2 % 2 == 1
            signals = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP)[number % 3]
            folder = Path(work) / str(number)
            folder.mkdir()
            shutil.copy(place / "v.npy", folder)
            try:
                found = kill(folder, place / "kept" if over else None, lights, chance, times, late, signals)
            except (AssertionError, ig.BadInput) as trouble:
                found, wrong = f"WRONG: {trouble}", wrong + 1
            found = f"{signals.name}: {found}"
            tally[("with --overwrite: " if over else "to a new DIR: ") + found] += 1
            shutil.rmtree(folder)
            if number % 10 == 9:
                print(f"{number + 1} kills", flush=True)
    for found, count in sorted(tally.items()):
        print(f"{count:4}  {found}")
    raise SystemExit(wrong > 0)


if __name__ == "__main__":
    main()
