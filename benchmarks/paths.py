"""Whole paths per second of each backend: ``python benchmarks/paths.py [--json FILE]``.

open
    A smooth 64³ field, the sum of forty Gaussians, under a sky, 4 bounces: most paths escape soon. No lamps.
box
    The same field in the closed box with its luminaire, 6 bounces: every path has the maximum length, and samples a
    lamp at each reflection.

Queries are uniform by area on one level set, so that one mesh serves them all; its construction is timed separately.
Each backend runs on one thread and then on two; they take turns in one process. A rate is the best of the rounds, a
ratio the median of the ratios within the rounds. `enough` is the number of paths at which building a mesh breaks even.
"""

import argparse
import json
import time
from dataclasses import replace

import numpy as np
from rays import gaussians

from illumgrid.accuracy.verify import contenders
from illumgrid.backends.mesh import meshes
from illumgrid.field.scene import Scene
from illumgrid.stages import on_level_sets

LEVEL, ROUNDS, QUERIES = 0.4, 5, 2000
PATHS = {"numba:levelset": 64, "numba:mesh": 64, "embree": 16}  # reference is some 500 times slower


def timed(work):
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def measure(scene, bounces):
    """Measurements for one scene."""
    (queries,) = on_level_sets(scene, [LEVEL], 0, points=QUERIES)
    works = {}
    for name, backend in contenders().items():
        for threads in (1, 2) if name in PATHS else ():
            tracer = replace(backend, threads=threads).prepare(scene)

            def work(tracer=tracer, count=PATHS[name]):
                tracer.solve(queries, paths=range(count), bounces=bounces, seed=0)

            works[name, threads] = work
            work()
    build = min(timed(lambda: meshes.level_mesh(scene.fields[0], LEVEL)) for _ in range(3))
    seconds = np.array([[timed(work) for work in works.values()] for _ in range(ROUNDS)])
    each = dict(zip(works, seconds.T))
    rate = {key: PATHS[key[0]] * len(queries) / spent for key, spent in each.items()}
    best = rate["numba:levelset", 1]
    figures = {"mesh to build, seconds": build}
    for name in dict.fromkeys(name for name, _ in works):
        own = {"paths per second": float(rate[name, 1].max()), "times marching": float(np.median(rate[name, 1] / best))}
        if (name, 2) in rate:
            own["two threads"] = float(np.median(rate[name, 2] / rate[name, 1]))
        figures[name] = own
    gain = 1 / rate["numba:levelset", 1].max() - 1 / rate["numba:mesh", 1].max()
    figures["enough"] = build / gain if gain > 0 else float("inf")
    return figures


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="file for the measurements")
    asked = parser.parse_args()
    volume = gaussians(64)
    found = {}
    for name, scene, bounces in (
        ("open", Scene.sky(volume, range=(0.2, 0.9)), 4),
        ("box", Scene.box(volume, range=(0.2, 0.9)), 6),
    ):
        found[name] = figures = measure(scene, bounces)
        print(f"{name}: a mesh takes {figures['mesh to build, seconds']:.2f} s and breaks even after "
              f"{figures['enough']:.3g} paths")  # fmt: skip
        for backend, own in figures.items():
            if isinstance(own, dict):
                two = f", two threads {own['two threads']:.2f} times one" if "two threads" in own else ""
                rate = f"{own['paths per second']:10.3g} paths/s, {own['times marching']:.2f} x marching"
                print(f"  {backend:15} {rate}{two}")
    if asked.json:
        with open(asked.json, "w") as file:
            json.dump(found, file, indent=2)


if __name__ == "__main__":
    main()
