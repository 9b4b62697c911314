"""Light against closed forms: white furnaces, convex bodies, sealed cavities, and bars that cover."""

import math

import numpy as np
import pytest

from illumgrid.backends.numba_ import Numba
from illumgrid.backends.reference import Reference
from illumgrid.field.filters import smooth
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Volume, cell_gradient, outward_normals, world_to_index
from illumgrid.transport.samples import combine
from transport import (
    ALBEDO,
    assert_standard_normal,
    colored,
    everywhere,
    furnace,
    linear,
    noise,
    on_sets,
    on_voxels,
    rotation,
    waves,
    worth,
)  # fmt: skip

BACKENDS = {"numba": Numba(), "reference": Reference()}


def slabs():
    """Solids that extend from border to border, so that paths hit caps, and another field that reflects paths there."""
    return furnace(linear((1, 0, 0)), noise(9, (5, 5, 5), origin=(7.0, 1.0, -1.0)))


FURNACES = {
    "noise": lambda: furnace(noise(256, spacing=(1.0, 0.7, 1.9))),
    "plateaus": lambda: furnace(noise(4)),
    "below": lambda: furnace(noise(8, direction=rotation()), inside="below"),
    "smooth": lambda: furnace(waves(origin=(1e6, -1e6, 1e6))),
    "two fields": lambda: furnace(waves(), noise(9, seed=5, origin=(1.3, -0.8, 2.1), spacing=(1.3, 0.6, 0.9))),
    "capped": slabs,
}


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", FURNACES)
def test_in_a_white_furnace_every_path_is_white_or_cut_off(name, backend):
    scene = FURNACES[name]()
    queries = everywhere(scene)
    escaped = cut = 0
    for path in range(200 if backend == "numba" else 12):
        bounces = path % 4
        light, answered = worth(BACKENDS[backend], scene, queries, path, bounces)
        light = light[answered]
        white = np.abs(light - 1).max(axis=1) < 1e-6
        np.testing.assert_allclose(light[~white], np.tile(1 - ALBEDO ** (bounces + 1), ((~white).sum(), 1)), atol=1e-6)
        escaped += white.sum()
        cut += (~white).sum()
    assert escaped > 100
    assert cut > 100


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("inside", ["above", "below"])
@pytest.mark.parametrize("slopes", [(1, 0, 0), (0, 0, -3), (2, 3, -5)])
def test_a_linear_field_gathers_pi_on_every_path(slopes, inside, backend):
    volume = linear(slopes, spacing=(0.5, 2.0, 1.3), direction=rotation() @ np.diag([1, -1, 1]))
    low, high = volume.values.min(), volume.values.max()
    scene = Scene.sky(volume, (0.0, 0.5, 0.9), (low + 0.1, high - 0.1), inside)
    queries = everywhere(scene)
    answer = BACKENDS[backend].solve(scene, queries, paths=range(20), bounces=3, seed=0)
    assert (answer.paths == 20).all()
    np.testing.assert_allclose(answer.mean, math.pi, rtol=1e-6)
    np.testing.assert_allclose(answer.stderr, 0.2 * math.pi / 20, rtol=1e-5)  # what so few may have missed


def paraboloid(n=15, spacing=(1.0, 1.0, 1.0)):
    """h = -|x|²: between voxels a sum of three concave functions, each linear in every cell.

    So each solid is a polyhedron that is convex exactly, with one facet a cell.
    """
    axes = np.ogrid[:n, :n, :n]
    values = -sum(((2 * a - n + 1) * s) ** 2 for a, s in zip(axes, spacing))
    return Volume(values, spacing=spacing, direction=rotation())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("bounces", [0, 1, 5])
