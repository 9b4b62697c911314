"""Where methods fail: error of every method against parameters that break it.

``python benchmarks/stability.py`` measures for some minutes on two cores and writes the figure and the table of the
page "Where methods fail" into docs/images; ``--only noise`` measures one curve and prints it.
"""

import argparse
import json
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import illumgrid as ig
from illumgrid.accuracy.points import unseen_on_level_sets
from illumgrid.accuracy.reference import begin, converge, errors
from illumgrid.bake.around import look_up
from illumgrid.field.scene import Material, Scene
from illumgrid.field.volume import Volume
from illumgrid.transport.samples import join_queries
from illumgrid.transport.tracer import prepare

METHODS = {
    "direct": ("direct", "nearest"),
    "uniform, nearest": ("uniform", "nearest"),
    "uniform, splat": ("uniform", "splat"),
    "uniform, rbf": ("uniform", "rbf"),
    "adaptive, splat": ("adaptive", "splat"),
}
IMAGES = Path(__file__).parents[1] / "docs" / "images"
N = 28


def hills(n: int = N, seed: int = 0, noise: float = 0.0, flatten: float = 1.0, stretch: float = 1.0) -> Volume:
    """A sum of Gaussians in the unit cube plus white noise; `stretch` makes voxels along z fewer and longer."""
    random = np.random.default_rng(seed)
    shape = np.array([n, n, max(2, round((n - 1) / stretch) + 1)])
    step = 1 / (shape - 1)
    x = np.stack(np.indices(shape), axis=-1) * step
    values = np.zeros(shape)
    for _ in range(20):
        at, width = random.uniform(0.3, 0.7, 3), random.uniform(0.06, 0.1)
        values += np.exp(-((x - at) ** 2).sum(axis=-1) / (2 * width**2))
    values = values / values.max()
    return Volume(values + noise * random.standard_normal(shape), spacing=step)


def sky(volume: Volume, low: float = 0.15, high: float = 0.75) -> Scene:
    """Under a white sky."""
    return Scene.sky(volume, range=(low, high))


