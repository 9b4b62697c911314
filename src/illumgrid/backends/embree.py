"""Light transport over Intel's Embree (the optional package embreex): the NumPy path loop, all rays of a step at once.

Embree gets the same meshes as `numba` with ``surface="mesh"``, in the same single precision, so that both trace the
same paths except where a ray grazes an edge.
"""

import importlib.util
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from illumgrid.backends.lights_numpy import Bools, Ints
from illumgrid.backends.march_numpy import cell_normal, gradient_normal
from illumgrid.backends.mesh.bvh import unit_cube
from illumgrid.backends.mesh.meshes import LevelMesh, Meshes, check_opaque, meshed, row_groups
from illumgrid.backends.numba_ import pool, share
from illumgrid.backends.reference import answer
from illumgrid.constants import BURIED, CAP, LOST, MISS, NOWHERE, SURFACE
from illumgrid.errors import BadInput
from illumgrid.field.levelset import Marchable
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats
from illumgrid.grid.cache import NO_CACHE, Cache
from illumgrid.grid.channels import Channels
from illumgrid.rng import stream
from illumgrid.stages import Backend, hookimpl
from illumgrid.transport.samples import Queries, Samples, in_frame, in_turn
from illumgrid.transport.tracer import laid_out, prepare, solve_once

Cast = Callable[[int, Floats, Floats], tuple[Floats, Ints]]
"""First face of field f's mesh along frame rays (n, 3): distance and number in that mesh, each (n,); inf, -1: none."""


@dataclass(frozen=True)
class Casting:
    """Rays cast at the meshes of one row of levels by the function `cast`: see `mesh.cast.mesh_from`.

    Parameters
    ----------
    scene : Meshed
    cast : callable
    """

    scene: Any
    cast: Cast

    def first(self, f: int, x: Floats, d: Floats) -> tuple[Floats, Ints, Bools]:
        """First face along rays: (t, number among those of all fields, whether it was met from the front)."""
        t, face = self.cast(f, x, d)
        number, front = np.full(len(x), NOWHERE), np.zeros(len(x), bool)
        hit = np.flatnonzero(face >= 0)
        number[hit] = face[hit] + self.scene.face_start[f]
        front[hit] = np.einsum("ij,ij->i", self.scene.facing[number[hit]], d[hit]) < 0
        return t, number, front

    def meet(
        self, f: int, level: Floats, x: Floats, normal: Floats, d: Floats, own: Bools, face: Ints
    ) -> tuple[Floats, Ints, Ints]:
        """A ray that dips under its own face meets it at once; otherwise it is offset by the bound on rounding."""
        t, what, at = np.full(len(x), np.inf), np.full(len(x), MISS), np.full(len(x), NOWHERE)
        ray = np.flatnonzero(own)
        facing = normal.copy()
        facing[ray] = self.scene.facing[face[ray]]
        dips = np.einsum("ij,ij->i", facing[ray], d[ray]) <= 0
        under = ray[dips]
        t[under], what[under], at[under] = 0.0, SURFACE, face[under]
        stays = np.zeros(len(x), bool)
        stays[ray] = dips | self.scene.cap[face[ray]]  # a ray from a cap cannot meet the convex box again

        ray = np.flatnonzero(~stays)
        far, met, front = self.first(f, (x + self.scene.off[f] * facing)[ray], d[ray])
        hit, back = ray[front], ray[(met != NOWHERE) & ~front]
        t[hit], at[hit] = far[front], met[front]
        what[hit] = np.where(self.scene.cap[met[front]], CAP, SURFACE)
        # A ray that meets a back face dipped under a neighbour of its face, or was inside from the start.
        t[back], what[back], at[back] = 0.0, np.where(own[back], SURFACE, BURIED), face[back]
        return t, what, at

    def normal(self, f: int, what: Ints, face: Ints, x: Floats, d: Floats) -> Floats:
        """The gradient normal; that of the face on a cap, or if the gradient vanishes."""
        smooth = gradient_normal(self.scene, f, x)
        geometric = np.flatnonzero((what == CAP) | ~smooth.any(axis=1))
        smooth[geometric] = self.scene.facing[face[geometric]]
        return smooth

    def begin(self, own: Ints, x: Floats, normal: Floats) -> tuple[Floats, Ints]:
        """Move along the normal onto the mesh, or along that of the cell: see `mesh.cast.settle`."""
        x, face = x.copy(), np.full(len(x), NOWHERE)
        for f in range(len(self.scene.twin)):
            mine = np.flatnonzero(own == f)
            face[mine] = LOST
            for along in (normal[mine], cell_normal(self.scene, f, x[mine])):
                ask = (face[mine] == LOST) & along.any(axis=1)
                x[mine[ask]], face[mine[ask]] = self.settle(f, x[mine[ask]], along[ask])
        return x, face

    def settle(self, f: int, x: Floats, normal: Floats) -> tuple[Floats, Ints]:
        """Move onto a front face against the normal or a back along it, within a cell: see `mesh.cast.settle_along`."""
        reach = 1.0 / (np.abs(normal) / self.scene.spacing[f]).max(axis=1, initial=0.0)
        found, shift, face = np.full(len(x), np.inf), np.zeros(len(x)), np.full(len(x), LOST)
        near = 2.0 * self.scene.off[f]
        for along in (-1.0, 1.0):
            t, met, front = self.first(f, x - along * near * normal, along * normal)
            away = np.abs(t - near)
            good = (met != NOWHERE) & (front == (along < 0)) & (t < near + reach) & (away < found)
            good[good] = ~self.scene.cap[met[good]]
            found[good], shift[good], face[good] = away[good], along * (t - near)[good], met[good]
        return x + shift[:, None] * normal, face

    def inside(self, f: int, level: Floats, x: Floats, normal: Floats) -> Bools:
        """Whether a ray from beside the point along the normal meets a back face."""
        _, met, front = self.first(f, x + self.scene.off[f] * normal, normal)
        return np.asarray((met != NOWHERE) & ~front)


