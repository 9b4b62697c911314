"""How many rays a second the marching kernel follows, on one thread: ``python benchmarks/marching.py [--json FILE]``.

Cosine-distributed rays from points on one level set of a smooth 128³ field (the sum of forty Gaussians), in random
order and sorted by origin; beside them, where embreex is installed, the same rays against the marching-cubes mesh of
that level set. Each figure is the best of seven repeats of thread time after a warm-up, in one process.
"""

import argparse
import importlib.util
import json
import time
from functools import partial

import numpy as np

from illumgrid import Queries, Scene, Volume, isosurface
from illumgrid.backends.kernels import cast_rays
from illumgrid.levelset import in_frame, marchable

RAYS, ISOVALUE = 200_000, 0.4


def gaussians(voxels=128, count=40, seed=1):
    """Sum of `count` Gaussians of random place and width on -1 to 1."""
    random = np.random.default_rng(seed)
    axis = np.linspace(-1, 1, voxels)
    values = np.zeros((voxels, voxels, voxels))
    for _ in range(count):
        centre, sigma = random.uniform(-0.7, 0.7, 3), random.uniform(0.08, 0.25)
        along = np.exp(-((axis[:, None] - centre) ** 2) / (2 * sigma**2))
        values += np.einsum("i,j,k->ijk", *along.T)
    return Volume(values)


def rays(scene, seed=2):
    """Points on the level set, and cosine directions about their normals."""
    random = np.random.default_rng(seed)
    mesh = isosurface(scene.fields[0].volume, ISOVALUE)
    queries = Queries.at(scene, mesh.vertices[random.integers(0, len(mesh.vertices), RAYS)], level=ISOVALUE)
    point, normal, _ = in_frame(scene, queries)
    sphere = random.normal(size=(RAYS, 3))
    direction = normal + sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    return mesh, point, direction / np.linalg.norm(direction, axis=1, keepdims=True)


def rate(work):
    """Million rays a second: best of seven, warmed up."""
    work()
    seconds = []
    for _ in range(7):
        start = time.thread_time()
        work()
        seconds.append(time.thread_time() - start)
    return RAYS / min(seconds) / 1e6


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", help="write the figures here")
    scene = Scene.sky(gaussians(), range=(0.2, 0.9))
    fields = marchable(scene)
    mesh, point, direction = rays(scene)
    order = np.lexsort((point // 8).T)
    t, what, field = np.zeros(RAYS), np.zeros(RAYS, np.int64), np.zeros(RAYS, np.int64)
    normal, level = np.zeros((RAYS, 3)), np.array([ISOVALUE])
    figures = {}

    for name, rows in (("random", np.arange(RAYS)), ("sorted", order)):
        p, d = point[rows].copy(), direction[rows].copy()
        figures[f"marching, {name}"] = rate(partial(cast_rays, fields, level, p, d, 0, t, field, what, normal))
        if importlib.util.find_spec("embreex"):
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene

            embree = EmbreeScene()
            TriangleMesh(embree, mesh.triangles.astype(np.float32))
            start, along = (p + 0.01 * d).astype(np.float32), d.astype(np.float32)
            figures[f"embreex, {name}"] = rate(partial(embree.run, start, along))
    print(f"{len(mesh.faces)} triangles, {RAYS} rays, one thread; million rays a second")
    for name, figure in figures.items():
        print(f"  {name:20} {figure:.2f}")
    if path := parser.parse_args().json:
        with open(path, "w") as file:
            json.dump(figures, file, indent=2)


if __name__ == "__main__":
    main()
