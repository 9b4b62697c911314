"""The backend keeps the promises of all backends; beside Lambertian surfaces, glass and media in furnaces."""

import numpy as np
import pytest
from illumgrid_mitsuba import Mitsuba
from illumgrid_mitsuba.sky import picture, texel_directions

import illumgrid as ig
from illumgrid.field.upright import sky_axes
from illumgrid.testing import BackendTests

ALBEDO = np.array([0.8, 0.6, 0.4])


class TestMitsuba(BackendTests):
    stage = Mitsuba


def ball(size=16, radius=0.6):
    grid = np.linspace(-1, 1, size)
    away = np.sqrt(sum(x * x for x in np.meshgrid(grid, grid, grid, indexing="ij")))
    return ig.Volume(1 - away, origin=(-1, -1, -1), spacing=np.full(3, 2 / (size - 1))), 1 - radius


def around(count, radius=0.6):
    """Points (count, 3) on a sphere."""
    d = np.random.default_rng(0).normal(size=(count, 3))
    return radius * d / np.linalg.norm(d, axis=1, keepdims=True)


def test_lambertian_light_is_that_of_numba():
    volume, level = ball()
    floor = ig.Quad("floor", (-3, -3, -0.9), (6, 0, 0), (0, 6, 0), ig.Material(ALBEDO))
    lamp = ig.Quad("lamp", (0.5, 0.5, 1.5), (0, 1, 0), (1, 0, 0), ig.Material(np.zeros(3), np.full(3, 6.0)))
    scene = ig.Scene((ig.Field("ball", volume, ig.Material(ALBEDO[::-1]), (0.3, 0.5)),), (floor, lamp), (0.2, 0.3, 0.4))
    asked = ig.Queries.at(scene, around(40), level=level)
    one = Mitsuba().solve(scene, asked, paths=range(1024), bounces=3, seed=0)
    other = ig.backend("numba", surface="mesh").solve(scene, asked, paths=range(1024), bounces=3, seed=1)
    assert (one.paths > 0).all()
    off, bar = one.mean.astype(float) - other.mean, np.hypot(one.stderr, other.stderr)
    assert np.abs(off / bar).max() < 4.5  # of 120
    assert (np.abs(off.mean(axis=0)) < 4 * np.sqrt((bar**2).sum(axis=0)) / len(off)).all()


def furnace(bsdf="", medium="", bounces=64):
    """What 64 points of a ball report, of light 1 from everywhere."""
    volume, level = ball()
    scene = ig.Scene.sky(volume, albedo=ALBEDO, range=(0.3, 0.5))
    asked = ig.Queries.at(scene, around(64), level=level)
    return Mitsuba(bsdf=bsdf, medium=medium).solve(scene, asked, paths=range(64), bounces=bounces, seed=0)


@pytest.mark.parametrize(
    ("bsdf", "medium"),
    [
        ("dielectric", ""),
        ('{"type": "dielectric", "int_ior": 2.4}', ""),
        ("", '{"type": "homogeneous", "albedo": 1.0, "sigma_t": 2.0}'),
    ],
)
def test_what_takes_no_light_leaves_a_furnace_as_it_is(bsdf, medium):
    # Radiance 1 from everywhere stays 1 in glass, and in a medium that only scatters.
    answer = furnace(bsdf, medium)
    light = (answer.mean * ALBEDO).mean() / np.pi
    assert (answer.paths > 0).all() and abs(light - 1) < 4 * (answer.stderr * ALBEDO).mean() / np.pi / 8 + 2e-3


def test_glass_without_refraction_casts_no_shadow_and_a_black_ball_does():
    volume, level = ball()
    floor = ig.Quad("floor", (-2, -2, -0.7), (4, 0, 0), (0, 4, 0), ig.Material(np.zeros(3)))
    scene = ig.Scene((ig.Field("ball", volume, range=(0.3, 0.5)),), (floor,), (1, 1, 1))
    under = np.array([[0.0, 0.0, -0.7]])
    asked = ig.Queries(
        np.array([5], np.uint64), under, np.array([[0.0, 0, 1]]), np.array([[level]]), np.array([1], np.int32)
    )
    clear = Mitsuba(bsdf='{"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.0}')
    light = clear.solve(scene, asked, paths=range(512), bounces=8, seed=0)
    assert np.abs(light.mean - np.pi).max() < 4 * light.stderr.max()
    # Light that is reflected by the white ball comes from the black floor, or from the sky above.
    assert (
        Mitsuba().solve(scene, asked, paths=range(512), bounces=0, seed=0).mean.max()
        < np.pi * (1 - (0.6 / 0.7) ** 2) + 0.2
    )


def test_the_picture_of_the_sky_has_the_light_of_its_parts():
    volume, _ = ball()
    disc = ig.Distant("key", (1, -2, 3), 20.0, (3.0, 2.0, 1.0))
    scene = ig.Scene((ig.Field("ball", volume, range=(0.3, 0.5)),), (), (0, 0, 0), (disc,))
    image, d = picture(scene, np.zeros(3), [disc]), texel_directions(512, 1024)
    solid = np.sin(np.pi * np.arange(512) / 511)[:, None] * (np.pi / 511) * (2 * np.pi / 1024)
    facing = np.maximum(d @ disc.direction, 0)
    assert np.allclose((image * (facing * solid)[..., None]).sum(axis=(0, 1)), disc.irradiance, rtol=1e-3)
    gradient = ig.Sky("dome", ((0, 0, 0), (1, 1, 1)))
    up = sky_axes(scene)[2]
    assert np.allclose(picture(scene, np.zeros(3), [gradient])[..., 0], (d @ up + 1) / 2)


def test_descriptions_are_checked_and_found_by_name():
    assert ig.backend("mitsuba", bsdf="dielectric") == Mitsuba(bsdf="dielectric")
    for wrong in ("{", '{"alpha": 0.1}'):
        with pytest.raises(ig.BadInput, match="bsdf is"):
            ig.backend("mitsuba", bsdf=wrong)
