"""Stops commands at random moments: ``python benchmarks/kills.py [--kills N] [--seconds S] [--seed N] [--only NAME]``.

Each command that writes works on a tiny volume, or on its finished run, in its own process and is ended by SIGKILL,
SIGTERM, SIGHUP or SIGINT in turn, at a moment drawn uniformly from its duration. Every other time what it writes is
there already, from an earlier run with other options, where the command may replace it. Most of the time goes into
imports and light, which write nothing, so every other moment is drawn from the time of writing: it begins when a hidden
folder ``.NAME-...`` appears beside the result.

Afterwards the result must be absent, the old one, or the new one, each complete: equal to that of an uninterrupted
command, byte for byte (a run: light for light; what records seconds: readable). Only after SIGKILL may anything else
lie beside it, and the next command to the same place must work and remove it. Between the two renames of
``run --overwrite`` the folder is absent and both results are complete in the hidden folder, from which the next run
puts the old one back; the summary counts this case. The exit code is 1 if anything else is found.
"""

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import illumgrid as ig

STEP = 0.0005  # seconds between polls
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
RUN = ("run", "v.npy", "--range", "0.3", "0.9", "--grid", "24", "--paths", "4", "--threads", "1", "-o", "out")
KEPT = {"v.npy", "light", "points.csv", "temporary"}


@dataclass(frozen=True)
class Command:
    """What is stopped: its arguments, with {} for what tells an old result from a new one; and what it writes."""

    arguments: tuple[str, ...]
    writes: str | None = None
    old: str = "1"
    new: str = "2"
    replaces: bool = True
    same: Callable[[Path, Path], bool] | None = None
    """Compares two results, by default their bytes."""


def one_light(a, b):
    """Whether two folders are whole and hold one light."""
    last = {"moments.npz"}  # for more paths; written into a finished folder
    if {p.name for p in a.iterdir()} - last != {p.name for p in b.iterdir()} - last:
        return False
    return all(
        np.array_equal(x.values, y.values) for x, y in zip(ig.load(a).grids, ig.load(b).grids, strict=True)
    )  # with its checksum


def readable(a, b):
    """Whether a folder of `bench` is whole: its files are there, and not cut."""
    json.loads((a / "bench.json").read_text("utf-8"))
    ends = {".png": b"IEND\xaeB`\x82", ".svg": b"</svg>\n"}
    return {p.name for p in a.iterdir()} == {p.name for p in b.iterdir()} and all(
        p.read_bytes().endswith(ends[p.suffix]) for p in a.iterdir() if p.suffix in ends
    )


def bytes_of(path):
    """All bytes below a path."""
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    return [(p.relative_to(path).as_posix(), p.read_bytes()) for p in files]


def _export(ending, *more):
    return Command(("export", "light", f"a.{ending}", *more), f"a.{ending}", old="4", new="6")


COMMANDS = {
    "run": Command((*RUN, "--seed", "{}", "--overwrite"), "out", same=one_light),
    "preview": Command(
        ("preview", "light", "--engine", "software", "--exposure", "{}", "--output", "a.png", "--size", "300", "300"),
        "a.png",
    ),
    "sweep": Command(
        ("preview", "light", "--engine", "software", "--exposure", "{}", "--sweep", "3", "a.gif", "--size", "99", "99"),
        "a.gif",
    ),
    "view": Command(("view", "light", "--export", "a.html", "--light", "key=0.{}"), "a.html"),
    **{f"export .{e}": _export(e, "--light", "key=0.{}") for e in ("vti", "exr", "npz")},
    "export .nrrd": _export("nrrd", "--on", "field", "--light", "key=0.{}"),
    **{f"export .{e}": _export(e, "--isovalue", "0.{}") for e in ("glb", "ply")},
    "density": Command(
        ("density", "points.csv", "--spacing", "0.1", "--sigma", "0.{}", "-o", "a.nrrd"), "a.nrrd", old="3", new="2"
    ),
    "plugins --new": Command(("plugins", "--new", "mine", "sampler", "mine"), "mine", replaces=False),
    "bench": Command(
        ("bench", "v.npy", "--range", "0.3", "0.9", "--budget", "2", "-o", "b"), "b", replaces=False, same=readable
    ),
    "info": Command(("info", "v.npy")),
    "verify": Command(("verify", "--paths", "500", "--backend", "numba")),
}


def start(folder, command, which):
    text = [part.format(which) for part in command.arguments]
    environment = {**os.environ, "TMPDIR": str(folder / "temporary")}
    run = [sys.executable, "-m", "illumgrid", *text]
    with said(folder).open("wb") as stderr:
        return subprocess.Popen(run, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=stderr)


def said(folder):
    """What a process in a folder wrote to its standard error: a file beside the folder."""
    return folder.with_name(f"{folder.name}.said")


def not_begun(folder, ended, signals):
    """Whether a process ended before it ran illumgrid: Python at its own start dies of a signal, or exits with 1."""
    text = said(folder).read_bytes()
    return ended == -signals or (
        ended == 1 and (text.startswith(b"Fatal Python error: init") or b"runpy module" in text)
    )


def hidden(folder):
    return [p for p in folder.iterdir() if p.name.startswith(".")]


def writing(folder, process):
    """Wait until the process has begun to write, or has ended."""
    while process.poll() is None:
        with contextlib.suppress(FileNotFoundError):  # renamed meanwhile
            if any(any(p.iterdir()) for p in hidden(folder) if p.is_dir()):
                return
        time.sleep(STEP)


@dataclass
class Known:
    """What uninterrupted commands take and give."""

    before: float
    during: float
    new: Path | None
    old: Path | None = None


