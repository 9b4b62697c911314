"""Peak memory per query of a run: ``python benchmarks/memory.py [VOXELS GRID SCENE]``; the figures of `io/needs.py`."""

import sys
import threading
import time
from pathlib import Path

import numpy as np

import illumgrid as ig

PAGE = 4096


def held():
    return int(Path("/proc/self/statm").read_text("ascii").split()[1]) * PAGE


def main():
    voxels, grid, name = (sys.argv[1:] + ["32", "120", "sky"][len(sys.argv) - 1 :])[:3]
    x = np.indices((int(voxels),) * 3, dtype=np.float32) / (int(voxels) - 1) * 2 - 1
    volume = ig.Volume(1.8 - np.sqrt((x**2).sum(axis=0)))
    scene = getattr(ig.Scene, name)(volume, range=(0.05, 1.75))
    few = {"paths": 1, "bounces": 1, "judge": False}
    ig.run(scene, grid=8, **few)  # compiles
    before, peak, done = held(), [0], threading.Event()

    def watch():
        while not done.is_set():
            peak[0] = max(peak[0], held())
            time.sleep(0.002)

    watcher = threading.Thread(target=watch)
    watcher.start()
    light = ig.run(scene, grid=int(grid), **few)
    done.set()
    watcher.join()
    queries, channels = light.recipe["queries"], len(light.grids[0].channels.names)
    print(f"{queries} queries, {channels} channels: {(peak[0] - before) / queries:.0f} bytes a query")


if __name__ == "__main__":
    main()