def near_enough(x: Floats, d: Floats) -> Floats:
    """Distances (n,) at which rays from outside come near [-1, 1]³, 0 where they are; inf if never.

    As `illumgrid.backends.mesh.traversal.approach`.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-1.5 - x) / d, (1.5 - x) / d
        still = d == 0
        low = np.where(still, np.where(np.abs(x) > 1.5, np.inf, -np.inf), np.minimum(one, other)).max(axis=1)
        high = np.where(still, np.inf, np.maximum(one, other)).min(axis=1)
    start = np.where(low <= high, np.maximum(low, 0.0), np.inf)
    return np.where(np.abs(x).max(axis=1, initial=0.0) <= 2.0, 0.0, np.where(high < 0, np.inf, start))


def grow(vertices: Floats, faces: Ints) -> Any:
    """Embree's scene of a mesh, in the space of `LevelMesh`; None without faces, which Embree does not accept."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    if not len(faces):
        return None
    centre, scale = unit_cube(vertices[faces])
    scene = EmbreeScene(robust=True)  # no ray passes between two faces
    TriangleMesh(scene, ((vertices - centre) * scale).astype(np.float32), faces.astype(np.int32))
    scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))  # builds the tree
    return scene


def by_embree(scene: Any, meshes: Sequence[LevelMesh], stop: NDArray[np.uint8]) -> Cast:
    """The function by which embreex casts rays, until `stop` (1,) is set."""

    def cast(f: int, x: Floats, d: Floats) -> tuple[Floats, Ints]:
        if stop[0]:  # the caller's thread has received Ctrl-C
            raise KeyboardInterrupt
        tree = meshes[f].tree
        if tree is None or not len(x):
            return np.full(len(x), np.inf), np.full(len(x), -1)
        x, d = (x - scene.centre[f]) * scene.scale[f], d * scene.scale[f]
        start = near_enough(x, d)
        come = np.isfinite(start)
        t, face = np.full(len(x), np.inf), np.full(len(x), -1)
        origin = (x[come] + start[come, None] * d[come]).astype(np.float32)
        hit = tree.run(origin, d[come].astype(np.float32), output=1)
        face[come] = hit["primID"]
        t[come] = np.where(hit["primID"] < 0, np.inf, hit["tfar"].astype(float) + start[come])
        return t, face

    return cast


@dataclass(frozen=True)
class Embree:
    """Paths over the meshes of the level sets, traced by Intel's Embree.

    Parameters
    ----------
    threads : int
        Threads that share the queries; 0 means one per processor. The result does not depend on it.
    """

    name: ClassVar[str] = "embree"
    geometry: ClassVar[Literal["mesh", "levelset", "both"]] = "mesh"
    threads: int = 0

    def __post_init__(self) -> None:
        if cure := self.available():
            raise BadInput(f"the backend 'embree' needs the package embreex, which is not installed; run: {cure}")
        if self.threads < 0:
            raise BadInput(f"got {self.threads} threads; expected a positive number, or 0 for all")

    @classmethod
    def available(cls) -> str | None:
        """None, or the remedy."""
        return None if importlib.util.find_spec("embreex") else "pip install embreex"

    def prepare(self, scene: Scene) -> "EmbreeTracer":
        """Lay the fields out; meshes are built on first use."""
        check_opaque(scene)
        return EmbreeTracer(self, scene, *laid_out(scene), Meshes(scene, grow), pool(self.threads))

    solve = solve_once


@dataclass(frozen=True, eq=False)
class EmbreeTracer:
    """A scene set up for `Embree`."""

    backend: Embree
    scene: Scene
    channels: Channels
    fields: Marchable
    meshes: Meshes
    threads: ThreadPoolExecutor
    cache: Cache = NO_CACHE

    def __reduce__(self) -> tuple[Any, ...]:
        return prepare, (self.backend, self.scene, self.cache)

    @in_turn
    def solve(self, queries: Queries, *, paths: range, bounces: int, seed: int) -> Samples:
        """Trace paths from every query: see `illumgrid.stages.Backend`."""
        n = len(queries)
        mean, m2 = np.zeros((2, n, len(self.channels)), np.float32)
        count = np.zeros(n, np.int32)
        if n and len(paths):
            point, normal, level = in_frame(self.scene, queries)
            stop = np.zeros(1, np.uint8)
            with np.errstate(over="ignore"):
                key = stream(np.uint64(seed), queries.id)

            def chunk(surfaces: Casting, rows: Ints) -> None:
                own = queries.target[rows].astype(np.int64)
                light, spread, good = answer(
                    surfaces, self.cache, key[rows], level[rows], own, point[rows], normal[rows], paths, bounces
                )
                mean[rows], m2[rows], count[rows] = light, spread, np.where(good, len(paths), 0)

            share(self.threads, chunk, self._pieces(queries.level, stop), stop)
        return Samples(queries, mean, m2, count, self.channels)

    def _pieces(self, level: Floats, stop: NDArray[np.uint8]) -> Iterator[tuple[Casting, NDArray[np.int64]]]:
        """The surfaces for each row of levels, and the queries on it."""
        for row, members in row_groups(self.scene, level):
            meshes = self.meshes.of(row)
            layout = meshed(self.fields, meshes)
            surfaces = Casting(layout, by_embree(layout, meshes, stop))
            for i in range(0, len(members), 1024):
                yield surfaces, members[i : i + 1024]


@hookimpl
def register_backends() -> list[type[Backend]]:
    """Register the stage of this file, as a plugin does."""
    return [Embree]
