"""Lights by name: the oracle chain for distant light, layers that add up, mixes, spherical harmonics, the studio."""

from dataclasses import replace

import numpy as np
import pytest

import illumgrid as ig
import naive
from illumgrid.backends.numba_ import Numba
from illumgrid.backends.reference import Reference
from illumgrid.errors import BadInput, IllumgridWarning
from illumgrid.field.layers import layers_of
from illumgrid.field.levelset import marchable
from illumgrid.field.lights import Distant, Harmonics, Sky, basis, pixel_directions, projected, rotated
from illumgrid.field.scene import Material, Quad, Scene
from illumgrid.field.upright import sky_axes
from illumgrid.grid.channels import mixed
from illumgrid.io import store
from rooms import box
from transport import everywhere, furnace, noise, rotation, waves, worth

KEY = Distant("key", (1.0, -2.0, 1.5), 25.0, (3.0, 2.0, 1.0))
SUN = Distant("sun", (-0.3, 0.2, 1.0), 0.5, (2.0, 2.0, 2.0))
GRADIENT = Sky("gradient", [(0.2, 0.1, 0.0), (1.0, 2.0, 3.0)])
SPECKLED = Sky("image", np.random.default_rng(3).random((6, 12, 3)) ** 4)


def grey(volume, **rest):
    """A plain scene of albedo 0.7, lit by whatever is asked for."""
    return replace(Scene.sky(volume, (0.7, 0.7, 0.7), (0.3, 0.7)), background=np.zeros(3), **rest)


def unit(volume):
    low, high = volume.extremes
    return volume.with_stored(((volume.values - low) / (high - low)).astype(np.float32))


