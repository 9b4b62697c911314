"""The arrays of a page as one run of bytes: field values in whole steps, light in half floats."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.coarse import block_means
from illumgrid.field.layers import Layer
from illumgrid.field.volume import Volume, slabs
from illumgrid.grid import GridSpec, IlluminationGrid
from illumgrid.grid.channels import Channels, mixed

MOST_SIDE = 2048
"""Voxels along one side of a texture: what graphics drivers of phones and laptops accept."""
HOLE = -1.0  # in place of an error: no light of its own, or unknown error
_STEPS = 65535
_FINE = 4096  # steps that the swept range must span; otherwise values far outside it are clamped


class Bytes:
    """Arrays, one after the other."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.length = 0

    def add(self, part: bytes) -> int:
        """Append, and return where it begins."""
        self.parts.append(part)
        self.length += len(part)
        return self.length - len(part)


def _factors(shape: tuple[int, ...], most: int) -> NDArray[np.int64]:
    """Factors (3,) by which axes must shrink to leave at most `most` points, and at most `MOST_SIDE` along each."""
    sides = np.array(shape)
    long = -(-sides // MOST_SIDE)
    factor = 1
    while np.prod(-(-sides // np.maximum(long, factor)), dtype=float) > most:
        factor += 1
    factors: NDArray[np.int64] = np.minimum(np.maximum(long, factor), np.maximum(sides // 2, 1))
    return factors


def reduced(volume: Volume, most: int) -> Volume:
    """Means over blocks of voxels, until at most `most` remain, and at most `MOST_SIDE` along each axis."""
    factors = _factors(volume.shape, most)
    if (factors == 1).all():
        return volume
    return block_means(volume, factors.tolist())


def thinned(grid: IlluminationGrid, most: int) -> IlluminationGrid:
    """Light resampled on at most about `most` nodes, from the first node to the last.

    Error and support are those of the nearest node.
    """
    factors = _factors(grid.spec.shape, most)
    if (factors == 1).all():
        return grid
    old = np.array(grid.spec.shape) - 1
    new = np.maximum(1, -(-old // factors))
    shape = (int(new[0]) + 1, int(new[1]) + 1, int(new[2]) + 1)
    spec = GridSpec(shape, grid.spec.origin, grid.spec.spacing * old / new, grid.spec.direction)
    return grid.onto(spec)


def field_steps(
    volume: Volume, limits: tuple[float, float], sign: float = 1.0
) -> tuple[NDArray[Any], float, float, bool]:
    """Stored values times `sign` as whole steps of 8 or 16 bits: (steps, base, step, whether any was clamped).

    Such a value is base + step · steps. Whole numbers that fit stay exact. Others get 65535 steps over all values, or,
    where that would leave too few for the swept `limits` (of stored values times `sign`), over those and eight times
    their span on either side.
    """
    low, high = sorted(sign * float(x) for x in volume.stored_extremes)
    values, step, clamped = volume.stored, 1.0, False
    whole = high - low <= _STEPS and max(abs(low), abs(high)) < 2**24 and _whole(values)
    if not whole:
        clamped = (limits[1] - limits[0]) * _STEPS < _FINE * (high - low)
        if clamped:
            span = limits[1] - limits[0]
            low, high = max(low, limits[0] - 8 * span), min(high, limits[1] + 8 * span)
        step = (high - low) / _STEPS or 1.0
    steps = np.empty(values.shape, np.uint8 if whole and high - low < 256 else np.uint16)
    for slab in slabs(values.shape):
        share = (sign * values[slab].astype(float) - low) / step
        steps[slab] = share if whole else np.clip(np.round(share), 0, _STEPS)
    return steps, low, step, clamped


def _whole(values: NDArray[Any]) -> bool:
    parts = (values[slab] for slab in slabs(values.shape))
    return values.dtype.kind != "f" or all((part == np.round(part)).all() for part in parts)


def _planes(words: NDArray[np.uint16]) -> bytes:
    """All low bytes, then all high bytes: similar bytes are then adjacent and compress better."""
    return (words & 0xFF).astype(np.uint8).tobytes() + (words >> 8).astype(np.uint8).tobytes()


def _half(values: NDArray[np.floating]) -> NDArray[np.uint16]:
    half: NDArray[np.uint16] = np.clip(values, -65504, 65504).astype(np.float16).view(np.uint16)
    return half


def half_planes(values: NDArray[np.floating]) -> bytes:
    """Half floats, low bytes before high bytes."""
    return _planes(_half(values).ravel())


def pack_values(steps: NDArray[Any], into: Bytes) -> dict[str, Any]:
    """Field values (nx, ny, nz) as differences along x."""
    x_fastest = np.ascontiguousarray(steps.transpose(2, 1, 0))
    x_fastest[:, :, 1:] -= x_fastest[:, :, :-1].copy()  # wraps around; summation undoes it
    data = x_fastest.tobytes() if steps.dtype == np.uint8 else _planes(x_fastest.ravel())
    return {"shape": list(steps.shape), "bytes": steps.dtype.itemsize, "offset": into.add(data)}


def pack_light(light: NDArray[np.floating], error: NDArray[np.floating], into: Bytes) -> dict[str, Any]:
    """Light (nx, ny, nz, C), grey or RGB, and its error (nx, ny, nz) as half floats, x fastest."""
    # Channel by channel, and converted to half floats before the transposition: half the bytes to move.
    half = [_half(channel).T.ravel() for channel in (*np.moveaxis(light, 3, 0), error)]
    for channel in half[1:-1]:
        channel -= half[0]  # channels are similar, so their differences compress well
    data = b"".join(_planes(channel) for channel in half)
    return {"shape": list(light.shape[:3]), "channels": light.shape[3], "offset": into.add(data)}


def pack_layers(
    light: NDArray[np.floating], channels: Channels, layers: Sequence[Layer], colors: int, into: Bytes
) -> list[dict[str, Any]]:
    """The channels of light (nx, ny, nz, C) that hold one of several lights, as half floats, x fastest.

    Each with the number of its light, and its contribution to the `colors` colours (1 or 3) at weight 1.
    """
    names, packed = [layer.name for layer in layers], []
    for name, row, values in zip(channels.names, mixed(channels, layers, {}).mix, np.moveaxis(light, -1, 0)):
        if layer := name.rpartition(".")[0]:
            peak = max(row)  # half floats have enough range for the picture, however bright a light is
            data = half_planes(values.T * peak)
            color = [share / peak for share in row[:colors]]
            packed.append({"light": names.index(layer), "color": color, "offset": into.add(data)})
    return packed
