"""Reading by place, level and normal: what theory says of it, and how near it comes to a light that is known."""

import numpy as np
import pytest

from illumgrid.field.scene import Field, Scene
from illumgrid.field.volume import Volume
from illumgrid.grid import GridSpec, Nodes
from illumgrid.grid.nodes import reachable
from illumgrid.interpolators.bilateral import Bilateral, denser
from illumgrid.interpolators.nearest import Nearest
from illumgrid.samplers.direct import Direct
from illumgrid.transport.samples import Queries, Samples, join_queries
from shapes import DIRECTIONS, ball, refused, sampled, sky
from transport import noise

SIDE = 9


def asked(scene, longest=SIDE, field=0):
    specs = [GridSpec.over(f.volume, longest) for f in scene.fields]
    queries = join_queries(list(Direct().queries(scene, specs, 0)))
    return queries[queries.target == field], Nodes(specs[field], scene.fields[field], field)


def answered(queries, light, stderr=0.0, paths=4):
    """Samples with a light (n, C) and these standard errors."""
    n = len(queries)
    mean = np.asarray(light, np.float32).reshape(n, -1)
    paths = np.broadcast_to(paths, n).astype(np.int32)
    m2 = np.broadcast_to(np.float32(stderr) ** 2 * (paths * (paths - 1.0))[:, None], mean.shape)
    return Samples(queries, mean.astype(np.float32), m2.astype(np.float32), paths)


def shaded(queries):
    """A light of place, level and slope, as under a sky that is brighter above."""
    return (2 + queries.normal[:, 2] + 0.3 * queries.point[:, 0] + queries.level[:, 0])[:, None]


def off(grid, scene, light):
    """Root mean square error of a lookup at points of the volume within the range."""
    field = scene.fields[0]
    index = np.random.default_rng(1).random((4000, 3)) * (np.array(field.volume.shape) - 1)
    points = field.volume.origin + index * field.volume.spacing
    there = Queries.at(scene, points)
    inside = (there.level[:, 0] >= field.range[0]) & (there.level[:, 0] <= field.range[1])
    there = there[np.flatnonzero(inside & there.normal.any(axis=1))]
    return float(np.sqrt(np.mean((grid.lookup(there.point)[:, :1] - light(there)) ** 2)))


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_a_constant_is_reproduced(direction, channels):
    volume = noise(9, (8, 9, 7), seed=4, spacing=(1.0, 0.7, 1.6))
    scene = sky(Volume(volume.values, (1e3, -2, 5), volume.spacing, direction), (2, 6))
    queries, nodes = asked(scene)
    grid = Bilateral().fill(answered(queries, np.full((len(queries), channels), 3.0)), nodes)
    np.testing.assert_allclose(grid.light, 3.0, rtol=1e-6)
    assert grid.light.shape[3] == channels and (grid.support > 0).any()


def test_stored_nodes_are_denser_over_the_same_box():
    spec = GridSpec((5, 7, 2), (1, 2, 3), (0.5, 1.25, 3.0))
    for density, shape in ((1, (5, 7, 2)), (2, (9, 13, 3)), (1.5, (7, 10, 3))):
        more = denser(spec, density)
        assert more.shape == shape
        np.testing.assert_allclose(more.spacing * (np.array(more.shape) - 1), spec.spacing * (np.array(spec.shape) - 1))
    for density in (0.5, 9, np.nan):
        refused(lambda density=density: Bilateral(density), "bilateral.density")


def test_finer_grids_come_nearer():
    scene, error = sky(ball(20)), {}
    for longest in (9, 18):
        queries, nodes = asked(scene, longest)
        error[longest] = off(Bilateral().fill(answered(queries, shaded(queries)), nodes), scene, shaded)
    assert error[18] < 0.5 * error[9]


