"""A sampler for illumgrid: isovalues that split the voxels of the swept range into equal shares."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from illumgrid.stages import hookimpl, on_level_sets


@dataclass(frozen=True)
class Quantile:
    """Isovalues that split the first field's voxels within the range into equal shares: many where values are common.

    Parameters
    ----------
    count : int
        Number of isovalues.
    """

    name: ClassVar[str] = "quantile"
    contract: ClassVar[int] = 2
    count: int = 32

    def queries(self, scene, specs, seed):
        """Ask on `count` level sets: see `illumgrid.stages.Sampler`."""
        field = scene.fields[0]
        low, high = field.stored_range
        values = field.volume.stored
        swept = values[(values >= low) & (values <= high)]
        share = (np.arange(self.count) + 0.5) / self.count
        levels = field.volume.in_units(np.quantile(swept if swept.size else [low, high], share))
        return on_level_sets(scene, levels, seed, specs=specs)


@hookimpl
def register_samplers():
    """Name the sampler to illumgrid."""
    return [Quantile]
