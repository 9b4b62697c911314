"""Time and peak memory of whole commands over the size of the field and of the grid, with fitted exponents.

    python benchmarks/scale.py [fields|grids] [SIZE ...] [--type uint8]

Each command is a process of its own, measured by the operating system: processor seconds and the largest resident set.
What a field of 16³ voxels takes on a grid of 16 nodes (the interpreter, libraries, compiled kernels from the cache) is
subtracted before the exponents of a power of the number of voxels, or of lit nodes, are fitted.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

RUN = ("--paths", "2", "--overwrite", "--no-preview")


def lumps(path: Path, n: int, kind: str) -> None:
    """A lumpy ball with noise of one step in a background, plane by plane: larger than memory may be."""
    noise, x = np.random.default_rng(0), np.linspace(-1, 1, n, dtype=np.float32)
    values = np.lib.format.open_memmap(path, mode="w+", dtype=kind, shape=(n, n, n))
    waves = np.sin(11 * x)[:, None] * np.sin(7 * x)
    for k in range(n):
        radius = np.sqrt(x[k] ** 2 + x[:, None] ** 2 + x**2)
        plane = np.where(radius > 0.95, 20, 200 - 140 * radius + 18 * np.sin(9 * x[k]) * waves)
        values[k] = np.clip(plane + noise.normal(0, 1, (n, n)), 0, 255).astype(kind)
    values.flush()


def measured(*words: object) -> tuple[float, float, str]:
    """Processor seconds, peak in MB and output of a command line of illumgrid."""
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen([sys.executable, "-m", "illumgrid", *map(str, words)], stdout=said, stderr=said)
        _, status, usage = os.wait4(process.pid, 0)
        said.seek(0)
        text = said.read()
    if status:
        raise SystemExit(f"{' '.join(map(str, words))}: {text}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e6, text


def exponent(sizes: list[float], costs: list[float], none: float) -> float:
    """Of the power law through what is left of the costs of the two largest sizes."""
    left = np.maximum(np.array(costs) - none, 1e-3)
    return float(np.log(left[-1] / left[-2]) / np.log(sizes[-1] / sizes[-2]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=("fields", "grids"), nargs="?", default="fields")
    parser.add_argument("sizes", type=int, nargs="*")
    parser.add_argument("--type", default="uint8")
    given = parser.parse_args()
    sizes = given.sizes or ([64, 128, 256] if given.what == "fields" else [32, 64, 128])
    with tempfile.TemporaryDirectory() as folder:
        file, out, rows = Path(folder) / "v.npy", Path(folder) / "out", {}
        for n in [16, *sizes]:
            voxels, nodes = (n, 64) if given.what == "fields" else (128, n)
            lumps(file, max(16, voxels), given.type)
            run = "run", file, "--grid", nodes if n > 16 else 16, *RUN, "-o", out
            commands = {"run": run}
            if given.what == "fields":
                page = "view", out, "--export", Path(folder) / "p.html"
                commands = {"info": ("info", file), "run": run, "info DIR": ("info", out), "view --export": page}
            for name, command in commands.items():
                measured(*command) if n == 16 else None  # compiles
                seconds, peak, text = measured(*command)
                asked = re.search(r"(\d+) queries", text)
                size = float(n**3) if given.what == "fields" else float(asked[1]) if asked else np.nan
                rows.setdefault(name, []).append((size, seconds, peak))
                print(f"{name:14} {n:5} {size:12.0f} {seconds:8.1f} s {peak:8.0f} MB", flush=True)
        for name, found in rows.items():
            (_, idle, least), *rest = found
            size, seconds, peak = (list(column) for column in zip(*rest))
            each = (peak[-1] - peak[-2]) / (size[-1] - size[-2]) * 1e6
            powers = exponent(size, seconds, idle), exponent(size, peak, least)
            print(
                f"{name:14} time ~ size^{powers[0]:.2f}, memory ~ size^{powers[1]:.2f}: {each:.1f} bytes a further one"
            )


if __name__ == "__main__":
    main()
