"""The oracle itself, against theory, on tiny inputs."""

import math

import numpy as np
import pytest

import naive
from illumgrid.field.scene import Field, Material, Scene
from illumgrid.field.volume import Volume, interpolate, outward_normals
from illumgrid.transport.samples import Queries

SKY = (1.0, 1.0, 1.0)
ALBEDO = np.array([0.8, 0.5, 0.2])


def linear(shape=(5, 6, 4), slopes=(2, 3, -5), **placement):
    i, j, k = np.indices(shape)
    return Volume(slopes[0] * i + slopes[1] * j + slopes[2] * k, **placement)


def noisy(shape=(6, 6, 6), top=10, seed=1, **placement):
    return Volume(np.random.default_rng(seed).integers(0, top, shape), **placement)


def furnace(volume, inside="above"):
    field = Field("noise", volume, Material(ALBEDO, 1 - ALBEDO), (2.5, 7.5), inside)
    return Scene((field,), background=SKY)


def voxels(volume):
    return volume.origin + (np.argwhere(np.ones(volume.shape)) * volume.spacing) @ volume.direction.T


def open_queries(scene, queries):
    """Number of each query that is no hole."""
    return [i for i in range(len(queries)) if not naive.is_hole(scene, queries[i : i + 1])]


def random_direction(rng):
    d = rng.normal(size=3)
    return d / np.linalg.norm(d)


def depth(scene, levels, x, number=0):
    """Signed v - level at frame points, by the package's own interpolation; -inf outside the box."""
    field = scene.fields[number]
    sign = 1.0 if field.inside == "above" else -1.0
    u = (np.asarray(x) - scene.to_frame(field.volume.origin)) / field.volume.spacing
    beyond = ((u < 0) | (u > np.array(field.volume.shape) - 1)).any(axis=1)
    return np.where(beyond, -np.inf, sign * (interpolate(field.volume, u) - levels[number]))


# Polynomials and cells.


def test_a_polynomial_first_rises_where_it_should():
    assert naive.first_rise([-6.0, 11.0, -6.0, 1.0], 5.0) == pytest.approx(1.0, abs=1e-14)  # (s-1)(s-2)(s-3)
    assert naive.first_rise([6.0, -11.0, 6.0, -1.0], 5.0) == 0.0
    assert naive.first_rise([-1.0, 0.0, 0.0, 0.0], 5.0) is None
    assert naive.first_rise([-2.0, 1.0], 1.0) is None
    assert naive.first_rise([-1e-3, 1.0, -1.0], 1.0) == pytest.approx((1 - math.sqrt(1 - 4e-3)) / 2, rel=1e-12)


def test_the_cubic_of_a_cell_is_its_trilinear_value():
    rng = np.random.default_rng(3)
    volume = noisy((2, 2, 2))
    solid = naive.Solid(Scene.sky(volume), [5.5], 0)
    for _ in range(20):
        start, du = rng.uniform(0.3, 0.7, 3), rng.uniform(-0.2, 0.2, 3)
        p = naive.cubic(solid, [0, 0, 0], list(start), list(du))
        for s in (0.0, 0.4, 1.0):
            assert naive.value(p, s) == pytest.approx(interpolate(volume, (start + s * du)[None])[0] - 5.5, abs=1e-12)


def test_a_plateau_is_exactly_flat():
    values = np.full((3, 3, 3), 7.1)
    values[2] = 0
    solid = naive.Solid(Scene.sky(Volume(values)), [float(np.float32(7.1))], 0)
    assert naive.cubic(solid, [0, 0, 0], [0.3, 0.6, 0.9], [0.1, 0.2, 0.3]) == [0.0, 0.0, 0.0, 0.0]
    assert naive.cubic(solid, [1, 0, 0], [1.0, 0.3, 0.7], [0.1, 0.2, 0.3])[0] == 0.0


def test_directions_are_cosine_distributed_about_the_normal():
    rng = np.random.default_rng(4)
    for n in [random_direction(rng) for _ in range(5)] + [np.array([0, 0, 1.0]), np.array([0, 0, -1.0])]:
        for u1, u2 in rng.random((5, 2)):
            d = naive.cosine_direction(list(n), u1, u2)
            assert math.hypot(*d) == pytest.approx(1, abs=1e-12)
            assert np.dot(d, n) == pytest.approx(math.sqrt(1 - u1), abs=1e-12)


