"""Choices for a picture: exposure, ground, up, roll, the camera of another picture, strips, scale bars, large sizes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import illumgrid as ig
from illumgrid.errors import BadInput
from illumgrid.field.filters import smooth
from illumgrid.field.lights import Sky
from illumgrid.field.scene import Scene
from illumgrid.field.upright import axes_of, up_of
from illumgrid.field.volume import Volume
from illumgrid.show import UPS, fit_camera, png, render, strip
from illumgrid.show.camera import camera_of, camera_text
from illumgrid.show.captions import round_down, scale_bar
from illumgrid.show.engines import gl
from illumgrid.show.shade import Shown
from illumgrid.tone import curve, decode_srgb, encode_srgb
from shapes import DIRECTIONS, ball, lit, refused, sampled, sky
from test_preview_engines import cut_open
from test_tone_preview import GROUND, SIZE, is_object, places, three_balls

RUN = ["run", "v.npy", "--range", 0.3, 0.9, "--grid", 6, "--paths", 2, "--no-preview", "-o", "out"]
SMALL = ["--engine", "software", "--size", 64, 48]


def opened(path):
    with Image.open(path) as picture:
        return np.asarray(picture), dict(picture.info)


# Light


@pytest.mark.parametrize("stops", [-2.0, 0.5, 3.0])
@pytest.mark.parametrize("local", [False, True])
def test_a_stop_doubles_the_light_before_the_curve(stops, local):
    light = lit(sky(albedo=(0.5, 0.3, 0.1)))
    plain = decode_srgb(render(light, local=local, **SIZE))[45, 60]
    made = render(light, local=local, stops=stops, **SIZE)[45, 60].astype(int)
    assert np.abs(made - encode_srgb(curve(plain * 2**stops))).max() <= (3 if stops > 0 else 1)


# Ground


@pytest.mark.parametrize("engine", ["software", "egl"])
def test_a_transparent_ground_leaves_the_colors_of_the_object_and_its_coverage(engine):
    if engine == "egl" and gl.unavailable("egl"):
        pytest.skip("no EGL")
    light = lit(sky(albedo=(0.9, 0.5, 0.2)))
    clear = render(light, background="transparent", engine=engine, **SIZE)
    assert clear.shape == (90, 120, 4) and set(np.unique(clear[..., 3])) >= {0, 255}
    edge = (clear[..., 3] > 0) & (clear[..., 3] < 255)
    assert edge.sum() > 40
    inside = clear[45, 60, :3].astype(int)
    assert np.abs(clear[edge][:, :3] - inside).max() <= 6  # no rim of the ground's colour
    whole = render(light, background="transparent", **SIZE)[..., 3]
    assert abs(clear[..., 3].sum(dtype=float) / whole.sum(dtype=float) - 1) < 0.005
    for ground in ("black", "#3060c0") if engine == "software" else ():  # OpenGL mixes edges in sRGB
        wanted = render(light, background=ground, engine=engine, **SIZE)
        share = clear[..., 3:] / 255
        paper = decode_srgb(wanted[0, 0])
        over = encode_srgb(share * decode_srgb(clear[..., :3]) + (1 - share) * paper)
        assert np.abs(over.astype(int) - wanted).max() <= 3


def test_a_film_has_no_transparent_ground(call, refuse):
    call(*RUN)
    refuse("preview", "out", "--sweep", 2, "x.gif", "--background", "transparent", words=["transparent", "folder"])


def test_a_cap_is_brighter_than_the_ground_and_no_hole():
    light = lit(cut_open())
    picture = render(light, **SIZE).astype(int)
    cap = picture[45, 60]  # in the light of the open sky: one colour, see test_caps.py
    assert (picture == cap).all(axis=2).mean() > 0.1 and cap.min() > GROUND.max() + 80


# Up and roll


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
@pytest.mark.parametrize("up", UPS)
def test_up_is_the_array_axis_nearest_to_the_world_direction_asked_for(direction, up):
    right, front, above = axes_of(direction, up)
    assert above @ UPS[up] == pytest.approx(np.abs(direction.T @ UPS[up]).max())
    np.testing.assert_allclose(np.cross(above, front), right, atol=1e-12)  # never mirrored
    assert np.abs(direction.T @ np.stack([right, front, above], axis=1)).round(9).tolist() in (
        np.eye(3)[list(order)].tolist() for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))
    )


def test_upside_down_the_top_is_below_and_the_front_stays_in_front():
    light = lit(three_balls())
    found = places(render(light, view="front", up="-z", **SIZE))
    assert found["top"][1] > found["x"][1] + 15 and found["x"][0] < found["top"][0] - 15
    refused(lambda: render(light, up="w", **SIZE), "'w'", "-z")


def test_roll_turns_the_picture_clockwise():
    light = lit(three_balls())
    plain = places(render(light, view="front", width=100, height=100))
    turned = places(render(light, view="front", roll=90, width=100, height=100))
    for name in plain:  # a point right of the middle goes below it
        x, y = plain[name][0] - 49.5, plain[name][1] - 49.5
        assert turned[name][0] - 49.5 == pytest.approx(-y, abs=3)
        assert turned[name][1] - 49.5 == pytest.approx(x, abs=3)


def bust(upright, direction=None, origin=(0, 0, 0), n=41):
    """A head on a neck that is cut flat, of n³ voxels; its file states an orientation or not."""
    up = 1 if upright else -1

    def height(x):
        p = (x * 40 / (n - 1) - 20) * [1, 1, up]
        head, neck = 13 - np.linalg.norm(p - [0, 0, 2], axis=1), 9 - np.hypot(p[:, 0], p[:, 1]) - 9 * (p[:, 2] > 0)
        return np.where(p[:, 2] > -17, np.maximum(head, neck), -20)

    values = np.clip(sampled(height, (n, n, n)).values, -2, 2)
    return Scene.sky(
        ig.Volume(values, origin, direction=np.eye(3) if direction is None else direction), range=(0.5, 1.5)
    )


def test_what_would_stand_on_its_head_is_turned_over_unless_its_file_says_which_way_is_up():
    assert up_of(bust(True)) == "z" and up_of(bust(False)) == "-z"
    assert up_of(bust(False, direction=np.diag([-1.0, -1, 1]))) == "z" and up_of(bust(False, origin=(0, 0, 1))) == "z"
    floor = bust(False).fields[0].volume
    assert up_of(Scene.floor(floor, range=(0.5, 1.5))) == "z"
    assert up_of(sky()) == up_of(Scene.sky(ball(shape=(9, 9, 9), origin=(0, 0, 0), spacing=(1, 1, 1)))) == "z"


def test_a_part_of_a_file_that_states_no_orientation_has_none_either(tmp_path):
    values = bust(False, n=121).fields[0].volume.values
    np.save(tmp_path / "bust.npy", values)
    np.savez(tmp_path / "placed.npz", values=values, origin=(0, 0, 1))
    parts = {"downsample": 3}, {"crop": (1, 120, 1, 120, 0, 120)}, {"spacing": (1, 1, 2), "downsample": 2}
    for part in parts:
        volume = ig.read_volume(tmp_path / "bust.npy", **part)
        assert volume.origin.any() and up_of(Scene.sky(smooth(volume, 0.5), range=(0.5, 1.5))) == "-z"
        assert up_of(Scene.sky(ig.read_volume(tmp_path / "placed.npz", **part), range=(0.5, 1.5))) == "z"


def test_a_folder_keeps_that_its_file_states_no_orientation(tmp_path):
    np.save(tmp_path / "bust.npy", bust(False, n=81).fields[0].volume.values)
    scene = Scene.sky(ig.read_volume(tmp_path / "bust.npy", downsample=2), range=(0.5, 1.5))
    ig.run(scene, grid=5, paths=1, bounces=0).save(tmp_path / "out", preview=False)
    assert up_of(ig.load(tmp_path / "out").scene) == "-z"


# Cameras and strips


def test_a_camera_comes_back_from_its_text():
    scene = three_balls()
    camera = fit_camera(scene, scene.levels(0.5)[0], 1.5, "iso", roll=12)
    again = camera_of(camera_text(camera))
    for name in ("eye", "right", "up", "forward", "tangent"):
        assert np.array_equal(getattr(camera, name), getattr(again, name))
    for text in ("", "[]", "{}", '{"eye": [0, 0]}', camera_text(camera).replace("0.27", "-1")):
        with pytest.raises(BadInput, match="expected eye"):
            camera_of(text)


def test_a_picture_says_what_made_it_and_lends_its_camera(call, refuse, monkeypatch):
    call(*RUN)
    monkeypatch.setattr("sys.argv", ["illumgrid", "preview", "two words"])
    call("preview", "out", *SMALL, "--isovalue", 0.4, "--view", "iso", "--roll", 10, "-o", "one.png")
    picture, about = opened("one.png")
    assert about["Software"] == f"illumgrid {ig.__version__}" and about["Command"] == "illumgrid preview 'two words'"
    call("preview", "out", *SMALL, "--isovalue", 0.4, "--camera", "one.png", "-o", "two.png")
    assert np.array_equal(opened("two.png")[0], picture)
    call("preview", "out", *SMALL, "--isovalue", 0.8, "--camera", "one.png", "-o", "three.png")
    assert is_object(opened("three.png")[0]).sum() < 0.6 * is_object(picture).sum()
    (Image.new("RGB", (4, 4))).save("plain.png")
    refuse("preview", "out", "--camera", "plain.png", "-o", "x.png", words=["plain.png", "camera"])
    refuse("preview", "out", "--camera", "one.png", "--zoom", 2, "-o", "x.png", words=["--zoom", "--camera"])


def test_a_strip_shows_each_isovalue_by_one_camera(call, refuse):
    call(*RUN)
    call("preview", "out", *SMALL, "--isovalues", "0.9,0.3,0.6", "-o", "strip.png")
    picture, _ = opened("strip.png")
    assert picture.shape == (48, 192, 3)
    light = ig.load("out")
    camera = fit_camera(light.scene, np.array([0.3]), 64 / 48)  # the largest of the three
    for number, isovalue in enumerate((0.9, 0.3, 0.6)):
        panel = render(light, isovalue=isovalue, camera=camera, width=64, height=48)
        made = picture[:, 64 * number : 64 * (number + 1)]
        assert np.array_equal(made[:30], panel[:30]) and not np.array_equal(made[30:], panel[30:])  # its label is below
    for other in (["--isovalue", 0.4], ["--split"], ["--trust"], ["--grid-volume"]):
        refuse("preview", "out", "--isovalues", "0.3,0.6", *other, "-o", "x.png", words=[str(other[0]), "--isovalues"])


def test_a_strip_of_one_isovalue_is_its_picture_but_for_the_label():
    light = lit(sky())
    one = strip(light, [0.5], local=True, **SIZE)
    assert np.array_equal(one[:60], render(light, isovalue=0.5, local=True, **SIZE)[:60])


# Scale bars and large sizes


@pytest.mark.parametrize("length, found", [(0.99, 0.5), (1, 1), (1.99, 1), (4.9e-7, 2e-7), (73, 50), (2e5, 2e5)])
def test_a_bar_has_a_round_length(length, found):
    assert round_down(length) == pytest.approx(found)


def test_a_bar_is_as_long_as_it_says_at_the_middle_of_the_object():
    light = lit(sky())
    camera = fit_camera(light.scene, np.array([0.6]), 4 / 3)
    empty = np.zeros((600, 800, 3), np.uint8)
    drawn = scale_bar(empty, camera, np.zeros(3), light.scene.fields[0].volume)
    columns = np.flatnonzero((drawn[-12] > 100).all(axis=1))
    assert np.ptp(columns) + 1 == len(columns)
    volume = light.scene.fields[0].volume
    named = scale_bar(empty, camera, np.zeros(3), replace(volume, unit="mm"))
    assert np.array_equal(named[-12], drawn[-12]) and (named[:-14] > 100).sum() > 1.5 * (drawn[:-14] > 100).sum()
    depth = -camera.eye @ camera.forward
    length = len(columns) * 2 * camera.tangent * depth / 600
    assert min(abs(length / step - 1) for step in (0.1, 0.2, 0.5, 1)) < 0.02
    with_bar = render(light, isovalue=0.6, bar=True, **SIZE)
    without = render(light, isovalue=0.6, **SIZE)
    assert np.array_equal(with_bar[:60], without[:60]) and not np.array_equal(with_bar[60:], without[60:])


def test_opengl_draws_large_pictures_in_tiles_that_fit(monkeypatch):
    if gl.unavailable("egl"):
        pytest.skip("no EGL")
    light = lit(three_balls())
    whole = render(light, engine="egl", width=150, height=100).astype(int)
    monkeypatch.setattr(gl, "TILE", 64)
    tiled = render(light, engine="egl", width=150, height=100).astype(int)
    assert (np.abs(tiled - whole).max(axis=2) > 2).mean() < 0.01


def test_png_holds_coverage_and_text():
    import io

    picture = np.random.default_rng(0).integers(0, 256, (5, 6, 4)).astype(np.uint8)
    with Image.open(io.BytesIO(png(picture, {"Command": "made by ☃"}))) as again:
        assert np.array_equal(np.asarray(again), picture) and again.info["Command"] == "made by ☃"


def test_the_window_turns_about_what_it_shows(monkeypatch):
    from illumgrid.show.viewer.desktop import Window

    class Camera:
        pass

    class Plotter:
        camera = Camera()

    scene = sky(replace(ball(20), origin=(100.0, 200.0, 300.0)))
    window = Window.__new__(Window)
    window.light, window.plotter = lit(scene), Plotter()
    window._look(0.6, 1.0)
    centre = np.array([101.0, 201, 301])
    offset = np.asarray(Plotter.camera.focal_point) - centre
    seen = fit_camera(scene, np.array([0.6]), 1.0)
    assert abs(offset @ seen.forward) < 0.1  # at the depth of the middle of the ball, not of its volume's first voxel
    window._look(0.6, 1.0, "-x")
    assert np.asarray(Plotter.camera.up) @ [-1, 0, 0] > 0.9


def test_a_ground_under_the_open_sky_fades_and_walls_do_not():
    def cover(scene):
        light = ig.run(scene, grid=4, paths=2, bounces=0, isovalues=2, judge=False)
        shown = Shown(light, scene.levels(0.5)[0], 0.5)
        return shown.fade(0, np.array([0.5, 0.8, 1.0]), np.array([0.5, 0.5, 1.0]))

    volume = Volume(np.indices((6, 6, 6)).sum(axis=0).astype(np.float32))
    middle, outer, corner = cover(Scene.floor(volume, range=(4, 9)))
    assert middle == 1 and 0 < outer < 1 and corner == 0
    assert (cover(Scene.box(volume, range=(4, 9))) == 1).all()


# Light, as options choose it


def test_weights_on_the_command_line_are_those_of_mix(call):
    call(*RUN)
    call("preview", "out", *SMALL, "--light", "key=0.5", "--light", "dome=3", "-o", "mixed.png")
    light = ig.load("out")
    wanted = render(light.mix(key=0.5, dome=3), width=64, height=48)
    assert np.array_equal(opened("mixed.png")[0], wanted)
    assert np.abs(wanted.astype(int) - render(light, width=64, height=48)).max() > 10


def test_a_sky_and_its_turn_on_the_command_line_are_those_of_under(call):
    """A sky whose left half shines, as a Radiance picture: turned by 180 degrees, the right half does."""
    pixels = np.zeros((4, 8, 4), np.uint8)
    pixels[:, :4] = 128, 128, 128, 129  # 128/256 · 2
    header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n"
    Path("sky.hdr").write_bytes(header + pixels.tobytes())
    call(*RUN, "--lights", "sh", "--degree", 1)
    light, image = ig.load("out"), np.zeros((4, 8, 3))
    image[:, :4] = 1.0
    for turn, shining in ((0, image), (180, image[:, ::-1])):
        call("preview", "out", *SMALL, "--sky", "sky.hdr", "--turn", turn, "-o", "turned.png")
        wanted = render(light.under(Sky("sky", shining)), width=64, height=48)
        assert np.abs(opened("turned.png")[0].astype(int) - wanted).max() <= 1
    call("preview", "out", *SMALL, "--turn", 90, "-o", "own.png")
    assert np.array_equal(opened("own.png")[0], render(light.under(None, 90), width=64, height=48))
