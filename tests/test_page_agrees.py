"""The resting page gathers, pixel by pixel, what `preview --exact` gathers with as many rays."""

from dataclasses import replace

import numpy as np
import pytest

import illumgrid as ig
from browser import HEIGHT, WIDTH, browser, camera_state  # noqa: F401
from illumgrid.show import fit_camera
from illumgrid.show.engines import software
from illumgrid.show.exact import Exact, Gathering
from illumgrid.show.picture import _shown
from shapes import lit
from test_page_resting import balls

pytestmark = pytest.mark.filterwarnings("default")  # of the browser's driver
RAYS, SEEDS = 16, 24
BAND = range(45, 75)
"""Rows of the picture where rays are gathered in a box, which takes long: enough to show 1 % more light."""
HALF = 2.0**-11
"""Relative rounding of half floats, in which the page holds its grids."""
GATHER = """([rays, below, tall]) => {
  const { resting, state } = illumgrid, { gl } = resting;
  resting.judge = () => {};  // the weight of a lookup is not asked for
  resting.begin(state, gl.canvas.width, gl.canvas.height, 0);
  const { whole } = resting, { width } = whole;
  const places = [[0.25, 0.25], [0.75, 0.75], [0.75, 0.25], [0.25, 0.75]];  // where the package looks within a pixel
  gl.enable(gl.SCISSOR_TEST);
  gl.scissor(0, below, width, tall);
  for (let k = 0; k < rays; k++) resting.gather(whole, state, k, places[k % 4], false);
  const read = (frame) => {
    const into = new Float32Array(4 * width * tall);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.readPixels(0, below, width, tall, gl.RGBA, gl.FLOAT, into);
    return Array.from(into);
  };
  return [read(whole.means[rays % 2].frame), read(resting.raw.frame)];
}"""


def by_page(browser, light, address, rays, rows=BAND):  # noqa: F811
    """Display radiance (rows, w, 3) that rays gathered, without the lookups that the page blends it with."""
    for file in browser.folder.glob("*.html"):  # of another light, whose field has the same name
        file.unlink()
    browser.open(light, address, anew=True)
    assert not browser.troubles
    found = browser.page.evaluate(GATHER, [rays, HEIGHT - rows.stop, len(rows)])
    return sum(np.reshape(a, (len(rows), WIDTH, 4))[::-1, :, :3] for a in found)


def by_package(light, t, rays, seeds, full=False, rows=BAND):
    """The same by so many seeds (s, p, 3), at the pixels (p,) that show one lit surface alone, and the address."""
    row = light.scene.levels(t)[0]
    camera = fit_camera(light.scene, row, WIDTH / HEIGHT)
    made = Gathering(_shown(light, None, float(row[0]), False, False, 0.0), camera, WIDTH, HEIGHT, Exact(rays, full))
    directions = software.directions_of(camera, WIDTH, rows, HEIGHT)
    hits, first = software.first_hits(made.shown, camera.eye, directions), made.seed
    albedo, emission = (
        np.array([getattr(s.material, name) for s in (*light.scene.fields, *light.scene.quads)]) * made.shown.exposure
        for name in ("albedo", "emission")
    )
    found = []
    for seed in range(seeds):
        made.__dict__["seed"] = first + seed
        total, count = np.zeros((len(hits.what), 3), np.float32), np.zeros(len(hits.what), np.int32)
        pixel = made.gather(hits, rows.start, [(0, rays)], total, count)
        mean = [np.bincount(pixel, total[:, c]) / np.maximum(np.bincount(pixel, count), 1) for c in range(3)]
        found.append(np.stack(mean, axis=1))
    number = np.full(len(pixel), -1)
    for k in range(made.surfaces):
        number[hits.lit(k)] = k
    number = number[np.argsort(pixel, kind="stable")].reshape(-1, software.SIDE**2)
    whole = np.flatnonzero((number == number[:, :1]).all(axis=1) & (number[:, 0] >= 0))
    of = number[whole, 0]
    address = f"isovalue={float(row[0])!r}&view={camera_state(light.scene, camera)}"
    return np.array(found)[:, whole] * albedo[of] / np.pi + emission[of], whole, address


def off(one, others):
    """By how many standard errors (p,), one rounding included, an answer is off the mean of others (s, p)."""
    mean, count = others.mean(axis=0), len(others)
    return (one - mean) / np.sqrt(others.var(axis=0, ddof=1) * (1 + 1 / count) + (HALF * mean) ** 2)


@pytest.mark.parametrize("kind", ["studio", "box"])
def test_the_page_gathers_in_each_pixel_what_the_package_does(browser, kind):  # noqa: F811
    """Off by more than four standard errors in no more pixels than one seed of the package is from the others.

    Rays are few and some light is rare, so that a few pixels are, whatever gathers.
    """
    light = ig.run(getattr(ig.Scene, kind)(balls()), grid=10, paths=64, isovalues=3, seed=0, judge=False)
    rows = BAND if kind == "box" else range(HEIGHT)
    seeds, whole, address = by_package(light, 0.5, RAYS, SEEDS, rows=rows)
    seeds, page = seeds.mean(axis=2), by_page(browser, light, address, RAYS, rows).reshape(-1, 3)[whole].mean(axis=1)
    beyond = [(abs(off(seeds[k], np.delete(seeds, k, axis=0))) > 4).sum() for k in range(SEEDS)]
    assert len(whole) > 2000 and (abs(off(page, seeds)) > 4).sum() <= max(beyond)
    means = seeds.mean(axis=1)
    assert abs(page.mean() - means.mean()) < 0.003 * means.mean() + 3 * means.std(ddof=1)


@pytest.mark.parametrize("kind", ["sky", "box"])
def test_rays_are_reflected_once_more_where_light_is_not_to_be_trusted(browser, kind):  # noqa: F811
    """Where the grid is far too dark: what paths of every length find and rays do not is one reflection less."""
    dark = lit(getattr(ig.Scene, kind)(balls(), albedo=(0.8,) * 3), 0.1)
    holes = replace(
        dark, grids=tuple(replace(g, support=0 * g.support) for g in dark.grids),
        walls=tuple(replace(w, support=0 * w.support) for w in dark.walls),
    )  # fmt: skip
    (truth,), whole, address = by_package(dark, 0.5, RAYS, 1, full=True)
    few, more = (by_page(browser, light, address, RAYS).reshape(-1, 3)[whole].mean() for light in (dark, holes))
    few, more, truth = few / dark.exposure, more / holes.exposure, truth.mean() / dark.exposure
    assert few < more < 1.02 * truth and truth - more < 0.8 * (truth - few)
