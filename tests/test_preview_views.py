"""Viewpoints of pictures: named views, angles, zoom, one camera for a whole sweep; the grid as a block."""

from dataclasses import replace

import numpy as np
import pytest

from illumgrid.field.scene import Field, Material, Scene
from illumgrid.field.upright import axes_of
from illumgrid.field.volume import box_corners
from illumgrid.show import VIEWS, fit_camera, grid_volume, render, widest_row
from illumgrid.show.block import FACES
from illumgrid.show.camera import camera_around
from illumgrid.tone import decode_srgb, encode_srgb
from shapes import DIRECTIONS, ball, lit, refused, relit, sky
from test_tone_preview import GROUND, SIZE, is_object, places, three_balls

AXES = {"front": (0, -1, 0), "back": (0, 1, 0), "right": (1, 0, 0), "left": (-1, 0, 0), "top": (0, 0, 1),
        "bottom": (0, 0, -1), "iso": (1, -1, 1)}  # fmt: skip


@pytest.mark.parametrize("view", VIEWS)
def test_a_named_view_is_seen_from_where_its_name_says(view):
    scene = three_balls()
    camera = fit_camera(scene, scene.levels(0.5)[0], 1.0, view)
    back = np.array(AXES[view]) / np.linalg.norm(AXES[view])
    np.testing.assert_allclose(-camera.forward, back, atol=1e-12)
    np.testing.assert_allclose(np.cross(camera.forward, camera.up), camera.right, atol=1e-12)
    if view in ("top", "bottom"):
        np.testing.assert_allclose(camera.right, [1, 0, 0], atol=1e-12)  # as from the front, only tilted
    else:
        assert camera.up[2] > 0.8 and abs(camera.right[2]) < 1e-12


@pytest.mark.parametrize("axes, flips", [((0, 1, 2), (1, 1, 1)), ((2, 0, 1), (-1, 1, 1)), ((1, 0, 2), (1, -1, -1))])
def test_views_show_the_balls_where_they_are_however_the_array_is_stored(axes, flips):
    light = lit(three_balls(axes, flips))
    front = places(render(light, view="front", **SIZE))  # red at +x, green in front, blue on top
    assert front["x"][0] > front["top"][0] + 15 and front["top"][1] < front["x"][1] - 15
    right = places(render(light, view="right", **SIZE))  # from +x: the front is to the left
    assert right["front"][0] < right["top"][0] - 15 and right["top"][1] < right["front"][1] - 15
    above = places(render(light, view="top", **SIZE))  # the front is below
    assert above["front"][1] > above["top"][1] + 15 and above["x"][0] > above["top"][0] + 15
    left = places(render(light, view="left", **SIZE))
    assert left["front"][0] > left["top"][0] + 15
    below = places(render(light, view="bottom", **SIZE))
    assert below["front"][1] < below["top"][1] - 15 and below["x"][0] > below["top"][0] + 15
    behind = places(render(light, view="back", **SIZE))
    assert behind["x"][0] < behind["top"][0] - 15


def test_angles_are_those_of_the_names_and_the_picture_is_the_same():
    light = lit(three_balls())
    for name, (azimuth, elevation) in VIEWS.items():
        named = render(light, view=name, **SIZE)
        assert np.array_equal(named, render(light, view=f"{azimuth},{elevation}", **SIZE))
        assert np.array_equal(named, render(light, view=(azimuth, elevation), **SIZE))
    assert np.array_equal(render(light, **SIZE), render(light, view="30,18", **SIZE))


@pytest.mark.parametrize("view", ["", "up", "30", "1,2,3", "a,b", "nan,0", "0,inf", "0,91", (1, 2, 3), (0, -100)])
def test_what_is_no_view_is_refused(view):
    refused(lambda: render(lit(sky()), view=view, **SIZE), "view", "front, back", "30,18")


def test_zoom_enlarges_the_middle():
    light = lit(sky())
    one, two = (is_object(render(light, zoom=zoom, **SIZE)) for zoom in (0.4, 0.8))
    assert np.sqrt(two.sum() / one.sum()) == pytest.approx(2, rel=0.03)
    middle = np.argwhere(two).mean(axis=0)
    np.testing.assert_allclose(middle, [44.5, 59.5], atol=1)


def test_a_background_has_the_colour_that_was_asked_for():
    picture = render(lit(sky()), background="#a03020", **SIZE)
    assert picture[0, 0].tolist() == [0xA0, 0x30, 0x20]
    assert (picture[45, 60] > 150).all()
    assert render(lit(sky()), background="white", **SIZE)[0, 0].tolist() == [255, 255, 255]


