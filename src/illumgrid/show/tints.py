"""Surfaces coloured by a second quantity: its colormap times the brightness of a white surface in the same light."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats, Volume, interpolate, world_to_index
from illumgrid.tone import decode_srgb

STEPS = 256


@dataclass(frozen=True, eq=False)
class Tint:
    """A second quantity as colours of all fields.

    Parameters
    ----------
    volume : Volume
        In the same world coordinates; beyond its border, the border values continue.
    name : str
        For the legend.
    cmap : str
        Name of a colormap of matplotlib.
    limits : (float, float), optional
        Values at its ends; by default the smallest and the largest.
    """

    volume: Volume
    name: str = ""
    cmap: str = "viridis"
    limits: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        import matplotlib

        if self.cmap not in matplotlib.colormaps:
            raise BadInput(f"the colormap is {self.cmap!r}; expected one of matplotlib, such as viridis or coolwarm")
        low, high = self.ends
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise BadInput(f"the colours run from {low:g} to {high:g}; expected two values of which the first is lower")

    @property
    def ends(self) -> tuple[float, float]:
        """Values at the ends of the colormap."""
        return self.volume.extremes if self.limits is None else self.limits

    @cached_property
    def table(self) -> NDArray[np.uint8]:
        """The colormap (256, 3), sRGB."""
        import matplotlib

        return np.asarray(matplotlib.colormaps[self.cmap](np.linspace(0, 1, STEPS), bytes=True)[:, :3])

    def colors(self, points: Floats) -> NDArray[np.float32]:
        """Display-linear colours (n, 3) at world points (n, 3)."""
        low, high = self.ends
        values = interpolate(self.volume, world_to_index(self.volume, points))
        at = np.clip((values - low) / (high - low), 0.0, 1.0) * (STEPS - 1)
        return decode_srgb(self.table[np.round(np.nan_to_num(at)).astype(np.int64)])