def test_a_jump_at_a_level_is_kept_sharper_than_by_trilinear_reading():
    """As at a critical isovalue, where light is discontinuous."""
    scene = sky(ball(20))
    queries, nodes = asked(scene, 18)

    def jump(asked):
        return (asked.level[:, :1] > 0.6).astype(float)

    samples = answered(queries, jump(queries))
    trilinear = off(Nearest().fill(samples, nodes), scene, jump)
    assert off(Bilateral(3.0).fill(samples, nodes), scene, jump) < 0.8 * trilinear


def test_light_does_not_leak_between_level_sets_of_two_sheets():
    """Two slabs face each other across a gap of one node: less than 1 % of the light crosses."""
    scene = sky(sampled(lambda x: np.abs(x[:, 0] - 6.0), (13, 13, 13)), (1.0, 5.0))
    queries, nodes = asked(scene, 13)
    right = (queries.point[:, 0] > 6.0).astype(float)[:, None]
    grid = Bilateral(3.0).fill(answered(queries, right), nodes)
    x = grid.spec.nodes()[:, 0].reshape(grid.spec.shape)
    for side in (0.0, 1.0):
        near = (np.sign(x - 6.0) == 2 * side - 1) & (np.abs(x - 6.0) >= 1.0)
        assert np.abs(grid.values[near] - side).max() < 0.01


@pytest.mark.parametrize("axes, flips", [((0, 1, 2), (0,)), ((1, 0, 2), (0,)), ((1, 2, 0), (0, 1, 2))])
def test_the_array_may_be_turned(axes, flips):
    """Raw integers with nodes on voxels and a rim: the light of a turned array is the turned light."""
    volume = noise(256, (8, 8, 8), seed=4)
    light = np.random.default_rng(0).random(volume.shape)

    def filled(values, own):
        scene = sky(Volume(values), (60, 190))
        queries, nodes = asked(scene, 8)
        number = (queries.id & np.uint64((1 << 40) - 1)).astype(int)
        return Bilateral().fill(answered(queries, own.reshape(-1)[number][:, None]), nodes)

    straight = filled(volume.values, light)
    turned = filled(*(np.ascontiguousarray(np.flip(a.transpose(axes), flips)) for a in (volume.values, light)))
    for name in ("light", "support"):
        one = getattr(straight, name)
        one = np.flip(one.transpose(*axes, *range(3, one.ndim)), flips)
        worst = np.abs(getattr(turned, name) - one) / np.abs(one).max()
        assert np.quantile(worst, 0.999) < 1e-4, name


@pytest.mark.parametrize("scale", [1e-6, 1e6])
@pytest.mark.parametrize("of", ["values", "space"])
def test_units_do_not_matter(scale, of):
    one = ball(12)
    scene = sky(one)
    queries, nodes = asked(scene)
    light = np.random.default_rng(2).random((len(queries), 3))
    expected = Bilateral().fill(answered(queries, light), nodes)
    if of == "values":
        scene = sky(Volume(one.values * scale, one.origin, one.spacing), (0.3 * scale, 0.9 * scale))
    else:
        scene = sky(Volume(one.values, one.origin * scale, one.spacing * scale))
    queries, nodes = asked(scene)
    grid = Bilateral().fill(answered(queries, light), nodes)
    assert np.array_equal(grid.support > 0, expected.support > 0)
    own = grid.support > 0  # a hole may be as near to two nodes as makes no difference
    np.testing.assert_allclose(grid.light[own], expected.light[own], rtol=1e-4)


def test_a_hole_stays_a_hole_and_holds_the_light_of_a_neighbour():
    scene = sky(ball(12))
    queries, nodes = asked(scene)
    inner = np.linalg.norm(queries.point - [0.6, 0, 0], axis=1) < 0.4
    assert inner.any() and not inner.all()
    samples = answered(queries, np.where(inner, 0.0, 2.0)[:, None], paths=np.where(inner, 0, 4))
    grid = Bilateral().fill(samples, nodes)
    flat = (queries.id[inner] & np.uint64((1 << 40) - 1)).astype(int)
    place = np.stack(np.unravel_index(flat, nodes.spec.shape), axis=1) * 2
    on_nodes = np.abs(nodes.spec.nodes(flat) - queries.point[inner]).max(axis=1) < 1e-9
    hole = tuple(place[on_nodes].T)
    assert on_nodes.any() and not grid.support[hole].any() and np.isinf(grid.error[hole]).all()
    np.testing.assert_allclose(grid.values, 2.0, rtol=1e-6)


