"""What a cluster costs: ``python benchmarks/workers.py [--paths N] [--rounds N]``.

The same run by this process alone with one thread, by one worker and by two, in turn. Efficiency is the time alone over
the time of the workers times their number, the quickest of several rounds of each; on a machine that does other things
as well, the ratio of processor seconds, of this process and all workers, is what can be trusted. The overhead of a
piece of work is that of pieces that compute nothing, with the targets and answers of one of usual size.
"""

import argparse
import time
from collections import defaultdict
from contextlib import ExitStack

import numpy as np

import illumgrid as ig
from illumgrid.cluster import cluster
from illumgrid.grid.channels import GREY
from illumgrid.samplers.direct import Direct
from illumgrid.transport.walk import Answer

PIECES, ROWS = 200, 4096


def ball(n):
    x = np.indices((n, n, n)).reshape(3, -1).T * (2 / (n - 1)) - 1
    return ig.Volume((1.2 - np.linalg.norm(x, axis=1)).reshape(n, n, n))


def nothing(work):
    """An answer of usual size to a piece of work."""
    n = len(work[0])
    light = np.zeros((2, n, 1), np.float32)
    return Answer(*light, np.zeros(n, np.int32), GREY, 0.0)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paths", type=int, default=128)
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    scene = ig.Scene.sky(ball(48), range=(0.3, 0.9))
    backend = ig.backend("numba", threads=1)
    options = {"grid": 48, "paths": asked.paths, "bounces": 4, "backend": backend, "judge": False}
    specs = [ig.GridSpec.over(scene.fields[0].volume, 48)]
    (queries, *_) = Direct().queries(scene, specs, 0)
    found, bits = defaultdict(list), set()
    with ExitStack() as stack:
        ways = {"this process": map}
        for count in (1, 2):
            ways[f"workers: {count}"] = stack.enter_context(cluster(count))[0]
        for _ in range(asked.rounds):
            for name, way in ways.items():
                before = spent(way)
                light = ig.run(scene, map=way, **options)
                found[name].append((light.recipe["seconds"]["backend"], spent(way) - before))
                bits.add(light.grids[0].light.tobytes())
        for count in (1, 2):
            way = ways[f"workers: {count}"]
            list(way(nothing, [(queries[:ROWS], range(32))] * 4))
            begun, cpu = time.perf_counter(), spent(way)
            list(way(nothing, [(queries[:ROWS], range(32))] * PIECES))
            wall, cpu = (time.perf_counter() - begun) / PIECES * 1e3, (spent(way) - cpu) / PIECES * 1e3
            print(f"workers: {count}: a piece that computes nothing takes {wall:.1f} ms, {cpu:.1f} ms of processors")
    assert len(bits) == 1, "other bits"
    alone = np.min(found["this process"], axis=0)
    for name, seconds in found.items():
        count = int(name[-1]) if name[-1].isdigit() else 1
        wall, cpu = np.min(seconds, axis=0)
        print(f"{name}: {wall:.2f} s of light, efficiency {alone[0] / (wall * count):.2f}; ", end="")
        print(f"{cpu:.2f} s of processors for the run, {alone[1] / cpu:.2f}")


def spent(way):
    """Processor seconds of this process and the workers so far."""
    workers = way.client.run(time.process_time).values() if way is not map else ()
    return time.process_time() + sum(workers)


if __name__ == "__main__":
    main()