# Light against closed forms.


@pytest.mark.parametrize("inside", ["above", "below"])
@pytest.mark.parametrize("spacing", [(1, 1, 1), (0.5, 2.0, 1.3)])
def test_a_plane_under_the_sky_gathers_pi(inside, spacing):
    volume = linear(spacing=spacing)
    scene = Scene.sky(volume, range=(-5, 15), inside=inside)
    rng = np.random.default_rng(5)
    points = np.concatenate([rng.uniform(0, 1, (10, 3)) * (np.array(volume.shape) - 1) * spacing, voxels(volume)[::3]])
    queries = Queries.at(scene, points)
    mean, m2, paths = naive.solve(scene, queries, range(4), 3, 0)
    np.testing.assert_allclose(mean, math.pi, rtol=1e-14)
    np.testing.assert_allclose(m2, 0.75 * (0.2 * math.pi) ** 2, rtol=1e-12)  # what so few may have missed
    assert (paths == 4).all()


@pytest.mark.parametrize("inside", ["above", "below"])
@pytest.mark.parametrize("bounces", [0, 1, 5])
def test_a_white_furnace_on_noise_is_white_or_cut_off(inside, bounces):
    volume = noisy(spacing=(1.0, 0.7, 1.9))
    scene = furnace(volume, inside)
    queries = Queries.at(scene, voxels(volume)[:: 7 if bounces < 5 else 11])
    escaped = cut = 0
    for i in open_queries(scene, queries):
        for path in range(3):
            worth = naive.path_worth(scene, queries[i : i + 1], path, bounces, 0)
            if np.allclose(worth, 1.0, atol=1e-12, rtol=0):
                escaped += 1
            else:
                np.testing.assert_allclose(worth, 1 - ALBEDO ** (bounces + 1), atol=1e-12, rtol=0)
                cut += 1
    assert escaped > 5
    assert cut > 5


def test_moments_are_those_of_the_paths():
    scene = furnace(noisy())
    queries = Queries.at(scene, voxels(scene.fields[0].volume)[100:103])
    mean, m2, paths = naive.solve(scene, queries, range(3, 9), 1, 2)
    for i in open_queries(scene, queries):
        light = math.pi * np.array([naive.path_worth(scene, queries[i : i + 1], p, 1, 2) for p in range(3, 9)])
        np.testing.assert_allclose(mean[i], light.mean(axis=0), rtol=1e-14)
        np.testing.assert_allclose(light.var(axis=0), 0, atol=1e-14)
        np.testing.assert_allclose(m2[i], 5 / 6 * (0.2 * math.pi) ** 2, rtol=1e-12)  # what so few may have missed
    assert set(paths) <= {0, 6}


def test_no_path_and_no_normal_are_holes():
    scene = Scene.sky(linear(), range=(-5, 15))
    queries = Queries.at(scene, [[1, 1, 1], [99, 1, 1]])
    assert list(naive.solve(scene, queries, range(2), 0, 0)[2]) == [2, 0]
    assert list(naive.solve(scene, queries, range(0), 0, 0)[2]) == [0, 0]


# Hits.


@pytest.mark.parametrize("inside", ["above", "below"])
def test_rays_from_outside_stop_at_the_first_crossing(inside):
    volume = noisy(spacing=(1.0, 0.7, 1.9))
    scene, levels = furnace(volume, inside), [5.3]
    size = (np.array(volume.shape) - 1) * volume.spacing
    rng = np.random.default_rng(6)
    kinds = []
    for _ in range(60):
        d = random_direction(rng)
        x = rng.uniform(0, 1, 3) * size - 20 * d * rng.choice([0, 1])
        hit = naive.first_hit(scene, levels, x, d)
        t = np.linspace(0, 40 if hit is None else hit.t, 3000)[1:-1]
        dense = depth(scene, levels, x + t[:, None] * d)
        if hit is None:
            assert (dense < 1e-9).all()
        elif hit.normal is None:
            assert hit.t == 0
            assert depth(scene, levels, x[None])[0] >= 0
        else:
            assert (dense < 1e-9).all()
            at = depth(scene, levels, [np.array(hit.x) + (1e-9 * d if hit.cap else 0)])[0]
            assert at > -1e-7 if hit.cap else abs(at) < 1e-9
            assert math.hypot(*hit.normal) == pytest.approx(1, abs=1e-12)
        kinds.append("miss" if hit is None else "inside" if hit.normal is None else "cap" if hit.cap else "set")
    assert {"miss", "inside", "cap", "set"} == set(kinds)


