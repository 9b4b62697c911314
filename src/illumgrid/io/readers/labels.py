"""Label maps: one label as a field whose zero is the label's surface."""

from dataclasses import replace

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.io.readers.stored import Stored


def distance_to(stored: Stored, label: int) -> Stored:
    """Signed distance in world units from the surface of a label, positive inside it."""
    from scipy.ndimage import distance_transform_edt

    inside = stored.values == label
    if not inside.any() or inside.all():
        found = np.unique(stored.values)
        shown = ", ".join(f"{value:g}" for value in found[:20]) + (", ..." if len(found) > 20 else "")
        raise BadInput(f"--label is {label}; expected one of the labels of the file, which are {shown}")
    spacing = np.linalg.norm(stored.steps, axis=0)
    out, within = (distance_transform_edt(mask, sampling=spacing) for mask in (~inside, inside))
    values = np.where(inside, within - 0.5 * spacing.min(), 0.5 * spacing.min() - out).astype(np.float32)
    return replace(stored, values=values, slope=1.0, intercept=0.0)
