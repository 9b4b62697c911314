"""Equal queries give equal light, bit for bit, however the work is divided; another seed gives other light."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from illumgrid.backends.numba_ import Numba, cores
from illumgrid.backends.reference import Reference
from illumgrid.bake import bake
from illumgrid.errors import BadInput
from illumgrid.field.scene import level_table
from illumgrid.grid import GridSpec
from illumgrid.interpolators.nearest import Nearest
from illumgrid.samplers import direct
from illumgrid.samplers.direct import Direct
from illumgrid.samplers.uniform import Uniform
from illumgrid.stages import on_level_sets
from illumgrid.transport.samples import join_queries
from transport import colored, everywhere, furnace, noise, waves

BACKENDS = {"numba": Numba(), "reference": Reference()}


def two_fields():
    return colored(furnace(waves((13, 9, 11)), noise(9, (7, 9, 8), origin=(4.0, 1.0, 2.0), spacing=(1.1, 0.8, 1.3))))


def specs_of(scene, nodes=11):
    return [GridSpec.over(field.volume, nodes) for field in scene.fields]


def light(scene, sampler, seed=0, threads=0, **how):
    stages = sampler, Numba(threads=threads).prepare(scene), Nearest()
    levels = level_table(scene, 2)
    return bake(scene, specs_of(scene), levels, *stages, paths=[range(6)], bounces=3, seed=seed, **how).grids


def equal(one, other):
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for a, b in zip(one, other, strict=True)
        for name in ("values", "error", "support")
    )


@pytest.mark.parametrize("sampler", [Direct(), Uniform(count=4)], ids=["direct", "uniform"])
def test_the_grid_depends_on_the_seed_and_not_on_the_threads(sampler):
    scene = two_fields()
    one = light(scene, sampler, threads=1)
    assert all(grid.support.any() for grid in one)
    for threads in (2, 4, 0):
        assert equal(one, light(scene, sampler, threads=threads))
    assert equal(one, light(scene, sampler, threads=2, seed=0))
    assert not equal(one, light(scene, sampler, seed=1))


@pytest.mark.parametrize("sampler", [Direct(), Uniform(count=4)], ids=["direct", "uniform"])
def test_the_grid_does_not_depend_on_who_maps(sampler):
    scene = two_fields()
    one = light(scene, sampler)
    with ThreadPoolExecutor(3) as pool:
        assert equal(one, light(scene, sampler, map=pool.map))
        assert equal(one, light(scene, sampler, map=pool.map, threads=1))


@pytest.mark.parametrize("size", [1, 7, 100])
def test_the_grid_does_not_depend_on_the_batches_of_the_sampler(size, monkeypatch):
    scene = furnace(noise(9, (4, 4, 5)))
    one = light(scene, Direct())
    monkeypatch.setattr(direct, "_BATCH", size)
    assert equal(one, light(scene, Direct()))


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_answer_does_not_depend_on_its_batch(backend):
    scene = two_fields()
    queries = everywhere(scene)[:: 1 if backend == "numba" else 40]

    def solve(some):
        return BACKENDS[backend].solve(scene, some, paths=range(5), bounces=3, seed=9)

    whole, n = solve(queries), len(queries)
    assert 0 < (whole.paths > 0).mean() < 1
    order = np.random.default_rng(0).permutation(n)
    parts = [order, np.arange(n)[::-1], np.arange(n) % 3 == 1, slice(n // 2, n // 2 + 1), slice(0, 0)]
    parts += [slice(i, i + 97) for i in range(0, n, 97)]
    for rows in parts:
        part, expected = solve(queries[rows]), whole[rows]
        for name in ("mean", "m2", "paths"):
            np.testing.assert_array_equal(getattr(part, name), getattr(expected, name))


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_seed_and_the_path_choose_the_random_numbers(backend):
    scene = two_fields()
    queries = everywhere(scene)[::30]

    def solve(seed, paths):
        return BACKENDS[backend].solve(scene, queries, paths=paths, bounces=2, seed=seed).mean

    one = solve(0, range(4))
    np.testing.assert_array_equal(one, solve(0, range(4)))
    for other in (solve(1, range(4)), solve(2**63 + 5, range(4)), solve(0, range(4, 8))):
        assert (one != other).any(axis=1).mean() > 0.1
    # Neighbours in seed do not share their numbers shifted by a query.
    assert not np.array_equal(one[1:], solve(1, range(4))[:-1])


@pytest.mark.parametrize("sampler", [Direct(), Uniform(count=5)], ids=["direct", "uniform"])
def test_ids_are_unique_over_all_batches(sampler):
    scene = two_fields()
    batches = list(sampler.queries(scene, specs_of(scene, 20), 0))
    queries = join_queries(batches)
    assert len(batches) > 1
    assert set(queries.target) == {0, 1}
    assert len(np.unique(queries.id)) == len(queries)


def test_samplers_repeat_themselves():
    scene = two_fields()
    for make in (
        lambda seed: Direct().queries(scene, specs_of(scene), seed),
        lambda seed: Uniform(count=3).queries(scene, specs_of(scene), seed),
        lambda seed: on_level_sets(scene, [0.1, 0.5], seed),
    ):
        one, again = join_queries(list(make(3))), join_queries(list(make(3)))
        for name in ("id", "point", "normal", "level", "target"):
            np.testing.assert_array_equal(getattr(one, name), getattr(again, name))
    strewn = [join_queries(list(on_level_sets(scene, [0.5], seed))).point for seed in (0, 1)]
    assert not np.array_equal(*strewn)


def test_what_cannot_be_answered_is_refused():
    scene = furnace(noise(4, (4, 3, 3)))
    with pytest.raises(BadInput, match="threads"):
        Numba(threads=-1)
    for backend in (Numba(), Reference()):
        for paths, bounces in ((range(0, 4, 2), 1), (range(-1, 3), 1), (4, 1), (range(2), -1)):
            with pytest.raises(BadInput, match="expected"):
                backend.solve(scene, everywhere(scene), paths=paths, bounces=bounces, seed=0)
    assert cores() >= 1
