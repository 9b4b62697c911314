"""What the probe knows before a grid is built, against grids that are built, and the judgement afterwards."""

import numpy as np
import pytest

from illumgrid import run
from illumgrid.accuracy.choose import Goal, Plan, choose, outlook, planned, sizes
from illumgrid.accuracy.judge import judge
from illumgrid.accuracy.points import other_paths, unseen_in_volume, unseen_on_level_sets
from illumgrid.accuracy.probe import Measured, Probe
from illumgrid.accuracy.reference import Parts, Reference, begin, converge, errors, parts_of
from illumgrid.backends.numba_ import Numba
from illumgrid.bake.accumulator import Bake
from illumgrid.bake.ahead import lattice, nodes_to_light
from illumgrid.bake.around import look_up
from illumgrid.chain import rounds
from illumgrid.field.lattice import specs_over
from illumgrid.field.scene import Scene, level_table
from illumgrid.field.volume import interpolate, world_to_index
from illumgrid.grid import IlluminationGrid
from illumgrid.samplers.direct import corners
from illumgrid.transport.samples import Queries, Samples
from illumgrid.transport.tracer import prepare
from shapes import ball, refused, sampled, sky

BACKEND = Numba()


def bumps(n, count, seed, widths=(0.15, 0.4)):
    """Sum of Gaussians of random position and width on [-1, 1]³."""
    random = np.random.default_rng(seed)
    centres, sigmas = random.uniform(-0.6, 0.6, (count, 3)), random.uniform(*widths, count)

    def density(x):
        return sum(np.exp(-((x - c) ** 2).sum(axis=1) / (2 * s * s)) for c, s in zip(centres, sigmas))

    return sampled(density, (n, n, n), (-1, -1, -1), np.full(3, 2 / (n - 1)))


def gyroid(n):
    """A labyrinth of channels."""

    def value(x):
        a, b, c = (4.5 * x).T
        return np.sin(a) * np.cos(b) + np.sin(b) * np.cos(c) + np.sin(c) * np.cos(a)

    return sampled(value, (n, n, n), (-1, -1, -1), np.full(3, 2 / (n - 1)))


FIELDS = {
    "bumps": lambda: Scene.sky(bumps(22, 24, 1, (0.12, 0.22)), range=(0.3, 0.9)),
    "few bumps": lambda: Scene.sky(bumps(24, 9, 4, (0.12, 0.25)), range=(0.2, 0.7)),
    "labyrinth": lambda: Scene.sky(gyroid(22), range=(-0.4, 0.4)),
    "on a floor": lambda: Scene.floor(ball(20), range=(0.4, 0.9)),
    "colored bumps": lambda: Scene.sky(bumps(20, 14, 9, (0.15, 0.3)), (0.4, 0.6, 0.9), (0.3, 0.9)),
}


def off(light, truth):
    return errors(look_up(light.grids, truth.queries)[0], truth).rmse


def reference_of(one, other, bounces):
    """From two halves that were made by hand."""
    one, other = (
        Bake((half.queries,), (1,), bounces, 0, (half,), (range(int(half.paths[0])),)) for half in (one, other)
    )
    return Reference(prepare(BACKEND, sky()), (one, other))


def test_unseen_points_lie_on_level_sets_of_the_range_evenly_in_isovalue_and_in_area():
    scene = sky(ball(40), (0.4, 1.0))
    for asked in (unseen_in_volume(scene, 4000, 3), unseen_on_level_sets(scene, 40, 4000, 3)):
        assert 3500 < len(asked) <= 4000
        found = interpolate(scene.fields[0].volume, world_to_index(scene.fields[0].volume, asked.point))
        np.testing.assert_allclose(found, asked.level[:, 0], atol=1e-6)
        share = (asked.level[:, 0] - 0.4) / 0.6
        assert share.min() >= 0 and share.max() <= 1
        # 8 bins of 500: binomial spread 21; stratified draws have less.
        assert np.abs(np.histogram(share, 8, (0, 1))[0] / len(asked) * 4000 - 500).max() < 70
        height = asked.point[:, 2] / np.linalg.norm(asked.point, axis=1)  # uniform on a sphere (Archimedes)
        assert np.abs(np.histogram(height, 5, (-1, 1))[0] / len(asked) - 0.2).max() < 0.03


