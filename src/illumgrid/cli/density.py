"""``illumgrid density``: a field from a list of points."""

from pathlib import Path
from typing import Annotated, Any

import typer

from illumgrid.cli.terminal import progress_bars, reported_warnings, say
from illumgrid.errors import BadInput


def density(
    points: Annotated[
        Path, typer.Argument(metavar="POINTS", help="Points: .csv .txt .npy .xyz .pdb .cif, each also gzipped.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="File to write: .nrrd .vti .npz.")],
    spacing: Annotated[float, typer.Option(metavar="H", help="Distance between voxels.")],
    sigma: Annotated[float, typer.Option(metavar="S", help="Standard deviation of the Gaussian, in units of length.")],
    weights: Annotated[
        str | None,
        typer.Option(metavar="COLUMN", help="Column of the masses: name, or number from 0. [default: 1 each]"),
    ] = None,
    columns: Annotated[
        tuple[str, str, str] | None,
        typer.Option(metavar="X Y Z", help="Columns of the coordinates. [default: x y z, or the first three]"),
    ] = None,
    cell: Annotated[
        str | None,
        typer.Option(metavar="file|L,L,L", help="Periodic cell: that of the file, or its lengths. [default: none]"),
    ] = None,
) -> None:
    """Make a field from a list of points: each is a mass, spread by a Gaussian.

    The values are mass per volume. Atoms of PDB and mmCIF files count by their occupancy; --weights mass, number or
    b_factor selects another weight.
    """
    from illumgrid.errors import shown_range
    from illumgrid.io import exports
    from illumgrid.io.points import density_of_file

    exports.check_field(output)
    if points.exists() and output.exists() and output.samefile(points):
        raise BadInput(f"{output} is the list of points itself; expected another name for the field")
    with reported_warnings(), progress_bars() as progress:
        volume = density_of_file(
            points, spacing=spacing, sigma=sigma, weights=weights, columns=columns, cell=_lengths(cell)
        )
        exports.write_field(volume, output, points.name, progress)
    size = " x ".join(map(str, volume.shape))
    say(f"wrote {output}: density, {size} voxels, {shown_range(volume.extremes)}")


def _lengths(cell: str | None) -> Any:
    """The cell from what was typed: file, 10 or 10,12,9."""
    if cell is None or cell == "file":
        return cell
    try:
        lengths = [float(word) for word in cell.split(",")]
    except ValueError:
        lengths = []
    if len(lengths) not in (1, 3):
        raise BadInput(f"--cell is {cell!r}; expected file, or lengths such as 10 or 10,12,9")
    return lengths * (3 // len(lengths))