def test_a_convex_body_loses_only_what_dips_under_its_facets(bounces, backend):
    # About the gradient normal n, a share q = (1 - n·g)/2 of the directions dips under the facet with normal g; each
    # is one more reflection at the same place: E = π (1 - q) Σ (a q)^k. What has left never comes back.
    albedo = 0.6
    volume = paraboloid(spacing=(1.0, 1.2, 0.8))
    scene = Scene.sky(volume, [albedo] * 3, (-90, -20))
    queries = on_sets(scene, count=6, points=400)[:: 1 if backend == "numba" else 5]
    paths = range(400 if backend == "numba" else 24)
    answer = BACKENDS[backend].solve(scene, queries, paths=paths, bounces=bounces, seed=1)
    assert (answer.paths == len(paths)).all()

    facet = -cell_gradient(volume, world_to_index(volume, queries.point)) @ volume.direction.T
    facet /= np.linalg.norm(facet, axis=1, keepdims=True)
    q = 0.5 * (1 - (queries.normal * facet).sum(axis=1))[:, None]
    k = np.arange(bounces + 1)
    chance = (1 - q) * q**k
    truth = (chance * albedo**k).sum(axis=1)
    variance = (chance * albedo ** (2 * k)).sum(axis=1) - truth**2
    off = answer.mean[:, 0].astype(float) / math.pi - truth
    # Dips are rare: groups of queries with similar q, so that their sums are normal.
    groups = np.array_split(np.argsort(q[:, 0]), 20 if backend == "numba" else 2)
    assert_standard_normal([off[g].sum() / np.sqrt(variance[g].sum() / len(paths)) for g in groups])
    assert 0.99 * math.pi < answer.mean.mean() < math.pi  # a sphere's π, but for its facets


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("inside", ["above", "below"])
def test_a_voxel_of_a_convex_body_gathers_pi_on_every_path(inside, backend):
    # Eight facets meet there, and central differences are a mean of their slopes: of a concave field, a normal that has
    # all of the solid on one side. Whoever asks one of the eight cells which side a direction is on loses light here.
    volume = paraboloid(9)
    if inside == "below":
        volume = volume.with_stored(-volume.values)
    scene = Scene.sky(volume, [0.5] * 3, sorted([volume.values.min(), volume.values.max()]), inside)
    queries = on_voxels(scene)
    answer = BACKENDS[backend].solve(scene, queries, paths=range(100 if backend == "numba" else 4), bounces=2, seed=2)
    assert answer.paths.all()
    np.testing.assert_allclose(answer.mean, math.pi, rtol=1e-6)


WALL = 300.0


def cavity(values, **placement):
    """A cavity in voxels that are solid at all levels below WALL: none of its level sets reaches the outside."""
    return Volume(np.pad(np.asarray(values, np.float32), 1, constant_values=WALL), **placement)


def sealed(volume, inside="above", high=256.0):
    """Albedo 1 everywhere and light only outside, with queries on voxels and level sets inside."""
    limits = (-0.5, high) if inside == "above" else (-high, 0.5)
    scene = Scene.sky(volume, (1, 1, 1), limits, inside)
    queries = everywhere(scene)
    return scene, queries[np.abs(queries.level[:, 0]) < WALL]


RNG = np.random.default_rng(11)
CAVITIES = {
    "two grays": RNG.integers(0, 2, (10, 11, 12)),
    "four grays": RNG.integers(0, 4, (10, 11, 12)),
    "bytes": RNG.integers(0, 256, (12, 10, 11)),
    "reals": RNG.random((11, 12, 10)),
    "one bubble": np.linalg.norm(np.indices((11, 11, 11)) - np.array([5.2, 4.9, 5.0])[:, None, None, None], axis=0),
}


