"""Nodes that are lit where light is rough: which they are, what stands between them, and whole runs with them."""

import itertools
import sys
from dataclasses import replace

import numpy as np
import pytest

import illumgrid as ig
from illumgrid import unfinished
from illumgrid.accuracy import choose
from illumgrid.accuracy.points import unseen_in_volume
from illumgrid.accuracy.probe import Probe
from illumgrid.backends.numba_ import Numba
from illumgrid.bake.accumulator import Bake
from illumgrid.bake.ahead import looked, nodes_to_light
from illumgrid.bake.around import around, look_up
from illumgrid.bake.refined import MOST, PATH_COUNTS, SHARED, Chosen, Seen, chosen, read_choice, written
from illumgrid.bake.targets import filled
from illumgrid.field.volume import interpolate, world_to_index
from illumgrid.grid import GridSpec, IlluminationGrid, Nodes
from illumgrid.grid.nested import coarser, finer, spread, within
from illumgrid.grid.nodes import reachable
from illumgrid.interpolators.bilateral import Bilateral
from illumgrid.interpolators.nested import Nested
from illumgrid.io import partial
from illumgrid.samplers.direct import Direct
from illumgrid.transport import walk
from illumgrid.transport.samples import Samples, join_queries
from illumgrid.transport.tracer import prepare
from shapes import ball, sampled, sky


def shell(n=17):
    """A hollow ball that has a hole at low isovalues and is sealed at none: its cavity goes dark as the hole closes."""

    def value(x):
        r = np.linalg.norm(x, axis=1)
        pole = np.exp(-((x[:, 0] - 0.6) ** 2 + x[:, 1] ** 2 + x[:, 2] ** 2) / 0.05)
        return 1.0 - 3.0 * np.abs(r - 0.6) - 0.6 * pole

    return sampled(value, (n, n, n), (-1, -1, -1), np.full(3, 2 / (n - 1)))


@pytest.fixture(scope="module")
def hollow():
    """Scene, coarse lattice and the nodes chosen for it."""
    scene = sky(shell(), (0.2, 0.8))
    base = [GridSpec.over(scene.fields[0].volume, 13)]
    return scene, base, chosen(scene, base, 1, prepare(Numba(), scene), bounces=4, seed=1)


# Lattices in each other.


def test_every_second_node_of_the_finer_lattice_is_a_node():
    spec = GridSpec((4, 2, 3), (1, 2, 3), (0.5, 1, 2))
    fine = finer(spec, 2)
    assert fine.shape == (13, 5, 9) and coarser(fine, 2).shape == spec.shape
    places = fine.nodes().reshape(*fine.shape, 3)[::4, ::4, ::4]
    np.testing.assert_allclose(places.reshape(-1, 3), spec.nodes(), rtol=1e-15)


def test_a_cell_differs_by_its_corners_that_have_light():
    light, support = np.zeros((3, 2, 2, 1), np.float32), np.ones((3, 2, 2))
    light[1, 1, 0], light[2], support[2, 0, 0] = 5, 7, 0
    light[2, 0, 0] = 99
    grid = IlluminationGrid(GridSpec((3, 2, 2)), light, np.zeros((3, 2, 2)), support)
    assert spread(grid).reshape(-1).tolist() == [5, 7]
    assert spread(IlluminationGrid(GridSpec((3, 2, 2)), light, np.zeros((3, 2, 2)), 0 * support)).max() == 0


def test_nodes_within_cells_are_their_27():
    cells = np.zeros((3, 2, 2), bool)
    cells[1, 0, 1] = True
    assert within(cells).sum() == 27 and within(cells)[2:5, 0:3, 2:5].all()


# Where to light.


def test_a_body_without_hollows_is_lit_at_the_coarse_nodes_alone():
    scene = sky(ball(12))
    base = [GridSpec.over(scene.fields[0].volume, 9)]
    choice = chosen(scene, base, 2, prepare(Numba(), scene), bounces=4, seed=1)
    assert choice.levels == 0
    np.testing.assert_array_equal(choice.flat[0], reachable(scene.fields[0], base[0]))
    assert choice.paths == 64


