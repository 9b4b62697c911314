"""Error against number of paths, and coverage of the error bars: ``python benchmarks/convergence.py``.

Writes the figure and the table of the page "Is it right?" (`docs/images/convergence.png`, `convergence_table.md`) in
two minutes on one thread. `numba` marches nine scenes. The reference consists of two independent means A and B of many
paths each: the mean of (light - A)(light - B) is the squared error of the light, free of the errors of A and B.
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from chart import labyrinth
from rays import gaussians
from stability import hills

from illumgrid import Material, Quad, Scene, Volume, backend
from illumgrid.stages import on_level_sets
from illumgrid.transport.samples import join_queries

IMAGES = Path(__file__).parent.parent / "docs" / "images"
COUNTS = 4 * 2 ** np.arange(8)
SEEDS = 3  # per number of paths, to smooth the curves
LONG = (8192, 200)  # reference of the curves: paths and queries
WIDE = (2048, 1000)  # reference of the bars: paths and queries
BOUNCES = 4
ROUNDING = 2e-6  # relative: queries whose paths all contribute the same have, correctly, a bar of 0
SOLVE = backend("numba", threads=1).solve


def scenes():
    """Scenes by name, from smooth light to rough."""
    x = np.linspace(-1, 1, 33)
    distance = np.sqrt(x[:, None, None] ** 2 + x[:, None] ** 2 + x**2)
    ball = Volume(1.2 - distance, np.full(3, -1.0), np.full(3, 2 / 32))
    raw = Volume(np.random.default_rng(1).integers(0, 256, (20, 20, 20)))
    black = Scene.floor(ball, albedo=(0, 0, 0), range=(0.3, 0.9))
    floor = replace(black.quads[0], material=Material(np.zeros(3)))
    return {
        "black ball, black floor, sky": replace(black, quads=(floor,)),
        "ball on a floor, sky": Scene.floor(ball, range=(0.3, 0.9)),
        "ball in the box with a lamp": Scene.box(ball, range=(0.3, 0.9)),
        "raw noise, sky": Scene.sky(raw, range=(40, 215)),
    }


def others():
    """More scenes for the bars: light from lamps and walls, noise on a smooth field, and hardly any shadow."""
    smooth, slight, maze = gaussians(32), hills(24), Scene.floor(labyrinth(24), range=(-0.4, 0.4))
    noise = np.random.default_rng(0).normal(scale=0.03, size=smooth.values.shape)
    return {
        "labyrinth in the box with a lamp": Scene.box(labyrinth(32), range=(-0.4, 0.4)),
        "labyrinth, dim sky, two small lamps": replace(
            maze, quads=(*maze.quads, *small_lamps(maze)), background=np.full(3, 0.1)
        ),
        "hills in the box with a lamp": Scene.box(slight, range=(0.15, 0.75)),
        "noisy Gaussians, sky": Scene.sky(Volume(smooth.values + noise), range=(0.3, 1.0)),
        "hills, nearly all sky": Scene.sky(slight, range=(0.15, 0.75)),
    }


def small_lamps(scene):
    """Two lamps above the field, each with a hundredth of its area."""
    volume = scene.fields[0].volume
    size = np.array(volume.shape) * volume.spacing
    edge, glow = 0.12 * size.max(), Material(np.zeros(3), np.full(3, 30.0))
    for number, share in enumerate(((0.1, 0.2, 1.4), (0.8, 0.7, 1.4))):
        yield Quad(f"lamp {number}", volume.origin + share * size, np.array([0, edge, 0]), np.array([edge, 0, 0]), glow)


def asked(scene, count):
    """`count` queries with a normal on eight level sets, in random order."""
    rows = scene.levels((np.arange(8) + 0.5) / 8)
    queries = join_queries(list(on_level_sets(scene, rows, 0, points=count // 6)))
    queries = queries[queries.normal.any(axis=1)]
    return queries[np.random.default_rng(0).permutation(len(queries))[:count]]


def light(scene, queries, paths, seed):
    answer = SOLVE(scene, queries, paths=range(paths), bounces=BOUNCES, seed=seed)
    assert answer.paths.all()
    return answer.mean.astype(float), answer.stderr.astype(float)


def curve(scene):
    """Relative RMS error for each of COUNTS."""
    queries = asked(scene, LONG[1])
    one, other = (light(scene, queries, LONG[0], 1000 + k)[0] for k in (0, 1))
    squares = [
        np.mean([(mean - one) * (mean - other) for mean in (light(scene, queries, int(n), k)[0] for k in range(SEEDS))])
        for n in COUNTS
    ]
    return np.sqrt(squares) / one.mean()


def bars(scene, paths, references):
    """Share of the queries' colours whose 95 % bar covers the reference, and the median bar over the RMS error."""
    (one, its), (other, others) = references
    mean, bar = light(scene, asked(scene, WIDE[1]), paths, 0)
    rms = np.sqrt(np.mean((mean - one) * (mean - other)))
    off, wide = np.abs(mean - 0.5 * (one + other)), np.hypot(bar, 0.5 * np.hypot(its, others))
    return (off <= 1.96 * wide + ROUNDING * mean).mean(), np.median(bar) / rms


def draw(curves):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    colors = "tab:purple", "tab:blue", "tab:orange", "tab:green"
    for (name, error), marker, color in zip(curves.items(), "Dos^", colors):
        axes.loglog(COUNTS, 100 * error, marker=marker, color=color, label=f"{name}: paths$^{{{slope(error):.2f}}}$")
    start = 130 * max(error[0] for error in curves.values())
    axes.loglog(COUNTS, start * (COUNTS / COUNTS[0]) ** -0.5, "--", color="0.5", label="paths$^{-0.5}$")
    axes.set(xlabel="paths per query", ylabel="RMS error, % of the mean light")
    axes.set_xticks(COUNTS, [str(n) for n in COUNTS])
    axes.minorticks_off()
    axes.set_yticks([0.1, 0.3, 1, 3, 10, 30], ["0.1", "0.3", "1", "3", "10", "30"])
    axes.grid(color="0.9")
    axes.legend(frameon=False, loc="lower left")
    figure.savefig(IMAGES / "convergence.png", dpi=110)


def slope(error):
    """Exponent of the best-fitting power law in the number of paths."""
    return np.polyfit(np.log(COUNTS), np.log(error), 1)[0]


def main():
    curves, lines = {}, ["| scene | paths | covered | median bar / RMS error |", "|---|---|---|---|"]
    for name, scene in {**scenes(), **others()}.items():
        if name in scenes():
            curves[name] = curve(scene)
            errors = "  ".join(f"{n}: {e:.3%}" for n, e in zip(COUNTS, curves[name]))
            print(f"{name}: paths^{slope(curves[name]):.2f}   {errors}", flush=True)
        references = [light(scene, asked(scene, WIDE[1]), WIDE[0], 1000 + k) for k in (0, 1)]
        for paths in (16, 32, 64, 256):
            covered, ratio = bars(scene, paths, references)
            lines.append(f"| {name} | {paths} | {covered:.1%} | {ratio:.2f} |")
            print(lines[-1], flush=True)
    draw(curves)
    (IMAGES / "convergence_table.md").write_text("\n".join(lines) + "\n")
    print(f"{sum(os.times()[:2]):.0f} s of CPU")


if __name__ == "__main__":
    main()
