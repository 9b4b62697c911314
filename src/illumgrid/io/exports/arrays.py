"""The light of a field as arrays on a lattice, and the formats that hold arrays."""

import gzip
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.storing import single_precision_holds
from illumgrid.field.volume import (
    Floats,
    Lattice,
    Volume,
    index_to_world,
    interpolate,
    world_to_index,
)
from illumgrid.tone import curve, encode_srgb

if TYPE_CHECKING:
    from illumgrid.bake.accumulator import Progress
    from illumgrid.light import Illumination

NAMES = ("irradiance", "error", "support", "field", "color")
"""Arrays of every file, in order."""

_AT_ONCE = 1 << 18
"""Points that are looked up together: bounds the memory."""


Index = NDArray[np.integer]
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Points:
    """Arrays on a lattice, all of one field, computed in parts as a file takes them.

    Parameters
    ----------
    field : str
        Name of the field.
    lattice : Lattice
        Where the points lie in the world.
    kinds : dict of dtype
        By name: irradiance (linear RGB, float32), error, support, field (float32 or float64), color (sRGB, uint8).
    at : callable
        Takes names and whole indices (m, 3); returns arrays (m,) or, of irradiance and color, (m, 3).
    albedo : (3,) float64, optional
        Of the field's material; None without light.
    exposure : float, optional
        Exposure of `color`: sRGB of the tone curve of albedo/π · irradiance · exposure.
    """

    field: str
    lattice: Lattice
    kinds: dict[str, np.dtype[Any]]
    at: Callable[[set[str], Index], Arrays]
    albedo: Floats | None = None
    exposure: float | None = None

    def components(self, name: str) -> int:
        """Numbers at each point."""
        return 3 if name in ("irradiance", "color") else 1

    def parts(self, names: Sequence[str], x_fastest: bool, progress: "Progress") -> Iterator[Arrays]:
        """Yield consecutive points, with x running fastest, as in image formats, or z, as in NumPy."""
        shape = self.lattice.shape[::-1] if x_fastest else self.lattice.shape
        count = int(np.prod(shape))
        for first in range(0, count, _AT_ONCE):
            progress("points", first, count)
            index = np.unravel_index(np.arange(first, min(first + _AT_ONCE, count)), shape)
            found = self.at(set(names), np.stack(index[::-1] if x_fastest else index, axis=-1))
            yield {name: found[name].astype(self.kinds[name], copy=False) for name in names}
        progress("points", count, count)


