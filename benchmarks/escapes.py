"""Number of paths that escape from sealed cavities: ``python benchmarks/escapes.py [--paths N] [--backend NAME ...]``.

The cavities are white and the only light is outside, so a path that carries light has leaked. Each backend and surface
traces ten million paths, divided among solids of voxel noise (reals, bytes, and four grays, which are full of plateaus
and edges) and rooms of six quads, queried everywhere and in their corners, at scales of 1e-6, 1 and 1e6, at the origin
and 1e5 extents away from it.
"""

import argparse
import time
from dataclasses import replace
from itertools import product

import numpy as np

from illumgrid.accuracy.verify import contenders
from illumgrid.field.rooms import box_around
from illumgrid.field.scene import Field, Material, Scene
from illumgrid.field.volume import Volume
from illumgrid.stages import on_level_sets
from illumgrid.transport.samples import Queries, join_queries

BOUNCES = 6
WALL = 300.0  # solid at all levels
TURN = np.array([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 3


def noises():
    random = np.random.default_rng(11)
    return {
        "reals": random.random((11, 12, 10)) * 255,
        "bytes": random.integers(0, 256, (12, 10, 11)),
        "four grays": random.integers(0, 4, (10, 11, 12)) * 85,
    }


def cave(values, scale, extents):
    """Noise in a shell of solid voxels, and queries on three of its level sets."""
    spacing = scale * np.array([1.0, 0.7, 1.9])
    origin = extents * 13 * spacing.max() * np.array([1, -1, 1])
    volume = Volume(np.pad(values.astype(np.float32), 1, constant_values=WALL), origin, spacing, TURN)
    scene = Scene.sky(volume, (1, 1, 1), (-0.5, 256.0))
    return scene, join_queries(list(on_level_sets(scene, [40.3, 85.0, 170.2], 0, points=400)))


def room(scale, extents):
    """Six walls around an almost empty field, queried at random, near their edges and in their corners."""
    values = np.zeros((3, 3, 3))
    values[1, 1, 1] = 1
    spacing = scale * np.array([1.0, 0.7, 1.6])
    volume = Volume(values, extents * scale * np.array([3.2, -3.2, 3.2]), spacing, TURN * [1, 1, -1])
    walls = tuple(replace(q, material=Material(np.ones(3))) for q in box_around(volume)[:6])
    scene = Scene((Field("empty", volume, range=(0.5, 10.0)),), walls, np.ones(3))
    random = np.random.default_rng(0)
    edge = np.array([0.0, 1e-300, 1e-17, 1e-16, 1e-12, 1e-7])
    edge = np.concatenate([edge, 1 - edge])
    shares = np.concatenate([random.random((100, 2)), random.choice(edge, (100, 2))])
    shares = np.concatenate([shares, np.stack([random.choice(edge, 60), random.random(60)], axis=1)])
    parts = []
    for number, wall in enumerate(walls, 1):
        parts.append(
            Queries(
                np.arange(len(shares), dtype=np.uint64) | np.uint64(number << 40),
                wall.corner + shares @ np.stack([wall.edge_u, wall.edge_v]),
                np.tile(wall.normal, (len(shares), 1)),
                np.full((len(shares), 1), 9.0),
                np.full(len(shares), number, np.int32),
            )
        )
    return scene, join_queries(parts)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paths", type=int, default=10_000_000)
    parser.add_argument("--backend", action="append", help="such as numba:mesh; by default all available")
    asked = parser.parse_args()
    wrong = 0
    for name, backend in contenders().items():
        if name == "reference" or (asked.backend and name not in asked.backend):
            continue
        places = list(product((1e-6, 1.0, 1e6), (0.0, 1e5)))
        cases = [(f"{kind}, scale {s:g}, {e:g} extents away", cave(values, s, e))
                 for kind, values in noises().items() for s, e in places]  # fmt: skip
        cases += [(f"room, scale {s:g}, {e:g} extents away", room(s, e)) for s, e in places]
        total = escaped = lost = 0
        begun = time.perf_counter()
        for case, (scene, queries) in cases:
            count = -(-asked.paths // (len(cases) * len(queries)))
            answer = backend.solve(scene, queries, paths=range(count), bounces=BOUNCES, seed=4)
            leaks = round(float((answer.mean[:, 0].astype(float) * answer.paths).sum() / np.pi))
            total, escaped = total + int(answer.paths.sum()), escaped + leaks
            lost += int((answer.paths == 0).sum())
            if leaks:
                print(f"  {name}: {leaks} escape from {case}", flush=True)
        print(f"{name}: {escaped} of {total} paths escape ({lost} queries are holes; "
              f"{time.perf_counter() - begun:.0f} s)", flush=True)  # fmt: skip
        wrong += escaped
    raise SystemExit(wrong > 0)


if __name__ == "__main__":
    main()
