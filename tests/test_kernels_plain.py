"""The kernels, function by function: compiled, or with NUMBA_DISABLE_JIT=1 as plain Python, for coverage."""

import math

import numba
import numpy as np
import pytest

import naive
from illumgrid import constants
from illumgrid.backends import cubics, kernels, march, normals
from illumgrid.backends.numba_ import Numba
from illumgrid.backends.reference import Reference
from illumgrid.field.levelset import marchable, turned_levels
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Volume, interpolate, outward_normals
from illumgrid.grid.cache import NO_CACHE
from transport import ALBEDO, colored, everywhere, furnace, linear, noise, on_sets, on_voxels, rotation, waves, worth

pytestmark = pytest.mark.plain
SOLO = Numba(threads=1)


@pytest.fixture(autouse=True)
def as_compiled():
    """Compiled code neither warns when random numbers wrap around nor when a plane is infinitely far."""
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        yield


# Roots.


def first_of(coefficients, end):
    """Smallest real root in [0, end] by numpy, and whether rounding could decide about it or another."""
    roots = np.roots(coefficients[::-1])
    real = np.sort(roots[np.abs(roots.imag) < 1e-12 * np.maximum(1, np.abs(roots))].real)
    hits = real[(real >= 0) & (real <= end)]
    near = np.abs(roots.imag) < 1e-5
    close = near.sum() > 1 and np.diff(np.sort(roots[near].real)).min() < 1e-4
    return (hits[0] if len(hits) else math.inf), bool(close or np.abs(real - end).min(initial=1) < 1e-9)


def test_the_first_root_of_a_cubic_is_that_of_numpy():
    rng = np.random.default_rng(1)
    found = checked = 0
    for kind in range(3000):
        q = rng.normal(size=4) * 10.0 ** rng.uniform(-2, 2, 4)
        if kind % 3 == 0:
            q = np.poly(rng.uniform(-0.5, 2, 3))[::-1] * rng.choice([-1, 1])
        q[0] = -abs(q[0])
        end = rng.uniform(0.2, 3)
        expected, close = first_of(q, end)
        if close:
            continue
        t = cubics.first_root(*q, end)
        assert t == pytest.approx(expected, abs=1e-9, rel=1e-9)
        found += expected < math.inf
        checked += 1
    assert min(checked, 4 * found) > 2000


def test_the_first_root_of_what_is_no_cubic():
    for q, end, expected in (
        ((-1, 2, 0, 0), 1, 0.5),
        ((-1, 2, 0, 0), 0.4, math.inf),
        ((-1, 0, 4, 0), 1, 0.5),
        ((-1, 0, 0, 8), 1, 0.5),
        ((-1, 0, 0, 0), 1, math.inf),
        ((-0.24, 1, -1, 0), 1, 0.4),
        ((-2, 3, -1, 0), 3, 1),
    ):
        t = cubics.first_root(*(np.float64(c) for c in q), np.float64(end))
        assert t == pytest.approx(expected, abs=1e-13)


@pytest.mark.parametrize("gap", [1e-4, 1e-7, 1e-10])
def test_a_near_tangent_ray_hits_or_misses_as_the_sign_at_the_top_says(gap):
    rng = np.random.default_rng(2)
    for _ in range(300):
        top, slope, bend = rng.uniform(0.2, 0.8), rng.uniform(0.5, 2), rng.uniform(-0.3, 0.3)
        # q(s) = ±gap² - (slope + bend (s - top)) (s - top)²: its local maximum at `top` lies gap² above or below 0.
        falling = np.polynomial.Polynomial([-top, 1]) ** 2 * np.polynomial.Polynomial([slope - bend * top, bend])
        for sign in (1, -1):
            q = (np.polynomial.Polynomial([sign * gap**2]) - falling).coef
            t = cubics.first_root(*q, np.float64(1))
            if gap**2 < 1e-15:  # lost in rounding: either answer, but at the right place
                assert t == math.inf or t == pytest.approx(top, abs=1e-6)
            elif sign > 0:
                assert t == pytest.approx(top - gap / math.sqrt(slope), abs=max(gap**2, 1e-8) * 3)
            else:
                assert t == math.inf


