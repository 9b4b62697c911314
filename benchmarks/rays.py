"""Ray intersections per second: ``python benchmarks/rays.py [--json FILE]``.

The same rays, in random order and sorted by origin, are intersected in one run with the marching-cubes mesh of a level
set (`bvh`, and `embreex` if installed) and with its trilinear field (`marching`):

surface
    Cosine-distributed rays from points on one level set of a smooth 128³ field, the sum of forty Gaussians: 140,000
    triangles. One ray in eighteen hits something, but most pass close to many triangles.
cavity
    Rays in all directions from inside the sealed caves of a 64³ field of noise, 150,000 triangles: all hit something.

Each method runs on one thread, then on two, beside a bare loop that shows the current speed of the machine. The methods
take turns, so that other load affects all alike. A rate is the best of nine rounds in thread time; a ratio is the
median of the ratios within the rounds, in wall time for two threads. Setup is timed as well: the best of three, in
processor seconds (for embreex, summed over its threads).
"""

import argparse
import importlib.util
import json
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numba
import numpy as np
from scipy.ndimage import gaussian_filter

from illumgrid import Queries, Scene, Volume, isosurface
from illumgrid.backends.kernels import nearest_hit
from illumgrid.backends.mesh import bvh, traversal
from illumgrid.constants import NOWHERE
from illumgrid.field.levelset import marchable
from illumgrid.transport.samples import in_frame

RAYS, ROUNDS = 200_000, 9
ISOVALUE, WALL = 0.4, 0.31
OFF = 0.01  # voxels: offset of rays that leave a surface, for methods that only have the mesh


def gaussians(voxels=128, count=40, seed=1):
    """Sum of `count` Gaussians of random position and width on [-1, 1]³."""
    random = np.random.default_rng(seed)
    axis = np.linspace(-1, 1, voxels)
    values = np.zeros((voxels, voxels, voxels))
    for _ in range(count):
        centre, sigma = random.uniform(-0.7, 0.7, 3), random.uniform(0.08, 0.25)
        along = np.exp(-((axis[:, None] - centre) ** 2) / (2 * sigma**2))
        values += np.einsum("i,j,k->ijk", *along.T)
    return Volume(values)


def caves(voxels=64, seed=3):
    """Smooth noise in a solid shell: every cave in it is sealed."""
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(voxels, voxels, voxels)), 2.5)
    return Volume(np.pad(noise / noise.std(), 1, constant_values=9.0))


def rays_from(scene, mesh, seed=2):
    """Points on the level set, and cosine-distributed directions about their normals."""
    random = np.random.default_rng(seed)
    queries = Queries.at(scene, mesh.vertices[random.integers(0, len(mesh.vertices), RAYS)], level=ISOVALUE)
    point, normal, _ = in_frame(scene, queries)
    direction = normal + directions(random)
    return point, direction / np.linalg.norm(direction, axis=1, keepdims=True)


def rays_inside(volume, seed=9):
    """Voxels in the caves, away from the wall, and directions uniform on the sphere."""
    random = np.random.default_rng(seed)
    inside = np.argwhere(volume.values < 0.0).astype(float)
    return inside[random.integers(len(inside), size=RAYS)], directions(random)


def directions(random):
    """Unit vectors, uniform on the sphere."""
    sphere = random.normal(size=(RAYS, 3))
    return sphere / np.linalg.norm(sphere, axis=1, keepdims=True)


def race(contenders, rounds=ROUNDS, clock=time.thread_time):
    """Seconds (rounds, contenders), which take turns, after one warm-up round."""
    seconds = []
    for _ in range(rounds + 1):
        seconds.append([])
        for work in contenders:
            start = clock()
            work()
            seconds[-1].append(clock() - start)
    return np.array(seconds[1:])


