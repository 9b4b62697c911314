"""Coats and films in pictures: closed forms of what they reflect and let through."""

from dataclasses import replace

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.backends.reference import place_in_sweep
from illumgrid.field.levelset import turned_levels
from illumgrid.field.scene import Material, Quad, Scene
from illumgrid.show import fit_camera, render
from illumgrid.show.engines import software
from illumgrid.show.exact import Exact, cache_at
from illumgrid.show.looks import Layer, arriving, coated, displayed, layers_of
from illumgrid.show.shade import Shown
from illumgrid.tone import decode_srgb
from shapes import ball, lit, refused, sky

SMALL = {"width": 24, "height": 18, "isovalue": 0.5}
BLACK = (0.0, 0.0, 0.0)


def plain(test):
    """Run with the kernels as plain Python, too, which warns of infinite numbers that kernels mean."""
    return pytest.mark.plain(pytest.mark.filterwarnings("ignore::RuntimeWarning")(test))


def coat_of(light, roughness, rays=1):
    """Radiance that coats reflect where rays from the eye meet the ball, and the cosines there."""
    light = light.looking(roughness=roughness)
    shown = Shown(light, np.array([0.5]), 0.5)
    camera = fit_camera(light.scene, shown.row, 1.0)
    layer = layers_of(shown, camera.eye, software.directions_of(camera, 12, range(12), 12))[0]
    rows = coated(shown, layer)
    found = arriving(shown, camera.eye, layer, rows, np.arange(len(rows), dtype=np.uint64), range(rays), 1, False)
    return found / rays, layer.hits.facing[rows], layer.hits, rows, camera


def test_a_mirror_shows_fresnels_share_of_the_sky():
    """F = 0.04 + 0.96 (1 - cos)^5 of a convex body's sky of 1: no ray meets anything else."""
    found, cosine, *_ = coat_of(lit(sky(ball(16), albedo=BLACK)), 0.0)
    seen = cosine > 0.3  # smooth normals near the outline let some rays meet the ball
    truth = 0.04 + 0.96 * (1 - cosine[seen]) ** 5
    assert seen.sum() > 200 and np.allclose(found[seen], truth[:, None], rtol=0.02)


@pytest.mark.parametrize("lights", ["one grey", "one of a colour", "two grey"])
def test_coats_reflect_lights_at_their_weights(lights):
    scene = replace(sky(ball(12), albedo=BLACK), background=np.array((1, 0.5 if "colour" in lights else 1, 1)))
    if "two" in lights:
        scene = replace(scene, lights=(ig.Distant("sun", (0, 0, 1), 10.0, (1, 1, 1)),))
    light = ig.run(scene, grid=4, isovalues=2, paths=1, bounces=0, judge=False)
    dark = {"sun": 0.0} if "two" in lights else {}
    whole, dim = (coat_of(light.mix(sky=share, **dark), 0.0)[0] for share in (1.0, 0.25))
    assert whole.max() > 0.1 and np.allclose(dim, 0.25 * whole, rtol=1e-4)


