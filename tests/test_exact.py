"""Pictures whose light is gathered by rays: they converge to paths of every length, and blend without a bias."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import illumgrid as ig
from illumgrid.errors import BadInput
from illumgrid.field.scene import Material, Quad, Scene
from illumgrid.field.volume import world_to_index
from illumgrid.show import fit_camera, render
from illumgrid.show.engines import software
from illumgrid.show.exact import FEWEST_TRUST, MOST_TRUST, Exact, Gathering, cache_at, looked_up, steps_to, tracer_of
from illumgrid.show.picture import _background, _shown
from illumgrid.tone import decode_srgb
from shapes import ball, lit, refused, sky

SMALL = {"width": 48, "height": 36}


def lit_on_a_floor(albedo, **options):
    """A sphere clear of a wide floor under a white sky, and too few nodes for its light."""
    scene = sky(ball(16), albedo=np.full(3, albedo))
    floor = Quad("floor", (-200, -200, -1.1), (400, 0, 0), (0, 400, 0), Material(np.full(3, albedo)))
    return ig.run(Scene(scene.fields, (floor,), (1, 1, 1)), grid=4, isovalues=2, seed=0, **options)


@pytest.fixture(scope="module")
def on_a_floor():
    return lit_on_a_floor(0.0, paths=2, bounces=0)


@pytest.fixture(scope="module")
def grey():
    return lit_on_a_floor(0.5, paths=4, bounces=4)


def grey_light(value):
    """Light that is the same at all nodes, in the one channel of a grey scene."""
    light = lit(sky(ball(16), albedo=(0.0, 0.0, 0.0)), value)
    return replace(light, grids=tuple(replace(g, values=g.light[..., :1], channels=None) for g in light.grids))


def gathering(light, paths, full=False, isovalue=None):
    shown = _shown(light, None, isovalue, False, False, 0.0)
    camera = fit_camera(light.scene, shown.row, 48 / 36)
    return Gathering(shown, camera, 48, 36, Exact(paths, full))


def visible(made):
    directions = software.directions_of(made.camera, made.width, range(made.height), made.height)
    return software.first_hits(made.shown, made.camera.eye, directions)


def test_what_is_seen_lies_on_its_surface_and_faces_the_eye(on_a_floor):
    made = gathering(on_a_floor, 4, isovalue=0.5)
    hits = visible(made)
    sphere, floor = hits.lit(0), hits.lit(1)
    assert len(sphere) > 500 and len(floor) > 500
    assert np.abs(np.linalg.norm(hits.point[sphere], axis=1) - 0.7).max() < 0.02  # of radius 1.2 - c
    radial = hits.point[sphere] / np.linalg.norm(hits.point[sphere], axis=1)[:, None]
    assert np.einsum("ij,ij->i", hits.normal[sphere], radial).min() > 0.99
    assert np.allclose(hits.point[floor, 2], -1.1) and np.allclose(hits.normal[floor], (0, 0, 1))


@pytest.mark.parametrize("full", [False, True])
def test_gathered_light_is_that_of_the_closed_form(on_a_floor, full):
    """Floor: E = pi (1 - (r/d)² cos θ); sphere above it: E = pi (1 + n·up) / 2, and beyond its shadow."""
    made = gathering(on_a_floor, 256, full, isovalue=0.5)
    solve, _ = tracer_of(on_a_floor, full)
    hits = visible(made)
    rows = np.concatenate([hits.lit(0)[::7], hits.lit(1)[::7]])
    light, walked = solve(made.asked(hits, rows, np.arange(len(rows), dtype=np.uint64)), range(256), made.seed)
    assert (walked == 256).all()
    point, on_floor = hits.point[rows], hits.number[rows] == 1
    distance = np.linalg.norm(point, axis=1)
    on_the_floor = np.pi * (1 - 0.7**2 / distance**2 * (1.1 / distance))
    truth = np.where(on_floor, on_the_floor, np.pi * (1 + hits.normal[rows, 2]) / 2)
    for part in (on_floor, ~on_floor):
        off = (light[:, 0] - truth)[part] / np.pi
        assert abs(off.mean()) < 0.004 and np.sqrt((off**2).mean()) < 0.02


def test_the_blend_is_between_lookup_and_rays_and_its_weights_know_no_ray(on_a_floor):
    made = gathering(on_a_floor, 16)
    hits = visible(made)
    light, known = looked_up(made.shown, hits)
    worth = made.worth_of_lookup(hits, known)
    assert (worth >= FEWEST_TRUST).all() and (worth <= MOST_TRUST).all()
    pixel = np.arange(len(hits.what))  # each on its own
    count = np.full(len(pixel), 12, np.int32)
    for answer in (0.0, 5.0):
        blended = made.blended(hits, pixel, np.full((len(pixel), 3), answer * 12, np.float32), count)
        lit = np.concatenate([hits.lit(0), hits.lit(1)])
        share = (12 / (worth + 12))[lit, None]
        assert np.allclose(blended[lit], (1 - share) * light[lit] + share * answer, rtol=1e-4, atol=1e-5)
    unasked = made.blended(hits, pixel, np.zeros((len(pixel), 3), np.float32), np.zeros_like(count))
    assert np.array_equal(unasked[lit], light[lit])


def test_a_lookup_without_error_is_trusted_and_one_that_is_off_is_not():
    """On the sphere under a sky that is the same from everywhere, black: E is pi."""
    right, wrong = (gathering(grey_light(value), 4).trust[0] for value in (np.pi, 1.0))
    assert right[1] < 0.02 and wrong[1] == pytest.approx((np.pi - 1) ** 2, rel=0.01)


def test_a_node_that_knows_nothing_does_not_tell_what_is_usual():
    """One of 20³ whose bar is a million times that of the others, and in view."""
    light = lit(sky(ball(16), albedo=(0.0, 0.0, 0.0)), 3.0, nodes=20)
    (grid,) = light.grids

    def known(error):
        grids = (replace(grid, values=grid.light[..., :1], error=error, channels=None),)
        return gathering(replace(light, grids=grids), 4)

    error = np.full(grid.spec.shape, 0.1, np.float32)
    made = known(error.copy())
    hits = visible(made)
    index = np.round(world_to_index(grid.spec, hits.point[hits.lit(0)[500:501]]))[0]
    error[tuple(index.astype(int))] = 1e5
    assert 1.0 < known(error).trust[0][2] / made.trust[0][2] < 10.0  # a few per cent of the surface count as 100 each


def test_rays_converge_to_paths_of_every_length(grey):
    """What 256 rays are off is a quarter of what lookups are off, or less; more rays are nearer."""
    options = {**SMALL, "isovalue": 0.5}
    truth, plain = (decode_srgb(render(grey, exact=e, **options)) for e in (Exact(1024, True), None))
    off = [np.sqrt(np.square(plain - truth).mean())]
    for paths in (16, 256):
        gathered = decode_srgb(render(grey, exact=Exact(paths), **options))
        off.append(np.sqrt(np.square(gathered - truth).mean()))
    assert off[2] < off[1] < off[0] and off[2] < 0.25 * off[0]


def test_rays_are_reflected_once_under_a_sky_and_end_at_once_in_a_room(grey):
    """Surfaces of albedo 0.8 that hold light of 2 bring 1.6 to rays that end there, and 1.28 by one more reflection."""
    answers = []
    for value in (0.0, 2.0):
        room = lit(Scene.box(ball(16), albedo=(0.8, 0.8, 0.8)), value)
        made = gathering(room, 4)
        hits = visible(made)
        rows = hits.lit(0)[::5]
        asked = made.asked(hits, rows, np.arange(len(rows), dtype=np.uint64))
        answers.append(tracer_of(room, False)[0](asked, range(64), 0)[0])
    brought = np.median(answers[1] - answers[0])
    assert 1.28 < brought <= 1.6
    assert cache_at(room, 0.5).after == 0 and cache_at(grey, 0.5).after == 1


def test_a_picture_watched_ends_as_one_that_is_not(grey):
    seen = []
    watched = render(grey, exact=Exact(24), watch=seen.append, **SMALL)
    assert steps_to(24) == [4, 16, 24] and len(seen) == 3
    plain = render(grey, exact=Exact(24), **SMALL)
    assert np.array_equal(watched, plain) and np.array_equal(watched, seen[-1])
    assert not np.array_equal(seen[0], seen[1])


def test_lights_keep_their_weights():
    scene = replace(sky(ball(12)), lights=(ig.Distant("sun", (0, 0, -1), 10.0, (2, 2, 2)),))
    light = ig.run(scene, grid=6, paths=4, bounces=2, seed=0)
    options = {"exact": Exact(16), **SMALL, "background": "#000000"}
    dark = render(light.mix(sun=0.0, sky=0.0), **options)
    assert not dark.any()
    hits = visible(gathering(light, 4))
    one = gathering(light, 4).asked(hits, hits.lit(0), np.arange(len(hits.lit(0)), dtype=np.uint64))
    whole, sun, dome = (
        tracer_of(mix, True)[0](one, range(16), 0)[0] for mix in (light, light.mix(sky=0.0), light.mix(sun=0.0))
    )
    assert np.allclose(sun + dome, whole, rtol=1e-4)


@pytest.mark.parametrize("given", ["4", "full:8"])
def test_the_command_draws_and_refines(call, tmp_path, given):
    call("run", "v.npy", "--range", 0.3, 0.9, "--grid", 6, "--paths", 2, "--no-preview", "-o", "out")
    size = ["--size", 48, 36]
    call("preview", "out", *size, "--exact", given, "--watch", "-o", "a.png")
    call("preview", "out", *size, "--exact", given, "-o", "b.png")
    a, b = (np.asarray(Image.open(tmp_path / name), int) for name in ("a.png", "b.png"))
    assert a.shape == (36, 48, 3) and np.array_equal(a, b)
    call("preview", "out", *size, "--exact", "1", "--isovalues", "0.4,0.8", "-o", "strip.png")
    call("preview", "out", *size, "--exact", "1", "--sweep", 2, "film")
    assert len(list((tmp_path / "film").iterdir())) == 2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--exact", "0"], ["0 paths", "1 to"]),
        (["--exact", "many"], ["'many'", "full:256"]),
        (["--exact", "full:"], ["'full:'"]),
        (["--exact", "4", "--local"], ["--local", "--exact"]),
        (["--exact", "4", "--engine", "egl"], ["--engine", "software"]),
        (["--watch"], ["--watch", "--exact"]),
    ],
)
def test_nonsense_is_refused(refuse, options, words):
    refuse("preview", "out", "-o", "a.png", *options, words=words)


def test_a_picture_too_large_for_rays_is_refused(on_a_floor):
    refused(lambda: render(on_a_floor, exact=Exact(1), width=8000, height=8000), "8000 x 8000", "million")
    with pytest.raises(BadInput):
        Exact(0)


def test_the_ground_behind_stays_as_it_is():
    background = _background("#102030")
    made = gathering(grey_light(1.0), 1)
    (picture,) = made.pictures(background)
    missed = (visible(made).number.reshape(36, 2, 48, 2) < 0).all(axis=(1, 3))
    assert missed.any() and (picture[missed][:, :3] == (0x10, 0x20, 0x30)).all()
