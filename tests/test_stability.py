"""Where methods fail: one scene for each hard case, with every sampler and interpolator of the package.

Light is finite, not negative, no brighter than anything visible, and reported where missing; further requirements of a
case are stated below. The page docs/stability.md gives the error of each method.
"""

import warnings
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import illumgrid as ig
from illumgrid import registry
from illumgrid.errors import IllumgridWarning
from illumgrid.field.rooms import box_around
from illumgrid.field.scene import Field, Material, Scene
from illumgrid.field.volume import Volume
from illumgrid.grid import Nodes
from illumgrid.transport.samples import join_queries
from shapes import ball, refused, sampled

SAMPLERS = sorted(e.name for e in registry.entries() if e.kind == "sampler" and e.package == "illumgrid")
INTERPOLATORS = sorted(e.name for e in registry.entries() if e.kind == "interpolator" and e.package == "illumgrid")


def sky(values, limits, albedo=0.8, **place):
    return Scene.sky(values if isinstance(values, Volume) else Volume(values, **place), [albedo] * 3, limits)


def centred(n=9):
    """Coordinates (n, n, n, 3) from -1 to 1."""
    return np.stack(np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij"), axis=-1)


def grays(levels, shape=(8, 7, 6), seed=2):
    return np.random.default_rng(seed).integers(0, levels, shape)


def pierced():
    values = ball(9).values.copy()
    values[4, 4, 4], values[1, 2, 3], values[6, 6, 6] = np.nan, np.inf, -np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IllumgridWarning)
        return sky(values, (0.3, 0.9))


def overlapping():
    fields = (Field("one", ball(9), range=(0.3, 0.9)), Field("two", ball(9, at=(0.3, 0, 0)), range=(0.3, 0.9)))
    return Scene(fields, background=np.ones(3))


def with_lamp(shift):
    """A ball of radius 0.3 to 0.9 and a lamp: at 0 in its centre, at 0.6 across its surface in mid sweep."""
    scene = sky(ball(9), (0.3, 0.9))
    u, v = np.array([0.2, 0, 0]), np.array([0, 0.2, 0])
    lamp = ig.Quad("lamp", [-0.1, -0.1, shift], u, v, Material(np.zeros(3), np.ones(3)), (2, 2))
    return replace(scene, quads=(lamp,))


def sealed():
    """Albedo 1 everywhere, in a box without openings: the light of the lamp is reflected without end."""
    white = Material(np.ones(3))
    quads = tuple(replace(q, material=white, texels=(2, 2)) for q in box_around(ball(9))[:6])
    lamp = replace(box_around(ball(9))[6], material=Material(np.ones(3), np.full(3, 0.01)))
    return Scene((Field("ball", ball(9), white, (0.3, 0.9)),), (*quads, lamp))


HARD = {
    "isovalues on data values": lambda: sky(grays(9), (2, 6)),
    "isovalues at the extremes": lambda: sky(grays(256), (grays(256).min(), grays(256).max())),
    "plateaus in the range": lambda: sky(np.clip(ball(9).values, 0.3, 0.6), (0.3, 0.6)),
    "a gradient that vanishes": lambda: sky(1 - np.linalg.norm(centred(), axis=-1) ** 8, (0.1, 0.999)),
    "a saddle in the range": lambda: sky(centred()[..., 0] ** 2 - centred()[..., 1] ** 2, (-0.5, 0.5)),
    "noise": lambda: sky(np.random.default_rng(1).random((8, 8, 8)), (0.2, 0.8)),
    "a sheet of one voxel": lambda: sky(1.0 * (np.indices((9, 9, 9))[2] == 4), (0.2, 0.8)),
    "spacing 1e-6": lambda: sky(ball(9).values, (0.3, 0.9), spacing=[1e-6] * 3),
    "spacing 1e6, far origin": lambda: sky(ball(9).values, (0.3, 0.9), spacing=[1e6] * 3, origin=[8e11] * 3),
    "values of 1e-30": lambda: sky(ball(9).values * np.float32(1e-30), np.array([0.3, 0.9]) * 1e-30),
    "values of 1e30": lambda: sky(ball(9).values * np.float32(1e30), np.array([0.3, 0.9]) * 1e30),
    "voxels ten times as long": lambda: sky(ball(9).values, (0.3, 0.9), spacing=[1, 1, 10]),
    "a range beyond the data": lambda: sky(ball(9), (0.9, 3.0)),
    "a range of a hair": lambda: sky(ball(9), (0.5, np.nextafter(0.5, 1))),
    "fields that overlap": overlapping,
    "a lamp in the solid": lambda: with_lamp(0.0),
    "a lamp across the surface": lambda: with_lamp(0.6),
    "albedo 1 in a sealed box": sealed,
    "two voxels a side": lambda: sky(np.arange(8.0).reshape(2, 2, 2), (1, 6)),
    "two voxels thick": lambda: sky(np.random.default_rng(3).random((9, 2, 8)), (0.3, 0.7)),
    "not a number, and infinity": pierced,
    "black": lambda: sky(ball(9), (0.3, 0.9), albedo=0.0),
}


