"""Light over meshes: loops = NumPy = kernels = Embree path by path, and the mesh against the trilinear level set."""

import gc
import math
import pickle
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import naive
import naive_mesh
from illumgrid import registry
from illumgrid.backends import embree
from illumgrid.backends.embree import Casting, Embree
from illumgrid.backends.mesh import bvh, meshes
from illumgrid.backends.mesh.meshes import LevelMesh, Meshes, level_mesh, meshed, row_groups
from illumgrid.backends.numba_ import Numba
from illumgrid.backends.reference import Reference, answer
from illumgrid.errors import BadInput
from illumgrid.field import levelset
from illumgrid.field.levelset import isosurface, marchable
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Volume
from illumgrid.grid.cache import NO_CACHE
from illumgrid.rng import stream
from illumgrid.stages import on_level_sets
from illumgrid.transport.samples import Queries, Samples, in_frame, join_queries
from rooms import MIRRORED, ROOMS, on_quads
from shapes import sampled
from transport import colored, furnace, noise, on_sets, on_voxels, rotation, waves, worth

SAME = 1e-3
MESH = Numba(surface="mesh", threads=1)
HAVE_EMBREE = Embree.available() is None
needs_embree = pytest.mark.skipif(not HAVE_EMBREE, reason="embreex is not installed")


class Brute:
    """The NumPy path loop over meshes, with a test of every triangle."""

    def solve(self, scene, queries, *, paths, bounces, seed):
        mean, m2 = np.zeros((2, len(queries), 3), np.float32)
        count = np.zeros(len(queries), np.int32)
        point, normal, level = in_frame(scene, queries)
        with np.errstate(over="ignore"):
            key = stream(np.uint64(seed), queries.id)
        for row, members in row_groups(scene, queries.level):
            own = [naive_mesh.mesh_of(scene, row, f) for f in range(len(scene.fields))]

            def cast(f, x, d, own=own):
                found = [own[f].first(a, b) or (math.inf, -1) for a, b in zip(x, d)]
                return np.array([t for t, _ in found]), np.array([face for _, face in found], np.int64)

            surfaces = Casting(meshed(marchable(scene), Meshes(scene, bvh.build).of(row)), cast)
            target = queries.target[members].astype(np.int64)
            light, spread, good = answer(
                surfaces,
                NO_CACHE,
                key[members],
                level[members],
                target,
                point[members],
                normal[members],
                paths,
                bounces,
            )
            mean[members], m2[members], count[members] = light, spread, np.where(good, len(paths), 0)
        return Samples(queries, mean, m2, count)


def small(name):
    """Scenes of a few hundred triangles."""
    if name in ROOMS:
        return ROOMS[name]()
    if name == "two":
        return colored(furnace(waves(), noise(9, (5, 6, 5), seed=5, origin=(1.3, -0.8, 2.1))))
    return colored(furnace(waves(direction=MIRRORED, spacing=(1.0, 0.7, 1.4)), inside="below"))


def questions(scene, count):
    queries = on_sets(scene, 2, 30)
    if scene.quads:
        queries = join_queries([queries, on_quads(scene, 40, back="both")])
    return queries[np.random.default_rng(0).permutation(len(queries))[:count]]


@pytest.mark.parametrize("name", ["below, mirrored", "two", "box", "lamps, mirrored"])
def test_loops_numpy_kernels_and_embree_walk_the_same_paths(name, monkeypatch):
    scene = small(name)
    queries = questions(scene, 24)
    flips = total = 0
    for path, bounces in enumerate((0, 1, 3)):
        one, answered = worth(MESH, scene, queries, path, bounces)
        others = [Brute()] + ([Embree(threads=1)] if HAVE_EMBREE else [])
        different = np.zeros(len(queries), bool)
        for other in others:
            light, also = worth(other, scene, queries, path, bounces)
            np.testing.assert_array_equal(answered, also)
            different |= np.abs(light - one).max(axis=1) > SAME * (1 + one.max(axis=1))
        with monkeypatch.context() as patch:
            holes = [naive_mesh.is_hole(scene, queries[i : i + 1]) for i in range(len(queries))]
            np.testing.assert_array_equal(answered, ~np.array(holes))
            naive_mesh.use(patch)
            for i in np.flatnonzero(answered):
                truth = naive.path_worth(scene, queries[i : i + 1], path, bounces, 0)
                different[i] |= np.abs(truth - one[i]).max() > SAME * (1 + truth.max())
        flips, total = flips + different.sum(), total + answered.sum()
    assert total > 40
    assert flips <= max(1, 0.02 * total), f"{flips} of {total} paths differ"


