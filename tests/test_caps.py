"""Caps under the open sky: their light in closed form against traced light, and in every picture."""

from dataclasses import replace

import numpy as np
import pytest

from illumgrid import Queries, run
from illumgrid.backends.numba_ import Numba
from illumgrid.backends.reference import Reference
from illumgrid.field.layers import ALL
from illumgrid.field.lights import Distant, Harmonics, Sky
from illumgrid.field.open_sky import of_disc, open_irradiance
from illumgrid.field.scene import Field, Quad, Scene
from illumgrid.field.upright import sky_axes
from illumgrid.field.volume import index_to_world
from illumgrid.grid.channels import channels_of
from illumgrid.show import CAP_TONE, render
from illumgrid.show.caps import face_normals, faces_at, light_on_caps, open_faces
from illumgrid.show.shade import Shown
from illumgrid.show.triangles import seen
from illumgrid.tone import curve, encode_srgb
from shapes import DIRECTIONS, OBLIQUE, lit, sampled, sky

STRAIGHT = DIRECTIONS["straight"]
KEY = Distant("key", (-0.4, -1, 0.8), 25, (3, 2, 1))
LIGHTS = {
    "sky": Sky("dome", (0.5, 0.6, 0.7)),
    "gradient": Sky("gradient", [(0.2, 0.1, 0.0), (1.0, 2.0, 3.0)]),
    "image": Sky("image", np.random.default_rng(3).random((6, 12, 3)) ** 4),
    "key": KEY,
    "disc half below the horizon of three faces": Distant("wide", OBLIQUE @ (0.05, 0.1, 1), 60, (1, 2, 3)),
    "harmonics": Harmonics("smooth", 0.1 * np.random.default_rng(1).normal(size=(25, 3)) + 2 * np.eye(25, 3)[:, :1]),
}


def block(direction=STRAIGHT):
    """A solid that all faces of its box cut, with a bubble inside."""
    solid = sampled(lambda x: 5 + np.sin(x).sum(axis=1), (7, 5, 6), (3, -8, 1), (0.5, 0.7, 0.3), direction)
    values = solid.values.copy()
    values[3, 2, 3] = 0
    return solid.with_stored(values)


def half():
    """A ball, cut open at the front."""
    return sampled(lambda x: 1.2 - np.linalg.norm(x, axis=1), (20, 12, 20), (-1, 0, -1), (0.105,) * 3)


