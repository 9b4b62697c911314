"""Quads and lamps in the kernels, function by function: compiled, or as plain Python, for coverage."""

import math

import numpy as np
import pytest

import naive
from illumgrid import constants
from illumgrid.backends import kernels
from illumgrid.backends.numba_ import Numba
from illumgrid.backends.reference import Reference
from illumgrid.field.levelset import marchable
from illumgrid.field.rooms import box_around
from illumgrid.field.scene import Material, Quad, Scene
from illumgrid.transport.samples import join_queries
from rooms import MIRRORED, NOWHERE, at_levels, box, empty, lamp, lamps, on_quads, painted
from transport import everywhere, noise, worth

pytestmark = pytest.mark.plain
SOLO = Numba(threads=1)
X, Y, Z = np.eye(3)


@pytest.fixture(autouse=True)
def as_compiled():
    """Compiled code neither warns when random numbers wrap around nor when a plane is infinitely far."""
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        yield


def alone(*quads, direction=None):
    """Quads, and a field without a surface at NOWHERE."""
    return Scene((empty(**({} if direction is None else {"direction": direction})),), quads)


def meet(scene, x, d):
    d = np.array(d, float) / np.linalg.norm(d)
    return kernels.meet_quad(marchable(scene), 0, tuple(np.array(x, float)), tuple(d))


def test_a_ray_meets_a_parallelogram_within_its_edges_from_both_sides():
    scene = alone(Quad("wall", (1, 1, 1), 2 * X, Y + X))
    for x, d, expected in (
        ((2, 1.5, 3), -Z, 2), ((2, 1.5, -1), Z, 2), ((2, 1.5, 3), Z, math.inf), ((2, 1.5, -1), -Z, math.inf),
        ((1.1, 1.5, 3), -Z, math.inf), ((1.6, 1.5, 3), -Z, 2), ((3.4, 1.5, 3), -Z, 2), ((3.6, 1.5, 3), -Z, math.inf),
        ((2, 0.99, 3), -Z, math.inf), ((2, 2.01, 3), -Z, math.inf), ((1, 1, 3), -Z, 2), ((4, 2, 3), -Z, 2),
        ((0, 1.5, 1), X, math.inf), ((0, 1.5, 3), X - Z, 2 * math.sqrt(2)),
    ):  # fmt: skip
        assert meet(scene, x, d) == pytest.approx(expected)


@pytest.mark.parametrize("height", [0.0, 1e-15, -1e-15])
def test_a_ray_that_starts_on_a_wall_but_for_rounding_is_in_front_of_it(height):
    scene = alone(Quad("wall", (0, 0, 0), X, Y))
    for x in ((0.3, 0.4, height), (0, 0, height), (1, 1, height), (0, 0.5, height)):
        assert meet(scene, x, (0.1, 0.1, -1)) == pytest.approx(0, abs=1e-12)
        assert meet(scene, x, (0.1, 0.1, 1)) == math.inf
        assert meet(scene, x, (0.1, 0.1, 0)) == math.inf


def test_points_on_lamps_are_uniform_and_as_frequent_as_their_power():
    lights = lamp("a", Z, 2 * X, Y, 3 * X), lamp("b", 2 * Z, Y, X + Y, (1, 2, 3)), lamp("c", 3 * Z, X, 2 * Y, 9 * Y)
    scene = alone(Quad("dark", (0, 0, 0), X, Y), *lights, direction=MIRRORED)
    layout = marchable(scene)
    power = np.array([0, 3 * 2 / 3, 6 / 3 * 1, 9 * 2 / 3])
    np.testing.assert_allclose(layout.lamp_density * [1, 2, 1, 2], power / power.sum())
    choices = (np.arange(1000) + 0.5) / 1000
    found = np.array([kernels.lamp_point(layout, c, 0.25, 0.75)[0] for c in choices])
    np.testing.assert_allclose(np.bincount(found, minlength=4) / 1000, power / power.sum(), atol=2e-3)
    for c in (0.0, 0.35, 0.999, 1.0):
        q, at = kernels.lamp_point(layout, c, 0.25, 0.75)
        quad = scene.quads[q]
        np.testing.assert_allclose(
            scene.from_frame([at])[0], quad.corner + 0.25 * quad.edge_u + 0.75 * quad.edge_v, atol=1e-12
        )


