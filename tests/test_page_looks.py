"""Films, coats, cuts and a second quantity in the page: its pixels are those of the still pictures."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

import illumgrid as ig
from browser import browser, coloured, still  # noqa: F401
from illumgrid.field.scene import Material
from illumgrid.show.exact import Exact
from illumgrid.show.tints import Tint
from illumgrid.show.viewer import page
from illumgrid.show.viewer.packing import packed
from illumgrid.tone import decode_srgb
from shapes import ball, sampled, sky

pytestmark = pytest.mark.filterwarnings("default")  # of the browser's driver
SIZE = (72, 54)


def named(name, **material):
    scene = sky(ball(20))
    return coloured(replace(scene, fields=(replace(scene.fields[0], name=name, material=Material(**material)),)))


def alike(found, wanted, covered):
    inner = binary_erosion(covered, iterations=2)  # outlines are sampled at other places
    assert inner.sum() > 500
    off = np.abs(found - wanted)[inner]
    assert np.median(off) <= 1 and np.quantile(off, 0.95) <= 4


def test_what_is_seen_through_a_film_is_that_of_the_picture(browser):  # noqa: F811
    light = named("film", albedo=(0.3, 0.4, 0.5), transmission=0.5)
    wanted, address, covered = still(light, 0.5)
    browser.open(light, address)
    alike(browser.pixels(), wanted, covered)
    assert not browser.troubles


def test_a_cut_is_that_of_the_picture_and_in_the_address(browser):  # noqa: F811
    light = named("cut")
    wanted, address, _ = still(light, 0.5, clip=["-y=0.2"])
    browser.open(light, f"{address}&clip=-y,0.6")
    alike(browser.pixels(), wanted, still(light, 0.5)[2])
    assert "clip=-y,0.6" in browser.page.url and browser.page.locator('[data-part="clipNote"]').is_visible()
    assert float(browser.page.locator('[data-part="clipShown"]').inner_text()) == pytest.approx(0.2)
    assert not browser.troubles


def test_a_second_quantity_colours_the_page_as_the_picture(browser):  # noqa: F811
    light = named("tinted")
    height = sampled(lambda x: x[:, 2], (9, 9, 9), (-1, -1, -1), (0.25,) * 3)
    tint = Tint(height, "height")
    wanted, address, _ = still(light, 0.5, tint=tint)
    covered = still(light, 0.5)[2]
    covered[:30] = False  # the legend
    (browser.folder / "tinted.html").write_text(page(light, None, tint), encoding="utf-8")
    browser.open(light, address)
    found = browser.pixels()
    inner = binary_erosion(covered, iterations=2)
    assert np.median(np.abs(found - wanted)[inner]) <= 2  # 256 steps of the quantity
    browser.page.locator('[data-part="tint"]').uncheck()
    assert "tint=0" in browser.settle().url and np.abs(browser.pixels() - found)[inner].mean() > 5
    assert not browser.troubles


def test_coats_at_rest_become_those_of_exact_pictures(browser):  # noqa: F811
    scene = ig.Scene.studio(ball(20), range=(0.3, 0.9), albedo=(0.2, 0.2, 0.2))
    light = ig.run(scene, grid=10, paths=32, bounces=2, seed=0, judge=False).looking(roughness=0.4)
    wanted, address, covered = still(light, 0.5, SIZE, exact=Exact(64))
    browser.open(light, address, rest=(48, 36), size=SIZE)
    inner = binary_erosion(covered, iterations=2)
    assert inner.sum() > 500
    cheap, rested = browser.pixels(), browser.at_rest(32)
    truth, before, now = (decode_srgb(x[inner].astype(np.uint8)) for x in (wanted, cheap, rested))
    # The cheap look is worth 8 rays: 8 / 40 of its difference is left, and the noise of 32 rays.
    assert np.sqrt(np.square(now - truth).mean()) < 0.26 * np.sqrt(np.square(before - truth).mean())
    assert not browser.troubles


def test_a_field_that_is_held_has_no_slider(browser):  # noqa: F811
    scene = sky(ball(12), limits=(0.3, 0.6))
    core = replace(scene.fields[0], name="core", isovalue=0.9, range=None)
    light = coloured(replace(scene, fields=(core, replace(scene.fields[0], name="film"))))
    described = packed(light)[0]
    assert described["lead"] == 1 and described["resting"] is not None
    shown = browser.open(light, "isovalue=0.5")
    assert shown.locator(".sweep input[type=range]").count() == 1
    assert "held at 0.9" in shown.locator('[data-part="sweeps"]').inner_text()
    assert shown.url.split("#")[1].startswith("isovalue=0.5") and not browser.troubles