def test_plateaus_and_extreme_values_give_no_nan():
    values = np.zeros((8, 8, 8), np.float32)
    values[2:5, 3:6, 1:7] = 3e38
    values[5:, :2, :] = 1e-38
    scene = sky(Volume(values), (1e-38, 2e38))
    queries, nodes = asked(scene)
    grid = Bilateral().fill(answered(queries, np.random.default_rng(0).random((len(queries), 3))), nodes)
    assert np.isfinite(grid.values).all() and not np.isnan(grid.error).any() and grid.values.max() <= 1


def test_two_fields_are_filled_from_their_own_samples():
    places = {"a": (-0.3, 0, 0), "b": (0.3, 0, 0)}
    fields = tuple(Field(name, ball(12, at), range=(0.3, 0.9)) for name, at in places.items())
    scene = Scene(fields, background=np.ones(3))
    for number in (0, 1):
        queries, nodes = asked(scene, field=number)
        grid = Bilateral().fill(answered(queries, np.full((len(queries), 1), 1.0 + number)), nodes)
        np.testing.assert_allclose(grid.values, 1.0 + number, rtol=1e-6)
        filled = np.flatnonzero(grid.support.reshape(-1))
        assert set(filled) <= set(reachable(fields[number], grid.spec))


def test_noise_is_averaged_and_the_bar_follows():
    """A constant light with noise: nodes are closer to it than the samples are, by what their error says."""
    scene = sky(ball(24))
    queries, nodes = asked(scene, 24)
    random = np.random.default_rng(3)
    grid = Bilateral().fill(answered(queries, 1 + 0.1 * random.standard_normal((len(queries), 1)), stderr=0.1), nodes)
    good = grid.support > 0
    true = np.sqrt(np.mean((grid.values[good][:, 0] - 1) ** 2))
    assert true < 0.05
    assert 0.8 < np.sqrt(np.mean(grid.error[good].astype(float) ** 2)) / true < 1.6
    points = queries.point[random.integers(0, len(queries), 2000)] + random.uniform(-0.02, 0.02, (2000, 3))
    bar, miss = grid.uncertainty(points), np.abs(grid.lookup(points)[:, 0] - 1)
    known = np.isfinite(bar)
    assert np.mean(miss[known] <= 1.96 * bar[known]) >= 0.93


def test_each_of_several_layers_has_the_bar_that_it_would_have_alone():
    from dataclasses import replace

    from illumgrid.field.lights import Distant, Sky
    from illumgrid.grid.channels import channels_of

    lights = (Sky("dome", (0.2, 0.2, 0.2)), Distant("key", (-1, -1, 1), 25, (2, 2, 2)))
    scene = replace(sky(noise(9, (8, 9, 7), seed=4), (2, 6)), lights=lights)
    queries, nodes = asked(scene)
    channels, random = channels_of(scene), np.random.default_rng(0)
    light = random.random((len(queries), len(channels))).astype(np.float32)
    m2, paths = random.random(light.shape).astype(np.float32), np.full(len(queries), 4, np.int32)
    together = Bilateral(1.0).fill(Samples(queries, light, m2, paths, channels), nodes)
    for k in range(len(channels)):
        alone = Bilateral(1.0).fill(Samples(queries, light[:, k : k + 1], m2[:, k : k + 1], paths), nodes)
        known = alone.support > 0
        np.testing.assert_allclose(together.errors[..., k][known], alone.error[known], rtol=1e-5)
