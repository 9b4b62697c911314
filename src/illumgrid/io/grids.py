"""Illumination grids as parts of an EXR file: all nodes of a lattice, or blocks of nodes and where they lie."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.lattice import GridSpec
from illumgrid.grid import Channels, IlluminationGrid
from illumgrid.grid.blocks import SIDE, laid_out
from illumgrid.grid.illumination import Held
from illumgrid.io import exr

Images = dict[str, tuple[exr.Planned, dict[str, exr.Rows]]]
PLACES = ("x", "y", "z", "step")
"""Of a block: its first node in the finest lattice, and the distance of its nodes in spacings of that lattice."""
MOST_BLOCKS = 2**24  # whose numbers single precision still counts
_NODES = (SIDE + 1) ** 3


def errors_of(channels: Channels) -> list[str]:
    """Names of the channels of a file that hold the errors of lights that are stored separately."""
    return [f"{name}.error" for name in channels.names] if channels.mixable else []


def _names(channels: Channels) -> tuple[str, ...]:
    return (*channels.names, *errors_of(channels), "error", "support")


def blocks_of(grid: IlluminationGrid) -> int:
    """Number of blocks that are written; 0 for all nodes of the lattice."""
    layout = grid.held.layout
    return 0 if layout.dense or (layout.side != SIDE).any() else len(layout)


def planned(name: str, shape: tuple[int, int, int], channels: Channels, blocks: int) -> dict[str, exr.Planned]:
    """The parts that hold a grid."""
    if not blocks:
        return {f"light/{name}": exr.Planned(shape, _names(channels))}
    return {
        f"light/{name}": exr.Planned((_NODES, blocks, 1), _names(channels)),
        f"blocks/{name}": exr.Planned((len(PLACES), blocks, 1), ("Y",)),
    }


def count_of(about: Mapping[str, Any]) -> int:
    """The number of blocks of a grid in a record, 0 for none.

    Raises
    ------
    BadInput
        If it is no such number.
    """
    count = about.get("blocks", 0)
    if not (isinstance(count, int) and 0 <= count <= MOST_BLOCKS):
        raise BadInput(f"{str(count)[:40]!r} blocks of nodes came; expected a whole number up to {MOST_BLOCKS}")
    return count


def images(name: str, grid: IlluminationGrid) -> Images:
    """The parts of a grid, as `planned` has them."""
    count = blocks_of(grid)
    if not count:
        return {f"light/{name}": lattice(grid)}
    layout, light, error, support, errors = grid.held
    arrays = {c: light[..., k] for k, c in enumerate(grid.channels.names)} | {"error": error, "support": support}
    if names := errors_of(grid.channels):
        errors = np.full(light.shape, np.inf, np.float32) if errors is None else errors
        arrays |= {c: errors[..., k] for k, c in enumerate(names)}
    places = np.concatenate([layout.corner, layout.step[:, None]], axis=1).astype(np.float32)
    plan = planned(name, grid.spec.shape, grid.channels, count)
    return {
        f"light/{name}": (plan[f"light/{name}"], {c: a.reshape(count, _NODES) for c, a in arrays.items()}),
        f"blocks/{name}": (plan[f"blocks/{name}"], {"Y": places}),
    }


def lattice(grid: IlluminationGrid) -> tuple[exr.Planned, dict[str, exr.Rows]]:
    """The part of all nodes."""
    arrays = {c: grid.light[..., k] for k, c in enumerate(grid.channels.names)}
    arrays |= {"error": grid.error, "support": grid.support}
    if names := errors_of(grid.channels):
        errors = np.full(grid.light.shape, np.inf, np.float32) if grid.errors is None else grid.errors
        arrays |= {name: errors[..., c] for c, name in enumerate(names)}
    return exr.Planned(grid.spec.shape, tuple(arrays)), {name: exr.Turned(array) for name, array in arrays.items()}


def rebuilt(name: str, spec: GridSpec, channels: Channels, parts: exr.Parts, blocks: int) -> IlluminationGrid:
    """Undo `images`, trusting nothing."""
    light = parts.pop(f"light/{name}")
    if not blocks:
        return of_lattice(spec, channels, light)
    places, pool = parts.pop(f"blocks/{name}")["Y"], (blocks, *(SIDE + 1,) * 3)
    corner, step = places[:, :3], places[:, 3]
    most = np.array(spec.shape) - 2
    sound = np.isin(step, (1, 2, 4, 8, 16)).all() and (np.diff(step) <= 0).all()
    sound = sound and ((corner >= 0) & (corner <= most) & (corner % (SIDE * step[:, None]) == 0)).all()
    if not sound:
        raise BadInput(f"blocks of nodes of {name!r} do not lie in its lattice, the coarsest first")
    layout = laid_out(spec.shape, corner.astype(np.int64), step.astype(np.int64))

    def several(names: tuple[str, ...]) -> Any:
        return np.stack([light[c].reshape(pool) for c in names], axis=-1)

    names = tuple(errors_of(channels))
    held = Held(
        layout, several(channels.names), light["error"].reshape(pool), light["support"].reshape(pool),
        several(names) if names else None,
    )  # fmt: skip
    return IlluminationGrid(spec, channels=channels, held=held)


def of_lattice(spec: GridSpec, channels: Channels, light: dict[str, exr.Image]) -> IlluminationGrid:
    """Undo `lattice`."""
    values, error, support = (exr.array(light, names, spec.shape) for names in (channels.names, "error", "support"))
    errors = exr.array(light, tuple(errors_of(channels)), spec.shape) if errors_of(channels) else None
    return IlluminationGrid(spec, values, error, support, channels, errors)
