"""Splat and rbf at every node: constants, convergence, holes, error bars, and two sheets that face each other."""

import numpy as np
import pytest

from illumgrid.field.volume import Volume
from illumgrid.grid import GridSpec, Nodes
from illumgrid.interpolators import neighbours, spline
from illumgrid.interpolators.nearest import Nearest
from illumgrid.interpolators.rbf import Rbf
from illumgrid.interpolators.splat import Splat
from illumgrid.samplers.direct import Direct
from illumgrid.stages import Interpolator
from illumgrid.transport.samples import Queries, Samples, join_queries
from shapes import MIRRORED, ball, refused, sky

UNEVEN = np.array([0.5, 1.25, 3.0])
BOTH = pytest.mark.parametrize("stage", [Splat(), Rbf()], ids=["splat", "rbf"])


def answers(points, mean, stderr=0.0, paths=4, level=0.0, normal=(0, 0, 0)):
    """Samples at world points, with these standard errors."""
    n = len(points)
    rgb = np.broadcast_to(np.asarray(mean, np.float32).reshape(-1, 1) if np.ndim(mean) == 1 else mean, (n, 3))
    paths = np.broadcast_to(paths, n).astype(np.int32)
    m2 = np.broadcast_to(stderr, n)[:, None] ** 2 * (paths * (paths - 1.0))[:, None] * np.ones(3)
    level = np.broadcast_to(level, n).astype(float)[:, None]
    normal = np.broadcast_to(np.asarray(normal, float), (n, 3)).copy()
    queries = Queries(np.arange(n, dtype=np.uint64), np.asarray(points, float), normal, level, np.zeros(n, np.int32))
    return Samples(queries, rgb.astype(np.float32).copy(), m2.astype(np.float32), paths)


def cloud(n, spec, seed=0):
    """World points, uniform over a grid."""
    share = np.random.default_rng(seed).random((n, 3))
    return spec.origin + share * (np.array(spec.shape) - 1) * spec.spacing @ spec.direction.T


def wave(points):
    return 2 + np.sin(points @ [0.5, 0.3, -0.2]) * np.cos(points @ [0.1, -0.2, 0.4])


SPEC = GridSpec((9, 9, 9))
FIELD = sky(ball(6), (0.3, 0.9)).fields[0]


# What theory says


@BOTH
@pytest.mark.parametrize("n", [1, 2, 5, 600])
def test_a_constant_is_reproduced_with_any_normals_and_levels(stage, n):
    random = np.random.default_rng(1)
    spec = GridSpec((6, 7, 5), (1, 2, 3), UNEVEN, MIRRORED)
    normal = random.normal(size=(n, 3))
    samples = answers(cloud(n, spec), 3.0, level=random.integers(0, 5, n), normal=normal)
    grid = stage.fill(samples, Nodes(spec, FIELD))
    assert (grid.support > 0).any()
    np.testing.assert_allclose(grid.values, 3.0, rtol=1e-6)


@BOTH
def test_it_converges_as_samples_grow(stage):
    rmse = []
    for n in (400, 3200, 25600):
        points = cloud(n, SPEC)
        inner = (np.abs(SPEC.nodes() - 4) < 4).all(axis=1)
        grid = stage.fill(answers(points, wave(points)), Nodes(SPEC, FIELD))
        miss = grid.values.reshape(-1, 3)[:, 0] - wave(SPEC.nodes())
        rmse.append(np.sqrt(np.mean(miss[inner] ** 2)))
    # The samples come twice as close each time: first order would be 4 in all.
    assert rmse[2] < rmse[1] < rmse[0] and rmse[2] < rmse[0] / (3.5 if stage.name == "splat" else 10)


def test_rbf_reproduces_what_is_linear_among_its_samples():
    spec = GridSpec((7, 8, 6), (1e5, -2e5, 3e5), UNEVEN, MIRRORED)
    points = cloud(4000, spec)
    values = 5 + (points - spec.origin) @ [0.1, -0.2, 0.15]
    grid = Rbf().fill(answers(points, values), Nodes(spec, FIELD))
    node = spec.nodes() - spec.origin
    truth = (5 + node @ [0.1, -0.2, 0.15]).reshape(spec.shape)
    np.testing.assert_allclose(grid.values[1:-1, 1:-1, 1:-1, 0], truth[1:-1, 1:-1, 1:-1], rtol=2e-6)


