"""Files for other programs: arrays as .vti, .nrrd, .exr or .npz; a lit isosurface as .glb or .ply."""

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, cast

from illumgrid.errors import BadInput, shown
from illumgrid.field.volume import Volume
from illumgrid.io import disk
from illumgrid.io.exports import arrays, surface, vti
from illumgrid.io.readers.mesh import read_mesh

if TYPE_CHECKING:
    from illumgrid.bake.accumulator import Progress
    from illumgrid.light import Illumination

LATTICES = {".vti": vti.write, ".nrrd": arrays.write_nrrd, ".exr": arrays.write_exr, ".npz": arrays.write_npz}
FIELDS = {ending: LATTICES[ending] for ending in (".nrrd", ".vti", ".npz")}
"""Formats that `read_volume` reads back with all digits."""
SURFACES = {".glb": surface.write_glb, ".ply": surface.write_ply}


def check(
    path: str | os.PathLike[str],
    isovalue: float | None = None,
    on: str | None = None,
    array: str | None = None,
    onto: str | os.PathLike[str] | None = None,
) -> None:
    """Check that these options of `write` go together; reads and writes nothing.

    Raises
    ------
    BadInput
        If one is unknown, or has no meaning for this kind of file.
    """
    name, ending = Path(path).name, Path(path).suffix.lower()
    if ending not in LATTICES | SURFACES:
        raise BadInput(
            f"the file to write is {name!r}; expected a name that ends in {', '.join(LATTICES)} (the grid) or "
            f"{', '.join(SURFACES)} (one isosurface)"
        )
    if isovalue is not None and not math.isfinite(isovalue):
        raise BadInput(f"the isovalue is {isovalue}; expected a finite number")
    if isovalue is not None and ending in LATTICES:
        raise BadInput(
            f"an isovalue came with {name!r}, which holds the light of every isovalue; leave the isovalue out, or "
            f"write {' or '.join(SURFACES)}"
        )
    if onto is not None and ending in LATTICES:
        raise BadInput(
            f"a mesh came with {name!r}, which holds the light of a lattice; leave it out, or write "
            f"{' or '.join(SURFACES)}"
        )
    if on is not None and ending in SURFACES:
        raise BadInput(
            f"'on' came with {name!r}, which holds an isosurface; leave it out, or write {', '.join(LATTICES)}"
        )
    if on not in (None, "grid", "field"):
        raise BadInput(f"'on' is {on!r}; expected grid or field")
    if array is not None and ending != ".nrrd":
        raise BadInput(f"an array was chosen for {name!r}; only a .nrrd holds a single one: leave it out")
    if array is not None and array not in arrays.NAMES:
        raise BadInput(f"the array is {array!r}; expected one of {', '.join(arrays.NAMES)}")


def write(
    light: "Illumination",
    path: str | os.PathLike[str],
    field: str | None = None,
    isovalue: float | None = None,
    *,
    on: str | None = None,
    array: str | None = None,
    onto: str | os.PathLike[str] | None = None,
    progress: "Progress" = lambda what, done, total: None,
) -> str:
    """Write the light of one field to a file that another program reads.

    Parameters
    ----------
    light : Illumination
    path : str or path-like
        Its ending chooses the format: `.vti`, `.nrrd`, `.exr`, `.npz` hold arrays on a lattice, `.glb` and `.ply` an
        isosurface with the light as colour of its vertices. An existing file is replaced, once the new one is whole.
    field : str, optional
        Which field, by default the first.
    isovalue : float, optional
        Which isosurface, within the range of the field; by default the middle of the range.
    on : {"grid", "field"}, optional
        Where the arrays lie: at the nodes of the illumination grid (default), or at the voxels of the field.
    array : {"irradiance", "error", "support", "field", "color"}, optional
        Which array a `.nrrd` holds; by default the irradiance. The other formats hold all.
    onto : str or path-like, optional
        File of a mesh to light in place of an isosurface that is extracted: see `Illumination.bake`. A `.ply` then has
        the property ``light``, a `.glb` the attribute ``_LIGHT``.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    str
        What was written, in a few words.

    Raises
    ------
    BadInput
        On options that do not go together, an unknown field, an isovalue outside the range of the light or without a
        surface, or a file that cannot be written.
    """
    check(path, isovalue, on, array, onto)
    number = light.scene.number_of(field)
    ending = Path(path).suffix.lower()
    if onto is not None:
        made = surface.lit_onto(light, number, isovalue, read_mesh(onto), Path(onto).suffix.lower() == ".glb")
        with disk.fresh_file(path) as fresh:
            SURFACES[ending](fresh, made)
        return (
            f"{made.field!r} on {len(made.mesh.vertices)} vertices of {Path(onto).name}, exposure {made.exposure:.4g}"
        )
    if ending in SURFACES:
        lit = surface.lit(light, number, isovalue, progress)
        with disk.fresh_file(path) as fresh:
            SURFACES[ending](fresh, lit)
        progress("file", 1, 1)
        count = len(lit.mesh.faces)
        level = shown(cast(float, lit.isovalue), light.scene.fields[number].range, 6)
        return f"isosurface {level} of {lit.field!r}, {count} triangles, exposure {lit.exposure:.4g}"
    names = (array or "irradiance",) if ending == ".nrrd" else arrays.NAMES
    points = arrays.points_of(light, number, on or "grid", names)
    with disk.fresh_file(path) as fresh:
        LATTICES[ending](fresh, points, progress)
    shape = " x ".join(map(str, points.lattice.shape))
    where = "voxels" if on == "field" else "nodes"
    return f"{', '.join(points.kinds)} of {points.field!r} at {shape} {where}"


def check_field(path: str | os.PathLike[str]) -> None:
    """Refuse a name that does not end like a file of a field."""
    if Path(path).suffix.lower() not in FIELDS:
        raise BadInput(f"the file to write is {Path(path).name!r}; expected a name that ends in {', '.join(FIELDS)}")


def write_field(
    volume: Volume,
    path: str | os.PathLike[str],
    name: str,
    progress: "Progress" = lambda what, done, total: None,
) -> None:
    """Write a field without light to a `.nrrd`, `.vti` or `.npz`, as the array "field"; completely or not at all."""
    check_field(path)
    points = arrays.field_alone(volume, name)
    with disk.fresh_file(path) as fresh:
        FIELDS[Path(path).suffix.lower()](fresh, points, progress)
