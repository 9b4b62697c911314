"""``illumgrid info``: what is inside a volume or a finished run."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from illumgrid.cli.told import heard, told_left_out

if TYPE_CHECKING:
    from illumgrid.grid import WallTexture
    from illumgrid.scene import Quad
    from illumgrid.volume import Volume

BLOCKS = " ▁▂▃▄▅▆▇█"


def histogram_line(volume: "Volume", width: int = 64) -> str:
    """Histogram of the finite values in a line of block characters; heights are logarithmic."""
    import numpy as np

    finite = volume.values[np.isfinite(volume.values)]
    counts, _ = np.histogram(finite, width, (np.float64(finite.min()), np.float64(finite.max())))
    height = np.log1p(counts) / max(np.log1p(counts.max()), 1e-9)
    return "".join(BLOCKS[int(np.ceil(h * 8))] for h in height)


def info(
    source: Annotated[
        str, typer.Argument(metavar="DIR|VOLUME", help="A finished run, a volume file or a DICOM folder.")
    ],
) -> None:
    """Tell what is inside a volume or a finished run."""
    from illumgrid import store

    with heard():
        if store.is_run(source):
            _told_run(source)
        else:
            _told_volume(source)


def _told_volume(source: str) -> None:
    from illumgrid.readers import read_volume, volume_name
    from illumgrid.scene import suggest_range
    from illumgrid.volume import finite

    volume = finite(read_volume(source), "above")
    _told_lattice(volume_name(source), volume)
    low, high, why = suggest_range(volume)
    typer.echo(f"  suggested range  {low:.4g} to {high:.4g}: {why}")


def three(numbers: Any) -> str:
    """Coordinates or a colour as text."""
    return ", ".join(f"{x + 0.0:.6g}" for x in numbers)  # no -0


def _told_wall(quad: "Quad", texture: "WallTexture") -> None:
    rows, nv, nu = texture.values.shape[:3]
    typer.echo(f"{quad.name} (wall)")
    typer.echo(f"  corner           {three(quad.corner)}")
    typer.echo(f"  edges            {three(quad.edge_u)}; {three(quad.edge_v)}")
    glow = f", emission {three(quad.material.emission)}" if quad.material.emission.any() else ""
    typer.echo(f"  albedo           {three(quad.material.albedo)}{glow}")
    typer.echo(f"  light            {nu} x {nv} texels, {rows} isovalues")


def _told_lattice(name: str, volume: "Volume") -> None:
    low, high = float(volume.values.min()), float(volume.values.max())
    typer.echo(f"{name}")
    typer.echo(f"  shape            {' x '.join(map(str, volume.shape))} voxels (x, y, z)")
    typer.echo(f"  spacing          {three(volume.spacing)}")
    typer.echo(f"  origin           {three(volume.origin)} (world; for medical formats LPS millimetres)")
    typer.echo(f"  axes             {'; '.join(three(volume.direction[:, axis]) for axis in range(3))}")
    typer.echo(f"  values           {low:.6g} to {high:.6g}")
    typer.echo(f"  histogram        |{histogram_line(volume)}| (logarithmic)")


def _told_run(source: str) -> None:
    from illumgrid.illumination import load

    light = load(source)
    for field, grid in zip(light.scene.fields, light.grids):
        _told_lattice(field.name, field.volume)
        typer.echo(f"  range            {field.range[0]:.6g} to {field.range[1]:.6g}, inside {field.inside}")
        supported = float((grid.support > 0).mean())
        typer.echo(
            f"  light            {' x '.join(map(str, grid.spec.shape))} nodes, {supported:.1%} with light of their own"
        )
    for quad, texture in zip(light.scene.quads, light.walls):
        _told_wall(quad, texture)
    recipe = light.recipe
    names = ", ".join(
        f"{kind} {recipe[kind]['name']}" for kind in ("sampler", "backend", "interpolator") if kind in recipe
    )
    typer.echo(
        f"recipe: {names}, {recipe.get('paths')} paths, {recipe.get('bounces')} bounces, seed {recipe.get('seed')}"
        f"{told_left_out(recipe)}"
    )
    for sentence in recipe.get("warnings", []):
        typer.echo(f"note: {sentence}")
