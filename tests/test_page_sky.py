"""The page under a smooth sky that is turned by hand: its pixels are those of the still picture under that sky."""

from dataclasses import replace

import numpy as np
import pytest

from browser import bent, browser, coloured, pair, still  # noqa: F401
from illumgrid.field.layers import in_harmonics, layers_of
from illumgrid.field.lights import Distant, Sky
from illumgrid.field.scene import Material
from illumgrid.field.upright import sky_axes
from illumgrid.grid.channels import channels_of, mixed
from illumgrid.grid.nodes import reachable
from illumgrid.show.viewer import skies
from illumgrid.show.viewer.packing import packed

pytestmark = pytest.mark.filterwarnings("default")  # of the browser's driver


def grey():
    """Grey surfaces under a sky that has no colour: one channel for each basis function."""
    (field,) = bent().fields
    lights = (Sky("dome", (0.6, 0.6, 0.6)), Distant("key", (-1, -1, 1), 25, (2, 2, 2)))
    field = replace(field, name="greysky", material=Material((0.7, 0.7, 0.7)))
    return replace(bent(), fields=(field,), lights=lights, background=np.zeros(3))


def room():
    """Coloured surfaces, a lamp and a coloured key."""
    one, other = pair().fields
    return replace(
        pair(), fields=(replace(one, name="roomsky"), other), lights=(Distant("key", (-1, -1, 1), 25, (3, 2, 1)),)
    )


def kept(scene, degree):
    """Light that answers to each basis function in a way of its own, made without a run."""
    scene = in_harmonics(scene, degree)
    light, channels = coloured(scene), channels_of(scene)
    mix = np.array(mixed(channels, layers_of(scene), {}).mix)
    random = np.random.default_rng(0)

    def answers(values):
        each = [values[..., "YRGB".index(name[-1]) % 3] for name in channels.names[channels.own :]]
        swing = [
            np.roll(a, k, axis=k % 3) * (1.0 if name.startswith("sh.0.") else 0.4 * random.normal())
            for k, (a, name) in enumerate(zip(each, channels.names[channels.own :]))
        ]
        held = np.stack(swing, axis=-1)
        return np.concatenate([np.maximum(held @ mix[channels.own :], 0)[..., : channels.own], held], axis=-1)

    grids = tuple(replace(g, values=answers(g.values), channels=channels, errors=None) for g in light.grids)
    walls = tuple(replace(w, values=answers(w.values), channels=channels) for w in light.walls)
    return replace(light, grids=grids, walls=walls)


def off(browser, light, under, exposure):  # noqa: F811
    """By how much the page's pixels miss those of a still picture under another sky, at the page's exposure."""
    wanted, _, covered = still(under, 0.4, stops=np.log2(exposure / under.exposure))
    difference = np.abs(browser.pixels() - wanted).max(axis=2)[covered]
    return np.median(difference), np.quantile(difference, 0.9), wanted


@pytest.mark.parametrize("make, degree", [(grey, 4), (room, 2)])
def test_the_page_turns_the_sky_as_the_package_does(browser, make, degree):  # noqa: F811
    light = kept(make(), degree)
    _, address, _ = still(light, 0.4)
    page = browser.open(light, address)
    median, most, first = off(browser, light, light, light.exposure)
    assert median <= 1 and most <= 3
    browser.open(light, f"{address}&turn=70,0")
    median, most, turned = off(browser, light, light.under(None, 70), light.exposure)
    assert median <= 1 and most <= 3 and np.quantile(np.abs(turned - first), 0.8) > 5
    assert "turn=70,0" in page.url
    page.locator('[data-part="ball"] button').click()
    assert off(browser, light, light, light.exposure)[0] <= 1 and "turn" not in page.url


def test_a_tilt_by_90_degrees_brings_what_is_in_the_back_above(browser):  # noqa: F811
    axes = sky_axes(bent())
    back = Distant("key", axes[1], 25, (2, 2, 2))
    light = kept(replace(grey(), fields=(replace(grey().fields[0], name="tilted"),), lights=(back,)), 4)
    _, address, _ = still(light, 0.4)
    browser.open(light, f"{address}&turn=0,90")
    above = light.under(replace(back, direction=axes[2]))
    median, most, _ = off(browser, light, above, light.exposure)
    assert median <= 1 and most <= 3


def test_the_ball_turns_by_hand_and_by_keys_and_says_that_error_bars_do_not_follow(browser):  # noqa: F811
    light = kept(grey(), 4)
    page = browser.open(light, "trust=1")
    ball = page.locator('[data-part="ball"] canvas')
    ball.scroll_into_view_if_needed()
    box = ball.bounding_box()
    before = ball.evaluate("e => e.toDataURL()")
    page.mouse.move(box["x"] + 40, box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 64, box["y"] + 28)
    page.mouse.up()
    turn, tilt = page.evaluate("illumgrid.state.turn")
    assert turn == pytest.approx(45, abs=4) and tilt == pytest.approx(22.5, abs=4)
    assert ball.evaluate("e => e.toDataURL()") != before
    ball.press("ArrowLeft")
    assert page.evaluate("illumgrid.state.turn") == pytest.approx([turn - 5, tilt])
    assert "the light with which the page opened" in page.locator('[data-part="opened"]').inner_text()


def test_a_page_without_such_a_sky_has_no_ball(browser):  # noqa: F811
    assert browser.open(coloured(bent())).locator('[data-part="ball"] canvas').count() == 0
    assert not browser.troubles


@pytest.mark.plain
def test_components_lose_what_they_say():
    random = np.random.default_rng(0)
    light = random.normal(size=(400, 3, 2)) @ random.normal(size=(2, 9)) + 0.01 * random.normal(size=(400, 3, 9))
    values, basis, lost = skies.components(light.astype(np.float32), 2)
    left = light - values @ basis
    assert lost == pytest.approx(np.sqrt((left**2).sum() / (light**2).sum()), rel=1e-3) and 0.001 < lost < 0.02
    values, basis, lost = skies.components(light.astype(np.float32), 9)
    assert lost == 0 and np.allclose(values @ basis, light, atol=1e-6)


@pytest.mark.plain
def test_a_page_holds_what_fits_and_says_what_it_leaves_out(monkeypatch):
    light = kept(grey(), 4)
    noise = np.random.default_rng(0).normal(0, 0.1, light.grids[0].light.shape)
    light = replace(light, grids=(replace(light.grids[0], values=light.grids[0].light + noise),))
    scene, _ = packed(light)
    assert len(scene["fields"][0]["light"]["sky"]) == 25 and not any("components" in note for note in scene["notes"])
    lit = len(reachable(light.scene.fields[0], light.grids[0].spec))
    monkeypatch.setattr(skies, "MOST_BYTES", 20 * lit)
    scene, _ = packed(light)
    assert len(scene["fields"][0]["light"]["sky"]) == 16
    assert any("16 components for 25" in note and "%" in note for note in scene["notes"])
    monkeypatch.setattr(skies, "MOST_BYTES", 8 * lit)  # too few for 12 components: fewer nodes
    scene, _ = packed(light)
    assert len(scene["fields"][0]["light"]["sky"]) >= 12 and np.prod(scene["fields"][0]["light"]["shape"]) < 9**3 / 2