def test_rays_from_a_voxel_on_its_own_level_set_stop_at_the_first_crossing():
    volume = noisy(spacing=(1.0, 0.7, 1.9))
    scene = furnace(volume)
    queries = Queries.at(scene, voxels(volume)[::5])
    rng = np.random.default_rng(7)
    kinds = []
    for i in open_queries(scene, queries):
        on, levels = naive.on_query(scene, queries[i : i + 1]), queries.level[i]
        d = random_direction(rng)
        hit = naive.first_hit(scene, levels, on.x, d, on=on)
        first = depth(scene, levels, [np.array(on.x) + 1e-6 * d])[0]
        if hit is not None and hit.t == 0:
            assert first > -1e-9
            assert hit.normal == on.normal
        else:
            assert first < 1e-9
            t = np.linspace(0, 20 if hit is None else hit.t, 3000)[1:-1]
            assert (depth(scene, levels, on.x + t[:, None] * d) < 1e-9).all()
            if hit is not None:
                assert abs(depth(scene, levels, [hit.x])[0]) < 1e-9
        kinds.append("miss" if hit is None else "dip" if hit.t == 0 else "set")
    assert {"miss", "dip", "set"} == set(kinds)


def test_a_solid_is_closed_by_caps():
    scene = Scene.sky(linear((4, 5, 6), (1, 0, 0), spacing=(1.0, 2.0, 0.5)), range=(0.5, 2.5))
    # Frame box [0,3] x [0,8] x [0,2.5], solid where x >= 1.25.
    hit = naive.first_hit(scene, [1.25], [2.0, -3.0, 1.0], [0.0, 1.0, 0.0])
    assert (hit.cap, hit.t, hit.x, hit.normal) == (True, 3.0, [2.0, 0.0, 1.0], [0.0, -1.0, 0.0])
    # Having met the cap, a ray leaves, also one that dips.
    assert naive.first_hit(scene, [1.25], hit.x, [0.0, -1.0, 0.0], on=hit) is None
    assert naive.first_hit(scene, [1.25], hit.x, [0.0, 1.0, 0.0], on=hit) is None
    d = [-0.6, 0.8, 0.0]
    hit = naive.first_hit(scene, [1.25], [4.2, 0.0, 1.0], d)
    assert hit.cap
    assert hit.normal == [1.0, 0.0, 0.0]
    np.testing.assert_allclose(hit.x, [3.0, 1.6, 1.0], atol=1e-14)
    # Through the face where the field is not solid, on to the level set.
    hit = naive.first_hit(scene, [1.25], [0.5, -1.0, 1.0], [0.28, 0.96, 0.0])
    assert not hit.cap
    assert hit.t == pytest.approx(0.75 / 0.28, abs=1e-13)
    assert hit.normal == [-1.0, 0.0, 0.0]
    assert naive.first_hit(scene, [1.25], [0.5, -3.0, 1.0], [0.0, 1.0, 0.0]) is None
    # All of the box is solid: every ray meets a cap; from within it meets a back.
    assert naive.first_hit(scene, [-1.0], [0.5, -3.0, 1.0], [0.0, 1.0, 0.0]).cap
    assert naive.first_hit(scene, [-1.0], [0.5, 3.0, 1.0], [0.0, 1.0, 0.0]).normal is None


@pytest.mark.parametrize("inside", ["above", "below"])
def test_the_normal_is_that_of_central_differences(inside):
    values = np.zeros((4, 4, 4))
    values[1:3] = np.arange(4)
    flat = Volume(np.zeros((3, 3, 3)))
    for volume in (noisy(spacing=(1.0, 0.7, 1.9)), Volume(values, spacing=(2.0, 1.0, 0.5)), flat):
        solid = naive.Solid(furnace(noisy(), inside), [5.0], 0)
        solid.values, solid.last = volume.values, [n - 1 for n in volume.shape]
        solid.spacing = volume.spacing.tolist()
        for u in np.random.default_rng(10).uniform(0, np.array(volume.shape) - 1, (30, 3)):
            cell = [int(c) for c in u]
            normal = naive.outward_normal(solid, cell, (u - cell).tolist())
            expected = outward_normals(volume, u[None], inside)[0]
            np.testing.assert_allclose([0.0] * 3 if normal is None else normal, expected, atol=1e-12)