@needs_embree
@pytest.mark.parametrize("name", ROOMS)
def test_kernels_and_embree_agree_on_many_paths(name):
    scene = ROOMS[name]()
    queries = questions(scene, 150)
    flips = total = 0
    for path in range(5):
        one, answered = worth(MESH, scene, queries, path, 5, seed=3)
        other, also = worth(Embree(), scene, queries, path, 5, seed=3)
        np.testing.assert_array_equal(answered, also)
        flips += (np.abs(one - other).max(axis=1) > SAME * (1 + one.max(axis=1))).sum()
        total += answered.sum()
    assert flips <= 1e-2 * total, f"{flips} of {total} paths differ"


# Two surfaces stand for one level set.


def bumps(n):
    """A smooth field on [-1, 1]³ whose level sets have hills and hollows, with n voxels per side."""

    def h(x):
        return 0.8 - np.linalg.norm(x, axis=1) + 0.12 * np.sin(5 * x[:, 0]) * np.cos(4 * x[:, 1] + x[:, 2])

    return sampled(h, (n, n, n), origin=(-1, -1, -1), spacing=np.full(3, 2 / (n - 1)))


def test_mesh_and_level_set_differ_like_the_square_of_the_spacing():
    # The same random numbers: a path takes another turn where it dips under one surface and not under the other.
    # Normals of cells and of facets are off by δ = O(spacing), and (1 - cos δ)/2 of the directions dip: O(spacing²).
    where = isosurface(bumps(41), 0.13).vertices
    where = where[np.random.default_rng(0).permutation(len(where))[:1500]]
    turned = []
    for n in (9, 17, 33, 65):
        scene = colored(Scene.sky(bumps(n), range=(0.05, 0.3)))
        queries = Queries.at(scene, where, level=0.13)
        queries = queries[queries.normal.any(axis=1)]
        share, off = [], []
        for path in range(32):
            one, answered = worth(Numba(surface="mesh"), scene, queries, path, 3)
            other, also = worth(Numba(surface="levelset"), scene, queries, path, 3)
            assert (answered & also).mean() > 0.99
            difference = (one - other)[answered & also]
            share.append((np.abs(difference).max(axis=1) > 0.05).mean())
            off.append(difference.mean(axis=0))
        turned.append(np.mean(share))
        assert np.abs(np.mean(off, axis=0)).max() < turned[-1]  # no more than what turned: the rest moved by spacing²
    rate = -np.polyfit(np.log([1, 2, 4, 8]), np.log(turned), 1)[0]
    assert 1.7 < rate < 2.6, turned


# Sealed cavities.


@pytest.mark.parametrize("extents", [0.0, 1e5])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("backend", ["numba", pytest.param("embree", marks=needs_embree)])
def test_no_light_leaks_through_the_meshes_of_a_sealed_cavity(backend, scale, extents):
    # Four grays, and levels at and next to them: vertices of the mesh crowd at voxels. Mirrors all over, light outside.
    spacing = scale * np.array([1.0, 0.7, 1.9])
    values = np.random.default_rng(11).integers(0, 4, (6, 7, 8))
    shell = np.pad(values, 1, constant_values=300)
    place = {"origin": extents * 9 * spacing.max() * np.array([1, -1, 1]), "spacing": spacing, "direction": rotation()}
    scene = Scene.sky(Volume(shell, **place), (1, 1, 1), (-0.5, 256.0))
    queries = join_queries(list(on_level_sets(scene, [1.3, 2.0, 2.001], 0, points=150)))
    stage = MESH if backend == "numba" else Embree(threads=1)
    answer = stage.solve(scene, queries, paths=range(50), bounces=6, seed=4)
    assert answer.paths.sum() > 20_000
    assert not answer.mean.any(), f"{answer.mean.any(axis=1).sum()} of {len(queries)} queries see the sky"


