"""The default of `run` before and now, on real volumes: ``python benchmarks/defaults.py [VOLUME...] [--old PYTHON]``.

Each volume of RANGES (`chart.py`) under a white sky; with ``--scene studio`` each volume there is, in its suggested
range and the light that `run` gives it by default. Error of the grid at points on level sets that no run visits, read
trilinearly as it is displayed, against one converged reference, and processor seconds of `run` (user and system, all
threads, kernels loaded, without reading, judging and writing). References are kept in ``--keep``, so that repeated
trials cost only their runs.

``--old PYTHON`` is the interpreter of another version of the package, whose default runs on the same points;
``--try '{"grid": 60, "paths": 8}'`` (repeatable) runs other settings of this version.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
LEVELS, POINTS, MOST_PATHS, SHARP, SEED = 40, 1200, 4096, 0.001, 77

CHILD = r"""
import inspect, json, sys, time, warnings
import numpy as np
warnings.simplefilter("ignore")
import illumgrid as ig
file, lit, limits, sigma, points, out, options = sys.argv[1:]
made = getattr(ig.Scene, lit)
options = json.loads(options)
if "density" in options:
    options["interpolator"] = ig.interpolator("bilateral", density=options.pop("density"))
volume = ig.read_volume(file)
if float(sigma):
    from scipy.ndimage import gaussian_filter
    soft = gaussian_filter(np.asarray(volume.values, np.float32), float(sigma), mode="nearest")
    volume = ig.Volume(soft, volume.origin, volume.spacing, volume.direction)
scene = made(volume, range=json.loads(limits))
per_voxel = options.pop("nodes", None)
if per_voxel:
    options["grid"] = round(per_voxel * max(volume.shape))
if "judge" in inspect.signature(ig.run).parameters:  # earlier versions judge in the command line only
    options["judge"] = False
x = np.stack(np.meshgrid(*[np.linspace(-1, 1, 16)] * 3, indexing="ij"), -1)
kind = getattr(volume, "stored", volume.values).dtype  # kernels are compiled for each type of values
small = (90 + 60 * np.sin(3 * x).prod(-1) + 30 * x[..., 0]).astype(kind)
for bounces in (2, 6, None):  # loads what is compiled, the cache among it
    ig.run(made(ig.Volume(small), range=(70, 120)), isovalues=4,
           **{**options, "paths": 2, "bounces": bounces, **({"grid": 8} if "grid" in options else {})})
