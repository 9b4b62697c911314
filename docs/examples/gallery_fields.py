"""Volumes for the gallery: real ones if ``../shared/volumes`` exists beside the project, synthetic ones otherwise."""

import shlex
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import illumgrid as ig
from illumgrid.field.builtin import spread
from illumgrid.field.volume import smooth

HERE = Path.cwd()
_runs = TemporaryDirectory(prefix="illumgrid-gallery-")
RUNS = Path(_runs.name)
"""The folder in which the commands of the gallery run."""
PLACES = [parent / "shared" / "volumes" for parent in (HERE, *HERE.parents[:5])]


def _real(name):
    return next((place / name for place in PLACES if (place / name).is_file()), None)


def _every(volume, step):
    """Every `step`-th voxel, after a blur, to keep the gallery fast."""
    blurred = smooth(volume, 0.5 * step)
    return ig.Volume(blurred.values[::step, ::step, ::step], volume.origin, volume.spacing * step, volume.direction)


def neuron():
    """A neuron, its range of isovalues, and the source of the data."""
    if path := _real("rivulet_neuron.nrrd"):
        whole = ig.read_volume(path)  # crop to the middle: two thin arms extend far outwards
        part = ig.Volume(whole.values[45:195, 80:335, :105], spacing=whole.spacing)
        return smooth(part, 1.2), (10, 40), "one neuron, microscopy: rivuletpy, BSD-3 licence"
    t = np.linspace(0, 1, 160)
    arms = []
    for k in range(7):
        turn = 0.9 * k + 2.4 * t + 0.3 * np.sin(9 * t + k)
        arms.append(np.stack([0.85 * t * np.cos(turn), 0.85 * t * np.sin(turn), 0.12 * np.sin(7 * t + 2 * k)], axis=1))
    body = spread(np.concatenate(arms), voxels=88, sigma=0.035)
    return body, (0.1, 0.5), "synthetic: arms around a body"


def brain():
    """A brain, its range of isovalues, and the source of the data."""
    if path := _real("stroke_T1.nii.gz"):
        source = "MRI of a human brain: neurolabusc/VolumeRenderingData, stroke/T1, MIT licence"
        return _every(ig.read_volume(path), 2), (60, 105), source
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, 64)] * 3, indexing="ij")
    radius = np.sqrt(x**2 + (0.85 * y) ** 2 + (1.15 * z) ** 2)
    folds = np.sin(17 * x + 3 * np.sin(6 * y)) * np.sin(17 * y + 3 * np.sin(6 * z)) * np.sin(17 * z + 3 * np.sin(6 * x))
    ball = ig.Volume(1 - radius + 0.12 * folds, (-1, -1, -1), (2 / 63,) * 3)
    return ball, (0.15, 0.45), "synthetic: a folded ball"


def command(line):
    """Run a line as in a terminal, in `RUNS`; returns the picture that it writes, if any, as an array."""
    words = shlex.split(line)
    subprocess.run([sys.executable, "-m", *words], cwd=RUNS, check=True, capture_output=True)
    if words[-1].endswith(".png"):
        import matplotlib.image

        return matplotlib.image.imread(RUNS / words[-1])
    return None