def lit(scene, sampler, interpolator, paths=4, **more):
    options = {} if sampler == "direct" else {"count": 4, "points": 40}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IllumgridWarning)  # holes, where the case has them
        return ig.run(
            scene, sampler=ig.sampler(sampler, **options), interpolator=interpolator, backend="numba", grid=9,
            paths=paths, isovalues=2, **{"bounces": 2} | more,
        )  # fmt: skip


@pytest.mark.parametrize("sampler, interpolator", list(product(SAMPLERS, INTERPOLATORS)))
@pytest.mark.parametrize("case", HARD)
def test_light_stays_light(case, sampler, interpolator):
    scene = HARD[case]()
    light = lit(scene, sampler, interpolator)
    for field, grid in zip(scene.fields, light.grids):
        assert np.isfinite(grid.values).all() and (grid.values >= 0).all()
        if not scene.quads:
            assert (grid.values <= np.pi * (1 + 1e-5)).all()  # under a white sky no surface is brighter
        hole = grid.support == 0
        assert np.isinf(grid.error[hole]).all() and np.isfinite(grid.error[~hole]).all()
        assert not np.isnan(grid.bar).any()
        there = grid.spec.nodes()[::3] + 0.3 * grid.spec.spacing
        assert np.isfinite(grid.lookup(there)).all()
        if not hole.all() and not (scene.quads and not scene.background.any()):
            assert grid.values.max() > 0, field.name
    for texture in light.walls:
        assert np.isfinite(texture.values).all() and (texture.values >= 0).all()


@pytest.mark.parametrize("sampler, interpolator", list(product(SAMPLERS, INTERPOLATORS)))
def test_away_from_the_only_level_set_everything_is_a_hole_and_nothing_is_black(sampler, interpolator):
    """The range begins where the data end: a sweep over a single point, whose light all holes then show."""
    scene = sky(ball(9), (float(ball(9).values.max()), 3.0))
    grid = lit(scene, sampler, interpolator).grids[0]
    voxels = np.indices(grid.spec.shape) * 8 / (grid.spec.shape[0] - 1)  # bilateral stores more nodes than voxels
    from_peak = np.abs(voxels - 4).max(axis=0)
    np.testing.assert_array_equal(grid.support == 0, from_peak > 1)
    np.testing.assert_allclose(grid.values, np.pi, rtol=0.05)


def test_a_lamp_inside_the_solid_lights_nothing():
    dark = replace(with_lamp(0.0), background=np.zeros(3))
    for sampler in SAMPLERS:
        light = lit(dark, sampler, "nearest", paths=64)
        assert light.grids[0].values.max() == 0


def test_a_lamp_across_the_surface_lights_what_sticks_out_only():
    """The lamp faces up: points of the ball above its plane see none of it, and nothing inside leaks out."""
    dark = replace(with_lamp(0.6), background=np.zeros(3))
    mesh = ig.isosurface(dark.fields[0].volume, 0.75)
    asked = ig.Queries.at(dark, mesh.vertices, level=0.75)  # radius 0.45: the lamp is outside
    answer = ig.backend("numba").solve(dark, asked, paths=range(64), bounces=0, seed=0)
    assert answer.mean.max() == 0  # the front looks away from the ball
    flipped = replace(dark, quads=(replace(dark.quads[0], edge_u=dark.quads[0].edge_v, edge_v=dark.quads[0].edge_u),))
    answer = ig.backend("numba").solve(flipped, asked, paths=range(64), bounces=0, seed=0)
    up = asked.point[:, 2] > 0.4
    assert answer.mean[up].max() > 0 and answer.mean[asked.point[:, 2] < -0.1].max() == 0


def test_albedo_one_goes_on_for_ever_and_adds_up():
    """The closed form of the walls with a = 1: each reflection adds as much light as the first."""
    scene = sealed()
    wall = scene.quads[1]
    asked = ig.Queries(
        np.arange(1, dtype=np.uint64), (wall.corner + 0.5 * (wall.edge_u + wall.edge_v))[None], wall.normal[None],
        np.full((1, 1), 0.5), np.array([2], np.int32),
    )  # fmt: skip
    means = [
        float(ig.backend("numba").solve(scene, asked, paths=range(256), bounces=b, seed=0).mean.mean())
        for b in (20, 40, 80)
    ]
    first, second = means[1] - means[0], means[2] - means[1]
    assert second == pytest.approx(2 * first, rel=0.1)


