"""The light of a field as arrays on a lattice, and the formats that hold arrays."""

import gzip
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats, Lattice, index_to_world, interpolate, world_to_index
from illumgrid.tone import curve, encode_srgb

if TYPE_CHECKING:
    from illumgrid.bake import Progress
    from illumgrid.light import Illumination

NAMES = ("irradiance", "error", "support", "field", "color")
"""What each point carries, in the order of the files."""

_AT_ONCE = 1 << 18
"""Points that are looked up together: bounds the memory."""


@dataclass(frozen=True, eq=False)
class Points:
    """Arrays (nx, ny, nz) or (nx, ny, nz, 3) on a lattice, all of one field.

    Parameters
    ----------
    field : str
        Name of the field.
    lattice : Lattice
        Where the points lie in the world.
    arrays : dict of array
        By name: irradiance (linear RGB, float32), error, support, field (float32), color (sRGB, uint8).
    albedo : (3,) float64, optional
        Of the field's material; None where there is no light.
    exposure : float, optional
        What `color` was exposed by: sRGB of the tone curve of albedo/π · irradiance · exposure.
    """

    field: str
    lattice: Lattice
    arrays: dict[str, NDArray[Any]]
    albedo: Floats | None = None
    exposure: float | None = None


def display_linear(light: "Illumination", number: int, irradiance: NDArray[np.float32]) -> NDArray[np.float32]:
    """What a screen shows of irradiance (n, 3), before sRGB: the tone curve of albedo/π · E · exposure."""
    factor = light.scene.fields[number].material.albedo / np.pi * light.exposure
    return np.asarray(curve(irradiance * factor), dtype=np.float32)


def points_of(light: "Illumination", number: int, on: str, names: Sequence[str], progress: "Progress") -> Points:
    """Arrays of field `number` at the nodes of its grid, or at its voxels."""
    field, grid = light.scene.fields[number], light.grids[number]
    lattice: Lattice = grid.spec if on == "grid" else field.volume
    count = int(np.prod(lattice.shape))
    found: dict[str, list[NDArray[Any]]] = {name: [] for name in names}
    for first in range(0, count, _AT_ONCE):
        progress("points", first, count)
        flat = np.arange(first, min(first + _AT_ONCE, count))
        world = index_to_world(lattice, np.stack(np.unravel_index(flat, lattice.shape), axis=-1))
        here = _at(light, number, world, set(names))
        for name in names:
            found[name].append(here[name])
    progress("points", count, count)
    shaped = {name: np.concatenate(parts) for name, parts in found.items()}
    shaped = {name: array.reshape(*lattice.shape, *array.shape[1:]) for name, array in shaped.items()}
    return Points(field.name, lattice, shaped, field.material.albedo, light.exposure)


def _at(light: "Illumination", number: int, world: Floats, names: set[str]) -> dict[str, NDArray[Any]]:
    """The arrays (n,) or (n, 3) at world points (n, 3)."""
    field, grid = light.scene.fields[number], light.grids[number]
    here: dict[str, NDArray[Any]] = {}
    if names & {"irradiance", "color"}:
        here["irradiance"] = grid.lookup(world)
        here["color"] = encode_srgb(display_linear(light, number, here["irradiance"]))
    if names & {"error", "support"}:
        here["error"], here["support"] = grid.certainty(world)
    if "field" in names:
        values = interpolate(field.volume, world_to_index(field.volume, world))
        # Where the field has an offset or scale that single precision does not hold, nor does the file.
        plain = field.volume.slope == 1 and field.volume.intercept == 0
        here["field"] = values.astype(np.float32) if plain else values
    return here


def x_fastest(array: NDArray[Any]) -> NDArray[Any]:
    """(nx, ny, nz, ...) as (nz, ny, nx, ...): in memory x runs fastest, as image formats want it."""
    return np.ascontiguousarray(array.swapaxes(0, 2))


def write_nrrd(path: Path, points: Points, progress: "Progress") -> None:
    """Write the one array of `points`; space left-posterior-superior, directions as in the world; gzip."""
    ((name, array),) = points.arrays.items()
    progress("file", 0, 1)
    lattice = points.lattice
    steps = [_vector(lattice.direction[:, axis] * lattice.spacing[axis]) for axis in range(3)]
    color = array.ndim == 4
    head = {
        "type": {"f4": "float", "f8": "double", "u1": "uint8"}[array.dtype.str[1:]],
        "dimension": 4 if color else 3,
        "space": "left-posterior-superior",
        "sizes": " ".join(map(str, (3, *lattice.shape) if color else lattice.shape)),
        "space directions": " ".join(["none", *steps] if color else steps),
        "kinds": f"{'vector ' if color else ''}domain domain domain",
        "endian": "little",
        "encoding": "gzip",
        "space origin": _vector(lattice.origin),
    }
    about = {"illumgrid array": name, "illumgrid field": points.field}
    if name == "color":
        about["illumgrid exposure"] = repr(points.exposure)
    lines = ["NRRD0004", *(f"{k}: {v}" for k, v in head.items()), *(f"{k}:={v}" for k, v in about.items()), "", ""]
    data = x_fastest(array).astype(array.dtype.newbyteorder("<"), copy=False)
    with open(path, "wb") as file:
        file.write("\n".join(lines).encode())
        with gzip.GzipFile(fileobj=file, mode="wb", compresslevel=6, mtime=0) as packed:
            packed.write(data.data)
    progress("file", 1, 1)


def _vector(numbers: Floats) -> str:
    return f"({','.join(repr(float(x)) for x in numbers)})"


def write_exr(path: Path, points: Points, progress: "Progress") -> None:
    """Write an image nx wide and ny·nz high, float32: R, G, B (irradiance), error, support, field."""
    import OpenEXR

    from illumgrid.io.exr import LAYOUT

    if points.arrays["field"].dtype == np.float64:
        raise BadInput("the field's values need double precision, which .exr lacks; expected .vti, .nrrd or .npz")
    nx, ny, nz = points.lattice.shape
    progress("file", 0, 1)
    header = {
        "type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, "layout": LAYOUT.format(nx, ny, nz),
        "origin": points.lattice.origin, "spacing": points.lattice.spacing, "direction": points.lattice.direction,
        "exposure": points.exposure,
    }  # fmt: skip
    channels = {
        "RGB" if name == "irradiance" else name: x_fastest(array.astype(np.float32, copy=False)).reshape(
            nz * ny, nx, *array.shape[3:]
        )
        for name, array in points.arrays.items()
        if name != "color"  # an EXR viewer makes its own
    }
    OpenEXR.File(header, channels).write(str(path))
    # The library flushes where it cannot report a full disk, and leaves out channels that it cannot read back: look.
    if {*OpenEXR.File(str(path)).channels()} != {*channels}:
        raise BadInput("what was written cannot be read back, the disk may be full")
    progress("file", 1, 1)


def write_npz(path: Path, points: Points, progress: "Progress") -> None:
    """Write the arrays, indexed [x, y, z], and where they lie."""
    lattice = points.lattice
    progress("file", 0, 1)
    place: dict[str, Any] = {name: getattr(lattice, name) for name in ("origin", "spacing", "direction")}
    if points.albedo is not None and points.exposure is not None:
        place |= {"albedo": points.albedo, "exposure": np.float64(points.exposure)}
    with path.open("wb") as file:  # to a name that ends otherwise, as in .NPZ, NumPy adds .npz
        np.savez_compressed(file, **(points.arrays | place))
    progress("file", 1, 1)
