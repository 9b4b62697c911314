"""Paths that end in a cache: naive = reference = numba path by path, where they end, and what they are worth."""

import math
import pickle
import weakref

import numpy as np
import pytest

import illumgrid as ig
import naive
from illumgrid.backends.numba_ import Numba
from illumgrid.backends.reference import Reference
from illumgrid.bake import ahead, targets
from illumgrid.bake.ahead import light_ahead
from illumgrid.bake.bounces import enough_bounces
from illumgrid.bake.known import MOST_BIAS, light_known_first
from illumgrid.constants import BASE
from illumgrid.errors import BadInput
from illumgrid.field.filters import smooth
from illumgrid.field.lattice import specs_over
from illumgrid.field.scene import Scene, level_table
from illumgrid.field.volume import Volume
from illumgrid.grid import GridSpec, IlluminationGrid, WallTexture, channels_of
from illumgrid.grid.cache import NO_CACHE, cache_of
from illumgrid.interpolators.nearest import Nearest
from illumgrid.samplers.direct import Direct
from illumgrid.stages import on_level_sets
from illumgrid.transport.samples import Queries, join_queries
from illumgrid.transport.stages import fill_nodes
from illumgrid.transport.tracer import ending_in, prepare
from rooms import ROOMS, on_quads
from shapes import ball
from transport import colored, everywhere, furnace, noise, on_sets, rotation, waves

SAME = 1e-6  # of π, as in the oracle chain
ALIKE = 1.2  # of random light between 0.5 and 1.5 of its mean: some cells differ by more, some by less
PLACED = {"origin": (3.0, -4.0, 5.0), "spacing": (1.0, 0.7, 1.9)}


def made_up(scene, nodes=9, rows=4, holes=0.03, seed=4):
    """Light that no scene has, with holes: (grids, walls), random."""
    random, channels = np.random.default_rng(seed), channels_of(scene)

    def light(*shape):
        return random.uniform(0.5, 1.5, (*shape, len(channels))), (random.random(shape) >= holes).astype(np.float32)

    grids = []
    for spec in (GridSpec.over(field.volume, nodes) for field in scene.fields):
        values, support = light(*spec.shape)
        grids.append(IlluminationGrid(spec, values, np.zeros(spec.shape, np.float32), support, channels))
    return grids, [WallTexture(*light(rows, *q.texels[::-1]), channels) for q in scene.quads]


def two_fields():
    other = waves((5, 7, 4), origin=(1.3, -0.8, 2.1), spacing=(1.3, 0.6, 0.9))
    return colored(furnace(waves((5, 5, 6), spacing=(0.9, 1.1, 0.8)), other))


SCENES = {
    "smooth": lambda: colored(furnace(waves((6, 10, 13)))),
    "below, placed": lambda: colored(furnace(waves(**PLACED), inside="below")),
    "rotated bytes": lambda: colored(furnace(noise(256, direction=rotation(), **PLACED))),
    "two fields": two_fields,
    **{name: ROOMS[name] for name in list(ROOMS)[:3]},
}


