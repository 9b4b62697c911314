"""Coverage of the error bar of a lookup: the table of the page "Where methods fail".

``python benchmarks/bars.py FOLDER`` takes blocks of 48³ voxels from the real volumes in FOLDER (without FOLDER, only
synthetic fields) and runs for some minutes.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
from stability import IMAGES, hills

import illumgrid as ig
from illumgrid.field.filters import smooth
from illumgrid.field.volume import Volume
from illumgrid.stages import on_level_sets
from illumgrid.transport.samples import join_queries

SIDE = 48
REAL = {
    "aquarius-A2.nrrd": ("cosmology", 60, 150),
    "betaGal.mrc.gz": ("cryo-EM map", 0.05, 0.13),
    "hydrogen_atom.nrrd": ("hydrogen atom", 12, 80),
    "neghip.nrrd": ("electron density", 30, 180),
    "stroke_T1.nii.gz": ("MRI of a brain", 60, 110),
    "vis_male.nrrd": ("CT of a head", 40, 140),
}


def block(volume: Volume, low: float, high: float) -> Volume:
    """Cube with a side of `SIDE` voxels (or the whole axis) that contains the most voxels of the range."""
    from scipy.ndimage import uniform_filter

    size = [min(SIDE, n) for n in volume.shape]
    inside = (volume.values >= low) & (volume.values <= high)
    best = np.unravel_index(uniform_filter(inside.astype(np.float32), size, mode="constant").argmax(), volume.shape)
    first = [int(np.clip(b - s // 2, 0, n - s)) for b, s, n in zip(best, size, volume.shape)]
    return Volume(volume.values[tuple(slice(f, f + s) for f, s in zip(first, size))], spacing=volume.spacing)


def fields(folder: Path | None) -> dict[str, tuple[Volume, float, float]]:
    """Blocks by name, with their ranges."""
    found: dict[str, tuple[Volume, float, float]] = {
        "sum of Gaussians": (hills(SIDE), 0.15, 0.75),
        "the same, noise of 3 %": (hills(SIDE, noise=0.03), 0.15, 0.75),
    }
    for name, (what, low, high) in REAL.items() if folder and folder.is_dir() else ():
        volume = ig.read_volume(folder / name)
        found[what] = block(volume, low, high), low, high
        if name == "stroke_T1.nii.gz":
            found[f"{what}, smoothed by 1"] = block(smooth(volume, 1.0), low, high), low, high
    return found


def measured(volume: Volume, low: float, high: float, share: float) -> tuple[float, float, float, float, float]:
    """Coverage, median bar over RMS error, relative RMS of the bars, relative RMSE, resolution."""
    scene = ig.Scene.sky(volume, range=(low, high))
    light = ig.run(scene, grid=max(2, int(max(volume.shape) * share)), paths=64, bounces=4, isovalues=2)
    random = np.random.default_rng(5)
    rows = low + (high - low) * (np.arange(12) + random.random(12)) / 12
    asked = join_queries(list(on_level_sets(scene, rows, 7, points=100)))
    answer = ig.backend("numba").solve(scene, asked, paths=range(512), bounces=4, seed=99)
    answer = answer[answer.paths > 0]
    grid, points, truth = light.grids[0], answer.queries.point, answer.mean.astype(float)
    off = np.sqrt(((grid.lookup(points) - truth) ** 2).mean(axis=1))
    bar = np.hypot(grid.uncertainty(points), answer.error)
    known = np.isfinite(bar)
    off, bar = off[known], bar[known]
    rms = float(np.sqrt((off**2).mean()))
    return (
        float((off <= 1.96 * bar).mean()), float(np.median(bar)) / rms, float(np.sqrt((bar**2).mean())) / truth.mean(),
        rms / truth.mean(), grid.resolution,
    )  # fmt: skip


def main() -> None:
    """Measure all blocks at 1 and 0.5 nodes per voxel."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path)
    warnings.simplefilter("ignore")
    lines = [
        "| block | nodes per voxel | covered | median bar / RMS error | RMS bar | RMS error | resolution |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, (volume, low, high) in fields(parser.parse_args().folder).items():
        for share in (1.0, 0.5):
            covered, length, bar, error, resolution = measured(volume, low, high, share)
            lines.append(
                f"| {name} | {share:g} | {covered:.1%} | {length:.2f} | {bar:.1%} | {error:.1%} | {resolution:.2f} |"
            )
            print(lines[-1], flush=True)
    (IMAGES / "bars_table.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