busy, wall = time.process_time(), time.perf_counter()
light = ig.run(scene, isovalues=4, seed=3, **options)
busy, wall = time.process_time() - busy, time.perf_counter() - wall
light_at = light.grids[0].lookup(np.load(points))
about = {key: light.recipe.get(key) for key in ("grid", "paths", "bounces", "queries", "seconds", "interpolator")}
json.dump({"busy": busy, "wall": wall, **about, "stored": list(light.grids[0].spec.shape)}, open(out + ".json", "w"))
np.save(out + ".npy", light_at)
"""


def reference(file, lit, limits, sigma, keep):
    """Points (n, 3), their light (n, 3) and its half-difference (n, 3), computed once."""
    place = keep / f"{file.name.split('.')[0]}-{sigma:g}{'' if lit == 'sky' else '-' + lit}.npz"
    if not place.exists():
        from illumgrid import Scene, backend, read_volume
        from illumgrid.accuracy.points import unseen_on_level_sets
        from illumgrid.accuracy.reference import begin, converge
        from illumgrid.bake.bounces import enough_bounces
        from illumgrid.field.filters import smooth
        from illumgrid.transport.tracer import prepare

        volume = read_volume(file)
        scene = getattr(Scene, lit)(smooth(volume, sigma) if sigma else volume, range=limits)
        tracer = prepare(backend("numba"), scene)
        asked = unseen_on_level_sets(scene, LEVELS, POINTS, SEED)
        bounces, _ = enough_bounces(scene, tracer, SEED, 3e-4)
        exact = begin(tracer, asked, bounces, SEED)
        exact = converge(exact, SHARP, MOST_PATHS if bounces <= 16 else MOST_PATHS // 4)
        keep.mkdir(parents=True, exist_ok=True)
        np.savez(place, points=exact.queries.point, light=exact.light, off=exact.off)
    with np.load(place) as stored:
        return stored["points"], stored["light"], stored["off"]


def measured(python, file, lit, limits, sigma, exact, options):
    """Error (relative RMSE, its spread, median, bias) and what the run says about itself."""
    points, light, off = exact
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder) / "points.npy", points)
        given = [str(file), lit, json.dumps(limits), str(sigma), f"{folder}/points.npy", f"{folder}/out"]
        given.append(json.dumps(options))
        own = {k: v for k, v in os.environ.items() if k != "PYTHONPATH" or python == sys.executable}
        try:
            subprocess.run([python, "-c", CHILD, *given], check=True, env=own, capture_output=True, text=True)
        except subprocess.CalledProcessError as reason:
            sys.exit(f"{file.name} {options} failed: {reason.stderr}")
        found, about = np.load(f"{folder}/out.npy"), json.loads(Path(f"{folder}/out.json").read_text())
    miss = (found - light) / light.mean()
    square, own = (miss**2).mean(axis=1), (off**2).mean() / light.mean() ** 2
    rmse = float(np.sqrt(max(own / 9, square.mean() - own)))
    return about | {
        "rmse": rmse, "uncertain": float(square.std() / np.sqrt(len(square)) / (2 * rmse)),
        "median": float(np.median(np.sqrt(square))), "bias": float(miss.mean()), "reference": float(np.sqrt(own)),
    }  # fmt: skip


def line(m):
    """One measurement in words."""
    seconds = ", ".join(f"{k} {v:.2f}" for k, v in m["seconds"].items())
    return (
        f"{m['rmse']:7.2%} ± {m['uncertain']:.2%}, median {m['median']:.2%}, bias {m['bias']:+.2%}, "
        f"{m['busy']:6.2f} CPU s ({m['wall']:.2f} wall); {m['grid']} x {m['paths']}, {m['bounces']} bounces, "
        f"{m['interpolator']['name']}; {m['queries']} lit; {seconds}"
    )


def main():
    """Run each volume with each setting."""
    from chart import RANGES

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="beginnings of file names; by default all")
    parser.add_argument("--scene", choices=("sky", "studio"), default="sky")
    parser.add_argument("--volumes", type=Path, default=ROOT.parent / "shared" / "volumes")
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()) / "illumgrid-references")
    parser.add_argument("--old", help="Python interpreter of the version to compare with")
    parser.add_argument("--try", dest="tried", action="append", type=json.loads, default=[], metavar="OPTIONS")
    parser.add_argument("--smooth", type=float, default=0.0)
    parser.add_argument("--no-default", action="store_true", help="only the settings of --try")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    if not asked.volumes.is_dir():
        parser.error(f"there is no folder {asked.volumes}; expected --volumes and the folder of the files")
    warnings.simplefilter("ignore")
    figures = {}
    studio = {file.name: None for file in sorted(asked.volumes.glob("*.*")) if file.name != "SOURCES.md"}
    for name, limits in (RANGES if asked.scene == "sky" else studio).items():
        file = asked.volumes / name
        if not file.exists() or (asked.names and not name.startswith(tuple(asked.names))):
            continue
        exact = reference(file, asked.scene, limits, asked.smooth, asked.keep)
        runs = [(asked.old, "old default", {})] if asked.old else []
        runs += [] if asked.no_default else [(sys.executable, "default", {})]
        runs += [(sys.executable, json.dumps(options), options) for options in asked.tried]
        figures[name] = {}
        for python, label, options in runs:
            figures[name][label] = m = measured(python, file, asked.scene, limits, asked.smooth, exact, options)
            print(f"{name.split('.')[0]:14} {label}: {line(m)} (reference {m['reference']:.2%})", flush=True)
    if asked.old and not asked.no_default:
        both = [(m["old default"], m["default"]) for m in figures.values()]
        error, time = (np.exp(np.mean([np.log(b[k] / a[k]) for a, b in both])) for k in ("rmse", "busy"))
        print(f"geometric mean over {len(both)}: error {error:.2f}, seconds {time:.2f} of the old default's")
    if asked.json:
        asked.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
