"""Walls and lamps: naive = reference = numba path by path, holes on walls, no leaks, and bars that cover."""

import math
from dataclasses import replace

import numpy as np
import pytest

import naive
from illumgrid.backends.numba_ import Numba
from illumgrid.backends.reference import Reference
from illumgrid.bake.walls import wall_queries
from illumgrid.field.rooms import box_around
from illumgrid.field.scene import Field, Material, Scene, level_table
from illumgrid.field.volume import interpolate, world_to_index
from illumgrid.transport.samples import join_queries
from rooms import NOWHERE, ROOMS, at_levels, box, empty, lamps, on_quads, painted
from transport import everywhere, noise, rotation, waves, worth

SAME = 1e-6  # of π: a path that takes another turn is off by far more
BACKENDS = {"numba": Numba(), "reference": Reference()}


def questions(scene, count, seed=0):
    """Queries on voxels and level sets, and as many on both sides of the quads."""
    solid = everywhere(scene)
    pick = np.random.default_rng(seed).choice(len(solid), count, replace=False)
    return join_queries([solid[np.sort(pick)], on_quads(scene, count, seed=seed, back="both")])


@pytest.mark.parametrize("name", ROOMS)
def test_loops_numpy_and_kernels_walk_the_same_paths(name):
    scene = ROOMS[name]()
    queries = questions(scene, 30)
    lit = 0
    for path, bounces in enumerate((0, 1, 3)):
        one, answered = worth(BACKENDS["numba"], scene, queries, path, bounces)
        other, also = worth(BACKENDS["reference"], scene, queries, path, bounces)
        holes = [naive.is_hole(scene, queries[i : i + 1]) for i in range(len(queries))]
        np.testing.assert_array_equal(answered, also)
        np.testing.assert_array_equal(answered, ~np.array(holes))
        assert answered.any()
        truth = [naive.path_worth(scene, queries[i : i + 1], path, bounces, 0) for i in np.flatnonzero(answered)]
        np.testing.assert_allclose(one[answered], truth, atol=SAME, rtol=SAME)
        np.testing.assert_allclose(other[answered], truth, atol=SAME, rtol=SAME)
        lit += (one > 0).any(axis=1).sum()
    assert lit > 20


@pytest.mark.parametrize("name", ROOMS)
def test_numpy_and_kernels_agree_on_many_paths(name):
    scene = ROOMS[name]()
    queries = questions(scene, 150, seed=1)
    many = [b.solve(scene, queries, paths=range(3, 9), bounces=6, seed=5) for b in BACKENDS.values()]
    np.testing.assert_array_equal(many[0].paths, many[1].paths)
    differ = np.abs(many[0].mean - many[1].mean).max(axis=1) > SAME * np.pi * (1 + many[1].mean.max(axis=1))
    assert differ.mean() <= (0.01 if "far" in name else 0.0)
    np.testing.assert_allclose(many[0].m2[~differ], many[1].m2[~differ], rtol=1e-4, atol=1e-4)


# Holes.


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("inside", ["above", "below"])
def test_a_texel_inside_a_solid_is_a_hole_and_one_outside_is_not(inside, backend):
    volume = waves((9, 8, 9), direction=rotation())
    field = Field("solid", volume, range=(-0.8, 0.8), inside=inside)
    right, up = volume.direction[:, 0], volume.direction[:, 2]
    through = painted(box_around(volume), 0.5)[0]
    through = replace(through, corner=through.corner + 5.2 * up + 0.1 * right, texels=(31, 29))  # the floor, lifted
    scene = Scene((field,), (through,), np.ones(3))
    (queries,) = wall_queries(scene, level_table(scene, 3))
    answer = BACKENDS[backend].solve(scene, queries, paths=range(1), bounces=1, seed=0)
    index = world_to_index(volume, queries.point)
    within = ((index >= 0) & (index <= np.array(volume.shape) - 1)).all(axis=1)
    above = interpolate(volume, index) - queries.level[:, 0]
    solid = within & ((above if inside == "above" else -above) >= 0)
    np.testing.assert_array_equal(answer.paths == 0, solid)
    assert 0.05 < solid.mean() < 0.9
    assert not answer.mean[solid].any()
    by_row = solid.reshape(3, -1).sum(axis=1)
    assert (np.diff(by_row) < 0).all() if inside == "above" else (np.diff(by_row) > 0).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_lamp_inside_a_solid_and_the_back_of_a_lamp_are_dark(backend):
    volume = noise(2, (6, 6, 6)).with_stored(np.ones((6, 6, 6)) + np.arange(6)[:, None, None] * 0.01)
    scene = Scene.box(volume, range=(0.5, 1.02))
    *walls, light = scene.quads
    middle = np.full(3, 2.5)
    buried = replace(light, corner=middle - (light.edge_u + light.edge_v) / 2)
    turned = replace(light, edge_u=light.edge_v, edge_v=light.edge_u)
    for lamp_there, where in ((buried, range(6)), (turned, [1])):
        dark = replace(scene, quads=(*walls, lamp_there))
        queries = at_levels(on_quads(dark, 200, only=where), 0.9)
        answer = BACKENDS[backend].solve(dark, queries, paths=range(8), bounces=0, seed=0)
        assert answer.paths.all()
        assert not answer.mean.any()
    lit = BACKENDS[backend].solve(scene, at_levels(on_quads(scene, 200), 5.0), paths=range(8), bounces=0, seed=0)
    assert (lit.mean > 0).any(axis=1).mean() > 0.5