def test_small_level_sets_have_as_many_points_as_large_ones():
    def needle(x):
        return np.exp(-((10 * x**2).sum(axis=1) ** 0.5))

    scene = sky(sampled(needle, (48, 48, 48), (-1, -1, -1), np.full(3, 2 / 47)), (0.001, 0.8))
    asked = unseen_in_volume(scene, 1000, 0)
    assert 950 < len(asked) <= 1000
    share = (asked.level[:, 0] - 0.001) / 0.799
    assert np.abs(np.histogram(share, 5, (0, 1))[0] - 200).max() < 30


def test_unseen_points_differ_from_seed_to_seed_and_the_truth_walks_other_paths():
    scene = sky()
    one, other = (unseen_in_volume(scene, 100, seed).point for seed in (0, 1))
    assert not np.isin(one[:, 0], other[:, 0]).any()
    assert other_paths(0) != 0 and other_paths(other_paths(5)) == 5


def test_corners_hold_exactly_what_a_lookup_in_the_built_grid_reads():
    scene = FIELDS["bumps"]()
    asked = unseen_in_volume(scene, 300, 0)
    for nodes in (9, 22, 31):
        light = run(scene, grid=nodes, paths=8, bounces=2, seed=5)
        ahead = lattice(specs_over(scene, nodes), prepare(BACKEND, scene), 2)
        around = corners(scene, ahead.specs, asked)
        read, covered = around.read(BACKEND.solve(scene, around.asked, paths=range(8), bounces=2, seed=5))
        assert covered.mean() > 0.5 and nodes_to_light(scene, ahead) == light.recipe["queries"]
        np.testing.assert_allclose(read[covered], look_up(light.grids, asked)[0][covered], rtol=2e-5)


def test_the_split_finds_parts_that_were_put_in():
    random, n = np.random.default_rng(0), 40_000
    scene = sky()
    asked = Queries.at(scene, np.zeros((n, 3)))
    exact = 2.0 + 0.3 * random.normal(size=(n, 1)) * np.ones((1, 3))
    noise = 0.03 * random.normal(size=(2, n, 3))  # the truth is itself noisy

    def truth_of(light, bounces):
        none, paths = np.zeros((n, 3), np.float32), np.full(n, 32, np.int32)
        one, other = (Samples(asked, (light + off).astype(np.float32), none, paths) for off in noise)
        return reference_of(one, other, bounces)

    truth, fewer = truth_of(exact, 9), truth_of(exact - 0.06, 2)
    assert truth.error == pytest.approx(0.03 / np.sqrt(2) / truth.mean, rel=0.02)
    grid = 0.1 * random.normal(size=(n, 1))
    covered = np.arange(n) % 4 > 0
    grid[~covered] *= 3
    one, other = (exact - 0.06 + grid + 0.08 * random.normal(size=(n, 3)) for _ in range(2))
    found = parts_of(one, other, covered, fewer, truth)
    assert found.noise == pytest.approx(0.08**2 / 4, rel=0.03)
    assert found.grid == pytest.approx(0.75 * 0.1**2 / 4, rel=0.06)
    assert found.uncovered == pytest.approx(0.25 * 0.3**2 / 4, rel=0.06)
    assert found.bounces == pytest.approx(0.06**2 / 4, rel=0.01)
    assert found.total == pytest.approx(((one - exact) ** 2).mean() / 4, rel=0.03)
    assert 0 < found.uncertain < 0.1 * found.grid


def test_the_measured_noise_is_that_of_two_built_grids():
    scene, nodes = FIELDS["few bumps"](), 24
    probe = Probe.start(scene, prepare(BACKEND, scene), 1500, 0.05, 0)
    ahead = lattice(specs_over(scene, nodes), probe.reference.tracer, 3)
    found = probe.measure(ahead, 16)
    one, other = (
        look_up(run(scene, grid=nodes, paths=16, bounces=3, seed=s).grids, probe.reference.queries)[0] for s in (8, 9)
    )
    built = ((one - other) ** 2).mean() / 2 / probe.reference.mean**2
    assert found.parts.noise == pytest.approx(built, rel=0.25)