def test_rays_and_lights_that_are_asked_add_up_to_the_lobe():
    """A rough coat under a soft disc of the sky: by quadrature of GGX over the disc."""
    sun = ig.Distant("sun", (0.4, -1.0, 0.7), 20.0, (1, 1, 1))
    scene = replace(sky(ball(16), albedo=BLACK), background=np.zeros(3), lights=(sun,))
    found, cosine, hits, rows, camera = coat_of(lit(scene), 0.5, 256)
    n, v = hits.normal[rows], camera.eye - hits.point[rows]
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    z = 1 - (np.arange(60) + 0.5) / 60 * (1 - np.cos(np.radians(20)))
    angle = 2 * np.pi * (np.arange(60) + 0.5) / 60
    a = np.cross(sun.direction, (0, 0, 1))
    a /= np.linalg.norm(a)
    b, level = np.cross(sun.direction, a), np.sqrt(1 - z * z)
    d = (
        z[:, None, None] * sun.direction
        + (level[:, None] * np.cos(angle))[..., None] * a
        + (level[:, None] * np.sin(angle))[..., None] * b
    ).reshape(-1, 3)
    solid, alpha = 2 * np.pi * (1 - np.cos(np.radians(20))) / len(d), 0.25

    def hidden(c):
        return 0.5 * (np.sqrt(1 + alpha**2 * (1 / c**2 - 1)) - 1)

    whole = (n @ d.T > 0.02).all(axis=1) & (cosine > 0.3)  # the disc is seen whole
    n, v, into = n[whole], v[whole], cosine[whole, None]
    h = v[:, None] + d
    h /= np.linalg.norm(h, axis=2, keepdims=True)
    up, out = np.einsum("nkc,nc->nk", h, n), n @ d.T
    spread = alpha**2 / (np.pi * (up**2 * (alpha**2 - 1) + 1) ** 2)
    share = 0.04 + 0.96 * (1 - np.einsum("nkc,nc->nk", h, v)) ** 5
    truth = (share * spread / (4 * into * (1 + hidden(into) + hidden(out)))).sum(axis=1) * solid * sun.radiance[0]
    assert whole.sum() > 40
    off = found[whole, 0] - truth
    assert abs(off.mean()) < 0.01 * truth.mean() and np.sqrt((off**2).mean()) < 0.05 * truth.mean()


@plain
def test_a_mirror_shows_the_light_of_the_wall_that_it_faces():
    """A wall close below the ball, of 3 in its texture and albedo 0.5, with the sky black: F · 0.5 · 3 / π."""
    floor = Quad("floor", (-90, -90, -0.75), (180, 0, 0), (0, 180, 0), Material(np.full(3, 0.5)))
    scene = Scene(sky(ball(16), albedo=BLACK).fields, (floor,), np.full(3, 1e-9))
    found, cosine, hits, rows, camera = coat_of(lit(scene, 3.0), 0.0)
    v = camera.eye - hits.point[rows]
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    mirrored = 2 * cosine[:, None] * hits.normal[rows] - v
    down = (mirrored[:, 2] < -0.2) & (cosine > 0.3)
    fresnel = 0.04 + 0.96 * (1 - cosine) ** 5
    assert down.sum() > 20 and np.allclose(found[down, 0], fresnel[down] * 1.5 / np.pi, rtol=0.02)
    assert np.allclose(found[(mirrored[:, 2] > 0.2) & (cosine > 0.3)], 0.0, atol=1e-6)


@pytest.mark.parametrize("exact", [None, Exact(4)])
def test_black_films_dim_what_lies_behind(exact):
    """A black translucent ball shows a quarter of the background: through its front and its back."""
    light = ig.run(sky(ball(16), albedo=BLACK), grid=4, isovalues=2, paths=1, bounces=0, seed=0)
    light = light.looking(translucent=0.5)
    middle = decode_srgb(render(light, **SMALL, background="#ffffff", exact=exact))[9, 12]
    assert middle == pytest.approx(0.25, abs=0.01)
    cut = render(light, **SMALL, background="transparent", exact=exact)[9, 12]
    assert cut[3] == pytest.approx(0.75 * 255, abs=1) and not cut[:3].any()


@plain
def test_the_inner_side_of_a_shell_is_lit_by_what_comes_through():
    """Under a sky of 1, E = π τ / (1 - a) within a closed shell, but for what its light lacks further reflections."""
    shell = Material(np.full(3, 0.2), transmission=0.5)
    scene = sky(ball(16))
    scene = replace(scene, fields=(replace(scene.fields[0], material=shell),))
    light = lit(scene, np.pi * 0.5 / 0.8)  # grids hold the light of the inner side: the answer must be that, too
    shown = Shown(light, np.array([0.5]), 0.5)
    camera = fit_camera(scene, shown.row, 1.0)
    front, back, *rest = layers_of(shown, camera.eye, software.directions_of(camera, 8, range(8), 8))
    rows = np.flatnonzero(back.inner)
    assert len(rows) > 100 and not front.inner.any() and not any(layer.inner.any() for layer in rest)
    assert np.allclose(back.weight[rows], 0.5) and np.allclose(back.behind[rows], 0.25)
    assert (np.einsum("ij,ij->i", back.hits.normal, back.hits.point)[rows] < 0).all()
    found = arriving(shown, camera.eye, back, rows, rows.astype(np.uint64), range(4), 1, True) * np.pi / 4
    assert found.mean() == pytest.approx(np.pi * 0.5 / 0.8, rel=0.005)


