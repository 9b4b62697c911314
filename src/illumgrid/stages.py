"""The three stages that can be exchanged, and all that their authors need.

A stage is a frozen dataclass with a class attribute ``name``; its fields are its options.
"""

from collections.abc import Iterable, Sequence
from typing import ClassVar, Literal, Protocol, runtime_checkable

from illumgrid.grid import GridSpec, IlluminationGrid
from illumgrid.samples import Queries, Samples
from illumgrid.scene import Scene

__all__ = ["Backend", "GridSpec", "IlluminationGrid", "Interpolator", "Queries", "Sampler", "Samples"]


@runtime_checkable
class Sampler(Protocol):
    """Where to ask for light."""

    name: ClassVar[str]

    def queries(self, scene: Scene, specs: Sequence[GridSpec], seed: int) -> Iterable[Queries]:
        """Yield batches of queries on the level sets of every field, ids unique over all batches.

        Parameters
        ----------
        scene : Scene
        specs : sequence of GridSpec
            The nodes to be filled, one lattice a field.
        seed : int
            Equal seeds give equal queries.
        """


@runtime_checkable
class Backend(Protocol):
    """Light transport: answers the questions."""

    name: ClassVar[str]
    geometry: ClassVar[Literal["mesh", "levelset", "both"]]

    def solve(self, scene: Scene, queries: Queries, *, paths: range, bounces: int, seed: int) -> Samples:
        """Trace the paths with these numbers from every query.

        The answer to a query depends on its id, `paths`, `bounces` and `seed`, never on the batch it came in.

        Parameters
        ----------
        scene : Scene
        queries : Queries
            A query without a normal, or inside another field's solid, is a hole: paths 0.
        paths : range
            Numbers of the paths, step 1; disjoint ranges combine.
        bounces : int
            Reflections: 0 is light straight from background and lamps.
        seed : int
        """


@runtime_checkable
class Interpolator(Protocol):
    """From scattered answers to a uniform grid."""

    name: ClassVar[str]

    def fill(self, samples: Samples, spec: GridSpec, field: int) -> IlluminationGrid:
        """Fill every node from the samples of one field.

        Parameters
        ----------
        samples : Samples
            All of them on level sets of field number `field`; holes (paths 0) among them.
        spec : GridSpec
        field : int
        """