def on_faces(scene, each=2):
    """Queries at points inside the faces of the box, `each` of them on every face, and the faces."""
    volume, random = scene.fields[0].volume, np.random.default_rng(0)
    index = random.uniform(0.2, 0.8, (6 * each, 3)) * (np.array(volume.shape) - 1)
    face = np.repeat(np.arange(6), each)
    index[np.arange(len(face)), face // 2] = np.where(face % 2, np.array(volume.shape)[face // 2] - 1, 0)
    level = np.full((len(face), 1), scene.fields[0].range[0])
    asked = index_to_world(volume, index), face_normals(volume)[face], level, np.zeros(len(face), np.int32)
    return Queries(np.arange(len(face), dtype=np.uint64), *asked), face


@pytest.mark.parametrize("name", LIGHTS)
def test_the_open_sky_on_a_cap_is_what_rays_from_it_bring(name):
    field = Field("block", block(OBLIQUE), range=(1.0, 1.5))
    scene = Scene((field,), lights=(LIGHTS[name],))
    asked, face = on_faces(scene)
    np.testing.assert_array_equal(faces_at(field.volume, asked.point), face)
    known = open_irradiance(scene, ALL, face_normals(field.volume))[face]
    found = Reference().solve(scene, asked, paths=range(2048), bounces=2, seed=5)
    deviation = np.hypot(found.stderr, 1e-5 * np.abs(known).max())
    z = (found.mean - known) / deviation
    assert np.abs(z).max() < 4.5 and np.abs(z).mean() < 1.2
    assert (known > 0).any(axis=1).sum() >= 6


def test_a_disc_at_the_horizon_is_what_a_sum_over_its_directions_says():
    z = 1 - (np.arange(2000) + 0.5) / 2000 * (1 - np.cos(np.radians(60)))
    azimuth = 2 * np.pi * (np.arange(1000) + 0.5) / 1000
    for towards in (-0.9, -0.6, 0.0, 0.3, 0.86, 0.87, 1.0):
        across = np.sqrt(1 - towards * towards)
        cosines = towards * z[:, None] + across * np.sqrt(1 - z * z)[:, None] * np.cos(azimuth)
        summed = np.maximum(cosines, 0).mean() * 2 * np.pi * 0.5
        assert of_disc(np.array([towards]), 0.5)[0] == pytest.approx(summed, abs=1e-5)
    assert of_disc(np.array([-1.0, 1.0]), 0.5) == pytest.approx([0.0, 0.75 * np.pi])


def test_only_faces_with_nothing_beyond_are_known():
    volume = half()
    alone = sky(volume, (0.2, 1.1))
    assert open_faces(alone, 0).all()
    floor = Scene.floor(volume, range=(0.2, 1.1))
    assert open_faces(floor, 0).tolist() == [False] * 5 + [True]
    assert np.isnan(light_on_caps(lit(floor), 0)[:5]).all()
    below = Quad("lamp", (-9, -9, -3), (18, 0, 0), (0, 18, 0))
    behind = replace(below, corner=(-0.9, 0.1, -3.0), edge_u=(1.8, 0, 0), edge_v=(0, 1, 0))
    found = [open_faces(replace(alone, quads=(quad,)), 0).tolist() for quad in (below, behind)]
    assert found == [[False] * 4 + [False, True], [True] * 4 + [False, True]]
    twin = replace(alone.fields[0], name="twin")
    assert open_faces(replace(alone, fields=(*alone.fields, twin)), 0).all()


@pytest.mark.parametrize("value", [0.5, 2.0])
def test_a_cap_is_shown_at_albedo_over_pi_times_the_open_sky(value):
    light = lit(sky(half(), albedo=(0.9, 0.6, 0.3)), value)
    shown = encode_srgb(curve(np.float32(light.exposure) * np.array([0.9, 0.6, 0.3], np.float32)))
    for options in ({}, {"engine": "software"}):
        plain = (np.abs(render(light, width=120, height=90, **options).astype(int) - shown) <= 1).all(axis=2)
        assert 0.15 < plain.mean() < 0.6


def test_triangles_and_rays_agree_on_caps_and_their_light_follows_the_mix():
    scene = Scene((Field("block", block(OBLIQUE), range=(1.0, 1.5)),), lights=(KEY, LIGHTS["sky"]))
    light = lit(scene)
    channels = channels_of(scene)
    grids = [
        replace(g, values=np.ones((*g.spec.shape, len(channels)), np.float32), channels=channels) for g in light.grids
    ]
    light = replace(light, grids=tuple(grids))
    normals = face_normals(scene.fields[0].volume)
    each = [open_irradiance(replace(scene, lights=(one,)), ALL, normals) for one in scene.lights]
    np.testing.assert_allclose(light_on_caps(light, 0), each[0] + each[1], rtol=1e-5)
    mixed = light.mix(key=0.5, dome=3.0)
    np.testing.assert_allclose(light_on_caps(mixed, 0), 0.5 * each[0] + 3 * each[1], rtol=1e-5, atol=1e-6)
    shown = Shown(mixed, np.array([1.2]), 0.4)
    caps = seen(shown, np.array([30.0, -40.0, 50.0]))[1:]
    material = np.float32(mixed.exposure) * scene.fields[0].material.albedo / np.pi
    for part, irradiance in zip(caps, light_on_caps(mixed, 0)):
        np.testing.assert_allclose(part.colors, np.tile(curve(material * irradiance), (len(part.points), 1)), rtol=1e-5)
    assert len(caps) == 6


def test_caps_turn_with_the_sky():
    kept = Scene((Field("block", block(), range=(1.0, 1.5)),), lights=(KEY,)).in_harmonics(2)
    light = run(kept, grid=4, paths=2, bounces=0, judge=False)
    before, after = light_on_caps(light, 0), light_on_caps(light.under(None, 90.0), 0)
    right, back, _ = sky_axes(kept)
    normals = face_normals(kept.fields[0].volume)
    at = {name: int((normals @ axis).argmax()) for name, axis in (("right", right), ("back", back), ("left", -right))}
    assert np.ptp(before) > 0.5
    np.testing.assert_allclose(after[at["right"]], before[at["back"]], atol=1e-5)
    np.testing.assert_allclose(after[at["back"]], before[at["left"]], atol=1e-5)


def test_caps_without_known_light_keep_a_plain_tone_and_the_lamp_at_the_camera_lights_all():
    scene = Scene.box(half(), albedo=(0.9, 0.6, 0.3), range=(0.2, 1.1))
    light = lit(scene)
    plain = encode_srgb(CAP_TONE * np.array([0.9, 0.6, 0.3]))
    picture = render(light, engine="software", width=120, height=90)
    assert 0.05 < (picture == plain).all(axis=2).mean() < 0.6
    local = render(light, engine="software", local=True, width=120, height=90)
    assert not (local == plain).all(axis=2).any()


def test_paths_on_caps_are_those_of_the_kernels():
    scene = Scene((Field("block", block(OBLIQUE), range=(1.0, 1.5)),), lights=(KEY, LIGHTS["image"]))
    asked, _ = on_faces(scene)
    one, other = (b.solve(scene, asked, paths=range(16), bounces=2, seed=1) for b in (Numba(), Reference()))
    np.testing.assert_allclose(one.mean, other.mean, atol=1e-5)
