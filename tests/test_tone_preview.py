"""Pictures: standard sRGB tones, no mirroring for any storage order, and the whole object in view."""

import io

import numpy as np
import pytest
from PIL import Image

from illumgrid.field.scene import Field, Material, Scene
from illumgrid.field.volume import Volume
from illumgrid.show import BACKGROUND, fit_camera, png, render
from illumgrid.tone import DIRECTED, WHITE, automatic_exposure, curve, encode_srgb, exposure_under
from shapes import lit, relit, sampled, sky

GROUND = encode_srgb(np.full(3, BACKGROUND))
SIZE = {"width": 120, "height": 90}


# Tones


@pytest.mark.parametrize(
    "linear, byte",
    [(0, 0), (1, 255), (0.5, 188), (0.25, 137), (0.21404, 127.5), (0.0031308, 10), (0.001, 3), (0.18, 118), (0.8, 231)],
)
def test_srgb_is_that_of_the_standard(linear, byte):
    assert abs(float(encode_srgb(np.array([linear]))[0]) - byte) <= 0.5


def test_srgb_has_both_pieces_of_the_curve_and_rises():
    linear = np.linspace(0, 1, 5001)
    coded = encode_srgb(linear).astype(int)
    assert (np.diff(coded) >= 0).all() and set(coded.tolist()) == set(range(256))
    decoded = np.where(coded / 255 <= 0.04045, coded / 255 / 12.92, ((coded / 255 + 0.055) / 1.055) ** 2.4)
    slope = np.where(decoded < 0.0031308, 1 / 12.92, 2.4 / 1.055 * np.maximum(decoded, 0.003) ** (1.4 / 2.4))
    assert (np.abs(decoded - linear) <= slope * 0.51 / 255 + 1e-4).all()


def test_what_no_screen_can_show_is_clamped():
    assert encode_srgb(np.array([-1.0, 7.0, np.inf])).tolist() == [0, 255, 255]


def test_a_color_given_as_albedo_comes_out_as_that_color_under_the_median_light():
    light = np.random.default_rng(0).random((10001, 3)).mean(axis=1, keepdims=True) * [1, 1, 1]
    albedo = np.tile([0.4, 0.3, 0.1], (len(light), 1))
    exposure = automatic_exposure(light, albedo)
    middle = np.argsort(light[:, 0])[5000]
    np.testing.assert_allclose(albedo[middle] / np.pi * light[middle] * exposure, albedo[middle], rtol=1e-6)
    assert automatic_exposure(light * 1e-6, albedo) == pytest.approx(exposure * 1e6)


def test_exposure_keeps_the_brightest_surfaces_below_the_shoulder():
    light = np.random.default_rng(0).random((10000, 3))
    exposure = automatic_exposure(light, np.full((10000, 3), 0.9))
    assert np.quantile(light.max(axis=1) * 0.9 / np.pi * exposure, 0.9) == pytest.approx(WHITE)


def test_under_light_from_one_side_nodes_that_are_hidden_in_the_dark_do_not_count():
    seen = np.random.default_rng(0).random((10000, 3))
    hidden = np.full((90000, 3), 1e-3)
    alone, among = (
        exposure_under(np.median(e.mean(axis=1)), e.max(axis=1), directed=True)
        for e in (seen, np.concatenate([seen, hidden]))
    )
    bright = seen.max(axis=1) / np.pi * alone
    assert bright[bright > DIRECTED].sum() == pytest.approx(0.1 * bright.sum(), rel=0.01)
    assert among == pytest.approx(alone, rel=0.01)


def test_exposure_of_the_dark_and_of_nothing_is_one():
    nothing = np.zeros((0, 3))
    assert automatic_exposure(np.zeros((5, 3)), np.ones((5, 3))) == automatic_exposure(nothing, nothing) == 1.0
    assert automatic_exposure(np.ones((5, 3)), np.zeros((5, 3))) == pytest.approx(np.pi)  # black paint: only the median


def test_the_curve_keeps_shadows_and_middle_tones_and_rolls_highlights_off():
    tones = np.linspace(0, 50, 100001)[:, None] * np.array([1.0, 0.7, 0.2])
    shown = curve(tones)
    below = tones.max(axis=1) <= WHITE
    assert np.array_equal(shown[below], tones[below])
    peak = shown.max(axis=1)
    assert (np.diff(peak) > 0).all() and peak[-1] < 1
    slope = np.diff(peak) / np.diff(tones[:, 0])
    assert np.abs(np.diff(slope)).max() < 0.02  # no kink at the shoulder, where the slope is 1
    one = curve(np.array([[WHITE + 0.05, 0, 0], [1e9, 0, 0], [np.inf, np.inf, 0], [-1, 0.5, 0]]))
    assert np.isfinite(one).all() and one.max() <= 1 and one[3].tolist() == [0, 0.5, 0]


