"""A headless browser, and small lit scenes for it, shared by the tests of the page."""

import base64
import io
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from illumgrid import show as preview
from illumgrid.field.layers import layers_of
from illumgrid.field.rooms import box_around, upright
from illumgrid.field.scene import Field, Material, Scene, level_table
from illumgrid.grid import GridSpec, IlluminationGrid, WallTexture
from illumgrid.grid.channels import channels_of, mixed
from illumgrid.light import Illumination
from illumgrid.show.camera import fit_camera
from illumgrid.show.viewer import page
from illumgrid.show.viewer.packing import Stage
from shapes import MIRRORED, ball, sampled

CHROMIUM = next((p for p in ("/usr/bin/chromium", "/usr/bin/chromium-browser") if Path(p).exists()), None)
ARGS = [
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-angle-features=warmUpPipelineCacheAtLink",  # what draws is compiled when it first draws
]  # fmt: skip
WIDTH, HEIGHT = 120, 90
QUICK = """const now = performance.now.bind(performance);
performance.now = () => 100 * now();"""
"""Full frames come at once, and the page takes them for slow: they have four samples, as still pictures."""
SMALL = """addEventListener('DOMContentLoaded', () => {
    const [, width, height] = location.search.match(/(\\d+)x(\\d+)/) ?? [0, WIDTH, HEIGHT];
    document.head.insertAdjacentHTML('beforeend', `<style>.viewer { display: block !important }
        .stage { width: ${width}px; height: ${height}px }</style>`);
})""".replace("WIDTH, HEIGHT", f"{WIDTH}, {HEIGHT}")
"""A picture of this size, or of that which the address asks for: graphics are drawn by the processor here."""


