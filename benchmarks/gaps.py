"""Gaps in space between a sampler's level sets: ``python benchmarks/gaps.py VOLUME LO HI [...] [--figure PNG]``.

Measures the distance from points of the object, uniform over the space that a sweep reaches, to the nearest level set
that the sampler visits, represented by the corners and centres of its triangles. `uniform` and `adaptive` use the same
number of levels. The figure shows the median and the 99th percentile of the distance against the level of the points.

``--error`` also computes the light and measures the resulting error: relative RMSE and median error of lookups at
points on isovalues that no sampler visited, drawn uniformly from the range. All samplers use the same numbers of
levels, points and paths, and the same interpolators.
"""

import argparse
import os

import numpy as np
from scipy.spatial import KDTree

from illumgrid import GridSpec, Scene, interpolator, isosurface, read_volume
from illumgrid import backend as backend_named
from illumgrid.field.filters import smooth
from illumgrid.field.scene import level_table
from illumgrid.field.volume import index_to_world, interpolate
from illumgrid.grid import Nodes
from illumgrid.samplers.adaptive import adaptive_rows
from illumgrid.stages import on_level_sets
from illumgrid.transport.samples import join_queries

POINTS, BINS = 50_000, 25


def points_within(scene, seed=0):
    """World points (n, 3), uniform over the part of the field with values in the range, and their values (n,)."""
    field = scene.fields[0]
    random, found, levels = np.random.default_rng(seed), [], []
    while sum(map(len, found)) < POINTS:
        index = random.random((POINTS, 3)) * (np.array(field.volume.shape) - 1)
        value = interpolate(field.volume, index)
        inside = (value >= field.range[0]) & (value <= field.range[1])
        found.append(index_to_world(field.volume, index[inside]))
        levels.append(value[inside])
    return np.concatenate(found)[:POINTS], np.concatenate(levels)[:POINTS]


def gaps(scene, rows, points):
    """Distance (n,), in voxels, from each point to the nearest level set of `rows`."""
    voxel = np.prod(scene.fields[0].volume.spacing) ** (1 / 3)
    meshes = [isosurface(scene.fields[0].volume, row[0]) for row in rows]
    visited = np.concatenate([part for mesh in meshes for part in (mesh.vertices, mesh.triangles_center)])
    return KDTree(visited).query(points, workers=-1)[0] / voxel


def samplers(scene, count):
    """The levels that each sampler chooses."""
    return {
        "uniform": level_table(scene, count).table,
        "adaptive, no topology": adaptive_rows(scene, count, topology=0.0),
        "adaptive": adaptive_rows(scene, count),
    }


def measure(path, limits, sigma, count):
    """Name, values of the points, and gaps of each sampler, for one volume."""
    scene = Scene.sky(smooth(read_volume(path), sigma), range=limits)
    points, level = points_within(scene)
    return (
        os.path.basename(path),
        level,
        {name: gaps(scene, rows, points) for name, rows in samplers(scene, count).items()},
    )


REFERENCE = {"paths": range(1024), "bounces": 4, "seed": 77}


def errors(scene, levels, nodes, points, paths):
    """Relative RMSE and median error of every interpolator, for the level sets of every sampler."""
    backend, spec = backend_named("numba"), GridSpec.over(scene.fields[0].volume, nodes)
    unseen = scene.levels(np.random.default_rng(5).random(12))
    asked = join_queries(list(on_level_sets(scene, unseen, 77, points=100)))
    asked = asked[asked.normal.any(axis=1)]
    truth = backend.solve(scene, asked, **REFERENCE).mean
    for sampler, rows in levels.items():
        queries = join_queries(list(on_level_sets(scene, rows, 0, specs=[spec], points=points)))
        samples = backend.solve(scene, queries, paths=range(paths), bounces=REFERENCE["bounces"], seed=0)
        found = []
        for name in ("nearest", "splat", "rbf"):
            miss = interpolator(name).fill(samples, Nodes(spec, scene.fields[0])).lookup(asked.point) - truth
            found.append(f"{name} {np.sqrt(np.mean(miss**2)) / truth.mean():.3f} / "
                        f"{np.median(np.abs(miss)) / truth.mean():.4f}")  # fmt: skip
        print(f"  {sampler:24} {len(rows)} levels, {len(queries)} queries:  " + "   ".join(found), flush=True)


def draw(results, count, file):
    """One panel per volume: median and 99th percentile of the gap against the level."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(
        1, len(results), figsize=(4.2 * len(results), 3.4), squeeze=False, layout="constrained"
    )
    for panel, (name, level, found) in zip(panels[0], results):
        edges = np.linspace(level.min(), level.max(), BINS + 1)
        bins = np.digitize(level, edges[1:-1])
        for color, sampler in (("tab:orange", "uniform"), ("tab:blue", "adaptive")):
            for style, share in (("-", 99), (":", 50)):
                line = [np.percentile(found[sampler][bins == b], share) if (bins == b).sum() > 20 else np.nan
                        for b in range(BINS)]  # fmt: skip
                what = "99th percentile" if share == 99 else "median"
                panel.plot(0.5 * (edges[1:] + edges[:-1]), line, style, color=color, label=f"{sampler}, {what}")
        panel.set(title=f"{name}, {count} levels", xlabel="isovalue of the point", ylim=(0, None))
    panels[0, 0].set_ylabel("distance to the nearest visited\nlevel set, voxels")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(file, dpi=100)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volumes", nargs="+", metavar="VOLUME LO HI", help="files, each with its range of isovalues")
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--smooth", type=float, default=1.0)
    parser.add_argument("--figure")
    parser.add_argument("--error", action="store_true")
    parser.add_argument("--nodes", type=int, default=64)
    parser.add_argument("--points", type=int, default=4000, help="on each level set")
    parser.add_argument("--paths", type=int, default=64)
    asked = parser.parse_args()
    results = []
    for path, low, high in zip(*(iter(asked.volumes),) * 3):
        name, level, found = measure(path, (float(low), float(high)), asked.smooth, asked.count)
        results.append((name, level, found))
        print(f"{name}, {asked.count} levels in {low} to {high}: distance to the nearest visited level set, voxels")
        for sampler, gap in found.items():
            print(f"  {sampler:24} mean {gap.mean():6.2f}   99th percentile {np.percentile(gap, 99):6.2f}   "
                  f"largest {gap.max():6.2f}   more than a voxel {np.mean(gap > 1):6.2%}", flush=True)  # fmt: skip
        if asked.error:
            scene = Scene.sky(smooth(read_volume(path), asked.smooth), range=(float(low), float(high)))
            errors(scene, samplers(scene, asked.count), asked.nodes, asked.points, asked.paths)
        if asked.figure:
            draw(results, asked.count, asked.figure)


if __name__ == "__main__":
    main()