def learn(work, name, command, which):
    """Run a command without a stop."""
    folder = place(work, f"{name} {which}")
    begun = time.perf_counter()
    process = start(folder, command, getattr(command, which))
    writing(folder, process)
    at = time.perf_counter()
    assert process.wait() == 0, (name, which)
    result = folder / command.writes if command.writes else None
    return Known(at - begun, time.perf_counter() - at, result)


def place(work, name):
    """Make a folder with what commands read."""
    folder = work / name.replace("/", "-")
    folder.mkdir()
    (folder / "temporary").mkdir()
    for source in (work / "first").iterdir():
        if source.name in KEPT and source.name != "temporary":
            (shutil.copytree if source.is_dir() else shutil.copy)(source, folder / source.name)
    return folder


def state(folder, command, known):
    """Whether the result is absent (None), the old one, or the new one; raises for anything else."""
    result = folder / command.writes if command.writes else None
    if result is None or not result.exists():
        return None
    same = command.same or (lambda a, b: bytes_of(a) == bytes_of(b))
    found = [which for which in ("new", "old") if getattr(known, which) and same(result, getattr(known, which))]
    assert found, f"{result.name} is neither the old nor the new result"
    return found[0]


def stop(folder, command, known, finished, late, signals, chance):
    """Stop one command and name what it left."""
    if finished:
        target = folder / command.writes
        (shutil.copytree if known.old.is_dir() else shutil.copy)(known.old, target)
    process = start(folder, command, command.new)
    if late:
        writing(folder, process)
        time.sleep(chance.uniform(0, known.during))
    else:
        time.sleep(chance.uniform(0, known.before + known.during))
    process.send_signal(signals)
    asked = time.perf_counter()
    ended = process.wait()
    took = time.perf_counter() - asked
    at, left = state(folder, command, known), hidden(folder)
    beside = {p.name for p in folder.iterdir()} - KEPT - {command.writes} - {p.name for p in left}
    rest = [p.name for p in (folder / "temporary").iterdir()]
    assert beside <= {"out.partial"}, beside  # which the next run goes on with
    found = {None: "absent", "old": "the old result", "new": "the new result"}[at]
    if command.writes is None:
        found = "nothing written"
    if ended == 0:
        found = "ended before the stop"
        assert at == "new" or command.writes is None
    elif at is None and finished:
        found = "absent between two renames, both results complete beside it"
        (hide,) = left
        assert one_light(hide / "old", known.old) and one_light(hide / "new", known.new)
    elif signals != signal.SIGKILL and not_begun(folder, ended, signals):
        found += ", the interpreter had not begun to run illumgrid"
        assert at == ("old" if finished else None), f"exit {ended}"
    elif signals != signal.SIGKILL:
        assert ended == 130, f"exit {ended}"
    if signals != signal.SIGKILL:
        assert not left and not rest, (left, rest)
    elif left or rest:
        found += ", a hidden folder beside it"
    if (left or rest) and (at is None or command.replaces):  # the next command removes it
        again = start(folder, command, command.new)
        assert again.wait() == 0 and (command.writes is None or state(folder, command, known) == "new")
        assert not hidden(folder) and not any((folder / "temporary").iterdir()), "what a dead process left is there"
    return found, took


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200, help="stops that come before the command has ended")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no stop after so long")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="name of a command")
    asked = parser.parse_args()
    until = time.monotonic() + asked.seconds
    chance, tally, wrong, slowest = random.Random(asked.seed), Counter(), 0, 0.0
    commands = {name: c for name, c in COMMANDS.items() if asked.only in (None, name)}
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        (work / "first" / "temporary").mkdir(parents=True)
        x = np.indices((24, 24, 24)).reshape(3, -1).T / 11.5 - 1
        np.save(work / "first" / "v.npy", (1.2 - np.linalg.norm(x, axis=1)).reshape(24, 24, 24))
        points = np.random.default_rng(0).random((3000, 3))
        np.savetxt(work / "first" / "points.csv", points, "%.6f", ",", header="x,y,z", comments="")
        assert start(work / "first", Command((*RUN, "--seed", "0")), "").wait() == 0  # compiles
        (work / "first" / "out").rename(work / "first" / "light")
        known = {}
        number = in_time = 0
        while in_time < asked.kills and time.monotonic() < until:
            at = list(commands)[number % len(commands)]
            command, turn = commands[at], number // len(commands)
            finished = bool(command.writes) and command.replaces and turn % 2 == 1
            if at not in known:
                known[at] = learn(work, at, command, "new")
            if finished and known[at].old is None:
                known[at].old = learn(work, at, command, "old").new
            signals = SIGNALS[number % len(SIGNALS)]
            folder = place(work, str(number))
            try:
                late = bool(command.writes) and number // 4 % 2 == 1  # each signal at moments of both kinds
                found, took = stop(folder, command, known[at], finished, late, signals, chance)
                slowest = max(slowest, took)
            except (AssertionError, OSError, ValueError) as trouble:
                found, wrong = f"WRONG: {type(trouble).__name__} {trouble}", wrong + 1
                print(f"{number} {at} {signals.name}: {found}", flush=True)
            if found.startswith("ended"):  # the machine is quicker than when the command was timed
                known[at].before, known[at].during = 0.7 * known[at].before, 0.7 * known[at].during
            else:
                in_time += 1
            tally[f"{signals.name}: {found}"] += 1
            shutil.rmtree(folder)
            number += 1
            if number % 10 == 0:
                print(f"{number} stops, {in_time} in time, {wrong} wrong", flush=True)
    for found, count in sorted(tally.items()):
        print(f"{count:4}  {found}")
    print(f"{number} stops of {len(commands)} commands, {in_time} before the command had ended, {wrong} wrong")
    print(f"the slowest took {slowest:.2f} s to end")
    raise SystemExit(wrong > 0)


if __name__ == "__main__":
    main()