def waves(*shape):
    """Smooth colours (*shape, 3) from 0.4 to 2.4 that vary along every axis."""
    place = np.stack(np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij"), axis=-1)
    slopes = np.array([[4.0, 1.1, -1.7], [-1.3, 3.1, 2.3], [2.1, -2.9, 3.7]])
    return (1.4 + np.sin(place @ slopes + (0.3, 1.0, 2.0))).astype(np.float32)


def coloured(scene, nodes=9, rows=3):
    """Light that varies everywhere, made without a run; one sheet of nodes in the first grid consists of holes."""
    grids, walls = [], []
    for field in scene.fields:
        spec = GridSpec.over(field.volume, nodes)
        values = waves(*spec.shape)
        grids.append(IlluminationGrid(spec, values, 0.05 * values[..., 0], np.ones(spec.shape)))
    grids[0].support[grids[0].spec.shape[0] // 2] = 0
    for quad in scene.quads:
        shape = (rows, *quad.texels[::-1])
        walls.append(WallTexture(waves(*shape), np.ones(shape)))
    return Illumination(scene, level_table(scene, rows), tuple(grids), tuple(walls), {"seed": 0})


def with_separate_lights(scene):
    """`coloured` light of a scene with several lights, of which it keeps each."""
    light, layers, channels = coloured(scene), layers_of(scene), channels_of(scene)
    shares = mixed(channels, layers, {}).mix

    def parts(values):
        """All together, then the layers, equally bright, each with a gradient of its own."""
        held, along = [], np.linspace(0.2, 1.8, values.shape[0])[:, None, None]
        for name, share in zip(channels.names[channels.own :], shares[channels.own :]):
            bright = along if name.startswith(layers[0].name) else 2 - along
            held.append(bright * values[..., "YRGB".index(name[-1]) % 3] / len(layers) / max(share))
        held = np.stack(held, axis=-1)
        together = held @ np.array(shares[channels.own :])
        return np.concatenate([together[..., : channels.own], held], axis=-1)

    grids = [replace(g, values=parts(g.light), channels=channels) for g in light.grids]
    walls = [replace(w, values=parts(w.light), channels=channels) for w in light.walls]
    return replace(light, grids=tuple(grids), walls=tuple(walls))


def bent(n=(22, 17, 25)):
    """A mirrored, oblique, anisotropic lattice far from the origin; solid below; the border cuts the solid."""
    place = {"origin": (900.0, -50.0, 3000.0), "spacing": (0.9, 1.4, 0.8), "direction": MIRRORED}
    centre = sampled(lambda x: x[:, 0], n, **place)
    axes = centre.direction * centre.spacing
    middle = centre.origin + axes @ (np.array(n) / 2)

    def height(x):
        p = (x - middle) @ centre.direction / 10
        return (
            np.linalg.norm(p * (1.0, 0.8, 1.1) - 0.2, axis=1)
            + 0.15 * np.sin(7 * p[:, 0]) * np.cos(5 * p[:, 1])
            - 0.3 * p[:, 2]
        )

    volume = sampled(height, n, **place)
    return Scene((Field("bent", volume, Material((0.9, 0.6, 0.3)), (0.3, 1.2), "below"),), background=np.ones(3))


def pair():
    """Two fields in a room, one of integers and one of floats."""
    one, other = ball(18, at=(-0.3, 0, 0.1)), ball(15, at=(0.4, -0.2, -0.3))
    whole = one.with_stored(np.round(3000 * one.values))
    fields = (
        Field("one", whole, Material((0.8, 0.4, 0.3)), (2100.0, 3000.0)),
        Field("other", other, Material((0.3, 0.5, 0.8)), (0.7, 1.0)),
    )
    return Scene(fields, box_around(fields[0].volume))


def camera_state(scene, camera):
    """The camera of a still picture, in the form of the page's address."""
    right, front, up = upright(scene.fields[0].volume.direction)
    ahead = camera.forward
    target = Stage.of(scene).place(camera.eye) + ahead
    view = [np.arctan2(-ahead @ right, -ahead @ front), np.arcsin(-ahead @ up), 1.0, *target]
    return ",".join(repr(float(x)) for x in view)


TO = """(address) => new Promise((done) => {
    if (location.hash === `#${address}`) return done();
    addEventListener('hashchange', () => done(), { once: true });
    location.hash = address;
})"""


REST = """(size) => {
    const { resting, put } = illumgrid, begin = resting.begin.bind(resting);
    resting.begin = (state, width, height) => begin(state, width, height, 0);  // whole frames, whatever the clock says
    if (size !== true) resting.trial = resting.targets(...size);
    put({ rest: true });
}"""


def until(page, condition):
    """Wait for a condition; Playwright's own way evaluates text, which the page's policy forbids."""
    end = time.monotonic() + 120
    while not page.evaluate(condition):
        assert time.monotonic() < end, condition
        time.sleep(0.01)
    return page


class Browser:
    """One browser per test module; it records requests and errors."""

    def __init__(self, playwright, folder):
        self.chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGS)
        self.context = self.chromium.new_context(viewport={"width": 600, "height": 700})
        self.context.set_default_timeout(120_000)
        self.context.add_init_script(SMALL)
        self.folder, self.requests, self.troubles, self.shown = folder, [], [], None
        self.page = self.context.new_page()
        self.page.add_init_script(QUICK)
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("pageerror", lambda error: self.troubles.append(str(error)))
        self.page.on("console", lambda said: self.troubles.append(said.text) if said.type == "error" else None)

    def open(self, light, address="", anew=False, rest=False, tint=None, size=(WIDTH, HEIGHT)):
        """Show a light at an address; a page that shows this light already only gets the address. Pictures of lookups
        are compared while no rays refine them; with `rest`, they do, judged in a trial of this size in pixels, or of
        the page's own size.
        """
        address = f"{address}&rest=0" if address else "rest=0"
        if self.shown is light and not anew:
            self.page.evaluate(TO, address)
            return self.settle()
        self.shown = light
        file = self.folder / f"{light.scene.fields[0].name}.html"
        if not file.exists():
            file.write_text(page(light, tint=tint), encoding="utf-8")
        self.page.goto("about:blank")
        self.page.goto("{}?{}x{}#{}".format(file.as_uri(), *size, address))
        self.settle()
        if rest:
            self.page.evaluate(REST, rest)
            self.settle()
        return self.page

    def settle(self):
        return until(self.page, "document.querySelector('canvas').getAttribute('aria-busy') === 'false'")

    def at_rest(self, rays):
        """Pixels once so many rays have left every pixel; no further ones leave."""
        until(self.page, f"illumgrid.resting.rays >= {rays} || illumgrid.resting.done")
        return self.drawn("illumgrid.resting.enough = 0, illumgrid.resting.show(illumgrid.state.stops)")

    def pixels(self):
        self.settle()
        return self.drawn("illumgrid.picture.show()")

    def drawn(self, how):
        script = f"({how}, document.querySelector('canvas').toDataURL())"
        return decoded(base64.b64decode(self.page.evaluate(script).split(",")[1]))


def decoded(file):
    return np.asarray(Image.open(io.BytesIO(file)).convert("RGB")).astype(int)


def still(light, t, size=(WIDTH, HEIGHT), **options):
    """The software picture at a position of the sweep, the page's address for the same view, and the object's mask."""
    scene = light.scene
    row = scene.levels(t)[0]
    camera = fit_camera(scene, row, size[0] / size[1])
    options |= {"width": size[0], "height": size[1], "camera": camera}
    made = preview.render(light, isovalue=row[0], **options).astype(int)
    address = f"isovalue={float(row[0])!r}&view={camera_state(scene, camera)}"
    return made, address, (made != made[0, 0]).any(axis=2)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed (Debian: apt-get install chromium)")
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (pip install playwright)")
    with api.sync_playwright() as playwright:
        held = Browser(playwright, tmp_path_factory.mktemp("page"))
        yield held
        held.chromium.close()
