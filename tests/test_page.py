"""The page in a browser: its pixels equal those of the still picture, and mouse, keys and addresses control it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from browser import HEIGHT, WIDTH, bent, browser, coloured, decoded, pair, still, until, with_separate_lights  # noqa: F401
from illumgrid.field.lights import Distant
from illumgrid.field.scene import Material, Scene
from illumgrid.show import BACKGROUND, fit_camera
from illumgrid.show.engines import software
from illumgrid.show.shade import Shown, opaque
from illumgrid.tone import decode_srgb
from shapes import ball

pytestmark = pytest.mark.filterwarnings("default")  # of the browser's driver
KEY = Distant("key", (-1, -1, 1), 25, (3.0, 2.0, 1.0))
SCENES = {"bent": coloured(bent()), "pair": coloured(pair())}


def alike(one, other):
    """The same picture except for outlines, whose refinement depends on time."""
    off = np.abs(one - other).max(axis=2)
    return off.mean() < 1.5 and np.quantile(off, 0.9) <= 4


@pytest.mark.parametrize("t, kind", [(0.1, "global"), (0.5, "global"), (0.9, "global"), (0.6, "local")])
@pytest.mark.parametrize("name", SCENES)
def test_the_pixels_are_those_of_the_still_picture(browser, name, t, kind):  # noqa: F811
    light = SCENES[name]
    wanted, address, covered = still(light, t, local=kind == "local")
    browser.open(light, f"{address}&light={kind}")
    off = np.abs(browser.pixels() - wanted).max(axis=2)
    assert covered.mean() > 0.2
    # Half floats are good to 0.1 of 255; what is left are outlines, which the page samples up to four times as densely.
    assert np.median(off[covered]) <= 1 and np.quantile(off[covered], 0.9) <= 3
    assert np.mean(off[~covered] > 3) < 0.02


def grey_under_a_key():
    """Grey surfaces: each layer is one channel, and its colour that of its light."""
    (field,) = bent().fields
    return replace(bent(), fields=(replace(field, name="grey", material=Material((0.7, 0.7, 0.7))),), lights=(KEY,))


def dark_room_with_a_key():
    one, other = pair().fields
    return replace(pair(), fields=(replace(one, name="room"), other), lights=(KEY,))


@pytest.mark.parametrize("scene", [grey_under_a_key, dark_room_with_a_key])
def test_sliders_mix_the_lights_at_the_exposure_of_the_first_picture(browser, scene):  # noqa: F811
    baked = with_separate_lights(scene())
    kept = baked.mix(**{baked.lights[0]: 0.8})  # opens at weights of its own
    wanted, address, covered = still(kept, 0.1)
    page = browser.open(kept, address)
    off = np.abs(browser.pixels() - wanted).max(axis=2)[covered]
    assert np.median(off) <= 1 and np.quantile(off, 0.9) <= 3
    weights = dict(zip(baked.lights, (0.2, 1.6)))
    sliders = page.locator('[data-part="lights"] input')
    assert [float(s.input_value()) for s in sliders.all()] == [0.8, 1.0] and "weights" not in page.url
    for slider, weight in zip(sliders.all(), weights.values()):
        slider.evaluate("(e, w) => { e.value = w; e.dispatchEvent(new Event('input', { bubbles: true })) }", weight)
    mixed = kept.mix(**weights)
    moved, _, _ = still(mixed, 0.1, stops=np.log2(kept.exposure / mixed.exposure))
    assert np.median(np.abs(moved - wanted).max(axis=2)[covered]) > 10
    off = np.abs(browser.pixels() - moved).max(axis=2)[covered]
    assert np.median(off) <= 1 and np.quantile(off, 0.9) <= 3
    assert page.url.endswith("weights=0.2,1.6")
    browser.open(kept, page.url.partition("#")[2], anew=True)
    off = np.abs(browser.pixels() - moved).max(axis=2)[covered]
    assert np.median(off) <= 1 and np.quantile(off, 0.9) <= 3


def test_a_ground_under_the_sky_fades_into_the_background_as_in_the_still_picture(browser, monkeypatch):  # noqa: F811
    light = coloured(Scene.floor(ball(14), range=(0.5, 0.9), name="ground"))
    wanted, address, _ = still(light, 0.5)
    browser.open(light, address)
    off = np.abs(browser.pixels() - wanted).max(axis=2)
    assert np.median(off) <= 1 and np.quantile(off, 0.95) <= 4
    monkeypatch.setattr("illumgrid.show.shade.fades", lambda scene, number: False)
    assert np.mean(np.abs(still(light, 0.5)[0] - wanted).max(axis=2) > 10) > 0.05


def test_a_run_of_one_light_has_no_slider_for_it(browser):  # noqa: F811
    assert browser.open(SCENES["bent"]).locator('[data-part="lights"] input').count() == 0


def test_the_page_opens_at_the_middle_with_the_camera_of_the_still_picture(browser):  # noqa: F811
    light = SCENES["bent"]
    wanted, _, covered = still(light, 0.5)
    browser.open(light)
    off = np.abs(browser.pixels() - wanted).max(axis=2)
    assert np.median(off[covered]) <= 1 and np.quantile(off[covered], 0.9) <= 3


def test_the_slider_moves_by_hand_and_keys_and_all_fields_follow(browser):  # noqa: F811
    page = browser.open(SCENES["pair"])
    before = browser.pixels()
    first = page.locator('input[type="range"]').first
    assert first.get_attribute("min") == "2100" and first.get_attribute("max") == "3000"
    first.evaluate("e => { e.value = 2800; e.dispatchEvent(new Event('input', { bubbles: true })) }")
    assert np.abs(browser.pixels() - before).max() > 50
    sliders = page.locator('.sweep input[type="range"]')
    assert float(sliders.nth(1).input_value()) == pytest.approx(0.7 + 0.3 * 7 / 9)
    assert page.locator('.sweep input[type="number"]').first.input_value() == "2800"
    first.focus()
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    browser.settle()
    moved = float(first.input_value())
    assert 2800 < moved < 2900 and f"isovalue={moved:.9g}" in page.url
    page.locator('.sweep input[type="number"]').nth(1).fill("0.85")
    page.keyboard.press("Enter")
    assert float(first.input_value()) == pytest.approx(2550)


def test_the_address_keeps_the_state(browser):  # noqa: F811
    page = browser.open(SCENES["pair"], "isovalue=2400&light=both&split=0.3&look=shiny&stops=-1", anew=True)
    page.locator("canvas").focus()
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("+")
    wanted, address = browser.pixels(), page.url.partition("#")[2]
    for part in ("isovalue=2400", "light=both", "split=0.3", "look=shiny", "stops=-1", "view="):
        assert part in address
    browser.open(SCENES["pair"], address, anew=True)
    assert alike(browser.pixels(), wanted)
    browser.open(SCENES["pair"], "isovalue=nonsense&view=1,2&light=moon&look=&split=&stops=inf")
    assert page.evaluate("[illumgrid.state.sweep, illumgrid.state.light, illumgrid.state.stops]") == [0.5, "global", 0]


def test_the_split_shows_local_light_left_of_it_and_global_light_right(browser):  # noqa: F811
    light = SCENES["bent"]
    lit, address, _ = still(light, 0.5)
    local, _, _ = still(light, 0.5, local=True)
    page = browser.open(light, f"{address}&light=both&split=0.25")
    handle = page.locator('[data-part="split"]')
    box = handle.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2 + 0.35 * WIDTH, box["y"] + 45)
    page.mouse.up()
    made, cut = browser.pixels(), round(0.6 * WIDTH)
    assert "split=0.6" in page.url and handle.get_attribute("aria-valuenow") == "60"
    off = [np.abs(made - want).max(axis=2) for want in (local, lit)]
    for missed, want, side in zip(off, (local, lit), (np.s_[:, : cut - 1], np.s_[:, cut + 1 :])):
        edge = (maximum_filter(want, (3, 3, 1)) - minimum_filter(want, (3, 3, 1))).max(axis=2) > 20
        assert np.quantile(missed[side][~edge[side]], 0.99) <= 3  # outlines are sampled at other places
    assert np.mean(off[1][:, : cut - 1] > 20) > 0.02
    handle.press("End")
    assert handle.get_attribute("aria-valuenow") == "100"


def test_a_drag_turns_the_object_with_the_hand_and_a_double_click_resets(browser):  # noqa: F811
    page = browser.open(SCENES["pair"])
    before, box = browser.pixels(), page.locator("canvas").bounding_box()
    near = page.evaluate("illumgrid.state.view.azimuth")
    page.mouse.move(box["x"] + 60, box["y"] + 45)
    page.mouse.down()
    page.mouse.move(box["x"] + 90, box["y"] + 45)
    page.mouse.up()
    assert page.evaluate("illumgrid.state.view.azimuth") < near  # the front goes right: the eye goes left
    page.mouse.wheel(0, -200)
    browser.settle()
    assert "view=" in page.url and np.abs(browser.pixels() - before).max() > 50
    page.locator("canvas").dblclick()
    assert alike(browser.pixels(), before) and "view=" not in page.url


def test_two_fingers_zoom(browser):  # noqa: F811
    page = browser.open(SCENES["bent"])
    zoom = """([moves]) => { const c = document.querySelector('canvas'); c.setPointerCapture = () => {};
        for (const [kind, pointerId, clientX] of moves) {
            c.dispatchEvent(new PointerEvent(kind, { pointerId, clientX, clientY: 50, pointerType: 'touch' })); } }"""
    before = page.evaluate("illumgrid.state.view.distance")
    page.evaluate(
        zoom,
        [
            [
                ["pointerdown", 1, 60],
                ["pointerdown", 2, 90],
                ["pointermove", 2, 120],
                ["pointerup", 2, 120],
                ["pointerup", 1, 60],
            ]
        ],
    )
    assert page.evaluate("illumgrid.state.view.distance") == pytest.approx(before / 2)


def test_a_saved_png_is_the_picture(browser):  # noqa: F811
    page = browser.open(SCENES["bent"])
    wanted = browser.pixels()
    with page.expect_download() as waiting:
        page.locator('[data-part="save"]').evaluate("e => e.click()")
    saved = waiting.value
    assert saved.suggested_filename == "bent-0.750.png"
    assert np.array_equal(decoded(saved.path().read_bytes()), wanted) and wanted.shape == (HEIGHT, WIDTH, 3)


def test_error_bars_are_those_of_the_still_picture(browser):  # noqa: F811
    scene = bent()
    light = coloured(replace(scene, fields=(replace(scene.fields[0], name="bars"),)))
    light.grids[0].error[:] = np.geomspace(0.005, 0.5, light.grids[0].error.shape[1])[:, None]
    _, address, covered = still(light, 0.5)
    scene = light.scene
    row = scene.levels(0.5)[0]
    camera = fit_camera(scene, row, WIDTH / HEIGHT)
    shown = Shown(light, row, 0.5, trust=True)
    ground = opaque(np.full(3, BACKGROUND, np.float32))
    wanted = software.draw(shown, camera, WIDTH, HEIGHT, ground)[..., :3].astype(int)
    page = browser.open(light, f"{address}&trust=1")
    made = browser.pixels()
    assert page.locator('[data-part="legend"]').is_visible()

    def hole(picture):  # the stripes run along the object there, along the picture here
        linear = decode_srgb(picture.astype(np.uint8))
        return linear[..., 0] > 3 * linear[..., 1:].max(axis=-1)

    both = covered & ~hole(made) & ~hole(wanted)
    assert 0.02 < hole(made)[covered].mean() < 0.6 and (hole(made) != hole(wanted)).mean() < 0.02
    off = np.abs(made - wanted).max(axis=2)[both]
    assert np.median(off) <= 2 and np.quantile(off, 0.9) <= 8
    assert len(np.unique(wanted[both], axis=0)) > 100


@pytest.mark.parametrize("look", ["shiny", "translucent"])
def test_a_look_says_that_it_is_an_effect_of_display(browser, look):  # noqa: F811
    page = browser.open(SCENES["bent"])
    matte = browser.pixels()
    assert page.locator('[data-part="effect"]').is_hidden()
    page.locator(f'input[value="{look}"]').evaluate("e => e.click()")
    made = browser.pixels()
    assert "computed for matte surfaces" in page.locator('[data-part="effect"]').inner_text()
    assert np.mean(np.abs(made - matte).max(axis=2) > 4) > 0.02


def test_a_browser_without_webgl2_gets_a_sentence(browser):  # noqa: F811
    from illumgrid.show.viewer import page as built

    page = browser.context.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    file = browser.folder / "none.html"
    file.write_text(built(SCENES["bent"]), encoding="utf-8")
    page.goto(file.as_uri())
    until(page, "!document.querySelector('[data-part=message]').hidden")
    assert "WebGL2" in page.locator('[role="alert"]').inner_text()
    page.close()


def test_nothing_was_asked_of_the_network_and_nothing_went_wrong(browser):  # noqa: F811
    assert browser.requests
    assert {url.partition(":")[0] for url in browser.requests} <= {"file", "about", "blob", "data"}
    assert not browser.troubles
