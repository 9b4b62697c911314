"""Fields of both signs (orbitals, differences, phases): the surfaces at +c and -c, swept outward together."""

import numpy as np
from numpy.typing import ArrayLike

from illumgrid.errors import BadInput, shown_range, tell
from illumgrid.field.boundaries import suggest_magnitudes
from illumgrid.field.labels import COLOURS
from illumgrid.field.scene import Field, Material
from illumgrid.field.volume import Volume

POSITIVE, NEGATIVE = COLOURS[1], COLOURS[2]
"""Albedos of h >= c and of h <= -c: orange and sky blue."""


def without_gaps(volume: Volume) -> Volume:
    """Replace voxels that are not finite by 0, which no surface encloses, with a warning."""
    if not volume.gaps:
        return volume
    good = np.isfinite(volume.stored)
    tell("finite", f"{volume.gaps} of {good.size} voxels are not finite: they became 0", stacklevel=2)
    return volume.with_stored(np.where(good, volume.stored, np.float32(volume.to_stored(0.0))))


def signed_pair(
    name: str, volume: Volume, limits: ArrayLike | None = None, material: Material | None = None
) -> tuple[Field, Field]:
    """Two fields of one volume, h >= c and h <= -c, that one sweep moves outward together.

    Parameters
    ----------
    name : str
        The fields are called ``NAME-positive`` and ``NAME-negative``.
    volume : Volume
        Voxels that are not finite become 0, with a warning.
    limits : (2,) array_like, optional
        Lowest and highest c, both positive, at t = 0 and 1; by default those of `suggest_magnitudes`.
    material : Material, optional
        Of both; by default orange for positive and sky blue for negative.

    Raises
    ------
    BadInput
        Unless 0 < low < high, and the data reach the lowest c on both sides.
    """
    volume = without_gaps(volume)
    low, high = np.asarray(suggest_magnitudes(volume)[:2] if limits is None else limits, float).tolist()
    if not 0 < low < high:
        raise BadInput(
            f"a signed field came with the range {low:g} to {high:g}; expected magnitudes 0 < LO < HI: the surfaces at "
            "+c and -c are swept together"
        )
    lowest, highest = volume.extremes
    if not (lowest <= -low and low <= highest):
        raise BadInput(
            f"got a signed field with surfaces at +c and -c from c = {low:g} on, but the data run from "
            f"{shown_range((lowest, highest), 6)}; expected both signs: choose a smaller c, or light the field unsigned"
        )
    one, other = (material, material) if material else (Material(np.array(c)) for c in (POSITIVE, NEGATIVE))
    return (
        Field(f"{name}-positive", volume, one, np.array([low, high])),
        Field(f"{name}-negative", volume, other, np.array([-high, -low]), "below", falling=True),
    )
