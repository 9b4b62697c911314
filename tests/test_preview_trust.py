"""``preview --trust``: colours of error bars, their scale, holes, and the note where bars are a lower bound."""

import numpy as np
import pytest
from PIL import Image

from illumgrid.show import render, trust
from illumgrid.show.trust import HIGH, LOW, SMALLEST, doubts, scale, scale_colors
from illumgrid.tone import decode_srgb, encode_srgb
from shapes import DIRECTIONS, ball, lit, refused, relit, sky
from test_tone_preview import three_balls

SIZE = {"width": SMALLEST[0], "height": SMALLEST[1]}
GROUND = np.full(3, 60, np.uint8)


def barred(bar, scene=None, nodes=9):
    """Light of 2 everywhere, with a relative bar of `bar` midway between nodes."""
    light = lit(scene or sky(), 2.0, nodes)
    for grid in light.grids:
        grid.error[:] = 2 * bar * np.sqrt(27 / 8)  # what a lookup keeps of it
    return light


def middle(picture):
    """Display-linear colour at the centre of the object, where it faces the viewer."""
    rows = len(picture) - len(scale(barred(0.1), *picture.shape[1::-1], GROUND))
    return decode_srgb(picture)[rows // 2 - 3 : rows // 2 + 3, picture.shape[1] // 2 - 3 :][:, :6].mean(axis=(0, 1))


def is_red(picture):
    """The red of holes, which is neither on the scale nor between two of its colours."""
    colors = decode_srgb(picture)
    return colors[..., 0] > 3 * colors[..., 1:].max(axis=-1)


# Colours


def test_the_scale_is_logarithmic_ends_where_it_says_and_has_no_color_twice():
    bars = np.geomspace(LOW, HIGH, 41)
    colors = scale_colors(bars)
    np.testing.assert_array_equal(scale_colors(np.array([0.0, LOW / 9, HIGH * 9])), colors[[0, 0, -1]])
    np.testing.assert_allclose(scale_colors(np.array([np.sqrt(LOW * HIGH)])), colors[[20]], atol=1e-6)
    distance = np.abs(encode_srgb(colors[:, None]).astype(int) - encode_srgb(colors)).max(axis=2)
    assert distance[~np.eye(41, dtype=bool)].min() >= 3
    assert (np.diff(colors @ [0.2126, 0.7152, 0.0722]) > 0).all()  # brighter is worse, also printed in gray


@pytest.mark.parametrize("bar", [0.001, 0.01, 0.05, 0.2])
def test_a_surface_has_the_color_of_its_bar_on_the_scale_that_is_drawn(bar):
    picture = render(barred(bar), trust=True, view="front", **SIZE)
    assert picture.shape == (SIZE["height"], SIZE["width"], 3)
    np.testing.assert_allclose(middle(picture), scale_colors(np.array([bar]))[0], atol=0.02)
    strip = picture[-len(scale(barred(bar), *SIZE.values(), GROUND)) :].astype(int)
    wanted = encode_srgb(scale_colors(np.array([bar])))[0].astype(int)
    assert (np.abs(strip - wanted).max(axis=2) <= 3).any()


def test_bars_are_relative_to_the_light_of_their_own_field():
    light = barred(0.03, three_balls())
    for number, grid in enumerate(light.grids):
        light = relit(light, number, values=grid.values * 10.0**number, error=grid.error * 10.0**number)
    for number, grid in enumerate(light.grids):
        point = light.scene.fields[number].volume.origin + 0.5
        found = trust.trust_colors(grid, point[None], np.ones(1))
        np.testing.assert_allclose(found, scale_colors(np.array([0.03])), atol=1e-3)


# Holes


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_a_hole_is_striped_in_red_and_nothing_else_is(direction):
    volume = ball(12)
    scene = sky(type(volume)(volume.values, (3, 4, 5), volume.spacing, direction))
    whole = render(barred(0.05, scene, 17), trust=True, **SIZE)
    light = barred(0.05, scene, 17)
    light.grids[0].support[8:], light.grids[0].error[8:] = 0, np.inf
    halved = render(light, trust=True, **SIZE)
    rows = len(whole) - len(scale(light, *SIZE.values(), GROUND))
    red, seen = is_red(halved[:rows]), (whole != whole[0, 0]).any(axis=2)[:rows]
    assert not is_red(whole[:rows]).any() and 0.2 < red.sum() / seen.sum() < 0.95
    tones = decode_srgb(halved[:rows])[red][:, 0]
    assert 0.15 < (tones > tones.max() / 2.5).mean() < 0.85  # two tones: stripes
    alike = (np.abs(halved.astype(int) - whole).max(axis=2) <= 2)[:rows]
    assert (red | alike)[seen].mean() > 0.97  # the rest, but for the edge of the hole, as before


def test_walls_and_caps_have_no_color_that_could_be_taken_for_a_bar():
    from illumgrid.field.scene import Scene

    light = barred(0.05, Scene.box(ball(12), range=(0.1, 0.9), albedo=(0.9, 0.2, 0.2)))
    picture = render(light, isovalue=0.1, trust=True, **SIZE).astype(int)
    rows = len(picture) - len(scale(light, *SIZE.values(), GROUND))
    gray = np.ptp(picture[:rows], axis=2) <= 2
    assert gray.mean() > 0.5 and not gray.all()
    assert len(np.unique(picture[:rows][gray])) > 3  # the walls are drawn
    assert not is_red(picture[:rows].astype(np.uint8)).any()


# Words


def test_what_bars_do_not_show_is_said_with_the_field():
    light = barred(0.05, nodes=12)
    assert doubts(light) == []
    light = barred(0.05, nodes=12)
    light = relit(light, values=light.grids[0].values + np.random.default_rng(0).normal(size=(12, 12, 12, 1)))
    assert doubts(light) == ["lower bounds only: the grid does not resolve the light of field"]
    light = barred(np.inf)
    assert len(doubts(light)) == 1 and "too few paths" in doubts(light)[0] and "field" in doubts(light)[0]
    light.grids[0].support[:] = 0  # a hole is no doubt: it is in the picture
    assert doubts(light) == []


def test_a_doubt_makes_the_strip_longer_by_its_lines_and_no_word_is_cut(monkeypatch):
    light = barred(0.05)
    plain = scale(light, 320, 240, GROUND)
    assert (plain[:, [0, -1]] == GROUND).all() and (plain[[0, -1]] == GROUND).all() and (plain != GROUND).any()
    monkeypatch.setattr(trust, "doubts", lambda light: ["a long doubt " * 12])
    doubting = scale(light, 320, 240, GROUND)
    assert len(doubting) > len(plain) + 40
    assert (doubting[:, [0, -1]] == GROUND).all()
    assert np.array_equal(doubting[-40:], plain[-40:])


@pytest.mark.parametrize("ground, words", [((60, 60, 60), 225), ((255, 255, 255), 40)])
def test_words_stand_out_from_the_background(ground, words):
    strip = scale(barred(0.1), 480, 360, np.array(ground, np.uint8))
    assert (strip == ground).all(axis=2).mean() > 0.5
    assert (np.abs(strip.astype(int) - words) < 40).all(axis=2).sum() > 100


# The command


RUN = ["run", "v.npy", "--range", 0.3, 0.9, "--grid", 6, "--no-preview", "-o", "out"]
SMALL = ["--engine", "software", "--size", 240, 180]


def test_the_command_draws_it_says_its_doubts_and_goes_with_field_view_and_sweep(call):
    import illumgrid as ig

    call(*RUN, "--paths", 1)
    said = call("preview", "out", "--trust", *SMALL, "--view", "left", "--field", "v", "-o", "x.png")
    assert "note: too few paths to estimate the error of v" in said and "exposure" not in said
    with Image.open("x.png") as image:
        found = np.asarray(image)
    assert np.array_equal(found, render(ig.load("out"), trust=True, view="left", **SIZE))
    assert is_red(found[:90]).sum() > 100  # light without a bar is hatched
    call(*RUN, "--paths", 4, "--overwrite")
    assert "too few" not in call("preview", "out", "--trust", *SMALL, "--sweep", 2, "frames")
    for name in ("0000.png", "0001.png"):
        with Image.open(f"frames/{name}") as image:
            assert image.size == (240, 180)


def test_what_does_not_go_with_it_is_refused(call, refuse):
    call(*RUN, "--paths", 1)
    for option in ("--local", "--split", "--grid-volume"):
        refuse("preview", "out", "--trust", option, "-o", "x.png", words=["--trust", option])
    refuse("preview", "out", "--trust", "--engine", "software", "--size", 200, 180, "-o", "x.png",
           words=["200 x 180", "240 x 180", "scale"])  # fmt: skip
    refuse("preview", "out", "--trust", "--sweep", 2, "new", "--engine", "software", "--size", 200, 180,
           words=["200 x 180"])  # fmt: skip


def test_a_picture_too_small_for_words_is_refused():
    refused(lambda: render(lit(sky()), trust=True, width=1000, height=100), "1000 x 100", "240 x 180")
