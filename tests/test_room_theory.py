"""Walls and lamps against closed forms. Means over many queries are tested with their own standard deviation."""

import math
from dataclasses import replace

import numpy as np
import pytest

from illumgrid.backends.numba_ import Numba
from illumgrid.bake.walls import wall_queries
from illumgrid.field.levelset import isosurface
from illumgrid.field.rooms import box_around
from illumgrid.field.scene import Field, Levels, Material, Scene
from illumgrid.field.volume import cell_gradient, world_to_index
from illumgrid.stages import on_level_sets
from rooms import MIRRORED, NOWHERE, assert_mean, at_levels, empty, lamp, on_quads, painted
from shapes import sampled
from transport import ALBEDO, noise, on_voxels, rotation, waves

SOLVE = Numba().solve
X, Y, Z = np.eye(3)


def lambert(point, normal, quad):
    """Irradiance (n,) from a lamp of radiance 1 entirely above the horizon: (1/2) Σ angle · (edge normal · n)."""
    r = np.array([quad.corner, quad.corner + quad.edge_u, quad.corner + quad.edge_u + quad.edge_v])
    r = np.array([*r, quad.corner + quad.edge_v])[:, None] - point
    r /= np.linalg.norm(r, axis=2, keepdims=True)
    after = np.roll(r, -1, axis=0)
    across = np.cross(r, after)
    across /= np.linalg.norm(across, axis=2, keepdims=True)
    angle = np.arccos(np.clip((r * after).sum(axis=2), -1, 1))
    return np.abs(0.5 * (angle * (across * normal).sum(axis=2)).sum(axis=0))


LAMPS = {
    "parallel": lamp("lamp", (-0.2, -0.3, 0.7), Y, X, X + 0.5 * Y),
    "slanted": lamp("lamp", (0.2, 0.2, 0.5), 0.3 * Y + 0.2 * Z, 0.5 * X + 0.1 * Y, X + 0.5 * Y),
    "close": lamp("lamp", (0.3, 0.3, 0.01), 0.4 * Y, 0.4 * X, X + 0.5 * Y),
    "small": lamp("lamp", (0.5, 0.5, 2.0), 1e-3 * Y, 1e-3 * X, X + 0.5 * Y),
}


@pytest.mark.parametrize("axes", [np.eye(3), MIRRORED], ids=["straight", "mirrored"])
@pytest.mark.parametrize("name", LAMPS)
def test_a_lamp_sends_what_lambert_says(name, axes):
    quad, field = LAMPS[name], empty(origin=(5.0, 5.0, -3.0), direction=axes)
    ground = lamp("ground", (0, 0, 0), X, Y, np.zeros(3))
    scene = Scene((field,), (ground, quad))
    queries = at_levels(on_quads(scene, 4000, only=[0]), NOWHERE)
    answer = SOLVE(scene, queries, paths=range(16), bounces=0, seed=1)
    expected = lambert(queries.point, queries.normal, quad)
    assert (expected > 0).all()
    assert_mean(answer.mean[:, 0] / expected, 1.0, tests=8)
    np.testing.assert_allclose(answer.mean[:, 1], 0.5 * answer.mean[:, 0], rtol=1e-5)
    assert not answer.mean[:, 2].any()
    if name == "small":  # asked at the lamp, a small lamp is almost free of noise
        np.testing.assert_allclose(answer.mean[:, 0], expected, rtol=0.01)


def test_lamps_of_different_power_add_up_and_shine_to_the_front_only():
    field = empty(origin=(5.0, 5.0, -3.0))
    lights = [
        replace(LAMPS["parallel"], name="a"),
        replace(LAMPS["slanted"], name="b", material=Material(0 * X, 30 * X)),
    ]
    turned = lamp("turned", (0, 0, 3), X, Y, 9 * X)  # shows its back
    scene = Scene((field,), (lamp("ground", (0, 0, 0), X, Y, 0 * X), *lights, turned))
    queries = at_levels(on_quads(scene, 4000, only=[0]), NOWHERE)
    one, other = (lambert(queries.point, queries.normal, q) for q in lights)
    parts = [
        SOLVE(replace(scene, quads=(scene.quads[0], q)), queries, paths=range(16), bounces=0, seed=2) for q in lights
    ]
    assert_mean(parts[0].mean[:, 0] / one, 1.0, tests=3)
    assert_mean(parts[1].mean[:, 0] / (30 * other), 1.0, tests=3)
    # Lamps are opaque: ask where the one in front hides nothing of the other.
    clear = (queries.point[:, 0] < 0.2) & (queries.point[:, 1] > 0.9)
    both = SOLVE(scene, queries[clear], paths=range(16), bounces=0, seed=3).mean[:, 0]
    assert_mean(both / (one + 30 * other)[clear], 1.0, tests=3)