def looked_at(light, noise, seed=0):
    """What two looks say of light (n, n, n), each with noise of its own."""
    random = np.random.default_rng(seed)
    return Seen.of(*(light + noise * random.standard_normal(light.shape) for _ in range(2)))


def test_noise_is_separated_from_what_lies_between_nodes():
    x = np.linspace(-1, 1, 41)[:, None, None] + np.zeros((41, 41, 41))
    straight = looked_at(1 + 0.3 * x, 0.1)
    assert straight.noise == pytest.approx(SHARED * 2 * 0.1**2, rel=0.05) and straight.between < 1e-4
    stepped = looked_at(1 + 0.5 * (x > 0.01), 0.02)
    mean = 1.25
    # Linear interpolation of a jump by 0.5 is off by 0.5² / 6 in the mean square over one of 40 cells.
    assert stepped.between == pytest.approx(0.25 / 6 / 40 / mean**2, rel=0.1) and stepped.falls == pytest.approx(2, 0.1)
    bent = looked_at(1 + 0.2 * np.sin(6 * x), 0.0)
    assert bent.falls > 12


def test_the_more_noise_for_what_is_between_nodes_the_more_paths():
    counts = [Seen(noise, 1e-4, 2.0).paths([1000]) for noise in (1e-6, 1e-3, 3e-3, 1e-1)]
    assert counts == sorted(counts) and len(set(counts)) > 2
    assert (counts[0], counts[-1]) == (PATH_COUNTS[0], PATH_COUNTS[-1])
    assert Seen(1e-1, 1e-4, 2.0).paths([1000, 3000]) == 16  # no more in all than the most from coarse nodes


def test_light_that_is_smooth_but_noisy_is_lit_at_few_nodes_by_many_paths():
    def labyrinth(x):
        x = 3.5 * x
        return np.sum(np.sin(x) * np.cos(np.roll(x, -1, axis=1)), axis=1)

    scene = sky(sampled(labyrinth, (24, 24, 24), (-1, -1, -1), np.full(3, 2 / 23)), (-0.4, 0.4))
    base = [GridSpec.over(scene.fields[0].volume, 20)]
    choice = chosen(scene, base, 2, prepare(Numba(), scene), bounces=8, seed=1)
    assert choice.levels == 0 and choice.paths == 64


