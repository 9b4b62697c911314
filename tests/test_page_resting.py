"""The page at rest: rays from every pixel make it the exact picture, and start from that of the lookup."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

import illumgrid as ig
from browser import bent, browser, coloured, pair, still, until  # noqa: F401
from illumgrid.field.lights import Sky
from illumgrid.field.scene import Material
from illumgrid.show.exact import Exact
from illumgrid.show.tints import Tint
from illumgrid.show.viewer.packing import packed
from illumgrid.show.viewer.resting import smaller
from illumgrid.tone import decode_srgb

pytestmark = pytest.mark.filterwarnings("default")  # of the browser's driver
RAYS, TRIAL = 8, (48, 36)


def balls():
    """Some that touch and shade one another, lit by a grid too coarse for their shadows."""
    place = np.stack(np.meshgrid(*[np.linspace(-1, 1, 24)] * 3, indexing="ij"), axis=-1)
    middles, sizes = np.random.default_rng(0).uniform(-0.5, 0.5, (6, 3)), (0.05, 0.2, 0.1, 0.15, 0.07, 0.18)
    height = sum(np.exp(-((place - m) ** 2).sum(axis=-1) / s) for m, s in zip(middles, sizes))
    return ig.Volume((height / height.max()).astype(np.float32))


def pictured():
    """Under two images of the sky: a smooth one, and one that is dark but for a small sun."""
    rows, columns = np.mgrid[:32, :64]
    waves = [np.cos(columns / 64 * 2 * np.pi + k) * np.sin(rows / 32 * np.pi) for k in range(3)]
    smooth = 0.5 + 0.4 * np.stack(waves, axis=-1)
    sun = np.zeros((64, 128, 3))
    sun[14:16, 40:42] = (900.0, 800.0, 600.0)
    return replace(ig.Scene.sky(balls()), background=np.zeros(3), lights=(Sky("dome", smooth), Sky("sun", sun)))


def scene_of(kind):
    if kind == "image":
        return pictured()
    return ig.Scene.studio(balls()) if kind == "tinted" else getattr(ig.Scene, kind)(balls())


def tint():
    """A second quantity that varies across the balls."""
    volume = balls()
    return Tint(ig.Volume(np.indices(volume.shape)[0].astype(np.float32), volume.origin, volume.spacing))


@pytest.mark.parametrize("kind", ["studio", "box", "image", "tinted"])
def test_rays_take_away_what_the_lookup_is_off(browser, kind):  # noqa: F811
    light = ig.run(scene_of(kind), grid=10, paths=64, isovalues=3, seed=0, judge=False)
    second = tint() if kind == "tinted" else None
    size = (120, 90) if kind == "box" else (96, 72)  # a pixel beside the lamp would outweigh all others
    looked_up, address, covered = still(light, 0.5, size, tint=second)
    wanted, _, _ = still(light, 0.5, size, exact=Exact(64), tint=second)
    for page in browser.folder.glob("*.html"):  # of the scene before, whose field has the same name
        page.unlink()
    browser.open(light, address, rest=TRIAL, tint=second, size=size)
    assert not browser.troubles
    if second:
        covered = still(light, 0.5, size)[2]
        covered[: size[1] // 3] = False  # the legend
    inner = binary_erosion(covered, iterations=2)  # outlines are sampled at other places
    before, now, truth = (decode_srgb(x[inner].astype(np.uint8)) for x in (looked_up, browser.at_rest(RAYS), wanted))
    off = np.sqrt(np.square(now - truth).mean()), np.sqrt(np.square(before - truth).mean())
    # By theory sqrt(N0 / (N0 + N)) is left: 0.58 where a lookup is worth the fewest rays, 4, and more on walls.
    assert off[0] < (0.8 if kind == "box" else 0.58) * off[1]
    noise = np.sqrt(np.square(now - truth).mean() / len(truth))
    kept = 0.8 * abs(before.mean() - truth.mean())  # of what the lookup is off, which counts as some rays
    assert abs(now.mean() - truth.mean()) < kept + 0.003 * truth.mean() + 3 * noise


def test_images_of_the_sky_keep_their_light_in_few_pixels():
    image = np.random.default_rng(0).random((90, 150, 3)) ** 8
    solid = [-np.diff(np.cos(np.linspace(0, np.pi, n + 1))) for n in (90, 40)]
    few = smaller(image, 40, 64)
    np.testing.assert_allclose(solid[1] @ few.mean(axis=1), solid[0] @ image.mean(axis=1))
    np.testing.assert_allclose(smaller(image, 90, 150), image)
    held = packed(coloured(pictured()))[0]["resting"]
    assert held["size"] == (128, 64) and len(held["images"]) == 2


def test_only_what_changes_the_light_starts_the_rays_again(browser):  # noqa: F811
    page = browser.open(coloured(pair()), rest=(16, 12), size=(32, 24))
    until(page, "illumgrid.resting.rays >= 3")
    page.evaluate("illumgrid.put({ stops: 0.5 })")
    browser.settle()
    assert page.evaluate("illumgrid.resting.rays") >= 3
    page.evaluate("illumgrid.put({ sweep: 0.45 })")
    browser.settle()
    assert page.evaluate("illumgrid.resting.rays") < 3
    page.locator('[data-part="rest"]').uncheck()
    browser.settle()
    assert page.url.endswith("&rest=0") and page.locator('[data-part="rays"]').inner_text() == ""
    assert not browser.troubles


def test_a_driver_that_refuses_the_shaders_of_rays_leaves_the_lookups(browser):  # noqa: F811
    page = browser.open(coloured(pair()), anew=True)
    before, switch = browser.pixels(), page.locator('[data-part="refine"]')
    assert switch.is_visible() and page.evaluate("illumgrid.resting.made === undefined")  # not before rays begin
    page.evaluate("illumgrid.resting.make = () => { throw new Error('refused'); }; illumgrid.put({ rest: true })")
    after = browser.pixels()
    browser.shown = None  # this page has no rays any more
    assert not switch.is_visible() and not browser.troubles
    np.testing.assert_array_equal(before, after)


def test_pages_that_cannot_gather_have_no_switch_for_it(browser):  # noqa: F811
    (field,) = bent().fields
    shining = replace(bent(), fields=(replace(field, name="shining", material=Material((0.5,) * 3, (1.0, 0, 0))),))
    light = coloured(shining)
    assert packed(light)[0]["resting"] is None
    assert not browser.open(light).locator('[data-part="refine"]').is_visible()


def test_lights_that_rays_ask_for_carry_their_exposure_and_weights():
    scene = replace(pair(), background=np.array([0.2, 0.1, 0.3]))
    light = coloured(scene)
    held = packed(light)[0]["resting"]
    (sky,) = held["skies"]
    np.testing.assert_allclose(np.array(sky["coefficients"][0]) / np.sqrt(4 * np.pi), light.exposure * scene.background)
    lamps = [k for k, quad in enumerate(scene.quads) if quad.material.emission.any()]
    assert [lamp["wall"] for lamp in held["lamps"]] == lamps and len(lamps) == 1
    np.testing.assert_allclose(held["lamps"][0]["color"], light.exposure * scene.quads[lamps[0]].material.emission)