def measured(grid, floor, noise=0.04, paths=16, nodes=None, slow=1.0):
    parts = Parts(noise=noise**2, grid=floor**2, uncovered=0, bounces=0, cross=0, uncertain=0)
    return Measured(grid, nodes or grid**3, parts, paths, node=slow * 1e-5, path=slow * 1e-6)


def test_the_least_time_for_an_error_and_the_least_error_for_a_time():
    tried = [measured(10, 0.05), measured(20, 0.02), measured(40, 0.005)]
    for goal in (0.01, 0.03, 0.06):
        choice = choose(tried, Goal(goal))
        assert choice.met and choice.error == pytest.approx(goal, rel=0.1)
        others = [m.seconds(m.nodes, n) for m in tried if (n := m.paths_for(goal**2))]
        assert choice.seconds == min(others)
    for seconds in (0.05, 0.5, 5.0):
        choice = choose(tried, Goal(seconds=seconds))
        assert choice.met and choice.seconds <= seconds * 1.001
        counts = [m.paths_in(seconds, m.nodes) for m in tried]
        assert choice.error == min(m.squared(n) ** 0.5 for m, n in zip(tried, counts) if n >= 4)


class Clock:
    """A machine with a given time per path, which may change."""

    def __init__(self, pace):
        self.now, self.pace = 0.0, pace

    def __call__(self):
        return self.now

    def walk(self, plan, until):
        done = 0
        for numbers in rounds(plan.paths, plan.fill, until, self):
            assert numbers.start == done  # one after the other, none twice
            done = numbers.stop
            self.now += len(numbers) * self.pace(self.now)
        return done


@pytest.mark.parametrize("factor", [0.2, 0.5, 1.0, 2.0, 3.0])
def test_a_time_is_kept_whatever_the_pace(factor):
    plan = Plan(grid=8, paths=400, bounces=4, error=0.01, seconds=8.0, fill=0.5, met=True, why=())
    clock = Clock(lambda now: factor * 8.0 / 400)
    done = clock.walk(plan, 10.0)
    assert 0.85 * 9.0 <= clock.now <= 9.05 and done == pytest.approx(9.0 / clock.pace(0), rel=0.1)  # 9: the rest fills


def test_a_machine_that_slows_down_is_late_by_what_it_slowed_last():
    plan = Plan(grid=8, paths=400, bounces=4, error=0.01, seconds=8.0, fill=0.0, met=True, why=())
    clock = Clock(lambda now: 0.02 if now < 5 else 0.03)
    clock.walk(plan, 10.0)
    assert 8.5 <= clock.now <= 12.5
    late = Clock(lambda now: 1.0)  # the fewest paths take longer than there is time
    assert late.walk(plan, 10.0) == 100


def test_the_probe_of_an_error_climbs_to_finer_grids_where_its_first_choice_will_not_do(monkeypatch):
    """The first look sees few points, and may find a grid good enough by chance."""
    scene, looks = FIELDS["few bumps"](), []

    def lucky(probe, ahead, paths):
        grid = max(ahead.specs[0].shape)
        looks.append((len(probe.reference), grid))
        first = looks[0][0] == len(probe.reference)
        return measured(grid, 0.001 if first or grid >= 20 else 0.1, nodes=grid**3)

    monkeypatch.setattr(Probe, "measure", lucky)
    plan, _ = planned(scene, prepare(BACKEND, scene), level_table(scene, 4), error=0.02, seed=0)
    assert plan.met and plan.grid >= 20


def test_what_cannot_be_had_is_said():
    choice = choose([measured(10, 0.05), measured(20, 0.02)], Goal(0.01))
    assert not choice.met and choice.measured.grid == 20 and choice.error == pytest.approx(0.02 * 1.25**0.5, rel=0.05)
    assert not choose([measured(40, 0.005)], Goal(seconds=1e-3)).met
    fixed = choose([measured(20, 0.02)], Goal(0.03, paths=7))
    assert fixed.paths == 7 and not fixed.met


