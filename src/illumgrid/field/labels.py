"""Label maps and masks: how they are recognised, and how several labels become the fields of a scene."""

from collections.abc import Mapping

import numpy as np

from illumgrid.field.scene import Field, Material
from illumgrid.field.volume import Floats, Volume

COLOURS = (
    *((0.80, 0.80, 0.80), (0.75, 0.30, 0.01), (0.09, 0.36, 0.65), (0.02, 0.36, 0.18), (0.67, 0.55, 0.06)),
    *((0.60, 0.19, 0.38), (0.01, 0.16, 0.42), (0.60, 0.14, 0.01)),
)
"""Albedos that people with any colour vision can distinguish: grey and those of Okabe and Ito, in linear light."""

MOST = 300  # values of a label map; atlases of the brain have up to this number
_SAMPLE = 1 << 21  # voxels that are examined
_EQUAL = 0.6  # share of equal neighbours in a label map, without the background
_LEAP = 0.1  # share of steps that skip a value, in a label map of many values; a smooth field skips none
_FEW = 8  # values that a map of nested labels may have, whose steps skip none


def labels_in(volume: Volume) -> list[int]:
    """Labels, without the background, of a volume that looks like a label map or a mask; none if it does not.

    Such a volume has few different values, all whole numbers, and is constant except for steps.
    """
    stride = max(1, int(np.ceil(np.sqrt(volume.stored.size / _SAMPLE))))
    sample = volume.in_units(volume.stored[:, ::stride, ::stride])
    whole = sample[np.isfinite(sample)]
    if not len(whole) or (whole != np.round(whole)).any() or np.abs(whole).max() > 2**24:
        return []
    values, counts = np.unique(whole, return_counts=True)
    if not 2 <= len(values) <= MOST:
        return []
    background = values[counts.argmax()]
    found = [round(float(value)) for value in values[values != background]]
    if len(values) == 2:
        return found
    rank = np.searchsorted(values, np.nan_to_num(sample))
    a, b = rank[:-1], rank[1:]
    ground = int(counts.argmax())
    step = np.abs(a - b)[(a != ground) | (b != ground)]
    if not len(step) or (step == 0).mean() < _EQUAL:
        return []
    leaps = step[step > 0] > 1
    return found if len(values) <= _FEW or (len(leaps) and leaps.mean() >= _LEAP) else []


def around_zero(volume: Volume) -> tuple[float, float]:
    """Isovalues from a voxel outside to a voxel inside the surface of a label, for a signed distance."""
    near = float(volume.spacing.min())
    return -near, near


def fields_of(name: str, volumes: Mapping[int, Volume], albedo: Floats | None, limits: Floats | None) -> list[Field]:
    """A field for each label, in different colours.

    Parameters
    ----------
    name : str
        Of the file.
    volumes : mapping from label to Volume
        Signed distances, positive inside.
    albedo : (3,) array_like, optional
        Of all labels.
    limits : (2,) array_like, optional
        Range of isovalues of all labels, by default a voxel outside to a voxel inside.
    """
    fields = []
    for k, (label, volume) in enumerate(volumes.items()):
        colour = COLOURS[k % len(COLOURS)] if albedo is None else albedo
        own = around_zero(volume) if limits is None else limits
        fields.append(Field(f"{name} {label}", volume, Material(np.asarray(colour)), own))  # type: ignore[arg-type]
    return fields