def test_a_ball_within_a_film_is_seen_with_light_of_its_own():
    ball_, scene = ball(16), sky(ball(16), limits=(0.3, 0.6))
    film = replace(scene.fields[0], name="film", material=Material(BLACK, transmission=0.5))
    core = replace(
        scene.fields[0], name="core", volume=ball_, isovalue=0.9, range=None, material=Material((0.5, 0.2, 0.1))
    )
    light = ig.run(replace(scene, fields=(film, core)), grid=6, paths=16, bounces=2, isovalues=2, seed=0)
    hits = [layer.hits for layer in _layers(light)]
    core_seen = hits[1].number == 1
    assert core_seen.sum() > 50 and not (hits[0].number == 1).any()
    picture = decode_srgb(render(light, **SMALL, background="#000000", exact=Exact(16)))[9, 12]
    dark, red = picture[2], picture[0]
    assert red / dark == pytest.approx(5.0, rel=0.1)  # the albedo of the core, and no light of the film


def test_rays_end_in_the_light_of_a_level_that_is_held():
    """Its place in the sweep is that of the picture, and its light that of a lookup there."""
    scene = sky(ball(12), limits=(0.3, 0.6))
    core = replace(scene.fields[0], name="core", isovalue=0.9, range=None)
    light = ig.run(replace(scene, fields=(scene.fields[0], core)), grid=5, paths=4, bounces=1, isovalues=2, seed=0)
    assert light.grids[1].rows
    for share in (0.2, 0.8):
        cache, row = cache_at(light, share), light.scene.levels(share)[0]
        assert place_in_sweep(cache, turned_levels(light.scene, row)[None])[0] == pytest.approx(share)
        spec = light.grids[1].spec
        nodes = cache.light[cache.start[1] :].reshape(*spec.shape, -1)
        assert nodes[..., 0].ravel() == pytest.approx(light.grids[1].lookup(spec.nodes(), share)[:, 0], rel=1e-5)


def _layers(light) -> list[Layer]:
    shown = Shown(light, light.scene.levels(0.5)[0], 0.5)
    camera = fit_camera(light.scene, shown.row, 1.0)
    return layers_of(shown, camera.eye, software.directions_of(camera, 12, range(12), 12))


def test_looks_change_no_light_and_are_kept(tmp_path):
    light = lit(sky()).looking(roughness=0.25, translucent=0.5)
    light.save(tmp_path / "out", preview=False)
    again = ig.load(tmp_path / "out").scene.fields[0].material
    assert (again.roughness, again.translucent, again.transmission) == (0.25, 0.5, 0.0)
    assert light.looking().scene.fields[0].material.plain
    shown = displayed(light.scene).fields[0].material
    assert shown.transmission == 0.5 and np.allclose(shown.albedo, 0.4)


def test_the_command_knows_looks(call, refuse, tmp_path):
    call("run", "v.npy", "--range", 0.3, 0.9, "--grid", 6, "--paths", 2, "--no-preview", "-o", "out")
    size = ["--size", 24, 18, "-o", "a.png"]
    call("preview", "out", *size, "--engine", "software")
    plain = (tmp_path / "a.png").read_bytes()
    call("preview", "out", *size, "--look", "v.roughness=0.2", "--look", "translucent=0.5")
    assert (tmp_path / "a.png").read_bytes() != plain
    for wrong in ("gloss=1", "v.roughness=2", "roughness"):
        refuse("preview", "out", *size, "--look", wrong, words=[wrong, "roughness=W"])


def test_nonsense_is_refused():
    refused(lambda: Material(roughness=1.5), "1.5", "mirror")
    refused(lambda: Material(translucent=-1), "-1", "0 to 1")
    corner = (0, 0, 0), (1, 0, 0), (0, 1, 0)
    refused(lambda: Quad("wall", *corner, Material(roughness=0.1)), "wall", "field only")