def questions(scene, count):
    solid = everywhere(scene)
    some = solid[np.sort(np.random.default_rng(0).choice(len(solid), count, replace=False))]
    return join_queries([some, on_quads(scene, count // 2, back="both")]) if scene.quads else some


def worth(tracer, queries, path, bounces):
    answer = tracer.solve(queries, paths=range(path, path + 1), bounces=bounces, seed=0)
    return answer.mean.astype(float) / math.pi, answer.paths == 1


@pytest.mark.plain
@pytest.mark.parametrize("name", SCENES)
def test_loops_numpy_and_kernels_end_the_same_paths(name):
    scene = SCENES[name]()
    grids, walls = made_up(scene)
    cache = cache_of(scene, grids, walls, ALIKE)
    queries = questions(scene, 40)
    tracers = [prepare(backend, scene, cache) for backend in (Numba(), Reference())]
    ended = 0
    for path, bounces in enumerate((0, 1, 2, 5)):
        one, answered = worth(tracers[0], queries, path, bounces)
        other, _ = worth(tracers[1], queries, path, bounces)
        rows = np.flatnonzero(answered)
        truth = np.array(
            [naive.path_worth(scene, queries[i : i + 1], path, bounces, 0, (grids, walls, ALIKE)) for i in rows]
        )
        np.testing.assert_allclose(one[rows], truth, atol=SAME, rtol=SAME)
        np.testing.assert_allclose(other[rows], truth, atol=SAME, rtol=SAME)
        without, _ = worth(prepare(Numba(), scene), queries, path, bounces)
        ended += (np.abs(one - without) > SAME).any(axis=1).sum()
        assert bounces > 0 or not ended
    assert ended > 5


def test_meshes_end_them_too_by_numba_and_by_embree():
    pytest.importorskip("embreex")
    from illumgrid.backends.embree import Embree

    scene = colored(furnace(waves((6, 10, 13))))
    cache = cache_of(scene, *made_up(scene), ALIKE)
    queries = on_sets(scene)
    many = [
        prepare(backend, scene, known).solve(queries, paths=range(8), bounces=3, seed=0)
        for backend, known in ((Numba(surface="mesh"), cache), (Embree(), cache), (Embree(), NO_CACHE))
    ]
    differ = [np.abs(many[0].mean - other.mean).max(axis=1) > 1e-4 * math.pi for other in many[1:]]
    assert differ[0].mean() < 0.03 < 0.3 < differ[1].mean()


def test_a_furnace_that_is_known_is_white_whatever_its_albedo():
    # Emission 1 - a and a times the cached π / π: a path that ends has met radiance 1, as one that escapes.
    scene = furnace(waves((7, 8, 9)), albedo=(0.5, 0.25, 0.1))
    spec = GridSpec.over(scene.fields[0].volume, 8)
    ones, channels = np.ones(spec.shape, np.float32), channels_of(scene)
    light = math.pi * ones[..., None].repeat(len(channels), -1)
    cache = cache_of(scene, [IlluminationGrid(spec, light, 0 * ones, ones, channels)], [])
    queries = on_sets(scene)
    answer = prepare(Numba(), scene, cache).solve(queries, paths=range(4), bounces=25, seed=0)
    np.testing.assert_allclose(answer.mean[answer.paths > 0], math.pi, rtol=1e-6)  # 0.5^26 is left


def test_where_nothing_is_trusted_the_light_is_the_same_bit_for_bit():
    scene = two_fields()
    queries, grids = everywhere(scene), made_up(scene)[0]
    aside = queries.level + np.array([0.0, 1e-3])
    off_the_sweep = Queries(queries.id, queries.point, queries.normal, aside, queries.target)
    for asked, alike in ((queries, 0.0), (off_the_sweep, np.inf)):
        cache = cache_of(scene, grids, [], alike)
        light = [
            tracer.solve(asked, paths=range(4), bounces=3, seed=0).mean
            for tracer in (prepare(Numba(), scene), prepare(Numba(), scene, cache))
        ]
        np.testing.assert_array_equal(*light)


def test_holes_and_jumps_are_not_trusted():
    scene = Scene.sky(Volume(np.indices((4, 4, 4)).sum(axis=0)))
    spec = GridSpec.over(scene.fields[0].volume, 4)
    light, support = np.ones((4, 4, 4, 1)), np.ones((4, 4, 4), np.float32)
    light[3, 3, 3], support[0, 0, 0] = 0.0, 0
    grid = IlluminationGrid(spec, light, 0 * support, support)
    trusted = cache_of(scene, [grid], [], 0.5).trusted.reshape(4, 4, 4)
    expected = np.ones((4, 4, 4), bool)
    expected[0, 0, 0] = expected[2:, 2:, 2:] = False
    expected[3, 3, 3] = True  # alone beyond the border
    np.testing.assert_array_equal(trusted, expected)
    assert cache_of(scene, [grid], [], np.inf).trusted.sum() == 63


def test_a_copy_in_another_process_has_its_cache():
    scene = two_fields()
    tracer = prepare(Numba(), scene, cache_of(scene, *made_up(scene)))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(tracer)).cache.light, tracer.cache.light)


def test_a_cache_of_another_scene_or_for_a_backend_that_knows_none_is_refused():
    scene = two_fields()
    grids, _ = made_up(scene)
    with pytest.raises(BadInput, match="1 grids and 0 walls came as a cache; expected 2 and 0"):
        cache_of(scene, grids[:1], [])
    grey = [IlluminationGrid(g.spec, g.light[..., :1], g.error, g.support) for g in grids]
    with pytest.raises(BadInput, match="channels Y; expected those of the scene: R, G, B"):
        cache_of(scene, grey, [])
    with pytest.raises(BadInput, match="expected the backend numba, embree or reference"):
        ending_in(cache_of(scene, grids, []), object())


def gaussians(n=20):
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij"), -1)
    middles = np.random.default_rng(2).uniform(-0.55, 0.55, (7, 3))
    return Volume(sum(np.exp(-((x - middle) ** 2).sum(-1) / 0.08) for middle in middles))


def shell(n=24):
    """A cavity that is sealed at most levels, and opens at some."""
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij"), -1)
    dent = 0.15 * np.exp(-((x - [0.6, 0, 0]) ** 2).sum(-1) / 0.02)
    return Volume(np.exp(-(((np.linalg.norm(x, axis=-1) - 0.6) / 0.12) ** 2)) - dent)


KNOWN = {
    "gaussians": lambda: Scene.sky(gaussians()),
    "a box with its lamp": lambda: Scene.box(gaussians()),
    "a sealed cavity": lambda: Scene.sky(shell(), range=(0.3, 0.9)),
    "a finer cavity": lambda: Scene.sky(shell(32), range=(0.3, 0.9)),
    "noise": lambda: Scene.sky(smooth(noise(256, (20, 20, 20)), 1.0), range=(105, 150)),
}


@pytest.mark.parametrize("name, look", [*((n, False) for n in KNOWN), *((n, True) for n in KNOWN if "box" not in n)])
def test_the_light_of_paths_that_end_is_off_by_less_than_the_bound_in_the_mean(name, look):
    scene = KNOWN[name]()
    tracer, levels = prepare(Numba(), scene), level_table(scene, 16)
    bounces, _ = enough_bounces(scene, tracer)
    if look:  # in that of a first look, as a run under a sky alone
        how = {"refining": True, "cached": bounces > 4, "automatic": True, "bounces": bounces, "seed": 1}
        stages = Direct(), Numba(), Nearest()
        gathering = light_ahead(scene, specs_over(scene, None, BASE), levels, tracer, stages, **how).tracer
    else:
        gathering = light_known_first(scene, specs_over(scene), levels, tracer, bounces=bounces, seed=1)
    rows = scene.levels((np.arange(7) + 0.37) / 7)  # none of those of the walls
    asked = join_queries(list(on_level_sets(scene, rows, 3, points=90)))
    truth, found = (t.solve(asked, paths=range(128), bounces=3 * bounces, seed=5) for t in (tracer, gathering))
    off = (found.mean - truth.mean)[truth.paths > 0].mean(axis=1, dtype=float) / truth.mean[truth.paths > 0].mean()
    assert off.std() / math.sqrt(len(off)) < MOST_BIAS / 3  # the same random numbers: most noise is common to both
    assert abs(off.mean()) < MOST_BIAS
    assert off.any()  # some paths did end


def test_a_run_lights_a_coarse_grid_first_where_light_needs_many_bounces():
    options = {"grid": 6, "paths": 2, "isovalues": 2, "judge": False}
    room = Scene.box(ball(8))
    one, other = (ig.run(room, backend=Numba(threads=threads), **options) for threads in (1, 3))
    assert one.recipe["bounces"] > 4
    assert one.recipe["cache"] and "cache" in one.recipe["seconds"]
    np.testing.assert_array_equal(one.grids[0].values, other.grids[0].values)
    for scene, bounces in ((room, one.recipe["bounces"]), (Scene.sky(ball(8)), None)):
        assert not ig.run(scene, bounces=bounces, **options).recipe["cache"]


def test_a_cache_goes_when_the_paths_that_end_in_it_are_walked(monkeypatch):
    caches, left = [], []

    def ending(*about, **how):
        tracer = light_known_first(*about, **how)
        caches.append(weakref.ref(tracer.cache.light))
        return tracer

    def fill(*about):
        left.append([cache() is not None for cache in caches])
        return fill_nodes(*about)

    monkeypatch.setattr(ahead, "light_known_first", ending)
    monkeypatch.setattr(targets, "fill_nodes", fill)
    scene = ig.Scene.box(ball(12), range=(0.3, 1.2))
    assert ig.run(scene, grid=12, paths=2, judge=False).recipe["cache"]
    assert left == [[], [False]]  # the coarse grid of the cache, and what was lit with it