# Leaks.


def sealed(scale, extents, axes):
    """Six white walls around an almost empty field, light only outside; queries everywhere."""
    field = empty(spacing=scale * np.array([1.0, 0.7, 1.6]), direction=axes)
    field = replace(field, volume=replace(field.volume, origin=extents * scale * np.array([3.2, -3.2, 3.2])))
    scene = Scene((field,), painted(box_around(field.volume)[:6], 1.0), np.ones(3))
    return scene, at_levels(on_quads(scene, 1500), NOWHERE)


def at_the_corners(scene, queries):
    """The same queries at and near the corners of the walls, inside and outside."""
    shift = np.array([0.0, 1e-300, 1e-17, 1e-16, 1e-12, -1e-17, -1e-16])
    shares = np.concatenate([shift, 1 - shift])
    u, v = np.random.default_rng(0).choice(shares, (2, len(queries), 1))
    quads = [scene.quads[k - 1] for k in queries.target]
    corner, along, across = (np.array([getattr(q, name) for q in quads]) for name in ("corner", "edge_u", "edge_v"))
    return replace(queries, point=corner + u * along + v * across)


@pytest.mark.parametrize("axes", [np.eye(3), rotation() @ np.diag([1, 1, -1.0])], ids=["straight", "oblique"])
@pytest.mark.parametrize("extents", [0.0, 1e5])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_no_light_leaks_into_a_sealed_box(scale, extents, axes):
    scene, queries = sealed(scale, extents, axes)
    answer = Numba().solve(scene, queries, paths=range(60), bounces=20, seed=3)  # a million paths in all cases
    assert answer.paths.all()
    assert not answer.mean.any(), f"{answer.mean.any(axis=1).sum()} of {len(queries)} see the outside"
    answer = Numba().solve(scene, at_the_corners(scene, queries), paths=range(10), bounces=5, seed=3)
    assert not answer.mean.any(), f"{answer.mean.any(axis=1).sum()} of {len(queries)} corners see the outside"
    few = Reference().solve(scene, queries[-100:], paths=range(1), bounces=20, seed=3)
    assert not few.mean.any()


def test_bars_are_honest_where_lamps_light():
    scene = lamps(waves((9, 8, 9)))
    queries = join_queries([on_quads(scene, 500, only=[0]), everywhere(scene)[::2]])
    truth = Numba().solve(scene, queries, paths=range(1000, 2500), bounces=2, seed=0)
    answer = Numba().solve(scene, queries, paths=range(128), bounces=2, seed=0)
    good = answer.paths > 0
    off = (answer.mean.astype(float) - truth.mean)[good]
    bar = np.hypot(answer.stderr, truth.stderr)[good]
    assert good.sum() > 600
    assert (np.abs(off) <= 1.96 * bar).mean() > 0.90
    assert np.median(answer.stderr[good]) < 1.5 * math.sqrt(np.mean(off**2))


def test_more_lamps_than_one_share_by_power_and_add_up():
    scene = box(waves((7, 6, 7)))
    dark = tuple(replace(f, material=Material(f.material.albedo)) for f in scene.fields)
    *walls, light = scene.quads
    quarter = [
        replace(
            light, name=f"{i}{j}", corner=light.corner + i * light.edge_u / 2 + j * light.edge_v / 2,
            edge_u=light.edge_u / 2, edge_v=light.edge_v / 2,
            material=Material(np.zeros(3), (1 + 2 * i + 5 * j) * np.array([1.0, 0.5, 0.1])),
        )
        for i in range(2) for j in range(2)
    ]  # fmt: skip
    queries = on_quads(scene, 400, only=range(6))

    def light_of(lights):
        room = replace(scene, fields=dark, quads=(*walls, *lights))
        return Numba().solve(room, queries, paths=range(512), bounces=0, seed=2)

    together, alone = light_of(quarter), [light_of([q]) for q in quarter]
    off = together.mean - sum(a.mean.astype(float) for a in alone)
    bar = np.sqrt(together.stderr.astype(float) ** 2 + sum(a.stderr.astype(float) ** 2 for a in alone))
    z = off[:, 0].sum() / math.sqrt((bar[:, 0] ** 2).sum())
    assert abs(z) < 4
    assert together.mean.mean() > 0
