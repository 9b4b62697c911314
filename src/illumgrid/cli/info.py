"""``illumgrid info``: the content of a volume or a finished run."""

import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from illumgrid.cli.reading import NONE, check_inside, given, labels_of, with_reading
from illumgrid.cli.terminal import Ignore, omitted_light, reported_warnings, result

if TYPE_CHECKING:
    from collections.abc import Sequence

    from illumgrid.field.volume import Side

BLOCKS = " ▁▂▃▄▅▆▇█"
PLAIN = " .:-=+*#@"
"""For terminals and pipes without block characters."""

MOST = 1 << 27
"""Voxels: a larger image is described from a coarser resolution of it, if the file has one and none is chosen."""


def histogram_line(counts: "Sequence[int]") -> str:
    """Histogram in a line of block characters; heights are logarithmic."""
    import numpy as np

    height = np.log1p(counts) / max(np.log1p(max(counts)), 1e-9)
    marks = BLOCKS
    try:
        BLOCKS.encode(sys.stdout.encoding or "utf-8")
    except (UnicodeEncodeError, LookupError):
        marks = PLAIN
    return "".join(marks[int(np.ceil(h * 8))] for h in height)


@with_reading
def info(
    source: Annotated[
        str, typer.Argument(metavar="DIR|VOLUME", help="A finished run, a volume file or a DICOM folder.")
    ],
    limits: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--range", metavar="LO HI", help="Isovalues to examine for warnings. [default: the suggested range]"
        ),
    ] = None,
    inside: Annotated[
        str | None, typer.Option(help="Which side of the isosurface is solid: above or below. [default: above]")
    ] = None,
    reading: dict[str, Any] = NONE,
    ignore: Ignore = None,
) -> None:
    """Describe a volume or a finished run; for a volume, suggest a range and warn of expected problems."""
    from illumgrid.errors import BadInput
    from illumgrid.io import store

    check_inside(inside, reading.get("label"))
    with reported_warnings(ignore):
        if not store.is_run(source):
            _describe_volume(source, limits, "below" if inside == "below" else "above", reading)
        elif extra := given(range=limits, inside=inside, **reading):
            options = ", ".join(f"--{option}" for option in extra)
            raise BadInput(f"{options} came with the finished run {source}; expected a volume file, or no such options")
        else:
            _describe_run(source)


def _describe_volume(source: str, limits: tuple[float, float] | None, inside: "Side", reading: dict[str, Any]) -> None:
    from illumgrid.errors import BadInput, shown, shown_range, tell
    from illumgrid.field.boundaries import has_both_signs, suggest_magnitudes, suggest_range
    from illumgrid.field.diagnosis import critical_isovalues, diagnose
    from illumgrid.field.filters import finite
    from illumgrid.field.labels import around_zero
    from illumgrid.field.lattice import nodes_over
    from illumgrid.field.plateaus import plateaus
    from illumgrid.field.scene import Field
    from illumgrid.field.volume import histogram
    from illumgrid.io import needs
    from illumgrid.io.readers import read_volume, volume_name
    from illumgrid.io.record import BINS

    labels = labels_of(reading.pop("label", None))
    if len(labels) > 1:
        raise BadInput(f"--label holds {len(labels)} labels; expected one; call info for each of them")
    enough = None if labels or {"crop", "downsample"} & set(reading) else MOST
    volume = finite(read_volume(source, **reading, label=labels[0] if labels else None, most=enough), inside)
    needs.check("info", needs.of_field(volume.stored.size, needs.TO_DESCRIBE), "cut or --downsample the volume")
    _describe_lattice(volume_name(source), volume, histogram(volume, BINS)[0].tolist(), volume.extremes)
    low, high, why = suggest_range(volume, inside)
    if labels:
        (low, high), why = around_zero(volume), "a voxel outside to a voxel inside the surface of the label"
    result(f"  suggested range  {shown_range((low, high))}: {why}")
    if has_both_signs(volume) and not labels:
        least, most, _ = suggest_magnitudes(volume)
        result(f"  both signs       run --signed --range {shown(least)} {shown(most)} lights the surfaces at +c and -c")
    field = Field(volume_name(source), volume, range=(low, high) if limits is None else limits, inside=inside)  # type: ignore[arg-type]
    known = plateaus(volume)
    if flat := sorted(known, key=lambda one: -one[1]):
        values = ", ".join(
            f"{shown(value, volume.extremes, 6)} ({share:.1%} of the cells)" for value, share, _ in flat[:6]
        )
        result(f"  plateaus         {values}{f', and {len(flat) - 6} more' if len(flat) > 6 else ''}")
    for at, what in critical_isovalues(field):
        result(f"  critical         {shown(at, field.range)}: {what}")
    for finding in diagnose(field, nodes_over(volume), flat=known):
        tell(finding.name, finding.sentence)


def three(numbers: Any) -> str:
    """Coordinates or a colour as text."""
    return ", ".join(f"{x + 0.0:.6g}" for x in numbers)  # no -0


def _describe_wall(about: dict[str, Any], rows: int) -> None:
    result(f"{about['name']} (wall)")
    result(f"  corner           {three(about['corner'])}")
    result(f"  edges            {three(about['edge_u'])}; {three(about['edge_v'])}")
    glow = f", emission {three(about['emission'])}" if any(about["emission"]) else ""
    result(f"  albedo           {three(about['albedo'])}{glow}")
    result(f"  light            {' x '.join(map(str, about['texels']))} texels, {rows} isovalues")


def _describe_lattice(
    name: str, lattice: Any, counts: "Sequence[int]", ends: tuple[float, float], unit: str | None = None
) -> None:
    from illumgrid.errors import shown_range

    unit = getattr(lattice, "unit", unit)
    result(f"{name}")
    result(f"  shape            {' x '.join(map(str, lattice.shape))} voxels (x, y, z)")
    result(f"  spacing          {three(lattice.spacing)}{f' {unit}' if unit else ''}")
    result(f"  origin           {three(lattice.origin)} (world; for medical formats LPS millimetres)")
    result(f"  axes             {'; '.join(three(lattice.direction[:, axis]) for axis in range(3))}")
    result(f"  values           {shown_range(ends, 6)}")
    result(f"  histogram        |{histogram_line(counts)}| (logarithmic)")


def _describe_run(source: str) -> None:
    from illumgrid.errors import shown_range
    from illumgrid.field.lattice import GridSpec
    from illumgrid.io import store
    from illumgrid.io.record import PLACE

    record = store.describe(source)
    for about in record["scene"]["fields"]:
        lattice, grid = GridSpec(*(about[key] for key in ("shape", *PLACE))), record["grids"][about["name"]]
        _describe_lattice(about["name"], lattice, about["histogram"], about["extremes"], about["unit"])
        held, swept = about.get("isovalue"), shown_range(about["range"], 6)
        place = f"range            {swept}" if held is None else f"held at          {held:g}"
        result(f"  {place}, inside {about['inside']}")
        nodes = " x ".join(map(str, grid["shape"]))
        result(f"  light            {nodes} nodes, {grid['lit']:.1%} with light of their own")
    for quad in record["scene"]["quads"]:
        _describe_wall(quad, len(record["levels"]))
    recipe = record["recipe"]
    names = ", ".join(
        f"{kind} {recipe[kind]['name']}" for kind in ("sampler", "backend", "interpolator") if kind in recipe
    )
    result(
        f"recipe: {names}, {recipe.get('paths')} paths, {recipe.get('bounces')} bounces, seed {recipe.get('seed')}"
        f"{omitted_light(recipe)}"
    )
    for sentence in recipe.get("warnings", []):
        result(f"note: {sentence}")