def test_the_next_root_is_the_first_of_the_quadratic_that_is_left():
    rng = np.random.default_rng(3)
    found = checked = 0
    for _ in range(3000):
        q = rng.normal(size=3) * 10.0 ** rng.uniform(-2, 2, 3)
        q[0] = -abs(q[0])
        end = rng.uniform(0.2, 3)
        expected, close = first_of(q, end)
        if not close:
            assert cubics.next_root(*q, end) == pytest.approx(expected, abs=1e-9, rel=1e-9)
            found += expected < math.inf
            checked += 1
    assert min(checked, 8 * found) > 2000


def test_the_next_root_of_what_is_no_cubic():
    for q, expected in (
        ((1, -5, 3), 0),  # dips at once
        ((0, 1, -9), 0),
        ((0, 0, 0), 0),  # flat at the level: solid
        ((0, 0, -1), math.inf),
        ((0, -1, 0), math.inf),
        ((0, -1, 2), 0.5),
        ((0, -3, 2), math.inf),
        ((-1, 2, 0), 0.5),
        ((-1, 0, 4), 0.5),
        ((-1, 2.1, -1), 0.72984378812835),
        ((-1, 1.9, -1), math.inf),
    ):
        t = cubics.next_root(*(np.float64(c) for c in q), np.float64(1))
        assert t == pytest.approx(expected, abs=1e-12)


def test_on_a_plane_of_voxels_the_direction_chooses_the_cell():
    for u, d, expected in (
        (2.5, 1.0, 2), (2.5, -1.0, 2), (2.0, 1.0, 2), (2.0, -1.0, 1), (2.0, 0.0, 2), (5.0, 0.0, 4), (5.0, -1.0, 4),
        (5.0, 1.0, 5), (0.0, -1.0, -1), (0.0, 1.0, 0), (0.0, 0.0, 0),
    ):  # fmt: skip
        assert march.first_cell(np.float64(u), np.float64(d), 5) == expected
    assert [march.snap(np.float64(u)) for u in (3 + 5e-8, 3 + 2e-7)] == [3, 3 + 2e-7]


# Values, normals, directions.


@pytest.mark.parametrize("inside", ["above", "below"])
def test_normals_and_solids_are_those_of_the_volume(inside):
    values = noise(9, (4, 5, 3)).values.copy()
    values[:3, :3, :] = [[1], [2], [1]]  # where central differences cancel, and where there is nothing but a plateau
    values[:2] = 7
    scene = furnace(Volume(values, spacing=(1.0, 0.7, 1.9)), inside=inside)
    volume, fields = scene.fields[0].volume, marchable(scene)
    rng = np.random.default_rng(4)
    index = np.concatenate([rng.uniform(0, 1, (80, 3)) * [3, 4, 2], np.argwhere(np.ones((4, 5, 3)))[::2]])
    expected = outward_normals(volume, index, inside)
    level = turned_levels(scene, np.array([4.5]))[0]
    solid = scene.fields[0].upward * (interpolate(volume, index) - 4.5) >= 0
    for u, normal, within in zip(index, expected, solid):
        np.testing.assert_allclose(normals.gradient_normal(fields, 0, *u), normal, atol=1e-6)
        assert march.in_solid(fields, 0, level, tuple(u * volume.spacing), tuple(normal)) == within
    assert (~expected.any(axis=1)).any()
    assert not any(
        march.in_solid(fields, 0, level, tuple(np.array(u) * volume.spacing), (0.0, 0.0, 1.0))
        for u in ([-0.1, 1, 1], [1, 4.1, 1], [1, 1, 2.1])
    )


def test_directions_have_the_moments_of_a_cosine():
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(6, 3))
    normals = [*(normals / np.linalg.norm(normals, axis=1, keepdims=True)), [0, 0, 1.0], [0, 0, -1.0], [1.0, 0, -1e-17]]
    for n in normals:
        u = (np.indices((30, 40)).reshape(2, -1).T + 0.5) / [30, 40]
        d = np.array([kernels.cosine_direction(a, b, *np.array(n, float)) for a, b in u])
        cosine = d @ n
        np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, atol=1e-14)
        np.testing.assert_allclose(cosine, np.sqrt(1 - u[:, 0]), atol=1e-14)
        assert cosine.mean() == pytest.approx(2 / 3, abs=1e-3)
        np.testing.assert_allclose(d.mean(axis=0), np.multiply(n, 2 / 3), atol=1e-3)
        second = d.T @ d / len(d)  # 1/2 along the normal, 1/4 across
        np.testing.assert_allclose(second, 0.25 * np.eye(3) + 0.25 * np.outer(n, n), atol=1e-3)