# Furnaces: emission 1 - albedo under a white sky. A path that escapes is worth 1, one that does not 1 - albedo^(B + 1).


@pytest.mark.parametrize("bounces", [0, 1, 4])
@pytest.mark.parametrize("name", ["sealed", "open"])
def test_a_white_furnace_of_lamps_is_white(name, bounces):
    volume = waves((7, 6, 8), direction=rotation())
    field = Field("solid", volume, Material(ALBEDO, 1 - ALBEDO), (-0.5, 0.5))
    walls = painted(box_around(volume)[:6], ALBEDO, 1 - ALBEDO)
    walls = walls if name == "sealed" else tuple(walls[k] for k in (0, 2, 3))  # fronts only can be seen, from inside
    scene = Scene((field,), walls, np.ones(3))
    queries = on_quads(scene, 3000, seed=bounces)
    answer = SOLVE(scene, queries, paths=range(16), bounces=bounces, seed=4)
    # The same without lamps, asked for what escapes: mirrors all over under the sky.
    mirrors = Scene((replace(field, material=Material(np.ones(3))),), painted(walls, 1.0), np.ones(3))
    escaped = SOLVE(mirrors, queries, paths=range(16, 32), bounces=bounces, seed=4).mean.astype(float) / math.pi
    assert (escaped.mean() == 0) if name == "sealed" else (0.1 < escaped.mean() < 0.95)
    truth = 1 - ALBEDO ** (bounces + 1) * (1 - escaped)
    assert_mean(answer.mean / math.pi - truth, 0.0, tests=6)


# A sealed cavity.


@pytest.mark.parametrize("bounces", [0, 2, 9])
def test_the_area_mean_in_a_sealed_cavity_is_that_of_the_geometric_sum(bounces):
    field, albedo = empty(spacing=np.array([1.0, 0.7, 1.6])), 0.7
    walls = painted(box_around(field.volume)[:6], albedo)
    light = lamp("light", (0.6, 0.3, 0.1), 0.8 * X, 0.7 * Y + 0.4 * Z, (5, 3, 1), albedo)
    scene = Scene((field,), (*walls, light))
    area = sum(q.area for q in walls) + 2 * light.area
    queries = at_levels(on_quads(scene, 8000), NOWHERE)
    back = at_levels(on_quads(scene, 2000, only=[6], back=True), NOWHERE)
    front, behind = (
        SOLVE(scene, q, paths=range(16), bounces=bounces, seed=5).mean.astype(float) for q in (queries, back)
    )
    truth = np.pi * light.material.emission * light.area * (1 - albedo ** (bounces + 1)) / (area * (1 - albedo))
    share = np.array([sum(q.area for q in scene.quads), light.area]) / area
    mean = share[0] * front.mean(axis=0) + share[1] * behind.mean(axis=0)
    bar = np.hypot(share[0] * front.std(axis=0) / 8000**0.5, share[1] * behind.std(axis=0) / 2000**0.5)
    assert (np.abs(mean - truth) < 4.5 * bar).all()
    assert (bar < 0.02 * truth).all()


def test_the_texels_of_a_sealed_furnace_are_all_alike():
    field = empty()
    walls = tuple(replace(q, texels=(9, 8)) for q in painted(box_around(field.volume)[:6], 0.5, 0.5))
    scene = Scene((field,), walls)
    for queries in wall_queries(scene, Levels(np.array([[NOWHERE]]))):
        answer = SOLVE(scene, queries, paths=range(64), bounces=7, seed=6)
        assert_mean(answer.mean, math.pi * (1 - 0.5**8), tests=6)


# A black sphere over a black floor.