def sheet(nodes: float) -> Scene:
    """A plate, `nodes` node spacings thick, lit from above; below it is a black floor."""
    x = (np.stack(np.indices((N, N, N)), axis=-1) - N // 2) / (N / 2)  # a plane of voxels lies in the plate
    depth = np.maximum(np.abs(x[..., 2]) - nodes / N, np.abs(x[..., :2]).max(axis=-1) - 0.8)
    scene = Scene.floor(Volume(-depth), range=(-0.3 * nodes / N, 0.3 * nodes / N))
    return replace(scene, quads=tuple(replace(q, material=Material(np.zeros(3))) for q in scene.quads))


def pair() -> Scene:
    """Two balls that merge at isovalue 0.7."""
    x = (np.stack(np.indices((44, N, N)), axis=-1) - [21.5, 13.5, 13.5]) / 13.5
    distance = [np.linalg.norm(x - [side * 0.5, 0, 0], axis=-1) for side in (-1, 1)]
    return Scene.sky(Volume(1.2 - np.minimum(*distance)), range=(0.5, 0.9))


def power(p: float) -> Scene:
    """1 - r^p: the gradient vanishes towards the centre, faster for larger p."""
    x = (np.stack(np.indices((N, N, N)), axis=-1) - (N - 1) / 2) / (N / 2)
    return Scene.sky(Volume(1 - np.linalg.norm(x, axis=-1) ** p), range=(0.2, 0.98))


def lit(scene: Scene, method: str, levels: int = 12, paths: int = 32, grid: int | None = None) -> "ig.Illumination":
    """The light of a scene, by one of the methods."""
    sampler, interpolator = METHODS[method]
    options = {} if sampler == "direct" else {"count": levels}
    return ig.run(
        scene, sampler=ig.sampler(sampler, **options), interpolator=interpolator, backend="numba", grid=grid,
        paths=paths, judge=False, bounces=3, isovalues=2,
    )  # fmt: skip


def judged(scene: Scene, grids: dict[str, "ig.Illumination"]) -> dict[str, float]:
    """Relative RMSE of each method at points on isovalues that no method visited."""
    tracer = prepare(ig.backend("numba"), scene)
    asked = unseen_on_level_sets(scene, 10, 400, 7)
    truth = converge(begin(tracer, asked, 3, 7), 0.005, 512)
    return {name: errors(look_up(light.grids, truth.queries)[0], truth).rmse for name, light in grids.items()}


def swept(values: list[float], make: Callable[[float], Scene]) -> Iterator[tuple[float, dict[str, float]]]:
    """Errors of all methods for each value of a parameter of the scene."""
    for value in values:
        scene = make(value)
        yield value, judged(scene, {name: lit(scene, name) for name in METHODS})


def by_levels() -> Iterator[tuple[float, dict[str, float]]]:
    """Errors against the number of isovalues that the sampler visits."""
    scene = sky(hills())
    for count in (2, 4, 8, 16, 32, 64):
        yield count, judged(scene, {name: lit(scene, name, levels=count) for name in METHODS})


def by_nodes() -> Iterator[tuple[float, dict[str, float]]]:
    """Errors against nodes per voxel."""
    scene = sky(hills())
    for share in (0.25, 0.5, 1.0, 2.0):
        grid = round(share * (N - 1)) + 1
        yield share, judged(scene, {name: lit(scene, name, grid=grid) for name in METHODS})


def by_paths() -> Iterator[tuple[float, dict[str, float]]]:
    """Errors against paths per query."""
    scene = sky(hills())
    for paths in (1, 2, 4, 16, 64, 256):
        yield paths, judged(scene, {name: lit(scene, name, paths=paths) for name in METHODS})


def by_distance() -> Iterator[tuple[float, dict[str, float]]]:
    """Errors against the distance of the isovalue from a critical one, on both sides."""
    scene = pair()
    grids = {name: lit(scene, name) for name in METHODS}
    tracer = prepare(ig.backend("numba"), scene)
    for off in (0.002, 0.005, 0.01, 0.02, 0.05, 0.1):
        parts = []
        for level in (0.7 - off, 0.7 + off):
            mesh = ig.isosurface(scene.fields[0].volume, level)
            near = mesh.vertices[np.abs(mesh.vertices[:, 0] - 21.5) < 5]  # around the neck
            parts.append(
                ig.Queries.at(scene, near[:: max(1, len(near) // 300)], level=level, first_id=len(parts) << 20)
            )

        asked = join_queries(parts)
        asked = asked[np.flatnonzero(asked.normal.any(axis=1))]
        truth = converge(begin(tracer, asked, 3, 7), 0.005, 512)
        yield off, {n: errors(look_up(light.grids, truth.queries)[0], truth).rmse for n, light in grids.items()}


CURVES: dict[str, tuple[str, Callable[[], Iterator[tuple[float, dict[str, float]]]]]] = {
    "noise": ("standard deviation of white noise / largest value",
              lambda: swept([0.002, 0.01, 0.03, 0.1], lambda s: sky(hills(noise=s)))),
    "sheet": ("thickness of a plate / node spacing", lambda: swept([0.5, 1, 2, 3, 4, 6], sheet)),
    "anisotropy": ("length of a voxel / its width",
                   lambda: swept([1, 2, 4, 6, 10], lambda r: sky(hills(stretch=r)))),
    "gradient": ("exponent p of 1 - r^p", lambda: swept([1, 2, 4, 8, 16], power)),
    "critical": ("distance from a critical isovalue", by_distance),
    "levels": ("isovalues visited", by_levels),
    "nodes": ("nodes per voxel", by_nodes),
    "paths": ("paths per query", by_paths),
}  # fmt: skip


def draw(measured: dict[str, list[tuple[float, dict[str, float]]]]) -> None:
    """One panel per curve."""
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(2, 4, figsize=(14, 6.4), layout="constrained", sharey=True)
    for panel, (name, points) in zip(panels.flat, measured.items()):
        for method, marker in zip(METHODS, "osD^v"):
            error = [y[method] or np.nan for _, y in points]  # errors below that of the reference are not resolved
            panel.plot([x for x, _ in points], error, f"-{marker}", label=method, ms=4, lw=1)
        panel.set(xscale="log", yscale="log", xlabel=CURVES[name][0], title=name)
        panel.set_xticks([x for x, _ in points], [f"{x:g}" for x, _ in points])
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    for panel in panels[:, 0]:
        panel.set_ylabel("relative RMSE at unseen isovalues")
    panels[0, 0].legend(fontsize=8)
    figure.savefig(IMAGES / "stability.png", dpi=110)


def table(measured: dict[str, list[tuple[float, dict[str, float]]]]) -> str:
    """The table that the page includes."""
    lines = ["| parameter | value | " + " | ".join(METHODS) + " |", "|---" * (2 + len(METHODS)) + "|"]
    for name, points in measured.items():
        for value, result in points:
            lines.append(f"| {CURVES[name][0]} | {value:g} | " + " | ".join(f"{result[m]:.3f}" for m in METHODS) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure the curves."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=list(CURVES))
    parser.add_argument("--redraw", action="store_true", help="figure and table from docs/images/stability.json")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    measured: dict[str, list[tuple[float, dict[str, float]]]] = {}
    if asked.redraw:
        measured = json.loads((IMAGES / "stability.json").read_text("utf-8"))
    for name in [] if asked.redraw else CURVES if asked.only is None else [asked.only]:
        measured[name] = list(CURVES[name][1]())
        for value, result in measured[name]:
            print(f"{name:11} {value:8g}  " + "  ".join(f"{m} {e:.4f}" for m, e in result.items()), flush=True)
    if asked.only is None:
        (IMAGES / "stability.json").write_text(json.dumps(measured, indent=1))
        (IMAGES / "stability_table.md").write_text(table(measured))
        draw(measured)


if __name__ == "__main__":
    main()
