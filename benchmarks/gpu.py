"""A graphics card beside two processor cores: 256³ field and nodes, 32 paths, in one run of under two minutes.

``python benchmarks/gpu.py [VOXELS]``, with the plugin illumgrid-cuda installed. Two cores light a share of the nodes,
drawn at random, which the card lights as well: seconds are compared, and the light. The card's memory rate is that of a
copy within its memory; what the kernels are sure to move are the worths of paths, written once and read once, so the
share said is a lower bound. ``--processor`` runs the kernels on one core, to try the script where there is no card;
``NUMBA_ENABLE_CUDASIM=1 python benchmarks/gpu.py 5`` runs it in the simulator, whose figures say nothing of a card.
"""

import sys
import time
import warnings

import numpy as np
from illumgrid_cuda import Cuda

import illumgrid as ig
from illumgrid.grid import GridSpec
from illumgrid.transport.samples import join_queries
from illumgrid.transport.tracer import prepare

PATHS, BOUNCES, SHARE = 32, 4, 200_000


def field(voxels):
    """Twelve soft balls: smooth, with clefts."""
    axis = np.linspace(-1, 1, voxels, dtype=np.float32)
    total = np.zeros((voxels,) * 3, np.float32)
    for at in np.random.default_rng(0).uniform(-0.6, 0.6, (12, 3)):
        along = [np.exp(-((axis - at[a]) ** 2) / 0.08).astype(np.float32) for a in range(3)]
        total += np.einsum("i,j,k->ijk", *along)
    return ig.Volume(total, spacing=np.full(3, 2 / (voxels - 1)))


def batches(scene, size):
    """Queries on all nodes of the lattice of the voxels that a sweep can reach, so many at a time."""
    spec = GridSpec.over(scene.fields[0].volume, max(scene.fields[0].volume.shape))
    every = join_queries(list(ig.sampler("direct").queries(scene, [spec], 0)))
    return [every[first : first + size] for first in range(0, len(every), size)]


def timed(tracer, queries):
    """Seconds, and the samples."""
    begun = time.perf_counter()
    samples = tracer.solve(queries, paths=range(PATHS), bounces=BOUNCES, seed=0)
    return time.perf_counter() - begun, samples


def copy_rate():
    """Bytes a second, read and written, of a copy within the memory of the card."""
    from numba import cuda

    one, other = (cuda.device_array(1 << 28, np.uint8) for _ in range(2))
    other.copy_to_device(one)
    cuda.synchronize()
    begun = time.perf_counter()
    for _ in range(10):
        other.copy_to_device(one)
    cuda.synchronize()
    return 10 * 2 * (1 << 28) / (time.perf_counter() - begun)


def main():
    """Measure, and print."""
    warnings.simplefilter("ignore", RuntimeWarning)  # in the simulator random numbers wrap around, on purpose
    processor = "--processor" in sys.argv
    numbers = [int(word) for word in sys.argv[1:] if word.isdecimal()]
    if not processor and (cure := Cuda.available()):
        sys.exit(f"no card: {cure}")
    device = "one core" if processor else "card"
    scene = ig.Scene.sky(field(numbers[0] if numbers else 256), range=(0.3, 2.0))
    card, cores = (
        prepare(b, scene) for b in (Cuda("processor" if processor else "card"), ig.backend("numba", threads=2))
    )
    begun = time.perf_counter()
    parts = batches(scene, 1 << 20)
    print(f"asking: {time.perf_counter() - begun:.1f} s")
    some = parts[0][:1000]
    for tracer in (card, cores):
        print(f"compilation and first answer: {timed(tracer, some)[0]:.1f} s ({type(tracer).__name__})")
    seconds = sum(timed(card, part)[0] for part in parts)
    nodes = sum(map(len, parts))
    print(f"{device}: {nodes} nodes, {PATHS} paths each: {seconds:.2f} s, {nodes * PATHS / seconds:.3g} paths a second")
    if not processor:
        moved, rate = 2 * 8 * len(card.channels) * nodes * PATHS, copy_rate()
        print(
            f"memory: copies at {rate:.3g} bytes a second; at least {moved / seconds / rate:.1%} of that by the paths"
        )
    every = join_queries(parts)
    share = every[np.random.default_rng(1).permutation(nodes)[:SHARE]]
    took, same = timed(card, share)
    slow, truth = timed(cores, share)
    print(f"{len(share)} nodes: {device} {took:.2f} s, two cores {slow:.2f} s, {slow / took:.1f} times as long")
    light, other = truth.mean.astype(float), same.mean.astype(float)
    near = np.abs(light - other).max(axis=1) <= 1e-3 * light.mean()
    print(f"nodes within 1e-3: {near.mean():.3%}; mean bias {other.mean() / light.mean() - 1:+.2e}")


if __name__ == "__main__":
    main()
