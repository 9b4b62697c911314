"""Rays hit a mesh where a loop over all triangles does, and never leak; BVH_RAYS=10000000 tests more rays."""

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from skimage.measure import marching_cubes

from illumgrid.backends.mesh import bvh, traversal

RAYS = int(os.environ.get("BVH_RAYS", 400_000))  # into each of ten sealed cavities
BATCH = 1_000_000


def cast(tree, origin, direction, limit=np.inf, any_hit=False):
    origin, direction = np.ascontiguousarray(origin, float), np.ascontiguousarray(direction, float)
    n = len(origin)
    t, face, uv = np.zeros(n), np.zeros(n, np.int64), np.zeros((n, 2), np.float32)
    traversal.cast_rays(tree, bvh.stack_for(tree), origin, direction, limit, any_hit, t, face, uv)
    return t, face, uv


def brute(vertices, faces, origin, direction):
    """Möller-Trumbore over all triangles in double precision: (t, face, clearance of the decision)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    e1, e2 = b - a, c - a
    t, face = np.full(len(origin), np.inf), np.full(len(origin), -1)
    for i, (o, d) in enumerate(zip(origin, direction)):
        p = np.cross(d, e2)
        det = (e1 * p).sum(1)
        with np.errstate(all="ignore"):
            s = o - a
            u = (s * p).sum(1) / det
            q = np.cross(s, e1)
            v = (d * q).sum(1) / det
            r = (e2 * q).sum(1) / det
            ok = (u >= 0) & (v >= 0) & (u + v <= 1) & (r > 0)
        if ok.any():
            face[i] = np.flatnonzero(ok)[np.argmin(r[ok])]
            t[i] = r[face[i]]
    return t, face


def unit(rng, n):
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1)[:, None]


def soup(rng, n, size=0.2):
    v = rng.uniform(-1, 1, (n, 1, 3)) + size * rng.normal(size=(n, 3, 3))
    return v.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3)


def cave(n=40, seed=3):
    """Closed mesh around cavities (index units) and points inside them, away from the wall."""
    rng = np.random.default_rng(seed)
    h = gaussian_filter(rng.normal(size=(n, n, n)), 2.5)
    h /= h.std()
    solid = np.pad(h, 1, constant_values=9.0)
    vertices, faces, _, _ = marching_cubes(solid, 0.31)
    inside = np.argwhere(solid < 0.0).astype(float)
    return vertices.astype(float), faces, inside


@pytest.fixture(scope="module")
def cavity():
    vertices, faces, inside = cave()
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 2).all()
    return vertices, faces, inside


@pytest.mark.parametrize("count,size", [(1, 0.5), (7, 0.5), (9, 0.5), (300, 0.2), (2000, 0.05), (500, 2.0)])
def test_agrees_with_brute_force_on_soups(count, size):
    rng = np.random.default_rng(count)
    v, f = soup(rng, count, size)
    o, d = rng.uniform(-1.5, 1.5, (1500, 3)), unit(rng, 1500)
    d[::2] = v[f[rng.integers(count, size=750)]].mean(1) - o[::2]
    t, face, uv = cast(bvh.build(v, f), o, d)
    want, number = brute(v, f, o, d)
    differ = face != number
    # a grazed edge may be decided otherwise in single precision; t must then agree or be one of a few
    assert differ.mean() < 2e-3
    same = ~differ & (face >= 0)
    assert same.sum() > 700
    np.testing.assert_allclose(t[same], want[same], rtol=2e-4, atol=1e-5)
    hit = v[f[face[same]]]
    w = np.concatenate([1 - uv[same].sum(1, keepdims=True), uv[same]], axis=1)
    assert (w >= -1e-6).all()
    off = np.abs((w[:, :, None] * hit).sum(1) - o[same] - t[same][:, None] * d[same])
    assert off.max() < 1e-5 * max(1, size * 10)


def test_agrees_with_brute_force_on_marching_cubes(cavity):
    v, f, inside = cavity
    rng = np.random.default_rng(1)
    o, d = inside[rng.integers(len(inside), size=300)], unit(rng, 300)
    t, face, _ = cast(bvh.build(v, f), o, d)
    want, number = brute(v, f, o, d)
    assert (face != number).sum() <= 1
    np.testing.assert_allclose(t, want, rtol=1e-4, atol=1e-3)


def test_any_hit_and_limit(cavity):
    v, f, inside = cavity
    rng = np.random.default_rng(2)
    o, d = inside[rng.integers(len(inside), size=20000)], unit(rng, 20000)
    tree = bvh.build(v, f)
    t, face, _ = cast(tree, o, d)
    assert (face >= 0).all()
    for limit in (0.0, 0.5, 3.0, 10.0):
        near, _, _ = cast(tree, o, d, limit)
        some, any_face, _ = cast(tree, o, d, limit, True)
        clear = abs(t - limit) > 1e-5
        assert ((near < np.inf) == (t < limit))[clear].all()
        assert ((any_face >= 0) == (t < limit))[clear].all()
        assert (some >= near).all()
        assert (near[near < np.inf] == t[near < np.inf]).all()


def test_axis_parallel_rays():
    # A wall of squares in each of the six directions, its edges on the rays.
    grid = np.linspace(-1, 1, 9)
    for axis in range(3):
        for sign in (-1.0, 1.0):
            a, b = np.meshgrid(grid, grid, indexing="ij")
            v = np.zeros((81, 3))
            v[:, (axis + 1) % 3], v[:, (axis + 2) % 3], v[:, axis] = a.ravel(), b.ravel(), 0.75 * sign
            i = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
            f = np.concatenate([np.stack([i, i + 1, i + 9], 1), np.stack([i + 10, i + 9, i + 1], 1)])
            o = v.copy()
            o[:, axis] = 0.0
            o = np.concatenate([o, o * 0.9 + 0.01])
            o[:, axis] = 0.0
            for zero in (0.0, -0.0):
                d = np.full(3, zero)
                d[axis] = sign
                t, face, _ = cast(bvh.build(v, f), o, np.broadcast_to(d, o.shape))
                assert (face >= 0).all()
                np.testing.assert_allclose(t, 0.75, rtol=1e-6)
                t, face, _ = cast(bvh.build(v, f), o, np.broadcast_to(-d, o.shape))
                assert (face < 0).all() and (t == np.inf).all()


def test_empty_single_and_degenerate():
    rng = np.random.default_rng(0)
    o, d = rng.uniform(-2, 2, (1000, 3)), unit(rng, 1000)
    t, face, _ = cast(bvh.build(np.zeros((0, 3)), np.zeros((0, 3), int)), o, d)
    assert (face == -1).all() and (t == np.inf).all()
    v = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0.5, 0], [0, 0, 0]])
    f = np.array([[0, 1, 2]])
    t, face, _ = cast(bvh.build(v, f), [[0.2, 0.2, 1.0]], [[0.0, 0, -2.0]])
    assert face[0] == 0 and t[0] == 0.5
    # lines and points among the triangles are never hit, and hide nothing; a mesh of one point
    f = np.array([[0, 0, 0], [0, 3, 1], [1, 3, 2], [0, 4, 0], [0, 1, 2]])
    t, face, _ = cast(bvh.build(v, f), [[0.2, 0.2, 1.0]] * 2, [[0.0, 0, -1.0], [0.0, 0, 1.0]])
    assert face.tolist() in ([4, -1], [1, -1])
    t, face, _ = cast(bvh.build(v, [[0, 0, 0]] * 20), o, d)
    assert (face == -1).all()


def test_ties_go_to_the_lowest_number():
    rng = np.random.default_rng(5)
    v, f = soup(rng, 200)
    o, d = rng.uniform(-1, 1, (3000, 3)), unit(rng, 3000)
    t, face, _ = cast(bvh.build(v, f), o, d)
    twice = np.concatenate([f, f, f])
    t2, face2, _ = cast(bvh.build(v, twice), o, d)
    assert (t == t2).all() and (face == face2).all()
    # in any order of the triangles the same surface is hit at the same t
    order = rng.permutation(200)
    t3, face3, _ = cast(bvh.build(v, f[order]), o, d)
    assert (t == t3).all() and (np.where(face3 >= 0, order[face3], -1) == face).mean() > 0.999


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("shift", [0.0, 1e5])
def test_nothing_escapes_from_a_sealed_cavity(cavity, scale, shift):
    v, f, inside = cavity
    move = shift * 40 * np.array([1.0, -0.7, 0.3])
    w = (v + move) * scale
    tree = bvh.build(w, f)
    rng = np.random.default_rng(9)
    for first in range(0, RAYS, BATCH):
        n = min(BATCH, RAYS - first)
        o = inside[rng.integers(len(inside), size=n)]
        d = unit(rng, n)
        target = f[rng.integers(len(f), size=n)]
        kind = np.arange(n) % 5
        d[kind == 1] = v[target[kind == 1, 0]] - o[kind == 1]  # a vertex
        along = rng.random(n)[:, None]
        edge = v[target[:, 0]] * along + v[target[:, 1]] * (1 - along)
        d[kind == 2] = (edge - o)[kind == 2]
        d[kind == 3] = np.eye(3)[rng.integers(3, size=(kind == 3).sum())] * rng.choice([-1, 1], ((kind == 3).sum(), 1))
        t, face, _ = cast(tree, (o + move) * scale, d)
        assert (face < 0).sum() == 0
        hit = (o + move) * scale + t[:, None] * d
        assert np.abs(np.clip(hit, w.min(0), w.max(0)) - hit).max() < 1e-5 * 40 * scale


def test_far_origins():
    # An icosphere from 1e5 extents away: as from nearby, to what the caller's doubles can tell.
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=4)
    tree = bvh.build(mesh.vertices, mesh.faces)
    rng = np.random.default_rng(4)
    d = unit(rng, 100000)
    o = unit(rng, 100000) * 0.9 - 1e5 * d
    t, face, _ = cast(tree, o, d)
    assert (face >= 0).all()
    hit = o + t[:, None] * d
    assert abs(np.linalg.norm(hit, axis=1) - 1).max() < 5e-3
    _, same, _ = cast(tree, o + (1e5 - 3) * d, d)
    assert (same == face).mean() > 0.999
    t, face, _ = cast(tree, o, -d)
    assert (face < 0).all()
    t, face, _ = cast(tree, o, d, 1e5 - 1)
    assert (face < 0).sum() > 0 and (t[face >= 0] < 1e5 - 1).all()


TWIN = """
import sys, warnings
import numpy as np
sys.path.insert(0, {folder!r})
warnings.simplefilter("error")
import test_bvh as T
np.savez(sys.argv[1], *T.answers())
"""


def answers():
    """Everything that the tree and the traversal return, for a few rays that need all of it."""
    v, f, inside = cave(12)
    rng = np.random.default_rng(0)
    o, d = inside[rng.integers(len(inside), size=200)], unit(rng, 200)
    d[:20] = np.eye(3)[rng.integers(3, size=20)]
    o[150:] += 300 * d[150:]  # far outside, and back
    d[150:] *= -1
    tree = bvh.build(v, f)
    sv, sf = soup(rng, 60)
    return [*cast(tree, o, d), *cast(tree, o, d, 2.0, True), tree.memory, *cast(bvh.build(sv, sf), o * 0.05, d)]


def test_without_numba_the_answers_are_the_same(tmp_path):
    for off in ("0", "1"):
        env = {**os.environ, "NUMBA_DISABLE_JIT": off}
        code = TWIN.format(folder=os.path.dirname(os.path.abspath(__file__)))
        subprocess.run([sys.executable, "-c", code, str(tmp_path / f"{off}.npz")], env=env, check=True)
    one, two = np.load(tmp_path / "0.npz"), np.load(tmp_path / "1.npz")
    assert (one["arr_1"] >= 0).sum() > 100
    for name in one:
        assert one[name].tobytes() == two[name].tobytes(), name


@pytest.mark.plain
def test_a_few_rays_agree_with_brute_force():
    rng = np.random.default_rng(11)
    v, f = soup(rng, 80)
    o, d = rng.uniform(-1, 1, (60, 3)), unit(rng, 60)
    o[::2] -= 40 * d[::2]  # half of them from far away
    tree = bvh.build(v, f)
    t, face, _ = cast(tree, o, d)
    want, number = brute(v, f, o, d)
    assert (face != number).sum() <= 1
    same = (face == number) & (face >= 0)
    assert same.sum() > 20
    np.testing.assert_allclose(t[same], want[same], rtol=1e-4)
    _, some, _ = cast(tree, o, d, any_hit=True)
    np.testing.assert_array_equal(some >= 0, face >= 0)


@pytest.mark.plain
def test_what_is_empty_or_flat_is_never_met():
    o, d = np.array([[0.2, 0.2, 1.0], [9.0, 9.0, 9.0]]), np.array([[0.0, 0.0, -2.0], [0.0, 1.0, 0.0]])
    for v, f in (
        (np.zeros((0, 3)), np.zeros((0, 3), int)),
        (np.ones((1, 3)), [[0, 0, 0]] * 20),
        (np.arange(9.0).reshape(3, 3), [[0, 1, 2]] * 3),
    ):
        t, face, _ = cast(bvh.build(v, f), o, d)
        assert (face == -1).all() and (t == np.inf).all()
    t, face, _ = cast(bvh.build([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 0, 1], [0, 1, 2]]), o, d)
    assert face.tolist() == [0, -1] and t[0] == 0.5
