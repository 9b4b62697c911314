"""The result of a reader: values as stored, their placement, and notes for the user."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.storing import NATIVE
from illumgrid.field.volume import Floats, Volume, states_place
from illumgrid.io.readers.limits import AS_FLOAT, check_axes, check_memory
from illumgrid.io.readers.paged import resident, settled
from illumgrid.io.readers.windows import Span, take

Choice = int | str | None
"""Number (from 0) or name of a channel, time step or array; None where the user chose none."""

Note = tuple[str, str]
"""Name of a warning (in `errors.WARNINGS`) and its sentence, without the file's name."""


@dataclass(frozen=True)
class Wanted:
    """The user's choices for a file that holds several volumes."""

    channel: Choice = None
    time: Choice = None
    array: Choice = None
    crop: Sequence[int] | None = None
    downsample: int | None = None
    follow: bool = False
    """Read data files outside the folder of the header that names them."""
    most: int | None = None
    """Of an image in several resolutions, without a choice, the finest with at most so many voxels is read."""

    def spans(self, shape: Sequence[int]) -> list[Span]:
        """The selection along x, y and z of a volume; refused if it is not possible."""
        box = [edge for n in shape for edge in (0, n)] if self.crop is None else list(self.crop)
        first, last = np.array(box[::2]), np.array(box[1::2])
        if len(box) != 6 or (first < 0).any() or (last > shape).any() or (last - first < 2).any():
            raise BadInput(
                f"--crop is {' '.join(map(str, box))}; expected first and last + 1 along x, y and z, at least 2 voxels "
                f"within {' '.join(f'0 {n}' for n in shape)}"
            )
        factor, least = 1 if self.downsample is None else self.downsample, int((last - first).min())
        if not 1 <= factor <= least // 2:
            raise BadInput(
                f"--downsample is {factor}; expected 1 to {least // 2}, which leaves 2 voxels along each axis"
            )
        return [Span(int(a), int(b), factor) for a, b in zip(first, last)]


@dataclass(frozen=True)
class Stored:
    """One volume of a file. Its values are `slope` · stored + `intercept`."""

    values: NDArray[Any]
    """(nx, ny, nz) real numbers in the type of the file, any memory order."""
    origin: Floats
    """(3,) world position of voxel (0, 0, 0)."""
    steps: Floats
    """(3, 3): column i is the world vector from a voxel to its neighbour along axis i; it may shear."""
    slope: float = 1.0
    intercept: float = 0.0
    spacing: Floats | None = None
    """(3,) lengths of the steps, where the header says them with more digits than the steps have."""
    unit: str | None = None
    """Of the world coordinates: "mm", "µm", "Å"."""
    notes: tuple[Note, ...] = ()
    whole: tuple[int, ...] | None = None
    """(3,) voxels in the file, where `values` are only the part of them that is wanted, and `origin` is that of all."""
    start: Floats | None = None
    """(3,) origin in voxels, where the file has it so: with another spacing it is elsewhere."""
    oriented: bool | None = None
    """Of a part, whether the file states where the whole lies."""


def following(count: int) -> tuple[Note, ...]:
    """A note about bytes behind the data."""
    if not count:
        return ()
    return (("file", f"{count} bytes follow its data, of which its header says nothing; they are ignored"),)


def pick(chosen: Choice, option: str, names: Sequence[str]) -> int:
    """Number of the channel, time step or array that the user wants; several without a choice are refused.

    Parameters
    ----------
    chosen : int, str or None
        What the user said: a number from 0, or one of `names`.
    option : str
        "channel", "time" or "array".
    names : sequence of str
        What each is called in the file; empty texts where it does not say.
    """
    listed = ", ".join(f"{number} {name}".strip() for number, name in enumerate(names))
    listed = listed if len(listed) < 400 else f"{listed[:380]}… up to {len(names) - 1}"
    kinds = {"channel": "channels", "time": "time steps", "array": "arrays"}[option]
    if chosen is None and len(names) == 1:
        return 0
    if chosen is None:
        raise BadInput(f"holds {len(names)} {kinds}: {listed}; expected one; choose it with --{option} N ({option}=N)")
    if isinstance(chosen, str) and chosen and chosen in names:
        return names.index(chosen)
    if (isinstance(chosen, int) or chosen.isdecimal()) and 0 <= int(chosen) < len(names):
        return int(chosen)
    raise BadInput(f"--{option} is {str(chosen)[:60]!r}; expected one of its {kinds}: {listed}")


def part(stored: Stored, wanted: Wanted) -> Stored:
    """The selected voxels; incomplete blocks at the upper ends are left out."""
    spans = wanted.spans(stored.whole or stored.values.shape)
    values = take(stored.values, spans) if stored.whole is None else stored.values
    first, factor = np.array([span.first + (span.block - 1) / 2 for span in spans]), spans[0].block
    lengths = np.linalg.norm(stored.steps, axis=0)
    stated = states_place(stored.origin, stored.steps / np.where(lengths > 0, lengths, 1.0))
    return replace(
        stored,
        values=values,
        origin=stored.origin + stored.steps @ first,
        steps=stored.steps * factor,
        spacing=None if stored.spacing is None else stored.spacing * factor,
        whole=None,
        oriented=stated if stored.oriented is None else stored.oriented,
    )


