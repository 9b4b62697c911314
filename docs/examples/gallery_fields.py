"""Commands of the gallery, on real volumes if ``../shared/volumes`` has them, else on synthetic ones."""

import shlex
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

HERE = Path.cwd()
_runs = TemporaryDirectory(prefix="illumgrid-gallery-")
RUNS = Path(_runs.name)
"""The folder in which the commands of the gallery run."""
PLACES = [parent / "shared" / "volumes" for parent in (HERE, *HERE.parents[:5])]


def _real(name):
    return next((place / name for place in PLACES if (place / name).is_file()), None)


def has(name):
    """Whether a volume exists; if so, commands can use its name."""
    if path := _real(name):
        (RUNS / name).symlink_to(path)
    return path is not None


def arms():
    """Write ``arms.csv``, points along the arms of a synthetic neuron."""
    t, body = np.linspace(0, 1, 160), []
    for k in range(7):
        turn = 0.9 * k + 2.4 * t + 0.3 * np.sin(9 * t + k)
        body.append(np.stack([0.85 * t * np.cos(turn), 0.85 * t * np.sin(turn), 0.12 * np.sin(7 * t + 2 * k)], axis=1))
    np.savetxt(RUNS / "arms.csv", np.concatenate(body), delimiter=",")


def folds():
    """Write ``folds.npy``, a folded ball."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, 64)] * 3, indexing="ij")
    radius = np.sqrt(x**2 + (0.85 * y) ** 2 + (1.15 * z) ** 2)
    folds = np.sin(17 * x + 3 * np.sin(6 * y)) * np.sin(17 * y + 3 * np.sin(6 * z)) * np.sin(17 * z + 3 * np.sin(6 * x))
    np.save(RUNS / "folds.npy", 1 - radius + 0.12 * folds)


def command(line):
    """Run a line as in a terminal, in `RUNS`; return the picture that its last command writes, if any, as an array."""
    for part in line.split("&&"):
        words = shlex.split(part)
        subprocess.run([sys.executable, "-m", *words], cwd=RUNS, check=True, capture_output=True)
    if words[-1].endswith(".png"):
        import matplotlib.image

        return matplotlib.image.imread(RUNS / words[-1])
    return None