def test_highlights_keep_their_hue_and_only_the_very_bright_fade_to_white():
    from colorsys import rgb_to_hsv

    color = np.array([0.8, 0.4, 0.1])
    hue, saturation, _ = rgb_to_hsv(*color)
    for gain, least in ((1.5, 0.95), (3.0, 0.75)):
        shown = rgb_to_hsv(*curve(gain * color[None])[0])
        assert shown[0] == pytest.approx(hue) and least * saturation < shown[1] < saturation
        clamped = rgb_to_hsv(*np.minimum(gain * color, 1))
        assert abs(clamped[0] - hue) > 0.01  # which is what the curve is for
    assert rgb_to_hsv(*curve(1e4 * color[None])[0])[1] < 0.01


# Which way is up, and which is right

BALLS = {"x": ((0.65, 0, 0), 0.25), "front": ((0, -0.6, 0), 0.2), "top": ((0, 0, 0.65), 0.15)}


def three_balls(axes=(0, 1, 2), flips=(1, 1, 1)):
    """A red ball at +x, a green one in front (-y), a blue one on top (+z), stored along these axes."""
    direction = np.eye(3)[:, list(axes)] * flips
    shape = np.array([40, 36, 44])[list(axes)]
    spacing = 2 / (shape - 1)
    origin = -direction @ np.ones(3)
    fields = []
    for (name, (centre, radius)), color in zip(BALLS.items(), np.eye(3)):

        def inside(x, centre=centre, radius=radius):
            return 1 + radius - np.linalg.norm(x - np.array(centre), axis=1)

        volume = sampled(inside, tuple(shape), origin, spacing, direction)
        fields.append(Field(name, volume, Material(color), (0.9, 1.1)))
    return Scene(tuple(fields), background=np.ones(3))


def places(picture):
    """Centre (column, row) of each colour in a picture of the three balls, and its number of pixels."""
    picture = picture.astype(int)
    found = {}
    for number, name in enumerate(BALLS):
        others = np.delete(picture, number, axis=2).max(axis=2)
        rows, columns = np.nonzero(picture[..., number] > others + 60)
        found[name] = columns.mean(), rows.mean(), len(rows)
    return found


def test_up_is_up_right_is_right_and_the_front_is_near():
    found = places(render(lit(three_balls()), **SIZE))
    x, front, top = found["x"], found["front"], found["top"]
    assert top[1] < x[1] - 20 and top[1] < front[1] - 20
    assert x[0] > top[0] + 15 > front[0] + 30  # seen from -y with +x to the right, from 30 degrees further right
    # the camera as it is said to be: 30 degrees to the right of the front, 18 above
    scene = three_balls()
    camera = fit_camera(scene, scene.levels(0.5)[0], 4 / 3)
    back = -camera.forward
    assert np.degrees(np.arctan2(back[0], -back[1])) == pytest.approx(30)
    assert np.degrees(np.arcsin(back[2])) == pytest.approx(18)
    np.testing.assert_allclose(np.cross(camera.forward, camera.up), camera.right, atol=1e-12)
    assert camera.up[2] > 0.9 and camera.right[0] > 0.8
    # by the camera's own projection
    for name, (centre, _) in BALLS.items():
        ray = np.array(centre) - camera.eye
        depth = ray @ camera.forward
        column = (1 + ray @ camera.right / depth / camera.tangent / (4 / 3)) / 2 * 120
        row = (1 - ray @ camera.up / depth / camera.tangent) / 2 * 90
        np.testing.assert_allclose(found[name][:2], (column - 0.5, row - 0.5), atol=1.0)


@pytest.mark.parametrize(
    "axes, flips",
    [
        ((0, 1, 2), (-1, 1, 1)),
        ((0, 1, 2), (1, -1, 1)),
        ((0, 1, 2), (1, 1, -1)),
        ((0, 1, 2), (-1, -1, -1)),
        ((1, 0, 2), (1, 1, 1)),
        ((2, 0, 1), (1, 1, 1)),
        ((2, 1, 0), (-1, 1, -1)),
    ],
)
def test_the_picture_does_not_depend_on_how_the_array_is_stored(axes, flips):
    expected = render(lit(three_balls()), **SIZE)
    picture = render(lit(three_balls(axes, flips)), **SIZE)
    differ = np.abs(picture.astype(int) - expected.astype(int)).max(axis=2)
    assert (differ > 2).mean() < 0.002  # a sub-sample that grazes an edge may fall to the other side


def test_a_volume_turned_by_a_little_is_seen_from_its_own_front():
    scene = sky()
    turned = Volume(scene.fields[0].volume.values, direction=np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]))
    camera = fit_camera(sky(turned), np.array([0.5]), 1.0)
    back = turned.direction.T @ -camera.forward
    assert np.degrees(np.arctan2(back[0], -back[1])) == pytest.approx(30)