def test_a_plan_that_is_crude_late_or_out_of_reach_is_announced():
    tried = [measured(20, 0.02), measured(40, 0.005)]

    def said(goal, pilot=0.0):
        return outlook(tried, goal, choose(tried, goal), pilot)

    easy = choose(tried, Goal(0.05)).seconds
    assert said(Goal(0.05)) == "" and said(Goal(seconds=10 * easy)) == ""
    short = said(Goal(seconds=1e-3))
    assert "0.001 seconds are too short" in short and "10% takes about 0.11 seconds" in short
    assert "10% takes about 2.1 seconds" in said(Goal(seconds=1e-3), pilot=2.0)  # which --seconds counts, too
    assert "out of reach" in said(Goal(1e-4))
    times = 100 / choose(tried, Goal(0.021)).seconds
    slow = [measured(20, 0.02, slow=times), measured(40, 0.005, slow=times)]
    late = outlook(slow, Goal(0.021), choose(slow, Goal(0.021)), 0.0)
    assert "2.1% is predicted to take" in late and "--seconds 60 reaches" in late


def test_walls_take_their_time():
    tried = [measured(20, 0.02)]
    without, beside = (choose(tried, Goal(seconds=1.0, texels=texels)) for texels in (0, 20**3))
    assert beside.paths < 0.6 * without.paths


def test_sizes_go_up_to_twice_the_voxels():
    found = sizes(sky(ball(20)))
    assert found == sorted(found) and found[-1] == 40 and 20 in found


def test_the_judgement_agrees_with_a_reference_on_level_sets():
    scene = FIELDS["labyrinth"]()
    tracer = prepare(BACKEND, scene)
    asked = unseen_on_level_sets(scene, 16, 1600, seed=50)
    truth = converge(begin(tracer, asked, 16, seed=50), 0.01, 128)
    light = run(scene, grid=14, paths=16, seed=0)
    found = judge(scene, tracer, unseen_in_volume, lambda asked: look_up(light.grids, asked)[0], 0, 10**7, 16, 4)
    assert found.rmse == pytest.approx(off(light, truth), rel=0.2)
    assert 0 < found.uncertain < 0.2 * found.rmse


def test_run_reports_what_it_chose_and_what_it_reached():
    scene = FIELDS["few bumps"]()
    recipe = run(scene, error=0.05, seed=0, judge=True).recipe
    assert recipe["plan"]["met"] and recipe["plan"]["grid"] in (recipe["grid"], (recipe["refined"] or {}).get("from"))
    assert recipe["paths"] == recipe["plan"]["paths"] and len(recipe["plan"]["why"]) >= 2
    assert recipe["reached"] <= 1.3 * 0.05
    kept = run(
        scene, seconds=1e6, grid=12, paths=8, bounces=3, seed=0
    ).recipe  # paths that are given end, not the clock
    assert kept["grid"] == 12 and kept["bounces"] == 3 and kept["paths"] == kept["plan"]["paths"] == 8
    assert run(scene, grid=8, paths=2, bounces=1).recipe["plan"] is None


def test_what_no_probe_can_plan_is_refused():
    scene = sky()
    refused(lambda: run(scene, error=0.1, seconds=3.0), "both", "one of them")
    refused(lambda: run(scene, error=0.0), "error of 0", "0.03")
    refused(lambda: run(scene, seconds=-1.0), "-1 seconds")
    refused(lambda: run(scene, error=0.1, sampler="uniform"), "uniform", "direct", "bench")
    dark = Scene(scene.fields)
    refused(lambda: run(dark, error=0.1), "no light", "background")


def test_errors_of_a_known_difference():
    scene = sky()
    grid = run(scene, grid=6, paths=4, bounces=0).grids[0]
    asked = unseen_in_volume(scene, 50, 0)
    n = len(asked)
    rgb = np.ones((n, 3), np.float32)
    half = Samples(asked, 2 * rgb, 0 * rgb, np.full(n, 9, np.int32))
    truth = reference_of(half, half, 1)
    flat = IlluminationGrid(grid.spec, np.full_like(grid.values, 2.2), grid.error, grid.support)
    found = errors(look_up([flat], asked)[0], truth)
    for value in (found.rmse, found.median, found.p95, found.bias):
        assert value == pytest.approx(0.1, rel=1e-4)