@pytest.mark.parametrize("origin", [(0, 0, 0), (1e7, -2e7, 3e7)])
def test_rbf_is_the_identity_on_direct_queries(origin):
    volume = Volume(ball(14).values, origin, UNEVEN, MIRRORED)
    scene = sky(volume, (0.4, 0.8))
    spec = GridSpec.over(volume, 14)
    queries = join_queries(list(Direct().queries(scene, [spec], 0)))
    random = np.random.default_rng(0)
    mean, m2 = random.random((2, len(queries), 3)).astype(np.float32)
    samples = Samples(queries, mean, m2, np.full(len(queries), 8, np.int32))
    at_node = np.flatnonzero((np.abs(queries.point - spec.nodes(queries.id.astype(int))) < 1e-6).all(axis=1))
    at_node = at_node[queries.normal[at_node].any(axis=1)]
    assert len(at_node) > 200
    grid = Rbf().fill(samples, Nodes(spec, FIELD))
    node = queries.id[at_node].astype(int)
    np.testing.assert_allclose(grid.values.reshape(-1, 3)[node], mean[at_node], atol=1e-6)
    np.testing.assert_allclose(grid.error.ravel()[node], samples.error[at_node], rtol=1e-5)
    np.testing.assert_allclose(grid.support.ravel()[node], 1, rtol=1e-5)


def test_the_weights_of_rbf_are_those_of_the_textbook():
    # The saddle-point system of the biharmonic spline with a linear tail, solved by NumPy.
    random = np.random.default_rng(2)
    for n in (5, 9, 16):
        x = random.uniform(-0.5, 0.5, (n, 3))
        distance = np.linalg.norm(x[:, None] - x, axis=2)
        tail = np.column_stack([np.ones(n), x])
        system = np.block([[distance, tail], [tail.T, np.zeros((4, 4))]])
        right = np.concatenate([np.linalg.norm(x, axis=1), [1, 0, 0, 0]])
        weight = np.zeros(n)
        assert spline.solve_weights(x, 0.0, spline._TAIL, np.zeros((n, n)), np.zeros((n, 2)), weight)
        np.testing.assert_allclose(weight, np.linalg.solve(system, right)[:n], atol=2e-6)


# Errors


@BOTH
def test_the_error_of_a_node_is_that_of_independent_samples(stage):
    random = np.random.default_rng(3)
    points = cloud(700, SPEC)
    stderr = random.uniform(0.1, 2.0, 700)
    runs = np.array([
        stage.fill(answers(points, 50 + stderr * random.normal(size=700), stderr), Nodes(SPEC, FIELD)).values[..., 0]
        for _ in range(200)
    ])  # fmt: skip
    error = stage.fill(answers(points, 50.0, stderr), Nodes(SPEC, FIELD)).error
    # The squared ratio of spread and error has mean 1; rbf's is smaller where it is held within its samples.
    ratio = np.mean(runs.var(axis=0, ddof=1) / error**2)
    assert ratio < 1.05 and ratio > (0.95 if stage.name == "splat" else 0.7)


@BOTH
def test_support_is_how_many_samples_a_node_is_worth(stage):
    grid = stage.fill(answers(cloud(700, SPEC), 1.0, stderr=0.3), Nodes(SPEC, FIELD))
    assert (grid.support > 0).all() and grid.support.max() <= 16
    np.testing.assert_allclose(grid.error, 0.3 / np.sqrt(grid.support), rtol=1e-5)


@BOTH
def test_one_path_supports_a_node_though_its_error_is_unknown(stage):
    grid = stage.fill(answers([[4, 4, 4], [4, 4, 5]], 2.0, paths=1), Nodes(SPEC, FIELD))
    near = grid.support > 0
    assert near.any() and np.isinf(grid.error[near]).all() and (grid.values == 2).all()


@BOTH
def test_samples_at_one_place_are_merged_by_their_paths(stage):
    points = np.full((500, 3), 4.0) + np.random.default_rng(0).uniform(-1e-9, 1e-9, (500, 3))
    paths = np.where(np.arange(500) < 100, 30, 10)
    mean = np.where(np.arange(500) < 100, 1.0, 8.0)
    grid = stage.fill(answers(points, mean, stderr=0.5, paths=paths), Nodes(SPEC, FIELD))
    np.testing.assert_allclose(grid.values, (3000 * 1 + 4000 * 8) / 7000, rtol=1e-5)
    expected = 0.5 * np.sqrt(100 * 30**2 + 400 * 10**2) / 7000
    np.testing.assert_allclose(grid.error[4, 4, 4], expected, rtol=1e-5)


# Reach