def embree_scene(mesh):
    """Scene of embreex with its tree, which the first ray builds."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    embree = EmbreeScene()
    TriangleMesh(embree, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
    embree.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    return embree


@numba.njit(nogil=True, error_model="numpy", _nrt=False)
def march_rays(fields, level, origin, direction, on, t):
    """Distances through the field, without normals, which the other methods do not compute either."""
    for i in range(len(origin)):
        x, d = (origin[i, 0], origin[i, 1], origin[i, 2]), (direction[i, 0], direction[i, 1], direction[i, 2])
        t[i] = nearest_hit(fields, level, x, (0.0, 0.0, 0.0), d, on, NOWHERE, np.int64(0))[0]


def contenders(fields, tree, embree, level, on, origin, direction):
    """Calls that cast these rays, and the distances they fill; `on` is 0 where rays leave the surface, else -1."""
    n = len(origin)
    start = origin + OFF * direction if on >= 0 else origin
    along_mesh, along_field = np.zeros(n), np.zeros(n)
    work = {
        "bvh": partial(
            traversal.cast_rays, tree, bvh.stack_for(tree), start, direction, np.inf, False,
            along_mesh, np.zeros(n, np.int64), np.zeros((n, 2), np.float32),
        ),
        "marching": partial(
            march_rays, fields, np.array([level]), origin, direction, on, along_field,
        ),
    }  # fmt: skip
    if embree:
        work["embreex"] = partial(embree.run, start.astype(np.float32), direction.astype(np.float32), query="DISTANCE")
    return work, {"bvh": along_mesh, "marching": along_field}


def one_thread(work, distances):
    """Rate, ratio to embreex and share of hits of each method."""
    seconds = dict(zip(work, race(work.values()).T))
    figures = {name: {"million rays per second": RAYS / spent.min() / 1e6} for name, spent in seconds.items()}
    for name, spent in seconds.items():
        if "embreex" in seconds:
            figures[name]["times embreex"] = float(np.median(seconds["embreex"] / spent))
        if name in distances:
            figures[name]["hit"] = float(np.isfinite(distances[name]).mean())
    return figures


@numba.njit(nogil=True)
def bare_loop(count):
    """Arithmetic that touches no memory."""
    total = 0.0
    for i in range(count):
        total += (0.5 * i) % 3.0
    return total


def two_threads(halves):
    """Speedup of two threads over one for casting both halves, in wall time."""
    pairs = {name: [half[name] for half in halves] for name in halves[0]}
    pairs["bare loop"] = [partial(bare_loop, 10_000_000)] * 2
    with ThreadPoolExecutor(2) as pool:

        def one(both):
            for work in both:
                work()

        def two(both):
            list(pool.map(lambda work: work(), both))

        ways = [partial(way, both) for both in pairs.values() for way in (one, two)]
        seconds = race(ways, clock=time.perf_counter)
    return dict(zip(pairs, np.median(seconds[:, ::2] / seconds[:, 1::2], axis=0).tolist()))


def measure(scene, mesh, level, on, origin, direction):
    """All measurements for one scene."""
    volume = scene.fields[0].volume
    builds = {
        "bricks": partial(marchable, scene),
        "isosurface": partial(isosurface, volume, level),
        "bvh": partial(bvh.build, mesh.vertices, mesh.faces),
    }
    if importlib.util.find_spec("embreex"):
        builds["embreex"] = partial(embree_scene, mesh)
    seconds = race(builds.values(), 3, time.process_time).min(axis=0)
    figures = {"triangles": len(mesh.faces), "build": dict(zip(builds, seconds.tolist()))}

    fields, tree = marchable(scene), bvh.build(mesh.vertices, mesh.faces)
    embree = embree_scene(mesh) if "embreex" in builds else None
    for name, order in (("random", np.arange(RAYS)), ("sorted", np.lexsort((origin // 8).T))):
        p, d = origin[order], direction[order]
        figures[name] = one_thread(*contenders(fields, tree, embree, level, on, p, d))
    halves = [contenders(fields, tree, None, level, on, p[k::2].copy(), d[k::2].copy())[0] for k in range(2)]
    figures["two threads"] = two_threads(halves)
    return figures


def show(scene, figures):
    """Print the measurements for one scene."""
    print(f"{scene}: {figures['triangles']} triangles, {RAYS} rays")
    print(f"  {'':26} {'Mrays/s':>8} {'x embreex':>10} {'hit':>8}")
    for order in ("random", "sorted"):
        for name, found in figures[order].items():
            ratio = f"{found['times embreex']:10.2f}" if "times embreex" in found else " " * 10
            hit = f"{found['hit']:8.2%}" if "hit" in found else ""
            print(f"  {order + ', ' + name:26} {found['million rays per second']:8.2f} {ratio} {hit}")
    print("  two threads over one:      " + ", ".join(f"{name} {f:.2f}" for name, f in figures["two threads"].items()))
    print("  setup, CPU seconds:        " + ", ".join(f"{name} {f:.3f}" for name, f in figures["build"].items()))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="file for the measurements")
    asked = parser.parse_args()
    figures = {}

    scene = Scene.sky(gaussians(), range=(0.2, 0.9))
    mesh = isosurface(scene.fields[0].volume, ISOVALUE)
    figures["surface"] = measure(scene, mesh, ISOVALUE, 0, *rays_from(scene, mesh))
    show("surface", figures["surface"])

    scene = Scene.sky(caves(), range=(0.1, 0.5))
    mesh = isosurface(scene.fields[0].volume, WALL)
    figures["cavity"] = measure(scene, mesh, WALL, -1, *rays_inside(scene.fields[0].volume))
    show("cavity", figures["cavity"])

    if asked.json:
        with open(asked.json, "w") as file:
            json.dump(figures, file, indent=2)


if __name__ == "__main__":
    main()
