"""The accumulator: walks go on, combine, and come back from plain arrays."""

import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from io import BytesIO
from typing import ClassVar

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.accuracy.chart.contestants import Method
from illumgrid.accuracy.chart.race import Run
from illumgrid.backends.numba_ import Numba
from illumgrid.bake.accumulator import Bake
from illumgrid.bake.walls import wall_queries
from illumgrid.field.scene import Scene, level_table
from illumgrid.grid import GridSpec
from illumgrid.interpolators.nearest import Nearest
from illumgrid.rng import shifted_seed
from illumgrid.samplers.direct import Direct
from illumgrid.transport.samples import Samples, join_queries
from illumgrid.transport.tracer import prepare
from shapes import ball, refused

SEED = 2**64 - 3


@pytest.fixture(scope="module")
def begun():
    """Nodes of a ball over a floor, and the texels of the floor with twice the paths."""
    scene = Scene.floor(ball(9), range=(0.4, 0.9))
    nodes = list(Direct().queries(scene, [GridSpec.over(scene.fields[0].volume, 6)], 0))
    texels = wall_queries(scene, level_table(scene, 2))
    tracer = prepare(Numba(), scene)
    return tracer, Bake((*nodes, *texels), (1,) * len(nodes) + (2,) * len(texels), 2, SEED)


def same(one, other):
    for a, b in zip((*one.answers, *one.targets), (*other.answers, *other.targets), strict=True):
        for name in vars(a).keys() - {"queries"}:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (one.walked, one.weights, one.bounces, one.seed) == (other.walked, other.weights, other.bounces, other.seed)


def test_a_walk_is_what_the_tracer_answers_and_texels_have_their_own_number_of_paths(begun):
    tracer, bake = begun
    found = bake.walk(tracer, range(3, 9))
    for targets, weight, answer in zip(bake.targets, bake.weights, found.answers, strict=True):
        asked = tracer.solve(targets, paths=range(3 * weight, 9 * weight), bounces=2, seed=SEED)
        np.testing.assert_array_equal(answer.mean, asked.mean)
        np.testing.assert_array_equal(answer.paths, asked.paths)
    assert found.paths == 6 and found.walked == (range(3, 9),)
    assert len(found.samples) == sum(map(len, bake.targets))