# Groups, cache, limit.


def test_an_answer_does_not_depend_on_the_batch():
    scene = small("two")
    queries = join_queries(
        [on_sets(scene, 3, 20), replace(on_sets(scene, 4, 15), id=np.arange(999, 1119, dtype=np.uint64))]
    )
    close = replace(queries, level=queries.level + 3e-7 * np.ptp(scene.fields[0].range))
    queries = join_queries([queries, replace(close, id=close.id + np.uint64(1 << 50))])
    whole = MESH.solve(scene, queries, paths=range(8), bounces=3, seed=0)
    order = np.random.default_rng(1).permutation(len(queries))
    parts = [Numba(surface="mesh", threads=2).solve(scene, queries[o], paths=range(8), bounces=3, seed=0)
             for o in np.array_split(order, 5)]  # fmt: skip
    np.testing.assert_array_equal(np.concatenate([p.mean for p in parts]), whole.mean[order])
    np.testing.assert_array_equal(np.concatenate([p.paths for p in parts]), whole.paths[order])
    assert len(list(row_groups(scene, queries.level))) <= 14


def test_meshes_are_built_once_kept_while_there_is_room_and_go_with_their_tracer(monkeypatch):
    kept = MESH.prepare(small("below, mirrored")).meshes
    (one,) = kept.of(np.array([0.25]))
    assert kept.of(np.array([0.25])) == [one]
    assert isinstance(one, LevelMesh) and one.size > 0
    monkeypatch.setattr(meshes, "ROOM", 2 * one.size)
    others = [kept.of(np.array([level]))[0] for level in (0.1, 0.2, 0.3)]
    assert kept.of(np.array([0.3])) == others[-1:]
    assert kept.of(np.array([0.25])) != [one]
    gone = weakref.ref(one)
    del kept, others, one
    gc.collect()
    assert gone() is None


def test_threads_that_ask_for_one_mesh_at_once_get_the_same(monkeypatch):
    built, build = [], meshes.level_mesh
    monkeypatch.setattr(meshes, "level_mesh", lambda *key: (time.sleep(0.01), built.append(key), build(*key))[2])
    kept = MESH.prepare(small("below, mirrored")).meshes
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda level: kept.of(np.array([level]))[0], [0.25, 0.1] * 8))
    assert len(built) == len({id(mesh) for mesh in found}) == 2


@pytest.mark.parametrize("stage", [Numba(), MESH, Reference(), pytest.param("embree", marks=needs_embree)])
def test_a_tracer_is_set_up_once_and_again_in_another_process(stage, monkeypatch):
    stage = Embree() if stage == "embree" else stage
    scene = small("two")
    queries, request = on_sets(scene, 2, 20), {"paths": range(4), "bounces": 2, "seed": 1}
    whole = stage.solve(scene, queries, **request)
    tracer = stage.prepare(scene)
    copy = pickle.loads(pickle.dumps(tracer))
    laid = []
    monkeypatch.setattr(levelset, "lay_bricks", laid.append)
    for again in (tracer.solve(queries, **request), copy.solve(queries[::-1], **request)[::-1]):
        np.testing.assert_array_equal(again.mean, whole.mean)
        np.testing.assert_array_equal(again.paths, whole.paths)
    assert not laid


def test_too_many_rows_are_refused_in_one_sentence():
    scene = Scene.sky(noise(256, (9, 9, 9)), range=(20, 230))
    queries = on_voxels(scene)
    queries = replace(queries, level=queries.level + np.random.default_rng(0).random(queries.level.shape))
    with pytest.raises(BadInput, match="level sets, each of which would need a mesh; expected at most 256") as caught:
        MESH.solve(scene, queries, paths=range(1), bounces=0, seed=0)
    assert "\n" not in str(caught.value)
    assert Numba().solve(scene, queries, paths=range(1), bounces=0, seed=0).paths.any()