@pytest.mark.parametrize("axes", [np.eye(3), rotation()], ids=["straight", "oblique"])
def test_a_black_sphere_takes_its_share_of_the_sky(axes):
    # E = π (1 - (r/d)² cos θ). The trilinear interpolant of the convex |x| lies above it, by at most s²/8 times the sum
    # of its second derivatives along the axes, each at most 1/ρ, ρ the nearest distance in the cells that are met: the
    # level set lies between the spheres of radius r and r - δ, δ = 3 s²/(8 ρ), and E between what they take.
    n, radius, height = 25, 0.7, 1.3
    s = 2 / (n - 1)
    origin = -axes @ np.ones(3)
    volume = sampled(lambda x: 2 - np.linalg.norm(x, axis=1), (n, n, n), origin, (s, s, s), axes)
    field = Field("sphere", volume, Material(np.zeros(3)), (1.0, 1.6))
    ground = lamp("floor", (-2, -2, -height), 4 * X, 4 * Y, np.zeros(3))
    scene = Scene((field,), (ground,), np.ones(3))
    queries = at_levels(on_quads(scene, 3000), 2 - radius)
    answer = SOLVE(scene, queries, paths=range(32), bounces=0, seed=7)
    distance = np.linalg.norm(queries.point, axis=1)
    share = height / distance**3
    inner = radius - 3 * s**2 / (8 * (radius - 3**0.5 * s))
    most, least = (np.pi * (1 - r**2 * share) for r in (inner, radius))
    assert_mean(answer.mean[:, 0] - 0.5 * (most + least), 0.0, slack=0.5 * (most - least).mean())
    near = distance < 1.6
    assert_mean((answer.mean[:, 0] - 0.5 * (most + least))[near], 0.0, slack=0.5 * (most - least)[near].mean())


# Energy.


def test_what_the_lamp_emits_is_absorbed():
    n, albedo, bounces = 24, 0.6, 24
    volume = sampled(lambda x: 2 - np.linalg.norm(x * [1, 1.2, 1], axis=1), (n,) * 3, -np.ones(3), (2 / (n - 1),) * 3)
    scene = Scene.box(volume, (albedo,) * 3, (1.1, 1.7))
    emitted = np.pi * sum(q.material.emission * q.area for q in scene.quads)
    front, behind = (on_quads(scene, 3000, back=back, only=[6] if back else None) for back in (False, True))
    absorbed = np.zeros(3)
    variance = np.zeros(3)
    *_, light = scene.quads
    for queries, area in ((front, sum(q.area for q in scene.quads)), (behind, light.area)):
        share = 1 - np.array([scene.quads[k - 1].material.albedo for k in queries.target])
        flux = area * share * SOLVE(scene, queries, paths=range(8), bounces=bounces, seed=8).mean
        absorbed += flux.mean(axis=0)
        variance += flux.var(axis=0) / len(flux)
    (solid,) = on_level_sets(scene, scene.levels(0.5), 0, points=1000)
    mesh_area = isosurface(volume, scene.levels(0.5)[0, 0]).area
    arriving = mesh_area * SOLVE(scene, solid, paths=range(8), bounces=bounces, seed=9).mean.astype(float)
    absorbed += (1 - albedo) * arriving.mean(axis=0)
    variance += ((1 - albedo) * arriving).var(axis=0) / len(arriving)
    # Light is gathered about gradient normals, not those of the facets: the flux is off by their angle at most.
    facet = -cell_gradient(volume, world_to_index(volume, solid.point))
    facet /= np.linalg.norm(facet, axis=1, keepdims=True)
    angle = np.linalg.norm(facet - solid.normal, axis=1).mean()
    bound = angle * arriving.mean(axis=0) / emitted
    cut = 0.75**bounces
    assert (bound < 0.02).all()
    assert (np.abs(absorbed / emitted - 1) < bound + cut + 4.5 * np.sqrt(variance) / emitted).all()
    assert (np.sqrt(variance) < 0.03 * emitted).all()


def test_a_node_that_lies_on_the_floor_is_above_it():
    volume = noise(9, (6, 6, 6))
    scene = Scene.floor(volume, range=(2.5, 6.5))
    (ground,) = painted(scene.quads, 0.0)
    queries = on_voxels(scene)
    queries = queries[np.abs((queries.point - ground.corner) @ ground.normal) < 1e-9]
    answers = []
    for lowered in (0.0, 1e-13, -1e-13, 1e-6):  # at a rounding error below or above, and clearly below
        beneath = replace(ground, corner=ground.corner - lowered * ground.normal)
        answers.append(SOLVE(replace(scene, quads=(beneath,)), queries, paths=range(64), bounces=0, seed=0).mean)
    for answer in answers[:-1]:
        np.testing.assert_allclose(answer, answers[-1], atol=1e-5)
    assert answers[-1].mean() > 0.3