def test_walks_one_after_the_other_and_merged_are_one_long_walk(begun):
    tracer, bake = begun
    whole = bake.walk(tracer, range(16))
    went_on = bake.walk(tracer, range(4)).walk(tracer, range(4, 16))
    merged = bake.walk(tracer, range(4)).merge(bake.walk(tracer, range(4, 16)))
    same(went_on, merged)
    assert went_on.paths == whole.paths == 16
    for a, b in zip(went_on.answers, whole.answers):
        np.testing.assert_allclose(a.mean, b.mean, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(a.paths, b.paths)


def test_paths_are_never_counted_twice(begun):
    tracer, bake = begun
    found = bake.walk(tracer, range(4))
    refused(lambda: found.walk(tracer, range(3, 6)), "overlap", "disjoint")


def test_a_state_of_plain_arrays_goes_on_bit_by_bit(begun):
    tracer, bake = begun
    for before in (bake, bake.walk(tracer, range(4))):
        file = BytesIO()
        np.savez(file, **before.state())
        file.seek(0)
        with np.load(file, allow_pickle=False) as arrays:
            after = Bake.from_state(arrays)
        same(after, before)
        same(after.walk(tracer, range(4, 8)), before.walk(tracer, range(4, 8)))


def test_any_map_gives_the_same_and_says_how_far_it_is(begun):
    tracer, bake = begun
    reported = []
    with ThreadPoolExecutor(2) as pool:
        one = bake.walk(tracer, range(4), pool.map, lambda *what: reported.append(what))
    same(one, bake.walk(tracer, range(4)))
    total = sum(map(len, bake.targets))
    assert reported[0] == ("light", 0, total) and reported[-1] == ("light", total, total)


def test_a_bake_without_targets_has_a_state():
    again = Bake.from_state(Bake.of((), 3, SEED).state())
    assert (again.targets, again.answers, again.bounces, again.seed) == ((), (), 3, SEED)


def test_seeds_beside_a_seed_stay_within_64_bits():
    assert shifted_seed(2**64 - 1, 1) == 0 and shifted_seed(5, 2**63) == 2**63 + 5


def test_bakes_of_another_seed_are_refused_and_one_that_has_not_walked_takes_nothing_away(begun):
    tracer, bake = begun
    found = bake.walk(tracer, range(4))
    same(found.merge(bake), found)
    same(bake.merge(found), found)
    refused(lambda: found.merge(replace(bake, seed=1).walk(tracer, range(4, 8))), "seed", "same")


@dataclass(frozen=True)
class InOneBatch:
    """The nodes of all fields in one batch."""

    name: ClassVar[str] = "in-one-batch"

    def queries(self, scene, specs, seed):
        yield join_queries(list(Direct().queries(scene, specs, seed)))


@dataclass(frozen=True)
class FirstField:
    """The nodes of the first field, and none of the others."""

    name: ClassVar[str] = "first-field"

    def queries(self, scene, specs, seed):
        yield from (q for q in Direct().queries(scene, specs, seed) if q.target[0] == 0)


def pair():
    """Two balls side by side over a floor."""
    one = Scene.floor(ball(9), range=(0.4, 0.9))
    volume = one.fields[0].volume
    beside = replace(volume, origin=volume.origin + np.array([3.0, 0.0, 0.0]))
    return replace(one, fields=(one.fields[0], replace(one.fields[0], name="other", volume=beside)))


def test_a_batch_may_hold_several_fields_beside_walls():
    small = {"grid": 6, "paths": 2, "bounces": 1, "isovalues": 2, "judge": False}
    one, other = (ig.run(pair(), sampler=sampler, **small) for sampler in (Direct(), InOneBatch()))
    for a, b in zip((*one.grids, *one.walls), (*other.grids, *other.walls), strict=True):
        np.testing.assert_array_equal(a.values, b.values)


@pytest.mark.parametrize("sampler, lit", [(InOneBatch(), [True, True]), (FirstField(), [True, False])])
def test_a_race_gives_each_field_its_own_samples(sampler, lit):
    scene = pair()
    tracer = prepare(Numba(), scene)
    found = []
    for way in (Direct(), sampler):
        run = Run(scene, Method(way, Numba(), tracer, "levelset", (Nearest(),)), 6, 1, 0)
        run.go_on(2)
        found.append(run.fill(Nearest())[0])
    for a, b, asked in zip(*found, lit, strict=True):
        np.testing.assert_array_equal(a.support * asked, b.support)


def test_an_interpolator_may_have_an_argument_of_its_own():
    @dataclass(frozen=True)
    class Powered:
        name: ClassVar[str] = "powered"

        def fill(self, samples, nodes, power=2.0):
            return Nearest().fill(samples, nodes)

    light = ig.run(pair(), interpolator=Powered(), grid=6, paths=2, bounces=1, isovalues=2, judge=False)
    assert light.grids[0].support.any()


@dataclass(frozen=True)
class Plain:
    """A backend that knows RGB only and does not say which surface it uses."""

    name: ClassVar[str] = "plain"

    def solve(self, scene, queries, **about):
        found = Numba().solve(scene, queries, **about)
        return Samples(queries, np.array(found.mean), np.array(found.m2), found.paths)


def test_light_of_a_backend_that_cannot_be_judged_is_kept():
    with pytest.warns(ig.IllumgridWarning, match="could not be measured.*geometry"):
        light = ig.run(pair(), backend=Plain(), grid=6, paths=2, bounces=1, isovalues=2, judge=True)
    assert light.recipe["reached"] is None and light.grids[0].mean > 0
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("error")
        again = ig.run(pair(), backend=Plain(), grid=6, paths=2, bounces=1, isovalues=2, judge=True)
    assert "could not be measured" in str(caught[0].message)
    np.testing.assert_array_equal(again.grids[0].values, light.grids[0].values)


def test_lights_that_a_backend_summed_are_not_mixed():
    light = ig.run(
        Scene.studio(ball(9), range=(0.4, 0.9)), backend=Plain(), grid=6, paths=2, bounces=1, isovalues=2, judge=False
    )
    refused(lambda: light.mix(**{light.lights[0]: 0.5}), "sum", "numba")