def test_what_is_flat_is_seen_from_above():
    flat = sampled(lambda x: 1 - np.abs(x[:, 2] - 2), (30, 30, 5))
    camera = fit_camera(sky(flat, (0.2, 0.8)), np.array([0.5]), 1.0)
    assert np.degrees(np.arcsin(-camera.forward[2])) == pytest.approx(60)


# What is in view


def is_object(picture):
    return (np.abs(picture.astype(int) - GROUND.astype(int)) > 3).any(axis=2)


@pytest.mark.parametrize("isovalue", [0.25, 0.6, 1.0])
@pytest.mark.parametrize("size", [(120, 90), (60, 120), (150, 50)])
def test_the_camera_holds_the_whole_object_and_little_else(size, isovalue):
    def long(x):
        return 1.2 - np.linalg.norm((x - [30, 7, 2]) / [1, 0.4, 0.6], axis=1)

    volume = sampled(long, (34, 20, 25), (29, 6.5, 1.2), (0.06, 0.05, 0.06))
    seen = is_object(render(lit(sky(volume, (0.2, 1.1))), isovalue=isovalue, width=size[0], height=size[1]))
    assert not seen[[0, -1]].any() and not seen[:, [0, -1]].any()
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    fills = np.ptp(rows) / size[1], np.ptp(columns) / size[0]
    assert max(fills) > 0.75
    # centred
    assert abs(rows[[0, -1]].mean() - (size[1] - 1) / 2) < 0.06 * size[1]
    assert abs(columns[[0, -1]].mean() - (size[0] - 1) / 2) < 0.06 * size[0]


@pytest.mark.parametrize("local", [False, True])
def test_an_empty_isosurface_is_background_only(local):
    picture = render(lit(sky()), isovalue=1.19, local=local, **SIZE)
    assert (picture == GROUND).all() and picture.shape == (90, 120, 3) and picture.dtype == np.uint8


def test_a_surface_is_shown_at_albedo_over_pi_times_its_light_times_the_exposure():
    light = lit(sky(albedo=(0.9, 0.6, 0.3)), value=2.0)
    assert light.exposure == pytest.approx(WHITE / (0.9 / np.pi * 2.0))
    middle = render(light, **SIZE)[45, 60]
    assert middle.tolist() == encode_srgb(WHITE * np.array([1, 2 / 3, 1 / 3])).tolist()


def test_the_light_on_show_is_that_of_the_field_and_the_place():
    light = lit(sky(), nodes=9)
    values = light.grids[0].values.copy()
    values[..., 1:] = 0
    values[4:, :, :, 0] = 0  # the half at -x is red
    values[4:, :, :, 1] = 1  # the half at +x is green
    picture = render(relit(light, values=values), **SIZE).astype(int)
    left = np.flatnonzero(is_object(picture)[45])[1]
    # seen from 30 degrees to the right: +x is in the middle too
    assert picture[45, left, 0] > 100 > picture[45, left, 1]
    assert picture[45, 60, 1] > 100 > picture[45, 60, 0]


def test_local_light_is_a_lamp_at_the_camera_and_knows_nothing_of_the_grid():
    light, other = lit(sky(), 1.0), lit(sky(), 5.0)
    picture = render(light, local=True, **SIZE)
    assert np.array_equal(picture, render(other, local=True, **SIZE))
    assert not np.array_equal(picture, render(light, **SIZE))
    row = picture[45, :, 0].astype(int)
    seen = np.flatnonzero(is_object(picture)[45])
    middle = seen.mean()
    assert row[int(middle)] == pytest.approx(int(encode_srgb(np.array([WHITE]))[0]), abs=2)
    radius = np.ptp(seen) / 2
    for share in (0.3, 0.6, 0.8):
        facing = np.sqrt(1 - share**2)  # of a sphere far away
        side = row[round(middle + share * radius)], row[round(middle - share * radius)]
        assert np.mean(side) == pytest.approx(float(encode_srgb(np.array([WHITE * facing]))[0]), abs=8)


def test_the_isovalue_belongs_to_the_field_that_is_named_and_the_others_follow():
    scene = three_balls()
    follow = places(render(lit(scene), field="top", isovalue=1.1, **SIZE))
    assert np.array_equal(render(lit(scene), field="top", isovalue=1.0, **SIZE), render(lit(scene), **SIZE))
    straight = places(render(lit(scene), field="x", isovalue=1.1, **SIZE))
    assert follow == straight


def test_a_png_holds_the_picture_exactly():
    picture = np.random.default_rng(0).integers(0, 256, (30, 40, 3)).astype(np.uint8)
    opened = Image.open(io.BytesIO(png(picture)))
    assert opened.format == "PNG" and np.array_equal(np.asarray(opened), picture)