def test_where_central_differences_cancel_the_normal_is_that_of_the_cell():
    values = np.zeros((4, 2, 2))
    values[[1, 3]] = 2.0
    solid = naive.Solid(Scene.sky(Volume(values), range=(0.5, 1.5)), [1.0], 0)
    assert naive.outward_normal(solid, [1, 0, 0], [0.5, 0.5, 0.5]) == [1.0, 0.0, 0.0]


def test_rays_in_the_planes_of_the_lattice():
    scene = Scene.sky(linear((4, 4, 4), (1, 0, 0)), range=(0.5, 2.5))
    hit = naive.first_hit(scene, [1.25], [-1.0, 1.0, 2.0], [1.0, 0.0, 0.0])
    assert (hit.t, hit.x, hit.normal) == (2.25, [1.25, 1.0, 2.0], [-1.0, 0.0, 0.0])
    assert naive.first_hit(scene, [1.25], [-1.0, 4.0, 2.0], [1.0, 0.0, 0.0]) is None
    on = naive.Hit(0.0, 0, [2.0, 1.0, 1.0], [-1.0, 0.0, 0.0])
    assert naive.first_hit(scene, [2.0], on.x, [1.0, 0.0, 0.0], on=on) == on
    assert naive.first_hit(scene, [2.0], on.x, [-1.0, 0.0, 0.0], on=on) is None


# Two fields.


def two_fields():
    left = Field("left", linear((4, 4, 4), (-1, 0, 0)), Material(ALBEDO, (1, 2, 3)), (-2.5, -0.5))  # solid x <= -c
    volume = linear((7, 7, 7), (1, 0, 0), origin=(2.0, -1.0, -1.0), spacing=(1.0, 0.9, 0.9))
    right = Field("right", volume, Material((0.5, 0.5, 0.5), (4, 5, 6)), (1.0, 4.0))  # solid x >= 2 + c
    return Scene((left, right), background=SKY)


def test_light_goes_from_one_field_to_another():
    scene, levels = two_fields(), [-1.5, 2.5]
    on = naive.Hit(0.0, 0, [1.5, 1.0, 1.0], [1.0, 0.0, 0.0])
    hit = naive.first_hit(scene, levels, on.x, [1.0, 0.0, 0.0], on=on)
    assert (hit.field, hit.cap, hit.normal) == (1, False, [-1.0, 0.0, 0.0])
    assert hit.t == pytest.approx(3.0, abs=1e-13)
    back = naive.first_hit(scene, levels, hit.x, [-1.0, 0.0, 0.0], on=hit)
    assert back.field == 0
    assert back.t == pytest.approx(3.0, abs=1e-13)
    # Along x between the two planes, a path picks up what both emit.
    queries = Queries.at(scene, [[1.5, 1.5, 1.5]], level=-1.5)
    queries.level[:] = levels
    worths = np.array([naive.path_worth(scene, queries, p, 0, 0) for p in range(60)])
    assert {tuple(w) for w in worths} == {(1.0, 1.0, 1.0), (4.0, 5.0, 6.0)}
    # The disk of the right plane seen from the left: lit share is that of the square 5.4 x 5.4 at distance 3.
    one = np.array([naive.path_worth(scene, queries, p, 1, 0) for p in range(60)])
    seen = {tuple(np.round(w, 12)) for w in one}
    assert (1.0, 1.0, 1.0) in seen
    assert tuple(np.round(np.array([4, 5, 6]) + 0.5 * np.array(SKY), 12)) in seen
    assert tuple(np.round(np.array([4, 5, 6]) + 0.5 * np.array([1, 2, 3]), 12)) in seen