def display_linear(light: "Illumination", number: int, irradiance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Display-linear colour of irradiance (n, 3), before sRGB: the tone curve of albedo/π · E · exposure."""
    factor = light.scene.fields[number].material.albedo / np.pi * light.exposure
    return np.asarray(curve(irradiance * factor), dtype=np.float32)


def points_of(light: "Illumination", number: int, on: str, names: Sequence[str]) -> Points:
    """Arrays of field `number` at the nodes of its grid, or at its voxels."""
    field, grid = light.scene.fields[number], light.grids[number]
    lattice: Lattice = grid.spec if on == "grid" else field.volume
    kinds = dict.fromkeys(NAMES, np.dtype(np.float32)) | {"color": np.dtype(np.uint8), "field": _kind(field.volume)}

    def at(these: set[str], index: Index) -> Arrays:
        return _at(light, number, index_to_world(lattice, index), these)

    return Points(field.name, lattice, {name: kinds[name] for name in names}, at, field.material.albedo, light.exposure)


def field_alone(volume: Volume, name: str) -> Points:
    """The values of a field without light, as the array "field"."""

    def at(these: set[str], index: Index) -> Arrays:
        return {"field": volume.in_units(volume.stored[tuple(index.T)])}

    return Points(name, volume, {"field": _kind(volume)}, at)


def _kind(volume: Volume) -> np.dtype[Any]:
    """Type of the field in a file: double precision if its offset or scale exceeds single precision."""
    return np.dtype(np.float32 if volume.plain or single_precision_holds(*volume.extremes) else np.float64)


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
        here["field"] = interpolate(field.volume, world_to_index(field.volume, world))
    return here


def write_nrrd(path: Path, points: Points, progress: "Progress") -> None:
    """Write the one array of `points`; space left-posterior-superior, directions as in the world; gzip."""
    ((name, kind),) = points.kinds.items()
    lattice = points.lattice
    steps = [_vector(lattice.direction[:, axis] * lattice.spacing[axis]) for axis in range(3)]
    color = points.components(name) == 3
    head = {
        "type": {"f4": "float", "f8": "double", "u1": "uint8"}[kind.str[1:]],
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
    with open(path, "wb") as file:
        file.write("\n".join(lines).encode())
        with gzip.GzipFile(fileobj=file, mode="wb", compresslevel=6, mtime=0) as packed:
            for part in points.parts([name], True, progress):
                packed.write(part[name].astype(kind.newbyteorder("<"), copy=False).tobytes())


def _vector(numbers: Floats) -> str:
    return f"({','.join(repr(float(x)) for x in numbers)})"


def write_exr(path: Path, points: Points, progress: "Progress") -> None:
    """Write an image nx wide and ny·nz high, float32: R, G, B (irradiance), error, support, field."""
    from illumgrid.io import scanlines
    from illumgrid.io.exr import LAYOUT, check_end

    if points.kinds["field"] == np.float64:
        raise BadInput("the field's values need double precision, which .exr lacks; expected .vti, .nrrd or .npz")
    nx, ny, nz = points.lattice.shape
    about = {
        "layout": LAYOUT.format(nx, ny, nz), "origin": points.lattice.origin, "spacing": points.lattice.spacing,
        "direction": points.lattice.direction, "exposure": points.exposure,
    }  # fmt: skip
    shown = [name for name in points.kinds if name != "color"]  # an EXR viewer applies its own tone curve
    channels = {c: np.float32 for name in shown for c in ("RGB" if name == "irradiance" else [name])}
    rows = _whole_rows(points.parts(shown, True, progress), nx)
    scanlines.write(path, [scanlines.Part((nx, nz * ny), channels, rows, about)])
    check_end(path, nz * ny)


def _whole_rows(parts: Iterator[Arrays], width: int) -> Iterator[list[NDArray[Any]]]:
    """Each component of arrays that come in parts, as rows (m, width)."""
    rest: list[NDArray[Any]] = []
    for part in parts:
        columns = [c for array in part.values() for c in (array.T if array.ndim == 2 else [array])]
        rest = [np.concatenate(pair) for pair in zip(rest, columns)] if rest else columns
        many = len(rest[0]) // width * width
        yield [column[:many].reshape(-1, width) for column in rest]
        rest = [column[many:] for column in rest]


def write_npz(path: Path, points: Points, progress: "Progress") -> None:
    """Write the arrays, indexed [x, y, z], and their placement, one after the other, as a ZIP needs them."""
    lattice = points.lattice
    place: dict[str, Any] = {name: getattr(lattice, name) for name in ("origin", "spacing", "direction")}
    if points.albedo is not None and points.exposure is not None:
        place |= {"albedo": points.albedo, "exposure": np.float64(points.exposure)}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, allowZip64=True) as pack:
        for number, (name, kind) in enumerate(points.kinds.items()):

            def so_far(what: str, done: int, total: int, number: int = number) -> None:
                progress(what, number * total + done, len(points.kinds) * total)

            several = (3,) if points.components(name) == 3 else ()
            about = {"descr": np.lib.format.dtype_to_descr(kind), "fortran_order": False}
            with pack.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, about | {"shape": (*lattice.shape, *several)})
                for part in points.parts([name], False, so_far):
                    member.write(part[name].tobytes())
        for name, value in place.items():
            with pack.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.asarray(value), allow_pickle=False)
