"""Loops, NumPy and compiled kernels trace the same paths: naive = reference = numba, path by path."""

import math
from collections import Counter

import numpy as np
import pytest

import naive
from illumgrid.backends.numba_ import Numba
from illumgrid.backends.reference import Reference
from illumgrid.field.scene import Field, Material, Scene
from illumgrid.field.volume import Volume
from transport import ALBEDO, EMISSION, colored, everywhere, furnace, noise, rotation, waves, worth

SAME = 1e-6  # of π, on irradiance: a path that takes another turn is off by far more
PLACED = {"origin": (3.0, -4.0, 5.0), "spacing": (1.0, 0.7, 1.9)}


def far(volume):
    """The same volume 1e5 of its extents from the world's origin, along every axis."""
    extent = (np.array(volume.shape) - 1) * volume.spacing
    return Volume(volume.values, 1e5 * extent.max() * np.array([1, -1, 1]), volume.spacing, volume.direction)


def two_fields():
    """Lattices that differ and overlap, the second solid below its level."""
    other = noise(9, (5, 7, 4), seed=5, origin=(1.3, -0.8, 2.1), spacing=(1.3, 0.6, 0.9))
    return furnace(noise(8, (5, 5, 6), spacing=(0.9, 1.1, 0.8)), other)


def two_nodes_shared():
    """Lattices whose voxels coincide, a mirrored frame, both sides of one plane solid."""
    axes = rotation() @ np.diag([1.0, 1.0, -1.0])
    here = noise(8, (5, 4, 5), direction=axes, origin=(1.0, 2.0, 3.0))
    there = noise(8, (4, 5, 5), seed=3, direction=axes, origin=here.origin + axes @ [2.0, -1.0, 1.0])
    return furnace(here, there)


SCENES = {
    "plateaus": lambda: furnace(noise(4)),
    "plateaus below": lambda: furnace(noise(4, seed=2), inside="below"),
    "eight grays": lambda: furnace(noise(8)),
    "bytes": lambda: furnace(noise(256, (10, 5, 6))),
    "bytes below": lambda: furnace(noise(256, **PLACED), inside="below"),
    "anisotropic": lambda: furnace(noise(8, (4, 9, 6), **PLACED)),
    "rotated": lambda: furnace(noise(256, direction=rotation(), **PLACED)),
    "mirrored": lambda: furnace(noise(8, direction=rotation() @ np.diag([1.0, -1.0, 1.0]), **PLACED), inside="below"),
    "far": lambda: furnace(far(noise(256, **PLACED))),
    "far and rotated": lambda: furnace(far(waves(direction=rotation(), **PLACED))),
    "smooth": lambda: furnace(waves((6, 10, 13))),  # several bricks along an axis
    "smooth below": lambda: furnace(waves(**PLACED), inside="below"),
    "smallest": lambda: furnace(noise(256, (2, 2, 2))),
    "flat": lambda: furnace(noise(256, (2, 9, 2), spacing=(0.1, 1.0, 3.0))),
    "two fields": two_fields,
    "two fields, nodes shared": two_nodes_shared,
}
FLIPS = {"plateaus": 0.005, "plateaus below": 0.005}
"""Share of paths that may differ: where a ray grazes a plateau, rounding decides. Elsewhere none."""


def differences(one, other):
    return np.abs(one - other).max(axis=-1) > SAME