def test_caps_are_the_faces_on_the_border_and_look_along_an_axis():
    volume = Volume(np.tensordot([1.0, 0.3, 0.0], np.indices((6, 5, 4)), axes=1), spacing=(1.0, 0.7, 1.9))
    mesh = level_mesh(Scene.sky(volume, range=(1, 4)).fields[0], 2.25)
    flat = np.abs(mesh.facing[mesh.cap]).max(axis=1)
    np.testing.assert_array_equal(flat[flat > 0], 1.0)
    slope = np.array([1.0, 0.3 / 0.7, 0.0]) / np.hypot(1.0, 0.3 / 0.7)
    sides = mesh.facing[~mesh.cap]
    np.testing.assert_allclose(sides[np.abs(sides).any(axis=1)] @ -slope, 1.0, atol=1e-5)
    # Closed, and outward: the divergence theorem gives the volume of the solid.
    corners = mesh.vertices[mesh.faces]
    inside = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert inside == pytest.approx((5 * 4 - (2.25 * 4 - 0.3 * 8)) * 0.7 * 3 * 1.9, rel=1e-5)


def test_fields_without_a_surface_are_all_solid_or_nothing():
    scene = colored(furnace(waves(), noise(9, seed=5, origin=(40.0, 0.0, 0.0))))
    queries = on_sets(scene, 1, 20)
    queries = queries[queries.target == 0]
    for level in (-100.0, 100.0):  # the second field is solid below its level
        rows = queries.level.copy()
        rows[:, 1] = level
        asked = replace(queries, level=rows)
        one = MESH.solve(scene, asked, paths=range(16), bounces=2, seed=0)
        other = Numba(surface="levelset").solve(scene, asked, paths=range(16), bounces=2, seed=0)
        assert one.paths.all()
        assert one.mean.mean() == pytest.approx(other.mean.mean(), rel=0.05)


# The option, and the package that may not be there.


def test_the_surface_is_an_option_and_auto_marches():
    scene = small("below, mirrored")
    queries = on_sets(scene, 1, 20)
    auto, marched, mesh = (
        registry.backend("numba", surface=s).solve(scene, queries, paths=range(8), bounces=2, seed=0).mean
        for s in ("auto", "levelset", "mesh")
    )
    np.testing.assert_array_equal(auto, marched)
    assert (mesh != marched).any()
    with pytest.raises(BadInput, match="expected 'auto', 'levelset' or 'mesh'"):
        Numba(surface="voxels")


def test_without_embreex_the_backend_says_what_to_do(monkeypatch):
    monkeypatch.setattr(embree.importlib.util, "find_spec", lambda name: None)
    assert "pip install embreex" in Embree.available()
    with pytest.raises(BadInput, match="pip install embreex"):
        registry.backend("embree")


@needs_embree
def test_embree_does_not_depend_on_threads_and_refuses_fewer_than_none():
    scene = small("two")
    queries = on_sets(scene, 2, 700)
    one, two = (Embree(threads=t).solve(scene, queries, paths=range(2), bounces=2, seed=0) for t in (1, 2))
    np.testing.assert_array_equal(one.mean, two.mean)
    with pytest.raises(BadInput, match="threads"):
        Embree(threads=-1)
    assert not len(Embree().solve(scene, queries[:0], paths=range(2), bounces=2, seed=0))


@pytest.mark.plain
def test_far_rays_come_near_first():
    x = np.array([[0.5, 0, 0], [9, 0, 0], [9, 0, 0], [9, 9, 0], [0, 0, -50.0]])
    d = np.array([[1, 0, 0], [-1, 0, 0], [1, 0, 0], [0, -1.0, 0], [0, 0, 2.0]])
    np.testing.assert_allclose(embree.near_enough(x, d), [0, 7.5, math.inf, math.inf, 24.25])


@pytest.mark.plain
def test_a_few_paths_over_a_mesh_are_those_of_numpy():
    scene = ROOMS["lamps"]()
    queries = questions(scene, 12)
    for path, bounces in enumerate((0, 2)):
        one, answered = worth(MESH, scene, queries, path, bounces)
        other, also = worth(Brute(), scene, queries, path, bounces)
        np.testing.assert_array_equal(answered, also)
        assert (np.abs(one - other).max(axis=1) > SAME * (1 + one.max(axis=1))).sum() <= 1