def test_finer_nodes_are_those_around_jumps_of_the_light(hollow):
    scene, (base,), choice = hollow
    fine, coarse = finer(base, 1), reachable(scene.fields[0], base)
    assert choice.levels == 1 and len(choice.flat[0]) <= MOST * len(coarse)
    place = np.stack(np.unravel_index(choice.flat[0], fine.shape), axis=1)
    even = (place % 2 == 0).all(axis=1)
    assert even.sum() >= len(coarse) and set(np.ravel_multi_index((place[even] // 2).T, base.shape)) >= set(coarse)
    # Light jumps where a level set passes from the lit outside to the hollow: the finer nodes reach into it.
    assert (np.linalg.norm(fine.nodes(choice.flat[0][~even]), axis=1) < 0.7).mean() > 0.5


def test_a_choice_is_read_as_it_was_written(hollow):
    _, base, choice = hollow
    again = read_choice(written(choice, base))
    assert again.levels == choice.levels
    np.testing.assert_array_equal(again.flat[0], choice.flat[0])


# What stands between lit nodes.


def samples_at(scene, spec, flat, light, paths=4):
    queries = join_queries(list(Chosen((flat,)).queries(scene, [spec], 0)))
    worth = np.asarray(light(queries.point), np.float32).reshape(-1, 1)
    return Samples(queries, worth, 0.01 * np.ones_like(worth), np.full(len(queries), paths, np.int32))


def test_constant_light_stays_constant_with_and_without_holes(hollow):
    scene, (base,), choice = hollow
    spec = finer(base, 1)
    samples = samples_at(scene, spec, choice.flat[0], lambda x: np.full(len(x), 2.0))
    dark = np.arange(len(samples.paths)) % 7 == 0
    for paths in (samples.paths, np.where(dark, 0, samples.paths).astype(np.int32)):
        light = np.where(paths[:, None] > 0, samples.light, 0).astype(np.float32)
        grid = Nested(1).fill(Samples(samples.queries, light, samples.spread, paths), Nodes(spec, scene.fields[0]))
        near = reachable(scene.fields[0], spec)
        np.testing.assert_allclose(grid.light.reshape(-1)[near], 2.0, rtol=1e-5)
        assert np.isfinite(grid.light).all()


def test_a_node_in_range_without_light_of_its_own_is_a_hole(hollow):
    scene, (base,), choice = hollow
    spec, flat = finer(base, 1), choice.flat[0]
    samples = samples_at(scene, spec, flat, lambda x: np.full(len(x), 2.0))
    level = interpolate(scene.fields[0].volume, world_to_index(scene.fields[0].volume, spec.nodes(flat)))
    odd = (np.stack(np.unravel_index(flat, spec.shape)) % 2 == 1).any(axis=0)
    lost = np.flatnonzero(odd & (level > 0.3) & (level < 0.7))[3]
    paths = samples.paths.copy()
    paths[lost] = 0
    grid = Nested(1).fill(Samples(samples.queries, samples.light, samples.spread, paths), Nodes(spec, scene.fields[0]))
    assert grid.support.reshape(-1)[flat[lost]] == 0 and np.isinf(grid.error.reshape(-1)[flat[lost]])
    assert grid.light.reshape(-1)[flat[lost]] == pytest.approx(2.0)


def test_all_nodes_lit_are_read_as_by_the_bilateral_filter():
    scene = sky(ball(10))
    spec = GridSpec.over(scene.fields[0].volume, 9)
    flat = reachable(scene.fields[0], spec)
    samples = samples_at(scene, spec, flat, lambda x: 2 + x[:, 0] + x[:, 1] * x[:, 2])
    one, other = (stage.fill(samples, Nodes(spec, scene.fields[0])) for stage in (Nested(0), Bilateral(1.0)))
    near = other.support.reshape(-1) > 0
    np.testing.assert_array_equal(one.light.reshape(-1)[near], other.light.reshape(-1)[near])
    np.testing.assert_array_equal(one.error.reshape(-1)[near], other.error.reshape(-1)[near])


# Whole runs.


def test_a_run_refines_by_default_and_gives_the_same_bits_on_any_threads():
    scene = sky(shell(), (0.2, 0.8))
    one, other = (ig.run(scene, backend=Numba(threads=n), isovalues=2, judge=False, seed=4) for n in (1, 3))
    assert one.recipe["refined"] == {"from": 14, "levels": 2} and one.recipe["cache"]
    assert one.recipe["grid"] == 53 and one.recipe["interpolator"] == {"name": "nested", "levels": 2}
    for name in ("light", "error", "support"):
        np.testing.assert_array_equal(getattr(one.grids[0], name), getattr(other.grids[0], name))


def test_a_grid_that_is_asked_for_is_lit_as_a_whole():
    light = ig.run(sky(ball(9)), grid=6, isovalues=2, judge=False)
    assert light.recipe["refined"] is None and light.recipe["paths"] == 32
    assert light.recipe["queries"] == sum(len(q) for q in Direct().queries(light.scene, [light.grids[0].spec], 0))


def test_a_studio_is_lit_on_one_lattice_and_its_layers_keep_their_errors():
    light = ig.run(ig.Scene.studio(ball(9), range=(0.3, 0.9)), paths=8, isovalues=2, judge=False)
    known = light.grids[0].support > 0
    assert light.recipe["refined"] is None and np.isfinite(light.grids[0].errors[known]).all()
    assert np.isfinite(light.mix(key=1.5, dome=0.3).grids[0].error[known]).all()


@pytest.mark.parametrize("planned", [False, True])
def test_a_refined_run_that_was_stopped_can_be_seen_and_goes_on_to_the_same_bits(planned, call, monkeypatch, tmp_path):
    monkeypatch.setattr(walk, "PIECE", 2000)
    monkeypatch.setattr(walk, "GROWTH", 1.0)
    monkeypatch.setattr(partial, "EVERY", 0.0)
    monkeypatch.setattr(partial, "CHUNK", 64)
    monkeypatch.setattr(sys.modules["illumgrid.cli.outcome"], "judged_light", lambda light, stages, folder: light)
    np.save(tmp_path / "shell.npy", shell().values)
    given = ("run", "shell.npy", "--scene", "sky", "--range", "0.2", "0.8", "--paths", "3", "--isovalues", "2",
             "--no-preview")  # fmt: skip
    if planned:  # the first look has another number of nodes
        scene = ig.Scene.sky(ig.read_volume(tmp_path / "shell.npy"), range=(0.2, 0.8))
        ahead = looked(scene, prepare(Numba(), scene), 11, None, 0)
        plan = choose.Plan(11, 3, None, 0.1, 1.0, 0.0, True, (), looked=True)
        monkeypatch.setattr("illumgrid.chain.planned", lambda *_, **how: (plan, ahead))
        given += ("--error", "0.1")
    call(*given, "-o", "whole")
    real, walked = walk.answer, itertools.count()

    def stopped(tracer, bounces, seed, work):
        if len(work[1]) == 3 and next(walked) == 3:  # the first look has two paths
            raise KeyboardInterrupt
        return real(tracer, bounces, seed, work)

    monkeypatch.setattr("illumgrid.bake.accumulator.answer", stopped)
    call(*given, "-o", "out", code=130)
    seen, share = unfinished.load(tmp_path / "out.partial")
    assert 0 < share < 1 and seen.grids[0].spec.shape == ig.load("whole").grids[0].spec.shape
    monkeypatch.setattr("illumgrid.bake.accumulator.answer", real)
    call(*given, "-o", "out")
    one, other = ig.load("whole").grids[0], ig.load("out").grids[0]
    np.testing.assert_array_equal(one.light, other.light)
    np.testing.assert_array_equal(one.error, other.error)


# What is known of a refined run before it is lit.


def test_the_nodes_around_points_hold_what_a_whole_run_has_there():
    scene = sky(shell(25), (0.2, 0.8))
    ahead = looked(scene, prepare(Numba(), scene), 17, None, 3)
    asked = unseen_in_volume(scene, 12, 5)
    near = around(scene, ahead, asked)
    assert ahead.refined["levels"] and len(near.asked) < 0.6 * nodes_to_light(scene, ahead)
    every = list(ahead.sampler.queries(scene, ahead.specs, 3))
    answers = Bake.of(every, ahead.bounces, 3).walk(ahead.tracer, range(4)).answers
    grids = list(filled(scene, ahead.specs, ahead.interpolator, answers))
    light, whole = near.read(Bake.of([near.asked], ahead.bounces, 3).walk(ahead.tracer, range(4)).samples)
    expected, covered = look_up(grids, asked)
    assert whole.all() and covered.all()
    np.testing.assert_allclose(light, expected, rtol=1e-5)


def test_an_error_or_a_time_under_a_sky_is_reached_by_a_first_look(monkeypatch):
    scene, real = sky(shell(25), (0.2, 0.8)), Probe.measure

    def coarse(probe, ahead, *how):
        found = real(probe, ahead, *how)
        return found if ahead.refined else replace(found, parts=replace(found.parts, grid=1.0))

    monkeypatch.setattr(Probe, "measure", coarse)  # no lattice will do
    met = ig.run(scene, error=0.05, isovalues=2, seed=1, judge=True).recipe
    assert met["plan"]["looked"] and met["refined"]["from"] == met["plan"]["grid"] and met["cache"]
    assert met["plan"]["met"] and met["reached"] < 1.3 * 0.05
    with pytest.warns(ig.IllumgridWarning, match="out of reach"):
        given = ig.run(scene, error=0.05, isovalues=2, seed=1, grid=20, judge=False).recipe
    assert given["refined"] is None and not given["plan"]["looked"]  # nodes that are given are lit as a whole
    own = ig.run(scene, error=0.08, bounces=3, isovalues=2, seed=1, judge=False).recipe
    assert own["refined"] and own["bounces"] == 3 and not own["cache"]
    with pytest.warns(ig.IllumgridWarning, match="too short"):
        short = ig.run(scene, seconds=1e-6, isovalues=2, judge=False).recipe
    assert short["refined"]["from"] == choose.sizes(scene)[0] and short["paths"] == 4  # as little as there is
