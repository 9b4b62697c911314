"""Isovalues in equal steps, and points scattered over each level set: the method of the founding paper."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

from illumgrid.errors import BadInput
from illumgrid.field.scene import Scene, level_table
from illumgrid.grid import GridSpec
from illumgrid.stages import Sampler, hookimpl, on_level_sets
from illumgrid.transport.samples import Queries


@dataclass(frozen=True)
class Uniform:
    """Level sets in equal steps of the isovalue, with points uniform by area on each.

    Parameters
    ----------
    count : int
        Number of isovalues, both ends of the range included.
    points : int
        Points on each level set; 0 selects one per squared node spacing, at least 64.
    """

    name: ClassVar[str] = "uniform"
    count: int = 32
    points: int = 0

    def __post_init__(self) -> None:
        if self.count < 2:
            raise BadInput(f"uniform.count is {self.count}; expected at least 2 isovalues")
        if self.points < 0:
            raise BadInput(
                f"uniform.points is {self.points}; expected a positive number, or 0 for one per squared node spacing"
            )

    def queries(self, scene: Scene, specs: Sequence[GridSpec], seed: int) -> Iterator[Queries]:
        """Queries on `count` rows of the common sweep: see `illumgrid.stages.Sampler`."""
        rows = level_table(scene, self.count).table
        yield from on_level_sets(scene, rows, seed, specs=specs, points=self.points or None)


@hookimpl
def register_samplers() -> list[type[Sampler]]:
    """Register the stage of this file, as a plugin does."""
    return [Uniform]