@pytest.mark.parametrize("paths", [1, 2, 3, 5])
def test_few_paths_give_light_and_say_how_unsure_it_is(paths):
    grid = lit(sky(ball(9), (0.3, 0.9)), "direct", "nearest", paths=paths).grids[0]
    lit_nodes = grid.support > 0
    assert np.isinf(grid.error[lit_nodes]).all() if paths == 1 else np.isfinite(grid.error[lit_nodes]).all()
    assert np.isinf(grid.bar[grid.support == 0]).all()


DTYPES = ["bool", "i1", "u1", "<i2", ">i2", "<u2", ">u2", "<i4", ">i4", "<u4", "<i8", ">f2", "<f2", ">f4", "<f8", ">f8"]


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_kind_of_number_is_the_same_field(dtype):
    """Kernels compile anew for each kind that stays as it is, which takes half a minute: bytes alone do.

    What a kernel does with other kinds is seen by `test_kernels_plain`.
    """
    values = grays(2 if dtype == "bool" else 100)
    one, other = (Volume(values.astype(t)) for t in (dtype, np.float32))
    np.testing.assert_array_equal(one.values, other.values)
    scenes = [sky(v, (0.2, 0.8) if dtype == "bool" else (20, 80)) for v in (one, other)]
    if dtype in ("i1", "<i2", ">i2", "<u2", ">u2"):
        asked = ig.Queries.at(scenes[1], ig.GridSpec.over(other, 5).nodes(), level=None)
        a, b = (ig.backend("reference").solve(s, asked, paths=range(4), bounces=2, seed=0).mean for s in scenes)
        assert b.any()
    else:
        a, b = (lit(s, "direct", "nearest").grids[0].values for s in scenes)
    np.testing.assert_array_equal(a, b)


def test_constant_data_are_refused_and_said_why():
    refused(lambda: sky(np.ones((4, 4, 4)), None), "all 1", "varies")
    refused(lambda: sky(np.ones((4, 4, 4)), (2, 3)), "misses its data")
    refused(lambda: Volume(np.full((3, 3, 3), np.nan)), "NaN")


def test_tangent_rays_neither_stick_nor_leak():
    """Rays that graze a ball: closer than its radius they hit, farther they pass, and on the rim either is allowed."""
    from illumgrid.backends.kernels import cast_rays
    from illumgrid.constants import MISS, SURFACE
    from illumgrid.field.levelset import marchable

    squares = sampled(lambda x: -(x**2).sum(axis=1), (21, 21, 21), origin=(-10,) * 3)
    fields = marchable(Scene.sky(squares, range=(-36, -30)))
    offset = 6 + np.array([-1e-1, -5e-2, 5e-2, 1e-1])  # a facet of squares is off by at most 3/8 / (2 · 6) = 0.031
    origin = np.stack([np.full(4, -12.0), offset, np.zeros(4)], axis=1) + 10
    direction = np.tile([1.0, 0.0, 0.0], (4, 1))
    t, number, what = np.zeros(4), np.zeros(4, np.int64), np.zeros(4, np.int64)
    cast_rays(fields, np.array([-36.0]), origin, direction, -1, t, number, what, np.zeros((4, 3)))
    assert what.tolist() == [SURFACE, SURFACE, MISS, MISS]


def test_coincident_samples_count_once():
    """A sampler that asks twice at one place: no interpolator divides by zero, and a mean counts both."""
    scene = sky(ball(9), (0.3, 0.9))
    spec = ig.GridSpec.over(scene.fields[0].volume, 9)
    asked = ig.Queries.at(scene, spec.nodes(), level=None)
    twice = join_queries([asked, replace(asked, id=asked.id + np.uint64(1 << 20))])
    answer = ig.backend("numba").solve(scene, twice, paths=range(8), bounces=1, seed=0)
    light = np.repeat(np.float32([1, 3]), len(asked))  # the same everywhere, but for which of the two is asked
    answer = replace(answer, mean=np.tile(light[:, None], 3))
    for name in INTERPOLATORS:
        grid = ig.interpolator(name).fill(answer, Nodes(spec, scene.fields[0]))
        found = grid.values[grid.support > 0]
        assert len(found)
        if name == "nearest":  # one of them
            assert np.isin(found, (1, 3)).all()
        else:
            np.testing.assert_allclose(found, 2, rtol=1e-6)