def test_the_camera_of_a_sweep_holds_the_solids_of_all_its_settings():
    one = Field("one", ball(20, at=(-0.5, 0, 0)), Material(np.array([0.9, 0.1, 0.1])), (0.7, 1.1))
    two = Field("two", ball(20, at=(0.5, 0, 0)), Material(np.array([0.1, 0.1, 0.9])), (0.7, 1.1))
    other_side = replace(two, volume=two.volume.with_stored(-two.volume.values), range=(-1.1, -0.7), inside="below")
    for scene in (Scene((one, two), background=np.ones(3)), Scene((one, other_side), background=np.ones(3))):
        camera = fit_camera(scene, widest_row(scene), 4 / 3)
        for isovalue in (0.7, 0.9, 1.1):
            seen = is_object(render(lit(scene), isovalue=isovalue, camera=camera, **SIZE))
            assert seen.any() and not seen[[0, -1]].any() and not seen[:, [0, -1]].any()


# The grid as a block


def everywhere(volume=None, **options):
    """A field whose range holds all its values: light is everywhere in the block."""
    volume = ball(16) if volume is None else volume
    low, high = volume.extremes
    return sky(volume, limits=(low, high), **options)


def test_a_block_shows_the_light_of_its_nodes_in_its_faces():
    light = lit(everywhere(), nodes=9)
    values = light.grids[0].values.copy()
    values[:, 0] *= 0.5  # what is in front
    light = relit(light, values=values)
    light.__dict__["exposure"] = 1.0
    picture = decode_srgb(grid_volume(light, view="front", **SIZE))
    expected = 0.8 / np.pi * 0.5 * FACES[1]
    np.testing.assert_allclose(picture[45, 60], expected, rtol=0.02)
    behind = decode_srgb(grid_volume(light, view="back", **SIZE))
    np.testing.assert_allclose(behind[45, 60], 2 * expected, rtol=0.02)


def test_what_no_isosurface_of_the_range_passes_is_not_drawn():
    light = lit(sky(), nodes=17)  # a ball in the middle of the block
    block = is_object(grid_volume(light, view="front", **SIZE))
    scene = light.scene
    camera = camera_around(box_corners(light.grids[0].spec), axes_of(np.eye(3)), 4 / 3, "front")
    surface = is_object(render(light, isovalue=scene.fields[0].widest, camera=camera, **SIZE))
    assert (block != surface).mean() < 0.01 and 0.1 < block.mean() < 0.9


def test_a_hole_has_the_light_around_it():
    light = lit(everywhere(), nodes=9)
    values, support = light.grids[0].values.copy(), light.grids[0].support.copy()
    whole = grid_volume(light, view="front", **SIZE)
    values[3:6, 0, 3:6], support[3:6, 0, 3:6] = 50.0, 0  # the light of some other node, as a shard
    made = relit(light, values=values, support=support)
    made.__dict__["exposure"] = light.exposure
    assert np.abs(grid_volume(made, view="front", **SIZE).astype(int) - whole).max() <= 1


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_the_corner_towards_the_eye_is_cut_out_and_shows_the_middle(direction):
    volume = ball(16)
    volume = type(volume)(volume.values, (3, 4, 5), volume.spacing, direction)
    light = lit(everywhere(volume), nodes=9)
    values = np.full((9, 9, 9, 3), 0.2)
    values[1:-1, 1:-1, 1:-1] = 1.0
    light = relit(light, values=values)
    light.__dict__["exposure"] = np.pi / 0.8
    whole, cut = (grid_volume(light, view="iso", cut=cut, **SIZE).astype(int) for cut in (False, True))
    assert np.array_equal(is_object(whole), is_object(cut))  # along a diagonal the corner hides nothing outside
    assert decode_srgb(whole[45, 60].astype(np.uint8)).max() < 0.25
    near = cut[40:50, 55:65]
    assert (decode_srgb(near.astype(np.uint8)).max(axis=2) > 0.5).all()
    assert np.array_equal(whole[0], cut[0]) and (whole[0, 0] == GROUND).all()
    changed = (whole != cut).any(axis=2)
    assert 0.15 < changed.sum() / is_object(whole).sum() < 0.5  # a quarter of the hexagon, by perspective more


def test_a_block_is_shown_at_the_exposure_of_pictures():
    light = lit(everywhere(albedo=(0.9, 0.6, 0.3)), value=2.0, nodes=9)
    tone = 0.8 / np.array([1, 1.5, 3]) * FACES[2]
    assert grid_volume(light, view="top", **SIZE)[45, 60].tolist() == encode_srgb(tone).tolist()
