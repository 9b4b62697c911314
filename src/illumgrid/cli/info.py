"""``illumgrid info``: the content of a volume or a finished run."""

import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from illumgrid.cli.reading import Array, Channel, Crop, Downsample, Label, Spacing, Time, check_inside, given, labels_of
from illumgrid.cli.terminal import Ignore, omitted_light, reported_warnings, result

if TYPE_CHECKING:
    from illumgrid.field.scene import Quad
    from illumgrid.field.volume import Side, Volume
    from illumgrid.grid import WallTexture

BLOCKS = " ▁▂▃▄▅▆▇█"
PLAIN = " .:-=+*#@"
"""Where the terminal or the pipe has no block characters."""


def histogram_line(volume: "Volume", width: int = 64) -> str:
    """Histogram of the finite values in a line of block characters; heights are logarithmic."""
    import numpy as np

    from illumgrid.field.volume import histogram

    counts, _ = histogram(volume, width)
    height = np.log1p(counts) / max(np.log1p(counts.max()), 1e-9)
    marks = BLOCKS
    try:
        BLOCKS.encode(sys.stdout.encoding or "utf-8")
    except (UnicodeEncodeError, LookupError):
        marks = PLAIN
    return "".join(marks[int(np.ceil(h * 8))] for h in height)


def info(
    source: Annotated[
        str, typer.Argument(metavar="DIR|VOLUME", help="A finished run, a volume file or a DICOM folder.")
    ],
    limits: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--range", metavar="LO HI", help="Isovalues to sweep, for the warnings. [default: the suggested range]"
        ),
    ] = None,
    inside: Annotated[
        str | None, typer.Option(help="Which side of the isovalue is solid: above, below. [default: above]")
    ] = None,
    spacing: Spacing = None,
    channel: Channel = None,
    time: Time = None,
    array: Array = None,
    label: Label = None,
    crop: Crop = None,
    downsample: Downsample = None,
    ignore: Ignore = None,
) -> None:
    """Describe a volume or a finished run; for a volume, suggest a range and warn of what will limit the result."""
    from illumgrid.errors import BadInput
    from illumgrid.io import store

    check_inside(inside, label)
    reading = given(
        spacing=spacing, channel=channel, time=time, array=array, label=label, crop=crop, downsample=downsample
    )
    with reported_warnings(ignore):
        if not store.is_run(source):
            _describe_volume(source, limits, "below" if inside == "below" else "above", reading)
        elif extra := given(range=limits, inside=inside, **reading):
            options = ", ".join(f"--{option}" for option in extra)
            raise BadInput(
                f"{options} came with the finished run {source}; expected a volume file with them; leave them out"
            )
        else:
            _describe_run(source)


def _describe_volume(source: str, limits: tuple[float, float] | None, inside: "Side", reading: dict[str, Any]) -> None:
    from illumgrid.errors import BadInput, shown, shown_range, tell
    from illumgrid.field.boundaries import has_both_signs, suggest_magnitudes, suggest_range
    from illumgrid.field.diagnosis import critical_isovalues, diagnose, plateaus
    from illumgrid.field.labels import around_zero
    from illumgrid.field.lattice import nodes_over
    from illumgrid.field.scene import Field
    from illumgrid.field.volume import finite
    from illumgrid.io import needs
    from illumgrid.io.readers import read_volume, volume_name

    labels = labels_of(reading.pop("label", None))
    if len(labels) > 1:
        raise BadInput(f"--label holds {len(labels)} labels; expected one for info; ask for one after another")
    volume = finite(read_volume(source, **reading, label=labels[0] if labels else None), inside)
    needs.check("info", needs.TO_DESCRIBE * volume.values.size, "cut or --downsample the volume")
    _describe_lattice(volume_name(source), volume)
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


def _describe_wall(quad: "Quad", texture: "WallTexture") -> None:
    rows, nv, nu = texture.values.shape[:3]
    result(f"{quad.name} (wall)")
    result(f"  corner           {three(quad.corner)}")
    result(f"  edges            {three(quad.edge_u)}; {three(quad.edge_v)}")
    glow = f", emission {three(quad.material.emission)}" if quad.material.emission.any() else ""
    result(f"  albedo           {three(quad.material.albedo)}{glow}")
    result(f"  light            {nu} x {nv} texels, {rows} isovalues")


def _describe_lattice(name: str, volume: "Volume") -> None:
    from illumgrid.errors import shown_range

    result(f"{name}")
    result(f"  shape            {' x '.join(map(str, volume.shape))} voxels (x, y, z)")
    result(f"  spacing          {three(volume.spacing)}{f' {volume.unit}' if volume.unit else ''}")
    result(f"  origin           {three(volume.origin)} (world; for medical formats LPS millimetres)")
    result(f"  axes             {'; '.join(three(volume.direction[:, axis]) for axis in range(3))}")
    result(f"  values           {shown_range(volume.extremes, 6)}")
    result(f"  histogram        |{histogram_line(volume)}| (logarithmic)")


def _describe_run(source: str) -> None:
    from illumgrid.chain import load
    from illumgrid.errors import shown_range

    light = load(source)
    for field, grid in zip(light.scene.fields, light.grids):
        _describe_lattice(field.name, field.volume)
        result(f"  range            {shown_range(field.range, 6)}, inside {field.inside}")
        supported = float((grid.support > 0).mean())
        result(
            f"  light            {' x '.join(map(str, grid.spec.shape))} nodes, {supported:.1%} with light of their own"
        )
    for quad, texture in zip(light.scene.quads, light.walls):
        _describe_wall(quad, texture)
    recipe = light.recipe
    names = ", ".join(
        f"{kind} {recipe[kind]['name']}" for kind in ("sampler", "backend", "interpolator") if kind in recipe
    )
    result(
        f"recipe: {names}, {recipe.get('paths')} paths, {recipe.get('bounces')} bounces, seed {recipe.get('seed')}"
        f"{omitted_light(recipe)}"
    )
    for sentence in recipe.get("warnings", []):
        result(f"note: {sentence}")