SCENES = {
    "discs": lambda: replace(furnace(noise(8)), background=np.zeros(3), lights=(KEY, SUN)),
    "disc and gradient": lambda: replace(furnace(waves(direction=rotation())), lights=(KEY, GRADIENT)),
    "lamp, disc and sky": lambda: replace(
        box(noise(8)), background=np.full(3, 0.1), lights=(SUN, Sky("dome", (0.3, 0.4, 0.5)))
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_loops_numpy_and_kernels_walk_the_same_paths_under_distant_light(name):
    scene = SCENES[name]()
    queries = everywhere(scene)
    queries = queries[np.sort(np.random.default_rng(0).choice(len(queries), 30, replace=False))]
    for path, bounces in enumerate((0, 1, 3)):
        one, answered = worth(Numba(), scene, queries, path, bounces)
        other, _ = worth(Reference(), scene, queries, path, bounces)
        truth = [naive.path_worth(scene, queries[i : i + 1], path, bounces, 0) for i in np.flatnonzero(answered)]
        scale = 1 + np.max(truth)
        np.testing.assert_allclose(one[answered], truth, atol=1e-6 * scale)
        np.testing.assert_allclose(other[answered], truth, atol=1e-6 * scale)
        assert (one > 0).any()


def test_numpy_and_kernels_agree_under_an_image_and_harmonics():
    smooth = Harmonics("smooth", np.random.default_rng(1).normal(size=(25, 3)))
    scene = replace(furnace(waves(direction=rotation())), lights=(SPECKLED, smooth, KEY))
    queries = everywhere(scene)[::7]
    one, other = (b.solve(scene, queries, paths=range(16), bounces=2, seed=1) for b in (Numba(), Reference()))
    np.testing.assert_allclose(one.light, other.light, atol=1e-5)
    np.testing.assert_allclose(one.spread, other.spread, rtol=1e-4, atol=1e-4)


# Layers.


def in_separate_layers(**options):
    lamps = (
        Quad("one", (0, 0, 30), (9, 0, 0), (0, 9, 0), Material((0, 0, 0), (3, 2, 1))),
        Quad("two", (0, 0, -9), (0, 9, 0), (9, 0, 0), Material((0, 0, 0), (1, 1, 4))),
    )
    scene = grey(unit(waves()), quads=lamps, lights=(KEY, Sky("dome", (0.5, 0.6, 0.7)), GRADIENT, SPECKLED))
    return ig.run(scene, grid=8, paths=4, bounces=2, isovalues=2, judge=False, **options)


@pytest.mark.parametrize("options", [{}, {"sampler": "uniform", "interpolator": "splat"}])
def test_layers_add_up_to_the_light_of_the_scene(options):
    light = in_separate_layers(**options)
    assert light.lights == ("key", "dome", "gradient", "image", "one", "two")
    for lit in (*light.grids, *light.walls):
        remixed = mixed(lit.channels, layers_of(light.scene), {}).rgb(lit.light)
        np.testing.assert_allclose(remixed, lit.values, rtol=1e-6, atol=1e-6 * lit.values.max())


def test_layers_of_rbf_are_not_clamped_one_by_one():
    parts = (KEY, Sky("dome", (0.5, 0.6, 0.7)), replace(GRADIENT, name="rest"))
    options = {"sampler": "uniform", "interpolator": "rbf", "isovalues": 4, "grid": 8}
    options |= {"paths": 2, "bounces": 1, "judge": False}
    separate = ig.run(grey(unit(waves()), lights=parts), **options).mix(key=0.0)
    joined = tuple(replace(part, name="rest") if part.name == "dome" else part for part in parts)
    together = ig.run(grey(unit(waves()), lights=joined), **options).mix(key=0.0)
    np.testing.assert_allclose(separate.grids[0].values, together.grids[0].values, rtol=1e-5, atol=1e-5)


def test_a_layer_is_the_bake_of_its_light_alone():
    both = grey(unit(waves()), lights=(KEY, Sky("dome", (0.5, 0.6, 0.7))))
    options = {"grid": 8, "paths": 8, "bounces": 2, "judge": False}
    alone = ig.run(replace(both, lights=both.lights[:1]), **options)
    grid = ig.run(both, **options).mix(dome=0.0).grids[0]
    np.testing.assert_allclose(grid.values, alone.grids[0].values, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(grid.error, alone.grids[0].error, rtol=1e-5)


def test_weights_of_lights_move_neither_points_nor_paths():
    dim = grey(unit(waves()), lights=(KEY, Sky("dome", (0.5, 0.5, 0.5))))
    bright = replace(dim, lights=(replace(KEY, irradiance=10 * KEY.irradiance), dim.lights[1]))
    options = {"grid": 8, "paths": 4, "bounces": 1, "judge": False, "sampler": "adaptive", "isovalues": 4}
    one, other = (ig.run(scene, **options) for scene in (dim, bright))
    np.testing.assert_allclose(one.mix(key=10.0).grids[0].values, other.grids[0].values, rtol=1e-5, atol=1e-5)


def test_mixes_multiply_the_lights_of_the_scene_and_come_back():
    light = in_separate_layers()
    assert light.mix() is light
    half = light.mix(dome=0.5)
    assert half.grids[0].light is light.grids[0].light or np.shares_memory(half.grids[0].light, light.grids[0].light)
    back = half.mix(dome=1.0)
    np.testing.assert_allclose(back.grids[0].values, light.grids[0].values, rtol=1e-6, atol=1e-6)
    assert (back.grids[0].error >= light.grids[0].error * (1 - 1e-5)).all()  # an upper bound
    with pytest.raises(BadInput, match=r"'kye'; expected one of key, .*; did you mean 'key'\?"):
        light.mix(kye=1.0)
    with pytest.raises(BadInput, match="weight of light 'key' is nan"):
        light.mix(key=np.nan)


def test_a_single_light_can_be_weighed():
    light = ig.run(grey(unit(waves()), lights=(KEY,)), grid=6, paths=2, bounces=0, judge=False)
    np.testing.assert_allclose(light.mix(key=2.0).grids[0].values, 2 * light.grids[0].values, rtol=1e-6)


def test_lights_and_their_mix_come_back_from_the_disk(tmp_path):
    light = in_separate_layers().mix(key=0.5, dome=2.0)
    light.save(tmp_path / "run", preview=False)
    again = ig.load(tmp_path / "run")
    assert again.lights == light.lights and again.weights == light.weights
    for one, other in zip((*light.grids, *light.walls), (*again.grids, *again.walls)):
        np.testing.assert_array_equal(one.light, other.light)
        np.testing.assert_array_equal(one.values, other.values)
    np.testing.assert_array_equal(again.mix(key=1.0).grids[0].error, light.mix(key=1.0).grids[0].error)
    assert store.is_run(tmp_path / "run")


# Spherical harmonics.


def test_the_basis_is_orthonormal_and_projections_restore_smooth_skies():
    directions, solid = pixel_directions(256, 512)
    functions = basis(4, directions.reshape(-1, 3))
    gram = (functions * np.repeat(solid, 512)[:, None]).T @ functions
    np.testing.assert_allclose(gram, np.eye(25), atol=1e-4)
    coefficients = np.random.default_rng(0).normal(size=(25, 3))
    coefficients[0] = 20  # positive everywhere
    image = (functions @ coefficients).reshape(256, 512, 3)
    assert image.min() > 0
    np.testing.assert_allclose(projected(Sky("s", image), 4, np.eye(3)), coefficients, atol=3e-3)
    quarter = projected(Sky("s", np.roll(image, 128, axis=1)), 4, np.eye(3))  # the middle column goes to the right
    np.testing.assert_allclose(rotated(coefficients, 90.0), quarter, atol=3e-3)


def test_a_disc_projects_as_its_image_does():
    directions, _ = pixel_directions(512, 1024)
    axis = KEY.direction
    image = np.where((directions @ axis)[..., None] >= np.cos(np.radians(KEY.angle)), KEY.radiance, 0.0)
    exact = projected(KEY, 4, np.eye(3))
    np.testing.assert_allclose(projected(Sky("s", image), 4, np.eye(3)), exact, atol=0.01 * np.abs(exact).max())


@pytest.mark.parametrize("albedo", [(0.7, 0.7, 0.7), (0.8, 0.5, 0.2)])
def test_a_smooth_sky_through_harmonics_is_what_a_bake_would_give(albedo):
    field = replace(grey(unit(waves())).fields[0], material=Material(albedo))
    options = {"grid": 8, "paths": 4, "bounces": 2, "judge": False}
    baked = ig.run(Scene((field,), lights=(GRADIENT,)), **options)
    kept = ig.run(Scene((field,), lights=(KEY,)).in_harmonics(2), **options).under(GRADIENT)
    np.testing.assert_allclose(kept.grids[0].values, baked.grids[0].values, rtol=1e-5, atol=1e-5)
    turned = kept.under(KEY, 30.0).grids[0].values
    assert turned.min() >= 0 and np.abs(turned - kept.under(KEY).grids[0].values).max() > 0.01
    with pytest.raises(BadInput, match="--lights sh"):
        baked.under(GRADIENT)


# The studio.


def test_the_key_of_the_studio_comes_from_the_upper_left_of_the_default_view():
    from illumgrid.show import fit_camera

    for direction in (np.eye(3), rotation()):
        scene = Scene.studio(unit(waves(direction=direction)))
        camera, key = fit_camera(scene, scene.levels(0.5), 1.0), scene.lights[0].direction
        assert [light.name for light in scene.lights] == ["key", "dome"]
        assert key @ camera.right < -0.3 and key @ camera.up > 0.3 and key @ camera.forward < -0.3
        assert key @ sky_axes(scene)[2] == pytest.approx(np.sin(np.radians(40)))


def test_lights_that_cannot_be_are_refused():
    for bad, words in (
        (lambda: Distant("a", (0, 0, 0), 1.0, (1, 1, 1)), "direction of light 'a'"),
        (lambda: Distant("a", (0, 0, 1), 0.0, (1, 1, 1)), "angle of light 'a'"),
        (lambda: Distant("a=b", (0, 0, 1), 1.0, (1, 1, 1)), "light's name"),
        (lambda: Sky("a", (1.0, -1.0, 0.0)), "radiance of light 'a'"),
        (lambda: Sky("a", np.ones((4, 8))), "radiance of light 'a'"),
        (lambda: Harmonics("a", np.ones((5, 3))), "coefficients of light 'a'"),
    ):
        with pytest.raises(BadInput, match=words):
            bad()


# Scene files.


@pytest.fixture
def scene_file(tmp_path):
    np.save(tmp_path / "v.npy", np.asarray(unit(waves()).values))

    def write(lights):
        path = tmp_path / "s.toml"
        path.write_text('[[field]]\nname = "v"\nvolume = "v.npy"\nrange = [0.3, 0.7]\n' + lights)
        return path

    return write


def exr(path, image):
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": np.ascontiguousarray(image, np.float32)}).write(str(path))


def hdr(path, image, lengths):
    """Radiance's RGBE of small whole numbers, with run lengths or without."""
    rows, columns, _ = image.shape
    rgbe = np.concatenate([image, np.full((rows, columns, 1), 136)], axis=2).astype(np.uint8)
    body = b""
    for row in rgbe:
        if not lengths:
            body += row.tobytes()
            continue
        body += bytes([2, 2, columns >> 8, columns & 255])
        for channel in row.T:
            even = (channel[:3] == channel[0]).all()
            body += bytes([128 + 3, channel[0]]) if even else bytes([3]) + channel[:3].tobytes()
            body += bytes([columns - 3]) + channel[3:].tobytes()
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (rows, columns) + body)


def test_lights_of_a_scene_file(scene_file, tmp_path):
    image = np.random.default_rng(0).integers(1, 200, (5, 10, 3)).astype(np.float32)
    image[:, :3] = image[:, :1]
    exr(tmp_path / "sky.exr", image)
    hdr(tmp_path / "flat.hdr", image, False)
    hdr(tmp_path / "runs.hdr", image, True)
    path = scene_file(
        '[[light]]\nname = "dome"\nradiance = [1, 2, 3]\n[[light]]\nname = "g"\nnadir = [0, 0, 0]\nzenith = [1, 1, 1]\n'
        '[[light]]\nname = "sun"\ndirection = [0, 0, 2]\nangle = 0.27\nirradiance = [3, 3, 3]\n'
        + "".join(f'[[light]]\nname = "{name}"\nimage = "{name}"\n' for name in ("sky.exr", "flat.hdr", "runs.hdr"))
        + '[[quad]]\nname = "q"\ncorner = [0, 0, 9]\nedge_u = [1, 0, 0]\nedge_v = [0, 1, 0]\nemission = [1, 1, 1]\n'
        'light = "sun"\n'
    )
    scene = ig.read_scene(path)
    dome, gradient, sun, *images = scene.lights
    assert dome.radiance.tolist() == [1, 2, 3] and gradient.radiance.tolist() == [[0, 0, 0], [1, 1, 1]]
    assert sun.direction.tolist() == [0, 0, 1] and sun.angle == 0.27 and sun.irradiance.tolist() == [3, 3, 3]
    for picture in images:
        np.testing.assert_array_equal(picture.radiance, image)
    assert [layer.name for layer in layers_of(scene)] == ["dome", "g", "sun", "sky.exr", "flat.hdr", "runs.hdr"]


@pytest.mark.parametrize(
    "table, words",
    [
        ("[[ligth]]", "did you mean 'light'"),
        ('[[light]]\nname = "a"\nradience = [1, 1, 1]', "did you mean 'radiance'"),
        ('[[light]]\nname = "a"\nzenith = [1, 1, 1]', "zenith came; expected radiance, or nadir with zenith, or image"),
        ('[[light]]\nname = "a"\nimage = "none.exr"', "image: there is no file"),
        ('[[light]]\nname = "a"\nimage = "v.npy"', "ends in .npy"),
        ('[[light]]\nname = "a"\ndirection = [0, 0, 1]\nangle = 95\nirradiance = [1, 1, 1]', "angle of light 'a'"),
    ],
)
def test_bad_lights_of_a_scene_file_are_reported(scene_file, table, words):
    with pytest.raises(BadInput, match=words):
        ig.read_scene(scene_file(table + "\n"))


@pytest.mark.parametrize(
    "content", [b"", b"#?RADIANCE\n\n-Y 4 +X 8\n\x02\x02", b"#?RADIANCE\n\n-Y 99999 +X 99999\n", b"#?RGBE\n+X 3 -Y 4\n"]
)
def test_damaged_images_of_a_sky_are_refused(content, tmp_path):
    from illumgrid.io.readers.sky import read_image

    for name in ("a.hdr", "a.exr"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(BadInput, match=name):
            read_image(tmp_path / name)


def test_negative_pixels_of_lossy_compression_become_0(tmp_path):
    from illumgrid.io.readers.sky import NEGATIVE, read_image

    image = np.ones((8, 16, 3), np.float32)
    image[4, 5] = -0.5, 0, 0.25
    exr(tmp_path / "sky.exr", image)
    with pytest.warns(IllumgridWarning, match="file: sky.exr has 1 negative pixels of 128 .*became 0"):
        np.testing.assert_array_equal(read_image(tmp_path / "sky.exr"), np.maximum(image, 0))
    size = np.sin((np.arange(8) + 0.5) * np.pi / 8)  # of a pixel in each row
    for much, allowed in ((0.99, True), (1.01, False)):
        image = np.ones((8, 16, 3), np.float32)
        image[0, 0] = 0
        total = 3 * (16 * size.sum() - size[0])
        image[0, 0, 0] = -much * NEGATIVE * total / size[0]
        exr(tmp_path / "sky.exr", image)
        if allowed:
            with pytest.warns(IllumgridWarning, match="0.01 of the light"):
                read_image(tmp_path / "sky.exr")
        else:
            with pytest.raises(BadInput, match=r"1 negative pixels of 128.*at most 0.01"):
                read_image(tmp_path / "sky.exr")


def test_a_small_sun_is_asked_for_wherever_interpolation_shows_it():
    """Bilinear, 0.75² of the light of one pixel comes from the pixel itself, the rest from its eight neighbours."""
    image = np.zeros((16, 32, 3))
    image[5, 0] = 1000.0
    laid = marchable(Scene(Scene.sky(waves()).fields, lights=(Sky("sun", image),)))
    solid = -np.diff(np.cos(np.linspace(0, np.pi, 17)))[:, None] * 2 * np.pi / 32
    share = laid.image_density * solid
    near = share[4:7][:, [31, 0, 1]]
    assert share.sum() == pytest.approx(1.0)
    assert near[1, 1] == pytest.approx(0.9 * 0.75**2, rel=0.02) and near.sum() == pytest.approx(0.9, rel=0.02)
