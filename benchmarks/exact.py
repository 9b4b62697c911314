"""Error against time of (a) a lookup, (b) a resting picture, its rays ending in the grid, (c) plain path tracing.

The same kernels trace the same visible points of a view that no run has seen. Errors are relative root mean squares of
the irradiance over the pixels, against paths of every length from other seeds; half the difference of two such
references is their own error, whose square is taken off. Seconds are those of all processors, scaled to a picture of
640 x 480. Also: seconds to a half and a tenth of the lookup's error; FLIP of the pictures against the converged one;
what residual paths would bring, which go on where the others end and pay the difference; and, with many rays in a small
picture, what is left of the error without noise: the mean product of the errors of two independent pictures, each
against a reference of its own.

    python benchmarks/exact.py [--only NAME] [--out FOLDER]
"""

import argparse
import json
import time
from itertools import pairwise
from pathlib import Path

import numpy as np

import illumgrid as ig
from illumgrid.field.filters import smooth
from illumgrid.show import fit_camera, render
from illumgrid.show.engines import software
from illumgrid.show.exact import Exact, Gathering, looked_up, steps_to, tracer_of
from illumgrid.show.picture import _shown

VOLUMES = Path("/data")
SIZE = 128, 96
SMALL = 64, 48, 4096
"""Pixels, and rays from each, at which errors are taken for converged; the reference has four times as many."""
TRUTH = 512
FULL = 640 * 480


def scenes(volumes):
    """Three scenes: a smooth field under the sky, a brain smoothed by a voxel, and a field in the box."""
    yield "neghip", lambda: ig.Scene.sky(ig.read_volume(volumes / "neghip.nrrd")), 64
    brain = lambda: smooth(ig.read_volume(volumes / "stroke_T1.nii.gz"), 1.0)  # noqa: E731
    yield "brain", lambda: ig.Scene.sky(brain(), range=(60, 110)), 112
    yield "box", lambda: ig.Scene.box(ig.read_volume(volumes / "nucleon.nrrd")), 48


def seen(light, exact, size=SIZE):
    """What gathers for the view, and its first hits."""
    row = light.scene.levels(0.37)[0]
    shown = _shown(light, None, float(row[0]), False, False, 0.0)
    camera = fit_camera(light.scene, row, size[0] / size[1], None if light.scene.quads else (215.0, 25.0))
    made = Gathering(shown, camera, *size, exact)
    return made, software.first_hits(
        shown, camera.eye, software.directions_of(camera, size[0], range(size[1]), size[1])
    )


def by_pixel(hits, pixel, light):
    """Irradiance in the mean over the sub-samples (p, 3) of each pixel that shows one surface."""
    number = np.where(hits.what == 0, hits.number, hits.number)
    groups = pixel * (number.max() + 1) + number
    lit = np.concatenate([hits.lit(k) for k in range(number.max() + 1)])
    _, inverse, many = np.unique(groups[lit], return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(inverse, light[lit, c]) / many for c in range(3)], axis=1)
    return mean[many == software.SIDE**2]


def gathered(light, exact, seed_shift=0):
    """Pictures after each step: (rays, seconds of all processors so far, irradiance by pixel)."""
    made, hits = seen(light, exact)
    made.__dict__["seed"] = made.seed + seed_shift
    made.trust  # noqa: B018  compiled, and its trial rays traced
    total, count = np.zeros((len(hits.what), 3), np.float32), np.zeros(len(hits.what), np.int32)
    made.gather(hits, 0, [(0, 1)], total.copy(), count.copy())
    low, spent = 0, 0.0
    for high in steps_to(exact.paths):
        begun = time.process_time()
        pixel = made.gather(hits, 0, [(low, high)], total, count)
        spent += time.process_time() - begun
        yield high, spent, by_pixel(hits, pixel, made.blended(hits, pixel, total, count))
        low = high


def converged(light):
    """Relative errors of the lookup, of many rays, and of what is left of these without noise; and their bias."""
    *size, rays = SMALL

    def found(full, rays, shift):
        made, hits = seen(light, Exact(rays, full), size)
        made.__dict__["seed"] = made.seed + shift
        total, count = np.zeros((len(hits.what), 3), np.float32), np.zeros(len(hits.what), np.int32)
        pixel = made.gather(hits, 0, [(0, rays)], total, count)
        alone = Gathering(made.shown, made.camera, *size, Exact(rays, True))  # no lookup in the blend
        return made, hits, pixel, by_pixel(hits, pixel, alone.blended(hits, pixel, total, count))

    (*_, one), (*_, other) = (found(True, 2 * rays, 2000 + k) for k in range(2))
    (made, hits, pixel, first), (*_, second) = (found(False, rays, k + 1) for k in range(2))
    lookup, mean = by_pixel(hits, pixel, looked_up(made.shown, hits)[0]), (one + other).mean() / 2

    def off(this, that):
        square = ((this - one) * (that - other)).mean()
        return float(np.sign(square) * np.sqrt(abs(square)) / mean)

    return {
        "rays": rays, "lookup": off(lookup, lookup), "error": off(first, first), "left": off(first, second),
        "bias": float((first + second - one - other).mean() / 2 / mean),
    }  # fmt: skip


