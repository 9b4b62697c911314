"""Protocols of the three exchangeable stages, and everything that their authors need.

A stage is a frozen dataclass with a class attribute ``name``; its fields are its options, each with a default, of type
bool, int, float, str, a ``Literal`` of words, or a tuple of numbers. It may have a class method ``available``, which
returns None if the stage can run, and otherwise the remedy, such as ``"pip install embreex"``.

A stage names the version of these requirements that it was written for by the class attribute ``contract``: see
`CONTRACT`.

A package provides stages by hooks, functions marked with `hookimpl`, in the module named by its entry point in the
group ``illumgrid``.
"""

import inspect
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
import pluggy
from numpy.typing import ArrayLike

from illumgrid.errors import BadInput
from illumgrid.field.levelset import isosurface
from illumgrid.field.scene import Scene
from illumgrid.grid import GridSpec, IlluminationGrid, Nodes
from illumgrid.transport.samples import Queries, Samples

__all__ = [
    "CONTRACT",
    "Backend",
    "GridSpec",
    "IlluminationGrid",
    "Interpolator",
    "Nodes",
    "Queries",
    "Sampler",
    "Samples",
    "hookimpl",
    "on_level_sets",
]

CONTRACT, OLDEST_CONTRACT = 2, 1
"""Version of what stages and the package agree upon, and the oldest that still runs: docs/plugins.md has their history.

A stage says by its class attribute ``contract`` for which version it was written; without one, for the first.
"""

hookimpl = pluggy.HookimplMarker("illumgrid")
"""Marks a function as one of the hooks below, selected by the function's name."""

_hookspec = pluggy.HookspecMarker("illumgrid")


@runtime_checkable
class Sampler(Protocol):
    """Chooses the points at which light is computed."""

    name: ClassVar[str]

    def queries(self, scene: Scene, specs: Sequence[GridSpec], seed: int) -> Iterable[Queries]:
        """Yield batches of queries on the level sets of every field, ids unique over all batches.

        Parameters
        ----------
        scene : Scene
        specs : sequence of GridSpec
            The nodes to be filled, one lattice per field.
        seed : int
            Equal seeds give equal queries.
        """