# Rays from outside.


def cast(scene, levels, origin, direction):
    n = len(origin)
    t, field, what, normal = np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64), np.zeros((n, 3))
    levels = turned_levels(scene, np.array(levels, float))
    origin, direction = np.array(origin, float), np.array(direction, float)
    kernels.cast_rays(marchable(scene), levels, origin, direction, -1, t, field, what, normal)
    return t, field, what, normal


@pytest.mark.parametrize("inside", ["above", "below"])
def test_camera_rays_meet_what_the_loops_say(inside):
    other = noise(9, (5, 4, 4), seed=5, origin=(5.3, -0.8, 1.1), spacing=(0.8, 0.6, 0.9))
    scene = furnace(noise(9, (6, 5, 4), spacing=(1.0, 0.7, 1.9)), other, inside=inside)
    rng = np.random.default_rng(6)
    at = rng.uniform(-1, 7, (100, 3))
    direction = rng.normal(size=(100, 3))
    direction[:30] = np.eye(3)[rng.integers(0, 3, 30)] * rng.choice([-1, 1], (30, 1))  # zero components
    direction[30:50, 1] = 0
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = at - 15 * direction * (rng.random((100, 1)) < 0.7)
    levels = [4.3, 5.6]
    t, field, what, normal = cast(scene, levels, origin, direction)
    for i in range(100):
        hit = naive.first_hit(scene, levels, origin[i], direction[i])
        if hit is None:
            assert (what[i], t[i], field[i]) == (constants.MISS, math.inf, -1)
            continue
        assert field[i] == hit.field
        assert t[i] == pytest.approx(hit.t, abs=1e-9)
        expected = constants.BURIED if hit.normal is None else constants.CAP if hit.cap else constants.SURFACE
        assert what[i] == expected
        np.testing.assert_allclose(normal[i], [0, 0, 0] if hit.normal is None else hit.normal, atol=1e-6)
    assert set(what) == {constants.MISS, constants.SURFACE, constants.CAP, constants.BURIED}


def test_rays_along_the_faces_and_edges_of_the_box():
    scene = Scene.sky(linear((1, 0, 0), (6, 6, 6)), range=(0.5, 4.5))  # solid where x >= 2.25
    x, y, z = np.eye(3)
    rays = [
        ([-1, 0, 2.5], x, 3.25, constants.SURFACE, -x),  # in a face
        ([-1, 5, 5], x, 3.25, constants.SURFACE, -x),  # along the last edge
        ([9, 0, 5], -x, 4, constants.CAP, x),
        ([5, -2, 1.5], y, 2, constants.CAP, -y),
        ([3, 3, 8], -z, 3, constants.CAP, z),
        ([-1, 5.001, 2], x, math.inf, constants.MISS, 0 * x),  # beside
        ([-1, -1, 0], (x + y) / math.sqrt(2), 3.25 * math.sqrt(2), constants.SURFACE, -x),  # the diagonal of a face
        ([4, 2, 2], x, 0, constants.BURIED, 0 * x),
    ]
    t, _, what, normal = cast(scene, [2.25], [r[0] for r in rays], [r[1] for r in rays])
    np.testing.assert_allclose(t, [r[2] for r in rays], atol=1e-12)
    assert what.tolist() == [r[3] for r in rays]
    np.testing.assert_allclose(normal, [r[4] for r in rays], atol=1e-12)


def test_where_a_ray_touches_a_saddle_there_is_no_normal():
    x, y, _ = np.indices((2, 2, 2))
    scene = Scene.sky(Volume((2.0 * x - 1) * (2 * y - 1)), range=(-0.9, 0.9))
    along = np.array([-1, 1, 0]) / math.sqrt(2)
    t, _, what, normal = cast(scene, [0.0], [[0.5, 0.5, 0.5] - 0.5 * along], [along])
    assert what == constants.SURFACE
    assert t == pytest.approx(0.5, abs=1e-7)
    assert not normal.any() or abs(normal[0] @ along) > 0.99  # or it is that of a rounding beside it