def test_the_density_of_lamps_sums_to_one_over_the_directions():
    scene = alone(lamp("a", (-0.5, -0.3, 1), Y, X, X), lamp("b", (0.4, 0.2, 0.7), 0.5 * Y, 0.3 * X - 0.2 * Z, 5 * Z))
    layout, total = marchable(scene), 0.0
    for q, quad in enumerate(scene.quads):
        u, v = ((np.indices((20, 20)) + 0.5) / 20).reshape(2, -1, 1)
        at = quad.corner + u * quad.edge_u + v * quad.edge_v
        distance = np.linalg.norm(at, axis=1)
        d = at / distance[:, None]
        density = np.array([kernels.lamp_density(layout, q, r, tuple(w)) for r, w in zip(distance, d)])
        assert (density > 0).all()
        assert kernels.lamp_density(layout, q, 1.0, tuple(-d[0])) == 0
        total += (density * np.abs(d @ quad.normal) / distance**2).mean() * quad.area
    assert total == pytest.approx(1, rel=1e-9)


def test_camera_rays_see_the_fronts_of_quads_only():
    front, back = Quad("front", (0, 0, 5), X, Y), Quad("back", (0, 0, 3), Y, X)
    layout = marchable(alone(front, back, Quad("far", (0, 0, 1), X, Y)))
    origin, direction = np.tile([0.5, 0.4, 9.0], (3, 1)), np.array([-Z, Z, -Z])
    origin[2, 2] = 4.0
    t, number, what, normal = np.empty(3), np.empty(3, np.int64), np.empty(3, np.int64), np.zeros((3, 3))
    levels = np.array([NOWHERE])
    kernels.cast_rays(layout, levels, origin, direction, -1, t, number, what, normal)
    assert what.tolist() == [constants.QUAD, constants.MISS, constants.QUAD]
    assert number.tolist() == [1, -1, 3]
    np.testing.assert_allclose(t, [4, math.inf, 3])
    np.testing.assert_allclose(normal, [Z, 0 * Z, Z])
    # the other way round
    kernels.cast_rays(layout, levels, origin, -direction, -1, t, number, what, normal)
    assert what.tolist() == [constants.MISS, constants.QUAD, constants.MISS]
    # a ray that is no camera's meets both sides
    kernels.cast_rays(layout, levels, origin, direction, 1, t, number, what, normal)
    assert number.tolist() == [2, -1, 2]
    np.testing.assert_allclose(normal[[0, 2]], [Z, Z])


@pytest.mark.parametrize("make", [box, lamps])
def test_a_few_paths_between_walls_are_those_of_loops_and_numpy(make):
    scene = make(noise(9, (5, 4, 5), spacing=(1.0, 0.7, 1.9), direction=MIRRORED))
    solid = everywhere(scene)
    solid = solid[np.random.default_rng(0).permutation(len(solid))[:12]]
    queries = join_queries([solid, on_quads(scene, 24, back="both")])
    for path, bounces in enumerate((0, 2)):
        one, answered = worth(SOLO, scene, queries, path, bounces)
        other, also = worth(Reference(), scene, queries, path, bounces)
        np.testing.assert_array_equal(answered, also)
        np.testing.assert_allclose(one, other, atol=1e-6, rtol=1e-6)
        for i in np.flatnonzero(answered):
            truth = naive.path_worth(scene, queries[i : i + 1], path, bounces, 0)
            np.testing.assert_allclose(one[i], truth, atol=1e-6, rtol=1e-6)


def test_a_lamp_does_not_light_itself_nor_what_lies_behind_it():
    light = lamp("lamp", (0, 0, 1), Y, X, 5 * X, albedo=0.5)
    scene = alone(light, lamp("above", (0, 0, 2), X, Y, 0 * X))
    for only, back in ((0, False), (0, True), (1, False)):
        queries = at_levels(on_quads(scene, 5, only=[only], back=back), NOWHERE)
        assert not SOLO.solve(scene, queries, paths=range(4), bounces=2, seed=0).mean.any()


def test_a_small_sealed_box_of_mirrors_is_dark_and_a_furnace_white():
    field = empty()
    walls = box_around(field.volume)[:6]
    shut = Scene((field,), painted(walls, 1.0), np.ones(3))
    queries = at_levels(on_quads(shut, 20), NOWHERE)
    assert not SOLO.solve(shut, queries, paths=range(4), bounces=4, seed=0).mean.any()
    glow = Scene((field,), painted(walls, 0.5, 0.5))
    light = SOLO.solve(glow, queries, paths=range(32), bounces=2, seed=0).mean
    assert light.mean() == pytest.approx(math.pi * (1 - 0.5**3), rel=0.1)
    assert Material().albedo.tolist() == [0.8] * 3
