"""Level sets as closed meshes for rays: grouped by level, built once, kept as long as memory allows.

A mesh lies in the axes of its volume, from voxel 0, in world units.
"""

from collections import OrderedDict, namedtuple
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.backends.mesh import bvh
from illumgrid.errors import BadInput
from illumgrid.field.levelset import Marchable, extract
from illumgrid.field.scene import Field, Scene
from illumgrid.field.volume import Floats

SAME_LEVEL = 1e-6
"""Levels that are equal when rounded to this share of a field's range have a common mesh."""

MOST_ROWS = 256
"""Most rows of levels of one call: at 128³ voxels each takes about half a second to extract and build."""

ROOM = 1 << 28
"""Bytes of meshes that a tracer keeps; the one not used for the longest time goes first."""

TREE = 160
"""Approximate bytes of a tree for each face of its mesh."""

OFF = 2.0**-19
"""Offset of rays that start on a face, as a share of the half extent of its mesh: four times the bound on the error of
triangle, origin and hit by rounding to single precision."""


def check_opaque(scene: Scene) -> None:
    """Refuse fields that transmit: rays would hardly meet the inner sides of meshes.

    Raises
    ------
    BadInput
    """
    for film in scene.fields:
        if film.material.transmission > 0:
            raise BadInput(
                f"field {film.name!r} has a transmission, which meshes do not support; expected the backend numba with "
                "the surface levelset, or reference"
            )


@dataclass(frozen=True, eq=False)
class LevelMesh:
    """The solid of one field at one level: a closed mesh, and what casts rays at it.

    Parameters
    ----------
    vertices : (k, 3) float64
    faces : (m, 3) int32
        Counterclockwise from outside.
    facing : (m, 3) float64
        Unit normals of the faces as the tree has them, in single precision; 0 where a face has no area.
    cap : (m,) bool
        Faces on the border of the volume.
    centre : (3,) float64
    scale : float
        What moves and scales the mesh into [-1, 1]³, the space of the tree: see `bvh.unit_cube`.
    tree : object
        What a backend made of the mesh in that space, such as a `bvh.Tree`.
    """

    vertices: Floats
    faces: NDArray[np.int32]
    facing: Floats
    cap: NDArray[np.bool_]
    centre: Floats
    scale: float
    tree: Any

    @property
    def size(self) -> int:
        """Bytes; a tree takes about `TREE` a face."""
        return int(sum(a.nbytes for a in (self.vertices, self.faces, self.facing, self.cap)) + TREE * len(self.faces))


def level_mesh(field: Field, level: float, grow: Callable[[Floats, NDArray[np.int64]], Any] = bvh.build) -> LevelMesh:
    """Mesh of the solid of a field, with caps; `grow` makes a tree of vertices (k, 3) and faces (m, 3)."""
    volume = field.volume
    index, faces = extract(volume, level, field.inside, capped=True)
    corners, last = index[faces], np.array(volume.shape) - 1
    cap = ((corners == 0).all(axis=1) | (corners == last).all(axis=1)).any(axis=1)
    vertices = index * volume.spacing
    centre, scale = bvh.unit_cube(vertices[faces])
    triangles = ((vertices - centre) * scale).astype(np.float32)[faces].astype(float)
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(across, axis=1, keepdims=True)
    facing = across / np.where(area > 0, area, 1.0)
    return LevelMesh(vertices, faces.astype(np.int32), facing, cap, centre, scale, grow(vertices, faces))


@dataclass(frozen=True, eq=False)
class Meshes:
    """The meshes of a scene's level sets: each is built on first use, and kept as long as memory allows.

    Any thread may call: one builds, the others wait.

    Parameters
    ----------
    scene : Scene
    grow : callable
        See `level_mesh`.
    """

    scene: Scene
    grow: Callable[[Floats, NDArray[np.int64]], Any]
    _kept: "OrderedDict[tuple[int, float], LevelMesh]" = field(default_factory=OrderedDict)
    _lock: Any = field(default_factory=Lock)

    def of(self, row: Floats) -> list[LevelMesh]:
        """The meshes of every field under a row of levels (F,)."""
        with self._lock:
            found = []
            for key in enumerate(row.tolist()):
                mesh = self._kept.pop(key, None) or level_mesh(self.scene.fields[key[0]], key[1], self.grow)
                self._kept[key] = mesh
                found.append(mesh)
            while len(self._kept) > len(row) and sum(m.size for m in self._kept.values()) > ROOM:
                self._kept.popitem(last=False)
            return found


def row_groups(scene: Scene, level: Floats) -> Iterator[tuple[Floats, NDArray[np.int64]]]:
    """Distinct rows of levels (F,), and the queries (n,) on each.

    Levels are rounded to a millionth of the field's range, independently of the batch: a result depends on the query
    alone.

    Raises
    ------
    BadInput
        Above `MOST_ROWS` of them.
    """
    limits = np.array([field.range for field in scene.fields])
    step = SAME_LEVEL * (limits[:, 1] - limits[:, 0])
    rows, group = np.unique(np.rint((level - limits[:, 0]) / step), axis=0, return_inverse=True)
    if len(rows) > MOST_ROWS:
        raise BadInput(
            f"these {len(level)} queries lie on {len(rows)} different level sets, each of which would need a mesh; "
            f"expected at most {MOST_ROWS}: march the level sets (surface=levelset), or choose a sampler whose queries "
            "share level sets, such as uniform"
        )
    order = np.argsort(group.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(group.reshape(-1), minlength=len(rows)))
    for row, members in zip(rows, np.split(order, ends[:-1])):
        yield limits[:, 0] + row * step, members


Meshed = namedtuple(  # type: ignore[misc]
    "Meshed",
    (
        *Marchable._fields,
        "centre",  # (F, 3) frame position of the origin of the space of the field's mesh
        "scale",  # (F,) scale into that space
        "facing",  # (m, 3) unit normals of the faces of all fields, in the frame
        "cap",  # (m,) bool
        "face_start",  # (F,) int64: number of the first face of each
        "off",  # (F,) offset of rays that start on a face
        "memory",  # (...) float32: the trees of all fields, one after the other, if these are `bvh.Tree`
        "tree_start",  # (F,) int64: where each begins
        "stack",  # (...) int32: scratch memory for the traversal, one for each thread
    ),
)
"""A `Marchable` with the meshes of one row of levels: what compiled kernels cast rays at."""


def meshed(fields: Marchable, meshes: Sequence[LevelMesh]) -> Any:
    """Lay out a scene with the meshes of one row of levels, one per field, as a `Meshed`; one field costs no copy."""
    trees = [mesh.tree for mesh in meshes if isinstance(mesh.tree, bvh.Tree)]
    memory = [tree.memory for tree in trees]
    scale = np.array([mesh.scale for mesh in meshes])
    layout: Any = Meshed
    return layout(
        *fields,
        centre=np.array([mesh.centre for mesh in meshes]) + fields.origin,
        scale=scale,
        facing=np.concatenate([mesh.facing for mesh in meshes]),
        cap=np.concatenate([mesh.cap for mesh in meshes]),
        face_start=np.cumsum([0, *(len(mesh.faces) for mesh in meshes)], dtype=np.int64)[:-1],
        off=OFF / scale,
        memory=memory[0] if len(trees) == 1 else np.concatenate([np.zeros(0, np.float32), *memory]),
        tree_start=np.cumsum([0, *(len(m) for m in memory)], dtype=np.int64)[:-1],
        stack=bvh.stack_for(*trees),
    )