@runtime_checkable
class Backend(Protocol):
    """Light transport: computes the light at queries.

    A backend that computes something other than light, such as ambient occlusion, sets the class attribute
    ``transport = False``; it is then not tested against closed forms of light.
    """

    name: ClassVar[str]
    geometry: ClassVar[Literal["mesh", "levelset", "both"]]

    def solve(self, scene: Scene, queries: Queries, *, paths: range, bounces: int, seed: int) -> Samples:
        """Trace the paths with these numbers from every query.

        The result of a query depends on its id, `paths`, `bounces` and `seed`, never on its batch.

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


@dataclass(frozen=True)
class Capabilities:
    """What a backend computes, and on which surface.

    Parameters
    ----------
    surface : {"levelset", "mesh"}
        Representation of a level set that it uses.
    transport : bool
        Whether it computes light.
    variants : tuple of str
        Surfaces that its option ``surface`` selects; empty if it has no such option.
    """

    surface: Literal["mesh", "levelset"]
    transport: bool
    variants: tuple[Literal["levelset", "mesh"], ...]


def capabilities(backend: Any) -> Capabilities:
    """Capabilities of a backend or its class, read from ``geometry``, ``transport`` and the option ``surface``.

    Raises
    ------
    BadInput
        If ``geometry`` is missing or unknown.
    """
    geometry, option = getattr(backend, "geometry", None), getattr(backend, "surface", None)
    if geometry not in ("mesh", "levelset", "both"):
        name = getattr(backend, "__name__", type(backend).__name__)
        raise BadInput(f"{name}.geometry is {geometry!r}; expected 'mesh', 'levelset' or 'both'")
    mesh = geometry == "mesh" or (geometry == "both" and option == "mesh")
    return Capabilities(
        surface="mesh" if mesh else "levelset",
        transport=getattr(backend, "transport", True),
        variants=("levelset", "mesh") if geometry == "both" and option is not None else (),
    )


@runtime_checkable
class Interpolator(Protocol):
    """From scattered samples to a uniform grid."""

    name: ClassVar[str]

    def fill(self, samples: Samples, nodes: Nodes) -> IlluminationGrid:
        """Fill every node from the samples of one field.

        Parameters
        ----------
        samples : Samples
            On level sets of the nodes' field; they may include holes (paths 0).
        nodes : Nodes
            The lattice and the field, and in blocks the point, normal and level of every node.
        """


def fill_nodes(interpolator: Interpolator, samples: Samples, nodes: Nodes) -> IlluminationGrid:
    """Fill nodes by an interpolator, which may have the former signature ``fill(samples, spec, field)``."""
    try:
        inspect.signature(interpolator.fill).bind("samples", "nodes")
    except TypeError:
        former: Callable[..., IlluminationGrid] = interpolator.fill
        return former(samples, nodes.spec, nodes.number)
    return interpolator.fill(samples, nodes)


@_hookspec
def register_samplers() -> Sequence[type[Sampler]]:  # type: ignore[empty-body]
    """Sampler classes of a package."""


@_hookspec
def register_backends() -> Sequence[type[Backend]]:  # type: ignore[empty-body]
    """Backend classes of a package."""


@_hookspec
def register_interpolators() -> Sequence[type[Interpolator]]:  # type: ignore[empty-body]
    """Interpolator classes of a package."""


def on_level_sets(
    scene: Scene,
    levels: ArrayLike,
    seed: int,
    *,
    specs: Sequence[GridSpec] | None = None,
    points: int | None = None,
) -> Iterator[Queries]:
    """Queries on every field's level set of each row of `levels`, uniform by area, projected onto the trilinear set.

    Parameters
    ----------
    scene : Scene
    levels : (K,) or (K, F) array_like
        Isovalues of field 0 (the other fields follow the common sweep), or whole rows.
    seed : int
        Equal seeds give equal points.
    specs : sequence of GridSpec, optional
        One per field. The node spacing determines the default number of points; without `specs` the voxel spacing does.
    points : int, optional
        Points on each level set; by default one per squared spacing, at least 64.

    Yields
    ------
    Queries
        One batch per row and field whose level set is not empty; ids count up within a field, over all rows.
    """
    rows = np.asarray(levels, dtype=float)
    if rows.ndim == 1:
        rows = scene.levels_through(0, rows)
    if rows.ndim != 2 or rows.shape[1] != len(scene.fields) or not np.isfinite(rows).all():
        raise BadInput(f"levels have shape {rows.shape}; expected (K,) or (K, {len(scene.fields)}) finite isovalues")
    asked = np.zeros(len(scene.fields), dtype=np.int64)
    for number, row in enumerate(rows):
        for f, field in enumerate(scene.fields):
            mesh = isosurface(field.volume, row[f], field.inside)
            if not len(mesh.faces) or not mesh.area > 0:
                continue
            spacing = (field.volume if specs is None else specs[f]).spacing
            count = points or max(64, round(mesh.area / float(np.prod(spacing) ** (2 / 3))))
            random = np.random.default_rng((seed, number, f))
            corners = mesh.triangles[random.choice(len(mesh.faces), count, p=mesh.area_faces / mesh.area)]
            # Uniform in a triangle: Osada et al., "Shape distributions", ACM TOG 21(4), 2002.
            root, share = np.sqrt(random.random((count, 1))), random.random((count, 1))
            at = (1 - root) * corners[:, 0] + root * (1 - share) * corners[:, 1] + root * share * corners[:, 2]
            queries = Queries.at(scene, at, field=f, level=row[f], first_id=(f << 40) + int(asked[f]))
            asked[f] += count
            yield Queries(queries.id, queries.point, queries.normal, np.tile(row, (count, 1)), queries.target)
