"""Size of the interactive page for several volumes and grids, and time of a frame in a headless browser.

``python benchmarks/page.py [--repeats 15]`` needs Chromium and playwright. Frames are 320 x 240, drawn in software;
global light, local light and no light take turns, so that a busy machine affects all alike; times are medians. So do
frames under a sky that rests and under one that turns, for skies of degree 2 and 4.
"""

import argparse
import statistics
import tempfile
from pathlib import Path

import numpy as np
from playwright.sync_api import Browser, Page, sync_playwright

from illumgrid.chain import run
from illumgrid.field.layers import in_harmonics
from illumgrid.field.scene import Scene, level_table
from illumgrid.field.volume import Volume
from illumgrid.grid import GridSpec, IlluminationGrid
from illumgrid.light import Illumination
from illumgrid.show.viewer import page

ARGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run", "--disable-sync"]
FRAME = """(light) => {
  const { picture, state } = illumgrid, begun = performance.now();
  picture.sample({ ...state, light }, 320, 240, [0.5, 0.5], 0);
  picture.wait();
  return performance.now() - begun;
}"""

TURNED = """([turn, size]) => {
  const { picture, put, state } = illumgrid, begun = performance.now();
  put({ turn: [turn, turn / 4] });
  const ball = performance.now() - begun;
  picture.mix(state);
  picture.wait();
  const mixed = performance.now() - begun - ball;
  picture.sample(state, ...size, [0.5, 0.5], 0);
  picture.wait();
  return [ball, mixed, performance.now() - begun];
}"""


def scene_of(voxels: int, whole: bool) -> Scene:
    """Smooth noise, which compresses badly: integers from 0 to 255, or float32."""
    from scipy.ndimage import gaussian_filter

    rough = np.random.default_rng(0).standard_normal((voxels,) * 3)
    values = gaussian_filter(rough, voxels / 24)
    values = 128 + 40 * values / values.std()
    values = np.clip(np.round(values), 0, 255) if whole else values
    return Scene.sky(Volume(values), range=(128.0, 180.0))


def light_of(scene: Scene, nodes: int) -> Illumination:
    """Light whose size is that of a real run: smooth, with 3 % noise, independent in each channel."""
    rng = np.random.default_rng(1)
    spec = GridSpec.over(scene.fields[0].volume, nodes)
    values = 2.0 + np.sin(np.indices(spec.shape) / nodes * 9).sum(axis=0)[..., None] * np.ones(3)
    values = np.maximum(values, 0.1) * (1 + 0.03 * rng.standard_normal((*spec.shape, 3)))
    error = 0.03 * np.abs(1 + 0.2 * rng.standard_normal(spec.shape))
    grid = IlluminationGrid(spec, values, error, np.ones(spec.shape))
    return Illumination(scene, level_table(scene, 8), (grid,), (), {"seed": 0})


def sizes() -> None:
    print("voxels  values   nodes   page MB")
    for voxels, nodes in ((64, 64), (128, 64), (128, 96), (192, 96)):
        for whole in (True, False):
            size = len(page(light_of(scene_of(voxels, whole), nodes))) / 1e6
            print(f"{voxels:4d}³   {'uint8 ' if whole else 'float32'}  {nodes:3d}³   {size:6.1f}", flush=True)


def opened(chromium: Browser, folder: str, name: str, text: str) -> tuple[Page, float]:
    """A page that has finished drawing, and the seconds until its first picture."""
    file = Path(folder) / f"{name}.html"
    file.write_text(text, encoding="utf-8")
    shown = chromium.new_page(viewport={"width": 720, "height": 480}, bypass_csp=True)  # waiting takes eval
    shown.goto(file.as_uri())
    shown.wait_for_function("globalThis.illumgrid?.took > 0", timeout=300_000)
    first = shown.evaluate("performance.now()") / 1000
    shown.wait_for_function("document.querySelector('canvas').getAttribute('aria-busy') === 'false'", timeout=300_000)
    return shown, first


def frames(repeats: int) -> None:
    text = page(light_of(scene_of(128, True), 96))
    dark = text.replace("lightOf(texture(uLight, texel))", "vec3(0.5)")
    assert dark != text
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=ARGS)
        lit, first = opened(chromium, folder, "lit", text)
        unlit, _ = opened(chromium, folder, "unlit", dark)
        print(f"\nfirst picture {first:.1f} s after the request")
        kinds = {"global": (lit, "global"), "local": (lit, "local"), "none": (unlit, "global")}
        took: dict[str, list[float]] = {kind: [] for kind in kinds}
        for turn in range(repeats + 1):
            for kind, (shown, light) in kinds.items():
                milliseconds = shown.evaluate(FRAME, light)
                if turn:  # the first is a warm-up
                    took[kind].append(milliseconds)
        for kind in kinds:
            print(f"{kind:7s} {statistics.median(took[kind]):7.1f} ms per frame of 320 x 240")
        for kind in ("local", "none"):
            ratios = [g / other for g, other in zip(took["global"], took[kind])]
            print(f"global / {kind}: {statistics.median(ratios):.3f} (median of {repeats} pairs)")
        chromium.close()


def turning(repeats: int) -> None:
    """Frames while the hand turns the sky: the ball, the mixing of the light, and the whole frame."""
    print("\ndegree  ball ms  mixing ms  frame ms: turning  resting")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=ARGS)
        for degree in (2, 4):
            scene = in_harmonics(scene_of(128, True), degree)
            light = run(scene, grid=96, paths=1, judge=False)
            shown, _ = opened(chromium, folder, f"degree-{degree}", page(light))
            took = [
                [*shown.evaluate(TURNED, [5 * turn, [320, 240]]), shown.evaluate(FRAME, "global")]
                for turn in range(1, repeats + 2)
            ]
            ball, mixed, frame, still = (statistics.median(column) for column in zip(*took[1:]))
            print(f"{degree:6d} {ball:8.1f} {mixed:10.1f} {frame:18.1f} {still:8.1f}", flush=True)
            shown.close()
        chromium.close()


if __name__ == "__main__":
    options = argparse.ArgumentParser()
    options.add_argument("--repeats", type=int, default=15)
    given = options.parse_args()
    sizes()
    frames(given.repeats)
    turning(given.repeats)