@pytest.mark.parametrize("name", SCENES)
def test_loops_and_kernels_walk_the_same_paths(name, monkeypatch):
    scene = colored(SCENES[name]())
    queries = everywhere(scene)
    queries = queries[np.random.default_rng(0).permutation(len(queries))[:80]]
    kinds, first_hit = Counter(), naive.first_hit

    def watched(*args, **kwargs):
        hit = first_hit(*args, **kwargs)
        kinds["miss" if hit is None else "cap" if hit.cap else "dip" if hit.t == 0 else "set"] += 1
        return hit

    monkeypatch.setattr(naive, "first_hit", watched)
    flips = total = 0
    for path, bounces in enumerate(range(7)):
        answers, answered = worth(Numba(), scene, queries, path, bounces)
        twins, twins_answered = worth(Reference(), scene, queries, path, bounces)
        is_hole = [naive.is_hole(scene, queries[i : i + 1]) for i in range(len(queries))]
        np.testing.assert_array_equal(answered, twins_answered)
        np.testing.assert_array_equal(answered, np.logical_not(is_hole))
        rows = np.flatnonzero(answered)
        truths = np.array([naive.path_worth(scene, queries[i : i + 1], path, bounces, 0) for i in rows])
        flips += (differences(answers[rows], truths) | differences(twins[rows], truths)).sum()
        total += len(rows)
    assert total > 100
    assert flips <= FLIPS.get(name, 0) * total, f"{flips} of {total} paths differ"
    # A ray that starts within a box never meets its caps: it takes another field to do so. In a single cell the
    # gradient normal is the geometric one, and nothing dips.
    assert set(kinds) - {"dip"} == {"miss", "set"} | ({"cap"} if len(scene.fields) > 1 else set())
    assert (kinds["dip"] > 0) == (name != "smallest")


@pytest.mark.parametrize("name", SCENES)
def test_numpy_and_kernels_walk_the_same_paths(name):
    scene = colored(SCENES[name]())
    queries = everywhere(scene)
    flips = total = 0
    for path in range(7, 14):  # each number of bounces once
        one, answered = worth(Numba(), scene, queries, path, path % 7, seed=3)
        other, also = worth(Reference(), scene, queries, path, path % 7, seed=3)
        np.testing.assert_array_equal(answered, also)
        flips += differences(one, other).sum()
        total += answered.sum()
    assert flips <= FLIPS.get(name, 0) * total, f"{flips} of {total} paths differ"


def test_paths_from_a_block_are_those_of_its_faces():
    # Solid from border to border: whatever is hit from outside is a cap, and both fields have some.
    i, j, _ = np.indices((4, 5, 6))
    tall = Field("tall", Volume(i), Material(ALBEDO, EMISSION), (0.5, 2.5))
    beside = Volume(j, origin=(4.0, -2.0, 1.0), spacing=(1, 1.5, 1))
    wide = Field("wide", beside, Material(EMISSION), (0.5, 3.5), "below")
    scene = Scene((tall, wide), background=(1.0, 0.9, 0.6))
    queries = everywhere(scene)[::9]
    caps = 0
    for path in range(6):
        one, answered = worth(Numba(), scene, queries, path, 3)
        other, _ = worth(Reference(), scene, queries, path, 3)
        for i in np.flatnonzero(answered):
            truth = naive.path_worth(scene, queries[i : i + 1], path, 3, 0)
            np.testing.assert_allclose([one[i], other[i]], [truth, truth], atol=SAME)
            caps += (truth != scene.background).any()
    assert caps > 10


@pytest.mark.parametrize("name", ["bytes below", "two fields", "rotated"])
def test_moments_of_many_paths_agree(name):
    scene = colored(SCENES[name]())
    queries = everywhere(scene)[::13]
    mean, m2, count = naive.solve(scene, queries, range(2, 8), 2, 5)
    for backend in (Numba(), Reference()):
        answer = backend.solve(scene, queries, paths=range(2, 8), bounces=2, seed=5)
        np.testing.assert_array_equal(answer.paths, count)
        np.testing.assert_allclose(answer.mean, mean, atol=1e-6 * math.pi)
        np.testing.assert_allclose(answer.m2, m2, atol=1e-5)


def test_holes_are_the_same_for_all():
    scene = colored(two_nodes_shared())
    queries = everywhere(scene)
    naive_holes = [naive.is_hole(scene, queries[i : i + 1]) for i in range(len(queries))]
    for backend in (Numba(), Reference()):
        answer = backend.solve(scene, queries, paths=range(2), bounces=0, seed=0)
        np.testing.assert_array_equal(answer.paths, np.where(naive_holes, 0, 2))
        assert not answer.mean[naive_holes].any()
        assert not answer.m2[naive_holes].any()
        assert np.isinf(answer.stderr[naive_holes]).all()
    assert 0.05 < np.mean(naive_holes) < 0.95