def with_spacing(stored: Stored, spacing: Sequence[float]) -> Stored:
    """The same with another spacing, and without the notes about that of the file."""
    step = np.array(spacing, float)
    if step.shape != (3,) or not np.isfinite(step).all() or not (step > 0).all():
        raise BadInput(f"--spacing is {' '.join(map(str, np.ravel(spacing)))}; expected three positive numbers: X Y Z")
    notes = tuple(note for note in stored.notes if note[0] != "spacing")
    steps = stored.steps / np.linalg.norm(stored.steps, axis=0) * step
    origin = stored.origin if stored.start is None else steps @ stored.start
    return replace(stored, origin=origin, steps=steps, spacing=step, notes=notes)


SKEW = 0.005
"""Largest cosine of the angle between axes that counts as a right angle (0.3°): rounding in a header."""


def place(stored: Stored) -> tuple[Volume, tuple[Note, ...]]:
    """The volume, resampled onto right angles if the axes of the file are oblique to each other; and its notes."""
    check_axes(stored.values.shape)
    if not (np.isfinite(stored.steps).all() and np.isfinite(stored.origin).all()):
        raise BadInput(
            "its spacing or orientation is not finite; expected numbers; correct its header or give --spacing"
        )
    spacing = np.linalg.norm(stored.steps, axis=0)
    if not (spacing > 0).all():
        raise BadInput(
            f"its spacing is {spacing.tolist()}; expected three positive numbers; give it with --spacing X Y Z"
        )
    if abs(np.linalg.det(stored.steps / spacing)) < 1e-3:
        raise BadInput(
            f"its axes are {stored.steps.T.tolist()}; expected three different directions; correct its header"
        )
    if stored.spacing is not None and np.allclose(stored.spacing, spacing, rtol=1e-5, atol=0):
        spacing = stored.spacing
    direction = stored.steps / spacing
    notes = stored.notes
    skew = float(np.abs(direction.T @ direction - np.eye(3)).max())
    if skew > SKEW:
        stored = unsheared(stored)
        spacing = np.linalg.norm(stored.steps, axis=0)
        direction = stored.steps / spacing
        notes = (*notes, ("placement", _SHEARED.format(90 - np.degrees(np.arccos(min(1.0, skew))))))
    elif skew > 1e-3:
        notes = (
            *notes,
            ("placement", f"its axes are {np.degrees(skew):.2f}° off right angles, which was rounded away"),
        )
    u, _, v = np.linalg.svd(direction)
    exact = direction if skew < 1e-14 else u @ v
    values = stored.values
    small = values.dtype.newbyteorder("=") in NATIVE
    check_memory(resident(values.nbytes) if small else values.size * (8 + AS_FLOAT))
    values = settled(values) if small else values
    units = stored.slope, stored.intercept, stored.unit
    volume = Volume(values, stored.origin, spacing, exact, *units, oriented=stored.oriented)
    return volume, notes


_SHEARED = (
    "its axes are up to {:.1f}° off right angles; it was resampled onto right angles by linear interpolation; where "
    "the new box has no data its values are NaN"
)


MOST_EMPTY = 64
"""Largest number of voxels of the box around a sheared volume, relative to the volume's."""


def unsheared(stored: Stored) -> Stored:
    """Resampled onto a box of right angles around the sheared one: its first axis is kept, its first plane is kept.

    World position is Q R · index with Q orthonormal and R upper triangular: along the new axes, Q, only whole planes
    and rows move.
    """
    from scipy.ndimage import map_coordinates

    q, r = np.linalg.qr(stored.steps)
    turn = np.sign(np.diag(r))
    q, r = q * turn, r * turn[:, None]
    step = np.diag(r)
    top = np.array(stored.values.shape) - 1.0
    corners = np.array(list(np.ndindex(2, 2, 2))) * top @ (r / step[:, None]).T
    first = np.floor(corners.min(axis=0) + 1e-6)
    last = np.ceil(corners.max(axis=0) - 1e-6)
    size = float(np.prod(last - first + 1))
    if not size <= MOST_EMPTY * stored.values.size:
        raise BadInput(
            f"its axes are so oblique that a box around it has {size / stored.values.size:.2g} times its voxels; "
            f"expected at most {MOST_EMPTY}; resample it elsewhere"
        )
    low, shape = first.astype(int), (last - first + 1).astype(int)
    check_memory(int(size) * (AS_FLOAT + 8) + stored.values.size * 8)
    values = np.asarray(stored.values, np.float64 if stored.values.dtype.itemsize > 4 else np.float32)
    out = np.empty(shape, values.dtype)
    back = np.linalg.inv(r / step[:, None])  # from the new index to the old one
    i, j = np.meshgrid(np.arange(shape[0]) + low[0], np.arange(shape[1]) + low[1], indexing="ij")
    for k in range(shape[2]):
        old = np.tensordot(back, np.stack([i, j, np.full(i.shape, k + low[2])]).astype(float), 1)
        old = np.where(np.abs(old - np.round(old)) < 1e-6, np.round(old), old)
        out[:, :, k] = map_coordinates(values, old, order=1, mode="constant", cval=np.nan)
    return replace(stored, values=out, origin=stored.origin + q @ (step * low), steps=q * step, spacing=step)