def measure(name, scene, grid, paths):
    """The table of one scene."""
    scene = scene()
    begun = time.process_time()
    light = ig.run(scene, grid=grid, paths=32, seed=0)
    row = {"scene": name, "run": time.process_time() - begun, "bounces": light.recipe["bounces"]}
    one, other = (list(gathered(light, Exact(TRUTH, True), 1000 + k))[-1][2] for k in range(2))
    truth, noise = (one + other) / 2, np.square((one - other) / 2).mean()

    def error(found):
        square = np.square(found - truth).mean()
        return float(np.sqrt(max(square - noise, 0.0)) / truth.mean()), float((found - truth).mean() / truth.mean())

    made, hits = seen(light, Exact(1))
    pixel = np.arange(len(hits.what))
    y, x = np.divmod(pixel, SIZE[0] * software.SIDE)
    pixel = y // software.SIDE * SIZE[0] + x // software.SIDE
    begun = time.process_time()
    found = looked_up(made.shown, hits)[0]
    scale = FULL / (SIZE[0] * SIZE[1])
    row["lookup"] = {"seconds": (time.process_time() - begun) * scale, "error": error(by_pixel(hits, pixel, found))}
    row["truth"] = float(np.sqrt(noise) / truth.mean())
    row["trust"] = made.trust.tolist()
    for kind, exact in (("resting", Exact(paths)), ("path tracing", Exact(256, True))):
        row[kind] = [
            {"rays": rays, "seconds": seconds * scale, "error": error(found)}
            for rays, seconds, found in gathered(light, exact)
        ]
        row[f"{kind}, seconds to"] = {s: reached(row[kind], s * row["lookup"]["error"][0]) for s in (0.5, 0.1)}
    row["residual"] = residual(made, hits, truth.mean())
    row["FLIP"] = flip(made, row["resting"])
    row["converged"] = converged(light)
    return row


def reached(steps, error):
    """Seconds at which an error is reached, along straight lines in logarithms; None if it is not."""
    for before, after in pairwise(steps):
        e, f = np.log([x["error"][0] for x in (before, after)])
        s, t = np.log([x["seconds"] for x in (before, after)])
        if f <= np.log(error) < e:
            return float(np.exp(s + (t - s) * (e - np.log(error)) / (e - f)))
    return steps[0]["seconds"] if steps[0]["error"][0] <= error else None


def residual(made, hits, mean):
    """What going on brings, path by path: mean and standard deviation over the mean light, and seconds of both."""
    rows = np.concatenate([hits.lit(k) for k in range(made.surfaces)])[::2]
    asked, found, spent = made.asked(hits, rows, np.arange(len(rows), dtype=np.uint64)), [], []
    for full in (False, True):
        solve, _ = tracer_of(made.shown.light, full)
        solve(made.asked(hits, rows[:8], np.arange(8, dtype=np.uint64)), range(1), 5)
        begun = time.process_time()
        found.append([solve(asked, range(k, k + 1), 5)[0].astype(float) for k in range(8)])
        spent.append(time.process_time() - begun)
    short, whole = np.array(found) / mean
    more = whole - short
    spread = np.square(more - more.mean(axis=0)).mean() * 8 / 7
    ray = np.square(short - short.mean(axis=0)).mean() * 8 / 7
    return {"bias": float(-more.mean()), "deviation": float(np.sqrt(spread)), "of a ray": float(np.sqrt(ray)),
            "seconds": spent}  # fmt: skip


def flip(made, steps):
    """FLIP of the lookup, and of as many rays as two processors trace in 10 s at 640 x 480; against the converged."""
    import flip_evaluator

    rays = max(1, int(20.0 * steps[-1]["rays"] / steps[-1]["seconds"]))
    options = {"isovalue": float(made.shown.row[0]), "width": SIZE[0], "height": SIZE[1], "camera": made.camera}
    kinds = {"truth": Exact(TRUTH, True), "lookup": None, "after 10 s": Exact(rays)}
    drawn = {
        name: render(made.shown.light, exact=exact, **options).astype(np.float32) / np.float32(255)
        for name, exact in kinds.items()
    }
    truth = drawn.pop("truth")
    return {"rays": rays} | {
        name: float(flip_evaluator.evaluate(truth, one, "LDR", applyMagma=False)[1]) for name, one in drawn.items()
    }


def chart(rows, file):
    """Error against seconds of all processors, a panel for each scene."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(rows), figsize=(3.4 * len(rows), 3.1), sharey=True, layout="constrained")
    for ax, row in zip(np.atleast_1d(axes), rows):
        for kind, color, mark in (("resting", "#0072b2", "o"), ("path tracing", "#d55e00", "s")):
            x, y = zip(*((step["seconds"], 100 * step["error"][0]) for step in row[kind]))
            ax.plot(x, y, color=color, marker=mark, ms=4, label=f"{kind} picture" if kind == "resting" else kind)
        ax.axhline(100 * row["lookup"]["error"][0], color="0.4", ls="--", label="lookup")
        ax.axhline(10 * row["lookup"]["error"][0], color="0.7", ls=":", label="a tenth of it")
        ax.set(xscale="log", yscale="log", title=row["scene"], xlabel="processor seconds at 640 x 480")
    np.atleast_1d(axes)[0].set_ylabel("relative RMSE, %")
    np.atleast_1d(axes)[0].legend(fontsize=8)
    figure.savefig(file, dpi=110)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--volumes", type=Path, default=VOLUMES)
    parser.add_argument("--only")
    parser.add_argument("--paths", type=int, default=1024)
    parser.add_argument("--out", type=Path, default=Path("exact.json"))
    parser.add_argument("--chart", nargs="+", type=Path, metavar="JSON", help="draw what was measured; PNG last")
    given = parser.parse_args()
    if given.chart:
        chart([row for file in given.chart[:-1] for row in json.loads(file.read_text())], given.chart[-1])
        return
    rows = []
    for name, scene, grid in scenes(given.volumes):
        if given.only in (None, name):
            rows.append(measure(name, scene, grid, given.paths))
            print(json.dumps(rows[-1]), flush=True)
    given.out.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
