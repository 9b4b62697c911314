"""Time, memory and error of the interpolators: ``python benchmarks/interpolators.py [--samples N] [--nodes N]``.

All fill the same grid from the same samples of a light that is known everywhere: on 24 concentric spheres, the level
sets that a sampler would visit, with noise of 2 % or none. The error is that of lookups at random points between the
spheres. Each interpolator runs in its own process, whose peak memory is reported, after a small fill that triggers
compilation. Processor seconds are summed over all threads.

``--scipy`` also times SciPy's `RBFInterpolator`, with the same neighbours on a part of the nodes.
"""

import argparse
import multiprocessing
import resource
import time

import numpy as np

from illumgrid import GridSpec, Queries, Samples, interpolator
from illumgrid.grid import Nodes

SPHERES, NOISE = 24, 0.02


def light(points):
    """Smooth light (n,) about 2, with waves of a third of the box."""
    x, y, z = 3 * np.pi * points.T
    return 2 + np.sin(x) * np.cos(y + 1) * np.sin(z + 2) + 0.5 * np.cos(x + y + z)


def on_spheres(count, nodes, noise):
    """Samples of the light on spheres of radius 0.1 to 0.5 around the centre of the unit box, uniform by area."""
    random = np.random.default_rng(0)
    radii = np.linspace(0.1, 0.5, SPHERES)
    which = random.choice(SPHERES, count, p=radii**2 / (radii**2).sum())
    normal = random.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    points = 0.5 + radii[which, None] * normal
    mean = np.repeat((light(points) * (1 + noise * random.normal(size=count)))[:, None], 3, axis=1).astype(np.float32)
    queries = Queries(
        np.arange(count, dtype=np.uint64), points * (nodes - 1), normal, radii[which, None], np.zeros(count, np.int32)
    )
    m2 = (4 * 3 * (noise * mean) ** 2).astype(np.float32)
    return Samples(queries, mean, m2, np.full(count, 4, np.int32))


def points_between(nodes):
    """Points (n, 3) between the innermost and the outermost sphere, in the unit box and in the grid."""
    random = np.random.default_rng(1)
    points = random.random((100_000, 3))
    distance = np.linalg.norm(points - 0.5, axis=1)
    points = points[(distance > 0.12) & (distance < 0.48)]
    return points, points * (nodes - 1)


def measure(name, count, nodes, noise, pipe):
    """Fill once, in this process, and send the measurements."""
    stage = interpolator(name)
    stage.fill(on_spheres(2000, 12, noise), Nodes(GridSpec((12, 12, 12)), None))  # no stage here reads the field
    samples, spec = on_spheres(count, nodes, noise), GridSpec((nodes,) * 3)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    wall, busy = time.perf_counter(), time.process_time()
    grid = stage.fill(samples, Nodes(spec, None))
    wall, busy = time.perf_counter() - wall, time.process_time() - busy
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    at, place = points_between(nodes)
    miss = grid.lookup(place)[:, 0] - light(at)
    pipe.send((wall, busy, before, peak, np.sqrt(np.mean(miss**2)) / light(at).mean(),
               np.median(np.abs(miss)) / light(at).mean(), float((grid.support == 0).mean())))  # fmt: skip


def scipy_seconds(count, nodes, part=20_000):
    """Seconds that SciPy's local splines would take for all nodes, extrapolated from a part of them."""
    from scipy.interpolate import RBFInterpolator

    samples = on_spheres(count, nodes, 0.0)
    spline = RBFInterpolator(samples.queries.point, samples.mean, neighbors=16, kernel="linear", degree=1)
    some = samples.queries.point[:part] + 0.3
    start = time.perf_counter()
    spline(some)
    return (time.perf_counter() - start) / part * nodes**3


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--nodes", type=int, default=128)
    parser.add_argument("--scipy", action="store_true")
    asked = parser.parse_args()
    spawn = multiprocessing.get_context("spawn")
    print(f"{asked.samples} samples on {SPHERES} spheres, {asked.nodes}³ nodes")
    for noise in (0.0, NOISE):
        print(f"noise {noise:.0%}:")
        for name in ("nearest", "splat", "rbf"):
            ours, theirs = spawn.Pipe()
            child = spawn.Process(target=measure, args=(name, asked.samples, asked.nodes, noise, theirs))
            child.start()
            wall, busy, before, peak, rmse, median, holes = ours.recv()
            child.join()
            print(f"  {name:8} {wall:6.1f} s, {busy:6.1f} CPU s  peak {peak:5.0f} MB, {before:4.0f} before   "
                  f"relative RMSE {rmse:.4f}, median {median:.4f}   holes {holes:.1%}", flush=True)  # fmt: skip
    if asked.scipy:
        print(f"  RBFInterpolator, neighbors=16: about {scipy_seconds(asked.samples, asked.nodes):.0f} s")


if __name__ == "__main__":
    main()