@pytest.mark.skipif(not numba.config.DISABLE_JIT, reason="one path alone would be compiled")
def test_a_path_that_starts_inside_another_solid_is_worth_nothing():
    scene = colored(furnace(linear((1, 0, 0)), linear((1, 0, 0), origin=(0.1, 0.1, 0.1))))
    levels = turned_levels(scene, np.array([2.5, 2.5]))  # the second, below, holds all from 0.1 to 2.6 along x
    point, normal = (2.5, 3.0, 2.0), (-1.0, 0.0, 0.0)
    for path in range(5):
        key = np.uint64(7)
        start, light = (levels, 0, constants.NOWHERE, point, normal), np.ones(3)
        scenery = marchable(scene), NO_CACHE, constants.OFF_SWEEP
        kernels.walk(*scenery, key, np.uint64(path), 4, *start, 0, np.ones(3), light)
        assert not light.any()


@pytest.mark.skipif(not numba.config.DISABLE_JIT, reason="each kind would be compiled: bytes are, in test_native")
@pytest.mark.parametrize("kind, least, step", [("i1", -120, 2), ("<i2", -30000, 600), ("<u2", 2, 600)])
def test_every_kind_of_number_is_read_as_in_single_precision(kind, least, step):
    values, found = noise(100).values.astype(int) * step + least, []
    for some in (values.astype(kind), values.astype(np.float32)):
        scene = Scene.sky(Volume(some), range=(20 * step + least, 80 * step + least))
        found.append(SOLO.solve(scene, on_sets(scene, 2, 6), paths=range(2), bounces=2, seed=0).light)
    assert np.array_equal(*found) and found[0].any()


@pytest.mark.parametrize("d", [(1, 1, 1), (-1, 1, -1), (0, 0, 1), (0, -1, 0)])
def test_a_lone_voxel_in_the_corner_of_eight_bricks_is_met(d):
    values = np.zeros((9, 9, 9))
    values[4, 4, 4] = 1
    d = np.array(d) / np.linalg.norm(d)
    t, _, what, normal = cast(Scene.sky(Volume(values), range=(0.1, 0.9)), [0.5], [4 - 20 * d], [d])
    assert what == constants.SURFACE
    assert 19 < t < 20
    np.testing.assert_allclose(normal[0], -d, atol=1e-6)


# Paths, small.


@pytest.mark.parametrize("name", ["noise", "below", "smooth", "two fields"])
def test_a_few_paths_are_those_of_loops_and_numpy(name):
    axes = rotation()
    volume = waves((9, 10, 6)) if name == "smooth" else noise(9, (5, 4, 5), spacing=(1.0, 0.7, 1.9), direction=axes)
    more = [noise(9, (4, 3, 4), seed=2, origin=[1.2, 0.4, -0.9], direction=axes)] if name == "two fields" else []
    scene = colored(furnace(volume, *more, inside="below" if name == "below" else "above"))
    queries = everywhere(scene)
    queries = queries[np.random.default_rng(0).permutation(len(queries))[:50]]
    for path, bounces in enumerate((0, 3)):
        one, answered = worth(SOLO, scene, queries, path, bounces)
        other, also = worth(Reference(), scene, queries, path, bounces)
        np.testing.assert_array_equal(answered, also)
        np.testing.assert_allclose(one, other, atol=1e-6)
        for i in np.flatnonzero(answered):
            truth = naive.path_worth(scene, queries[i : i + 1], path, bounces, 0)
            np.testing.assert_allclose(one[i], truth, atol=1e-6)


def test_small_furnaces_planes_and_cavities():
    scene = furnace(noise(4, (5, 5, 5)))
    light, answered = worth(SOLO, scene, on_voxels(scene)[::2], 0, 2)
    white = np.abs(light - 1).max(axis=1) < 1e-6
    cut = np.abs(light - (1 - ALBEDO**3)).max(axis=1) < 1e-6
    np.testing.assert_array_equal(white | cut, answered)
    assert white.any()
    assert cut.any()

    scene = Scene.sky(linear((2, 3, -5), (4, 4, 4)), range=(-9, 10))
    answer = SOLO.solve(scene, on_sets(scene, 2, 10), paths=range(3), bounces=1, seed=0)
    np.testing.assert_allclose(answer.mean, math.pi, rtol=1e-6)
    np.testing.assert_allclose(answer.stderr, 0.2 * math.pi / 3, rtol=1e-5)  # what so few may have missed

    shut = np.pad(noise(4, (6, 3, 3)).values, 1, constant_values=9)
    scene = Scene.sky(Volume(shut), (1, 1, 1), (-0.5, 3.5))
    queries = on_voxels(scene)
    queries = queries[queries.level[:, 0] < 9]
    assert not SOLO.solve(scene, queries, paths=range(3), bounces=3, seed=0).mean.any()
