"""``illumgrid bench``: the speed-accuracy chart on the user's own data."""

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from illumgrid.cli.terminal import progress_bars, reported_warnings, say

if TYPE_CHECKING:
    from illumgrid.accuracy.chart import Report
    from illumgrid.field.scene import Scene


def bench(
    source: Annotated[
        str | None,
        typer.Argument(metavar="[INPUT]", help="What run takes: a volume, scene file or built-in scene."),
    ] = None,
    limits: Annotated[
        tuple[float, float] | None,
        typer.Option("--range", metavar="LO HI", help="Isovalues to sweep. [default: from the data, as info suggests]"),
    ] = None,
    budget: Annotated[float, typer.Option(metavar="S", help="Seconds, from compiled kernels on.")] = 100.0,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Where the chart goes. [default: INPUT-bench]")
    ] = None,
    smooth: Annotated[
        float | None, typer.Option(min=0.0, metavar="SIGMA", help="Gaussian blur in voxels before anything else.")
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, max=2**64 - 1, metavar="N", help="Of the contestants and the reference.")
    ] = 0,
) -> None:
    """Chart seconds against error for everything that is registered, and say which setting to use.

    DIR then holds bench.json, bench.csv, chart.png and chart.svg.
    """
    from illumgrid.accuracy.chart import bench as race
    from illumgrid.cli.run import _input
    from illumgrid.constants import PATHS
    from illumgrid.io import store
    from illumgrid.show.difference import studio

    given = _input(source, None, limits, None, None, {})
    folder = output or Path(f"{given.name}-bench")
    store.claim_new(folder)
    with reported_warnings():
        scene = given.make(smooth or 0.0)
        with progress_bars() as progress:
            default = (given.preset.grid, given.preset.paths) if given.preset else (None, PATHS)
            found = race(scene, budget, seed, progress, default, studio)
        content, text = files(found, given.name, scene)
    store.write_folder(folder, iter(content.items()))
    typer.echo(text)
    say(f"wrote {folder}; look at {folder / 'chart.png'}")


def files(report: "Report", name: str, scene: "Scene") -> tuple[dict[str, bytes], str]:
    """Content of every file, and the text for the terminal."""
    from illumgrid.accuracy.chart.report import described
    from illumgrid.show import chart

    made = described(report, name, scene)
    records, points = made["points"], max(about["points"] for about in made["truth"].values())
    title = f"{name}: {report.bounces} bounces, reference at {points} points"
    figure = chart.draw(records, made["parts"], title)
    content = {
        "bench.json": json.dumps(made, indent=1).encode() + b"\n",
        "bench.csv": _csv(records),
        "chart.png": chart.image(figure, "png"),
        "chart.svg": chart.image(figure, "svg"),
    }
    notes = [f"note: {note}" for note in report.notes]
    return content, "\n".join([table(records), *notes, f"{name}: " + "; ".join(made["advice"])])


def _csv(records: Sequence[dict[str, Any]]) -> bytes:
    text = io.StringIO()
    columns = [key for key in records[0] if key != "options"]
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue().encode()


def table(records: Sequence[dict[str, Any]]) -> str:
    """The front, what `run` does by default, and the best of every other contestant, as text."""
    best = sorted((r for r in records if r["front"]), key=lambda r: r["seconds"])
    default = [r for r in records if r["default"] and not r["front"]]
    seen, others = {r["contestant"] for r in best}, []
    for r in sorted(records, key=lambda r: r["rmse"]):
        if r["contestant"] not in seen:
            seen.add(r["contestant"])
            others.append(r)
    wide = max(len(r["contestant"]) for r in records)
    heads = [f"{head:>8}" for head in ("seconds", "error", "+-", "median", "95 %", "bias", "FLIP", "MB")]
    lines = [f"{'contestant':{wide}} {'grid':>5} {'paths':>6} {' '.join(heads)}"]
    for name, part in (("the front:", best), ("run's default:", default), ("the best of the others:", others)):
        lines += [name] * bool(part)
        for r in part:
            spread = "" if r["rmse_spread"] is None else f"{r['rmse_spread']:.2%}"
            seconds = f"{'' if r['built'] else '~'}{r['seconds']:.2f}"
            setting = f"{r['contestant']:{wide}} {r['grid']:5} {r['paths']:6} {seconds:>8}"
            off = f"{r['rmse']:8.2%} {spread:>8} {r['median']:8.2%} {r['p95']:8.2%} {r['bias']:+8.2%}"
            flip = "" if r["flip"] is None else f"{r['flip']:.4f}"
            memory = "" if r["memory_mb"] is None else f"{r['memory_mb']:.0f}"
            lines.append(f"{setting} {off} {flip:>8} {memory:>8}".rstrip())
    return "\n".join(lines)