@BOTH
def test_nodes_beyond_a_cells_diagonal_are_holes_with_the_light_of_the_nearest_node(stage):
    spec = GridSpec((12, 3, 3))
    grid = stage.fill(answers([[0, 1, 1], [11, 1, 1]], [1.0, 4.0]), Nodes(spec, FIELD))
    supported = np.linalg.norm(spec.nodes() - [0, 1, 1], axis=1) <= 3**0.5 + 1e-5
    supported |= np.linalg.norm(spec.nodes() - [11, 1, 1], axis=1) <= 3**0.5 + 1e-5
    assert np.array_equal(grid.support.ravel() > 0, supported)
    assert np.array_equal(np.isinf(grid.error.ravel()), ~supported)
    low, high = grid.values[supported.reshape(spec.shape)].reshape(2, -1, 3)
    assert (low < 1.5).all() and (high > 3.5).all()  # of rbf a little of the far end comes along
    near = [np.unique(part) for part in (grid.values[2:6, 1, 1], grid.values[6:10, 1, 1])]
    assert np.isin(near[0], low).all() and np.isin(near[1], high).all()


def sheet(z, spec, seed, per=4):
    """Points uniform over a plane of constant z, `per` per squared node spacing."""
    wide = np.array(spec.shape[:2]) - 1
    share = np.random.default_rng(seed).random((int(wide.prod() * per), 2))
    return np.column_stack([share * wide, np.full(len(share), z)])


@BOTH
def test_between_two_level_sets_light_is_interpolated_and_beyond_them_it_is_not_extrapolated(stage):
    spec = GridSpec((13, 13, 15))
    low, high = sheet(4.0, spec, 0), sheet(10.0, spec, 1)
    up = answers(
        np.concatenate([low, high]), np.repeat([1.0, 7.0], [len(low), len(high)]),
        level=np.repeat([0.7, 0.2], [len(low), len(high)]), normal=(0, 0, 1),
    )  # fmt: skip
    grid = stage.fill(up, Nodes(spec, FIELD))
    reached = (grid.support > 0)[3:-3, 3:-3]
    # Samples reach a cell's diagonal, 1.7; between the sheets, 6 apart, every node is reached.
    assert reached[:, :, 3:12].all() and not reached[:, :, :2].any() and not reached[:, :, 13:].any()
    profile = grid.values[4:-4, 4:-4, :, 0].mean(axis=(0, 1))
    assert (np.diff(profile[3:12]) >= -1e-6).all() and profile[4] < 1.3 and profile[10] > 6.7
    assert profile[7] == pytest.approx(4, abs=0.6)
    np.testing.assert_allclose(profile[4:11], np.arange(1, 8), atol=0.3)


def test_nearest_leaves_the_middle_of_a_wide_gap_a_hole():
    spec = GridSpec((13, 13, 15))
    points = np.concatenate([sheet(4.0, spec, 0), sheet(10.0, spec, 1)])
    grid = Nearest().fill(answers(points, 1.0, level=points[:, 2], normal=(0, 0, 1)), Nodes(spec, FIELD))
    assert not grid.support[:, :, 7].any()


@BOTH
@pytest.mark.parametrize("count", [0, 3])
def test_no_answer_at_all_is_a_grid_of_holes_without_nan(stage, count):
    spec = GridSpec((3, 4, 5))
    grid = stage.fill(answers(np.ones((count, 3)), 0.0, paths=0), Nodes(spec, FIELD))
    assert not grid.values.any() and not grid.support.any() and np.isinf(grid.error).all()


@BOTH
def test_answers_without_paths_are_passed_over(stage):
    grid = stage.fill(answers([[1, 1, 1], [1, 1, 1.4]], [9.0, 3.0], paths=[0, 4]), Nodes(GridSpec((3, 3, 3)), FIELD))
    assert (grid.values[1, 1, 1] == 3).all()


# Sheets that are close


def two_faces(gap, facing, per=4):
    """Light 1 on one sheet and 0 on the other, `gap` nodes from it: the faces of a slab, or walls that face."""
    spec = GridSpec((13, 13, 9))
    lit, dark = sheet(4 + gap / 2, spec, 0, per), sheet(4 - gap / 2, spec, 1, per)
    away = -1.0 if facing else 1.0
    normal = np.zeros((len(lit) + len(dark), 3))
    normal[:, 2] = np.repeat([away, -away], [len(lit), len(dark)])
    points, light = np.concatenate([lit, dark]), np.repeat([1.0, 0.0], [len(lit), len(dark)])
    return spec, points, light, normal


def worst_mixture(stage, spec, samples):
    """Largest share of the other side's light at the nodes closer to one sheet than to the other."""
    light = stage.fill(samples, Nodes(spec, FIELD)).values[..., 0]
    side = np.where(np.arange(9) > 4, 1.0, 0.0)[None, None]
    return np.abs(light - side)[:, :, [3, 5]].max()


@pytest.mark.parametrize("stage", [Nearest(), Splat(), Rbf()], ids=["nearest", "splat", "rbf"])
@pytest.mark.parametrize("facing", [False, True], ids=["slab", "cleft"])
def test_two_faces_one_cell_apart_do_not_mix(stage, facing):
    spec, points, light, normal = two_faces(1.0, facing)
    assert worst_mixture(stage, spec, answers(points, light, normal=normal)) == 0
    if stage.name != "nearest":  # only the normals distinguish them
        assert worst_mixture(stage, spec, answers(points, light)) > 0.05


