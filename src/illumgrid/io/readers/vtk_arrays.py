"""The arrays of a VTK image, on points or on cells, and which of them is the field."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats
from illumgrid.io.readers.limits import AS_FLOAT, check_axes, check_memory
from illumgrid.io.readers.stored import Choice, Note, Wanted, pick


@dataclass(frozen=True)
class Array:
    """An array as described by a header."""

    name: str
    cells: bool
    """On cells instead of points."""
    components: int
    dtype: np.dtype[Any]
    active: bool
    """Marked as the scalars."""
    place: Any = None
    """Position of its numbers, for the reader of the format."""
    scale: float = 1.0
    """Whether its numbers are text."""

    @property
    def where(self) -> str:
        """What its values belong to."""
        return "cell" if self.cells else "point"

    @property
    def shown(self) -> str:
        """Name, where it is and number of components."""
        return f"{self.name}{' on cells' if self.cells else ''} ({self.components})"


def the_field(arrays: Sequence[Array], wanted: Wanted) -> tuple[Array, int, list[Note]]:
    """The wanted array, the number of its component, and a note about the others."""
    found = [array for array in arrays if not array.name.startswith("vtk")]  # ghosts, masks and numbers of points
    listed = ", ".join(array.shown for array in found)[:400] or "none"
    if wanted.array is not None:
        chosen, notes = _named(found, wanted.array, listed), []
    else:
        chosen = _default(found, listed)
        others = [array.shown for array in found if array is not chosen]
        notes = [("choice", f"its array {chosen.shown} was read; --array chooses another: {', '.join(others)[:300]}")]
        notes = notes if others else []
    names = [""] * chosen.components
    return chosen, pick(wanted.channel, "channel", names), notes


def _named(arrays: Sequence[Array], wanted: Choice, listed: str) -> Array:
    text = str(wanted)
    fits = [array for array in arrays if text in (array.name, array.shown, f"{array.where}:{array.name}")]
    if len(fits) == 1:
        return fits[0]
    if len(fits) > 1:
        raise BadInput(f"has {text!r} on points and on cells; expected one; choose --array point:{text} or cell:{text}")
    if text.isdecimal() and int(text) < len(arrays):
        return arrays[int(text)]
    raise BadInput(f"--array is {text}; expected one of its arrays, with their components: {listed}")


def _default(arrays: Sequence[Array], listed: str) -> Array:
    """The active scalars, or the only array of one component; those on points before those on cells."""
    for cells in (False, True):
        here = [array for array in arrays if array.cells == cells and array.components == 1]
        active = [array for array in here if array.active]
        if active or len(here) == 1:
            return (active or here)[0]
        if here:
            break
    raise BadInput(
        f"its arrays, with their components, are: {listed}; expected point data or cell data of one component, one "
        "array or one that is marked as the scalars; choose with --array NAME (array=NAME)"
    )


def lattice(shape: Sequence[int], array: Array, origin: Floats, steps: Floats) -> tuple[tuple[int, ...], Floats]:
    """Shape and origin of the values of an array on an image of `shape` points; cells lie half a step further."""
    if not array.cells:
        size, start = tuple(shape), origin
    else:
        size, start = tuple(max(n - 1, 1) for n in shape), origin + steps @ np.full(3, 0.5)
    check_axes(size)
    return size, start


def check_need(size: Sequence[int], array: Array) -> None:
    """Refuse what does not fit into the memory that is free."""
    check_memory(math.prod(size) * (array.components * max(array.dtype.itemsize, 8) * 2 + AS_FLOAT))