@pytest.mark.parametrize("extents", [0.0, 1e5])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("name", CAVITIES)
def test_no_light_leaks_into_a_sealed_cavity(name, scale, extents):
    spacing = scale * np.array([1.0, 0.7, 1.9])
    origin = extents * 13 * spacing.max() * np.array([1, -1, 1])
    volume, inside = cavity(CAVITIES[name], spacing=spacing, origin=origin, direction=rotation()), "above"
    if scale == 1e6:
        volume, inside = volume.with_stored(-volume.values), "below"
    scene, queries = sealed(volume, inside, high=CAVITIES[name].max())
    assert len(queries) > 1000
    answer = Numba().solve(scene, queries, paths=range(40000 // len(queries) + 1), bounces=6, seed=4)
    assert (answer.paths > 0).mean() > 0.9
    assert not answer.mean.any(), f"{(answer.mean.any(axis=1)).sum()} of {len(queries)} queries see the sky"


@pytest.mark.parametrize("name", ["four grays", "reals"])
def test_a_million_paths_stay_in_a_sealed_cavity(name):
    scene, queries = sealed(cavity(CAVITIES[name]), high=CAVITIES[name].max())
    for backend, paths in ((Numba(), 1_000_000 // len(queries) + 1), (Reference(), 1)):
        answer = backend.solve(scene, queries, paths=range(paths), bounces=3, seed=0)
        assert not answer.mean.any()


def test_bars_are_honest():
    volume = smooth(noise(256, (12, 12, 12)), 0.8)
    low, high = np.quantile(volume.values, [0.2, 0.8])
    scene = colored(Scene.sky(volume, range=(low, high)))
    queries = on_voxels(scene)
    queries = queries[(queries.level[:, 0] > low) & (queries.level[:, 0] < high)]
    assert len(queries) >= 1000
    truth = Numba().solve(scene, queries, paths=range(1000, 3000), bounces=4, seed=0)
    answer = Numba().solve(scene, queries, paths=range(256), bounces=4, seed=0)
    off = answer.mean.astype(float) - truth.mean
    bar = np.hypot(answer.stderr, truth.stderr)
    covered = (np.abs(off) < 1.96 * bar).mean()
    assert 0.90 < covered < 0.99
    assert np.median(answer.stderr) < 1.5 * math.sqrt(np.mean(off**2))
    assert_standard_normal(off.sum(axis=0) / np.sqrt((bar**2).sum(axis=0)))
    np.testing.assert_allclose(answer.error, np.sqrt((answer.stderr**2).mean(axis=1)), rtol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_ranges_of_paths_combine_to_one(backend):
    scene = colored(FURNACES["two fields"]())
    queries = everywhere(scene)[::40]
    solve = BACKENDS[backend].solve
    whole = solve(scene, queries, paths=range(3, 40), bounces=2, seed=0)
    together = solve(scene, queries, paths=range(3, 4), bounces=2, seed=0)
    for more in (range(4, 4), range(4, 17), range(17, 40)):
        together = combine(together, solve(scene, queries, paths=more, bounces=2, seed=0))
    np.testing.assert_array_equal(together.paths, whole.paths)
    np.testing.assert_allclose(together.mean, whole.mean, atol=1e-6)
    # The pieces count as independent: their bars are those of shorter nets, somewhat longer, never far off.
    one, other = (np.sqrt(np.mean(answer.stderr[whole.paths > 0] ** 2.0)) for answer in (together, whole))
    assert 0.8 * other < one < 2.5 * other
    assert set(whole.paths) == {0, 37}


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_path_is_a_hole_and_one_has_no_bar(backend):
    scene = FURNACES["noise"]()
    queries = everywhere(scene)[::9]
    none = BACKENDS[backend].solve(scene, queries, paths=range(0), bounces=2, seed=0)
    one = BACKENDS[backend].solve(scene, queries, paths=range(5, 6), bounces=2, seed=0)
    for answer in (none, one):
        assert np.isinf(answer.stderr).all()
        assert np.isinf(answer.error).all()
    assert not none.paths.any()
    assert not none.mean.any()
    assert one.paths.any()
    empty = BACKENDS[backend].solve(scene, queries[:0], paths=range(4), bounces=2, seed=0)
    assert len(empty) == 0


def test_the_normal_of_a_query_is_the_gradient_normal_in_the_world():
    scene = furnace(noise(9, direction=rotation() @ np.diag([1, 1, -1]), spacing=(1.0, 0.7, 1.9)), inside="below")
    volume = scene.fields[0].volume
    queries = on_voxels(scene)
    expected = outward_normals(volume, world_to_index(volume, queries.point), "below") @ volume.direction.T
    np.testing.assert_allclose(queries.normal, expected, atol=1e-15)