@BOTH
def test_light_stays_within_the_range_of_its_samples(stage):
    points = cloud(3000, SPEC)
    light = (np.random.default_rng(4).random(3000) > 0.5).astype(float)  # two sheets without a side
    values = stage.fill(answers(points, light), Nodes(SPEC, FIELD)).values
    assert values.min() >= 0 and values.max() <= 1


def test_rbf_lays_a_ridge_where_its_weights_would_amplify_and_nowhere_else():
    random = np.random.default_rng(5)

    def steps(x):
        n = len(x)
        weight, value, step = np.zeros((1, n)), np.zeros((1, 3)), np.zeros(1, np.int64)
        spline.weigh(
            np.zeros((1, 3)), np.arange(n)[None], np.linalg.norm(x, axis=1)[None], x, np.ones((n, 3)),
            3, spline.AMPLIFIES, weight, value, step,
        )  # fmt: skip
        assert weight.sum() == pytest.approx(1, abs=1e-6) and np.abs(weight).sum() <= spline.AMPLIFIES + 1e-6
        return step[0]

    around = random.normal(size=(16, 3))
    assert steps(around) == 0
    assert steps(1e-9 * around) == steps(1e9 * around) == 0
    thin = around * [1, 1, 1e-3] + [0, 0, 1]  # a sheet that is not quite flat, a node off it: the tail would fly off
    assert steps(thin) > 0
    assert steps(np.concatenate([around, around[:1] * (1 + 1e-12)])) > 0  # almost one place
    assert steps(around * [1, 1, 0] + [0, 0, 1]) == 0  # flat: no slope is to be had, and none is made up


# The rest


@BOTH
def test_slabs_of_nodes_do_not_show(stage, monkeypatch):
    samples = answers(cloud(300, SPEC), np.random.default_rng(0).random(300), stderr=0.1)
    whole = stage.fill(samples, Nodes(SPEC, FIELD))
    monkeypatch.setattr(neighbours, "_SLAB", 17)
    parts = stage.fill(samples, Nodes(SPEC, FIELD))
    for name in ("values", "error", "support"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name))


@pytest.mark.parametrize("stage", [Nearest(), Splat(), Rbf()], ids=["nearest", "splat", "rbf"])
def test_one_channel_has_the_bits_of_three(stage):
    random = np.random.default_rng(3)
    samples = answers(cloud(700, SPEC), random.random(700), stderr=0.3, level=random.integers(0, 4, 700))
    grey = Samples(samples.queries, samples.mean[:, :1], samples.m2[:, :1], samples.paths)
    one, three = (stage.fill(asked, Nodes(SPEC, FIELD)) for asked in (grey, samples))
    assert one.light.shape == (9, 9, 9, 1) and three.light.shape == (9, 9, 9, 3)
    for name in ("values", "error", "support", "bar"):
        assert np.array_equal(getattr(one, name), getattr(three, name)), name


@BOTH
@pytest.mark.parametrize("scale", [2.0**-20, 2.0**20])
def test_the_unit_of_length_does_not_matter(stage, scale):
    points = cloud(300, SPEC)
    light = np.random.default_rng(0).random(300)
    one = stage.fill(answers(points, light), Nodes(SPEC, FIELD))
    other = stage.fill(answers(scale * points, light), Nodes(GridSpec(SPEC.shape, spacing=np.full(3, scale)), FIELD))
    np.testing.assert_allclose(one.values, other.values, atol=1e-6)


def test_they_are_interpolators_that_refuse_nonsense():
    for stage, name in ((Splat(), "splat"), (Rbf(), "rbf")):
        assert isinstance(stage, Interpolator) and stage.name == name and stage.neighbours == 16
    refused(lambda: Splat(neighbours=0), "splat.neighbours", "0", "at least 1")
    refused(lambda: Rbf(neighbours=0), "rbf.neighbours", "0", "at least 1")


@pytest.mark.plain
def test_the_kernel_of_rbf_as_plain_python():
    points = cloud(60, GridSpec((3, 3, 3)))
    grid = Rbf(8).fill(answers(points, points @ [1.0, 2.0, 3.0]), Nodes(GridSpec((3, 3, 3)), FIELD))
    assert grid.values[1, 1, 1, 0] == pytest.approx(6, abs=0.02)
    flat = points * [1, 1, 1e-3]
    assert np.isfinite(Rbf(8).fill(answers(flat, 1.0), Nodes(GridSpec((3, 3, 3)), FIELD)).values).all()
