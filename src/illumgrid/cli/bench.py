"""``illumgrid bench``: the speed-accuracy chart on the user's own data."""

from pathlib import Path
from typing import Annotated, Any

import typer

from illumgrid.cli.reading import NONE, with_reading
from illumgrid.cli.terminal import progress_bars, reported_warnings, result, say


@with_reading
def bench(
    source: Annotated[
        str | None,
        typer.Argument(metavar="[INPUT]", help="A volume, scene file or built-in scene, as for run."),
    ] = None,
    limits: Annotated[
        tuple[float, float] | None,
        typer.Option("--range", metavar="LO HI", help="Isovalues to sweep. [default: from the data, as info suggests]"),
    ] = None,
    budget: Annotated[
        float, typer.Option(metavar="S", help="Seconds for the chart; compilation is not counted.")
    ] = 100.0,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Folder for the chart. [default: INPUT-bench]")
    ] = None,
    reading: dict[str, Any] = NONE,
    smooth: Annotated[
        float | None, typer.Option(min=0.0, metavar="SIGMA", help="Gaussian blur in voxels before anything else.")
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, max=2**64 - 1, metavar="N", help="Seed of the contestants and of the reference.")
    ] = 0,
) -> None:
    """Chart seconds against error for all registered stages, and recommend a setting.

    DIR then holds bench.json, bench.csv, chart.png and chart.svg.
    """
    from illumgrid.accuracy.chart import bench as race
    from illumgrid.cli.report import files
    from illumgrid.cli.scenes import scene_input
    from illumgrid.io import disk
    from illumgrid.show.difference import studio

    given = scene_input(source, None, limits, None, False, None, reading)
    folder = output or Path(f"{given.name}-bench")
    disk.claim_new(folder)
    with reported_warnings():
        scene = given.make(smooth or 0.0)
        with progress_bars() as progress:
            default = (given.preset.grid, given.preset.paths) if given.preset else (None, None)
            found = race(scene, budget, seed, progress, default, studio)
        content, text = files(found, given.name, scene)
    result(text)  # first: it stays where the files do not
    disk.write_folder(folder, iter(content.items()))
    say(f"wrote {folder}; look at {folder / 'chart.png'}")
