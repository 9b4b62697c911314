"""Clip planes and colours of a second quantity: what pictures show of them."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import illumgrid as ig
from illumgrid.field.scene import Material, Quad, Scene
from illumgrid.show import render
from illumgrid.show.cuts import greys, window
from illumgrid.show.exact import Exact
from illumgrid.show.tints import Tint
from illumgrid.tone import curve, decode_srgb, luminance
from shapes import ball, lit, refused, sampled, sky

SMALL = {"width": 40, "height": 30, "isovalue": 0.5, "view": "front"}


@pytest.fixture(scope="module")
def light():
    return lit(sky(ball(16)), 1.0)


def seen(light, **options):
    return decode_srgb(render(light, **{**SMALL, "background": "#000000", **options}))


@pytest.mark.parametrize("plane", ["-y=0", "-y=0.3"])
def test_a_cut_through_a_ball_shows_its_data_in_grey(light, plane):
    """From the front one looks along y: the cut is a disc in whose middle the values are largest."""
    field = light.scene.fields[0]
    shown = seen(light, clip=[plane])
    middle = (shown[14:16, 19:21]).mean(axis=(0, 1))
    place = np.array([[0.0, float(plane.partition("=")[2]), 0.0]])
    assert middle == pytest.approx(greys(field, place)[0], abs=0.02)
    assert np.allclose(shown[..., 0], shown[..., 2], atol=0.01)
    low, high = window(field)
    assert field.volume.extremes[0] <= low < 0.1 and 0.9 < high <= field.volume.extremes[1]


def test_what_lies_beyond_is_left_out_and_what_lies_before_stays(light):
    whole, left = seen(light), seen(light, clip=["x=0"])
    assert np.array_equal(left[:, :18], whole[:, :18]) and whole[:, 22:].any() and not left[:, 22:].any()
    both = seen(light, clip=["x=0", "-x=-0.2"])
    assert not both[:, :14].any() and both[:, 17:19].any()


def test_walls_stay_whole(light):
    floor = Quad("floor", (-2, -2, -0.8), (4, 0, 0), (0, 4, 0), Material(np.full(3, 0.5)))
    scene = Scene(light.scene.fields, (floor,), np.ones(3))
    whole, cut = (seen(lit(scene), clip=clip, view=None) for clip in ((), ["-y=0.9"]))
    bare = (whole == cut).all(axis=-1)
    assert bare.mean() > 0.4 and (whole[bare] > 0).any() and not bare.all()


def test_a_cut_film_lets_one_look_in():
    scene = sky(ball(16), limits=(0.3, 0.6))
    film = replace(scene.fields[0], name="film", material=Material((0.2, 0.2, 0.2), transmission=0.5))
    core = replace(scene.fields[0], name="core", isovalue=0.9, range=None, material=Material((0.8, 0.2, 0.1)))
    light = lit(replace(scene, fields=(film, core)), 1.0)
    through, open_ = (seen(light, clip=clip)[15, 20] for clip in ((), ["-y=-0.5"]))
    assert open_[2] > 0 and open_[0] / open_[2] == pytest.approx(8.0, rel=0.1)  # the core, and no film before it
    assert through[0] / through[2] < 6.0


def test_exact_pictures_are_cut_too():
    light = ig.run(sky(ball(12)), grid=4, isovalues=2, paths=2, bounces=0, seed=0)
    exact = seen(light, clip=["-y=0"], exact=Exact(4))
    assert exact[15, 20] == pytest.approx(seen(light, clip=["-y=0"])[15, 20], abs=0.01)


def test_colours_are_those_of_the_map_at_the_brightness_of_white(light):
    height = sampled(lambda x: x[:, 2], (8, 8, 8), (-1, -1, -1), (2 / 7,) * 3)
    tint = Tint(height, "height", limits=(-0.7, 0.7))
    colors = tint.colors(np.array([(0, 0, -0.7), (0, 0, 0.7), (0, 0, 3.0)]))
    viridis = decode_srgb(np.array([(68, 1, 84), (253, 231, 36)], np.uint8))
    assert np.allclose(colors[:2], viridis, atol=0.01) and np.array_equal(colors[1], colors[2])
    shown = seen(light, tint=tint, width=160, height=120)
    bright = luminance(curve(np.full((1, 3), light.exposure / np.pi)))[0]
    assert shown[60, 80] == pytest.approx(bright * tint.colors(np.array([(0, -0.7, 0.0)]))[0], abs=0.02)
    assert shown[:12, -40:].max() > 0.5  # the legend


def test_the_command_cuts_and_colours(call, refuse, tmp_path):
    call("run", "v.npy", "--range", 0.3, 0.9, "--grid", 6, "--paths", 2, "--no-preview", "-o", "out")
    size = ["--size", 60, 45, "-o", "a.png"]
    assert "in grey" in call("preview", "out", *size, "--clip", "x=5")
    said = call("preview", "out", *size, "--clip", "x=500", "--split")
    assert said.count("x=500 leaves nothing out") == 1 and "in grey" not in said
    call("preview", "out", *size, "--color", "v.npy", "--cmap", "magma", "--color-range", 0, 1)
    call("preview", "out", *size, "--color", "v")
    assert np.asarray(Image.open(tmp_path / "a.png")).shape == (45, 60, 3)
    for options, words in (
        (["--clip", "q=1"], ["'q=1'", "x=12.5"]),
        (["--clip", "x=-500"], ["x=-500", "nothing"]),
        (["--cmap", "magma"], ["--cmap", "--color"]),
        (["--color", "nowhere"], ["'nowhere'", "v"]),
        (["--color", "v", "--cmap", "nomap"], ["'nomap'", "viridis"]),
        (["--color", "v", "--color-range", 2, 1], ["2", "lower"]),
    ):
        refuse("preview", "out", *size, *options, words=words)


def test_a_range_of_one_value_is_refused():
    refused(lambda: Tint(ball(4), limits=(1.0, 1.0)), "lower")


def test_a_plane_that_leaves_nothing_out_or_nothing_at_all_names_the_bounds_of_the_data(light, recwarn):
    whole = seen(light)
    with pytest.warns(ig.errors.IllumgridWarning, match=r"clip: x=100 leaves nothing out, the data lie at x = -1 to 1"):
        assert np.array_equal(seen(light, clip=["x=100"]), whole)
    with pytest.warns(ig.errors.IllumgridWarning, match=r"clip: -y=-3 leaves nothing out"):
        seen(light, clip=["-y=-3"])
    recwarn.clear()
    for planes in (["x=-100"], ["-z=1.5"], ["x=-0.2", "-x=0.2"]):
        refused(lambda planes=planes: seen(light, clip=planes), f"{planes[-1]} leaves nothing", "the data lie at")
    seen(light, clip=["x=0.5", "-x=-0.5"])
    assert not recwarn.list