def test_a_polygonal_lamp_obeys_lambert():
    scene, levels = two_fields(), [-1.5, 2.5]
    scene = Scene(scene.fields)  # no sky
    queries = Queries.at(scene, [[1.5, 1.7, 1.7]], level=-1.5)
    queries.level[:] = levels
    mean, m2, paths = naive.solve(scene, queries, range(400), 0, 0)
    a = 2.7 / 3.0  # a quarter of the square, over the distance; the caps of the field's sides are hidden behind it
    quarter = 2 * a / math.sqrt(1 + a * a) * math.atan(a / math.sqrt(1 + a * a)) / (2 * math.pi)
    truth = math.pi * 4 * quarter * np.array([4, 5, 6])
    stderr = np.sqrt(m2 / (paths * (paths - 1))[:, None])
    assert (np.abs(mean - truth) < 4 * stderr).all()


def test_a_query_in_the_solid_of_another_field_is_a_hole():
    scene = two_fields()
    queries = Queries.at(scene, [[2.5, 1.5, 1.5], [2.5, 1.5, 1.5]], level=-2.5)
    queries.level[:] = [[-2.5, 0.25], [-2.5, 0.75]]  # the right solid starts at 2.25, then at 2.75
    mean, m2, paths = naive.solve(scene, queries, range(3), 1, 0)
    assert list(paths) == [0, 3]
    assert not mean[0].any()
    assert not m2[0].any()
    on = naive.Hit(0.0, 0, [2.5, 1.5, 1.5], [1.0, 0.0, 0.0])
    assert naive.first_hit(scene, queries.level[0], on.x, [0.6, 0.8, 0.0], on=on).normal is None
    assert naive.first_hit(scene, queries.level[0], on.x, [-1.0, 0.0, 0.0], on=on).normal is None


# Placement in the world.


def rotation():
    q, _ = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))
    return q if np.linalg.det(q) > 0 else -q


PLACEMENTS = {
    "far": {"origin": (1e5, -1e5, 1e5)},
    "mirrored": {"direction": np.diag([1.0, -1.0, 1.0])},
    "turned": {"direction": [[0, -1, 0], [1, 0, 0], [0, 0, 1]]},
    "oblique and far": {"origin": (1e5, 1e5, 1e5), "direction": rotation()},
    "mirrored and oblique": {"origin": (3, 4, 5), "direction": -rotation()},
}


@pytest.mark.parametrize("name", PLACEMENTS)
def test_placement_in_the_world_changes_no_path(name):
    spacing = (1.0, 0.7, 1.9)
    here, there = noisy(spacing=spacing), noisy(spacing=spacing, **PLACEMENTS[name])
    index = np.argwhere(np.ones(here.shape))[::9] * 1.0
    index[1::2] = np.clip(index[1::2] + 0.37, 0, 5)  # half on voxels, half between
    worths = []
    for volume in (here, there):
        scene = Scene.sky(volume, ALBEDO, (2.5, 7.5))
        points = volume.origin + (index * volume.spacing) @ volume.direction.T
        queries = Queries.at(scene, points)
        some = [queries[i : i + 1] for i in open_queries(scene, queries)]
        # Where n.z is 0 a rotation rounds it to either sign, and the tangent frame with it: another path, as good.
        some = [query for query in some if abs(naive.on_query(scene, query).normal[2]) > 1e-9]
        worths.append([naive.path_worth(scene, query, path, 3, 0) for query in some for path in (0, 1)])
    assert len(worths[0]) == len(worths[1])
    np.testing.assert_allclose(*worths, atol=1e-6)
    assert 0 < np.mean(worths[0]) < 1


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_which_side_a_ray_is_on_survives_a_mirrored_array(axis):
    volume = noisy()
    mirrored = volume.with_stored(np.flip(volume.values, axis))
    flip = np.ones(3)
    flip[axis] = -1
    shift = (1 - flip) / 2 * 5
    rng = np.random.default_rng(9)
    queries = Queries.at(furnace(volume), voxels(volume)[::4])
    for i in open_queries(furnace(volume), queries):
        on = naive.on_query(furnace(volume), queries[i : i + 1])
        d = random_direction(rng)
        one = naive.first_hit(furnace(volume), queries.level[i], on.x, d, on=on)
        there = naive.Hit(0.0, 0, flip * on.x + shift, list(flip * on.normal))
        other = naive.first_hit(furnace(mirrored), queries.level[i], there.x, flip * d, on=there)
        assert (one is None) == (other is None)
        if one is not None:
            assert one.t == pytest.approx(other.t, abs=1e-9)
