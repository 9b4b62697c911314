"""Level sets as closed meshes that rays meet: grouped by level, built once, kept while there is room.

A mesh lies in the axes of its volume, from voxel 0, in world units: what is built does not depend on the scene.
"""

import weakref
from collections import OrderedDict, namedtuple
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.backends import bvh
from illumgrid.errors import BadInput
from illumgrid.field.levelset import Marchable, extract, marchable
from illumgrid.field.scene import Field, Scene
from illumgrid.field.volume import Floats, Side, Volume

SAME_LEVEL = 1e-6
"""Levels that this share of a field's range rounds to the same number share a mesh."""

MOST_ROWS = 256
"""Rows of levels that one request may have: at 128³ voxels each costs about half a second to extract and to build."""

ROOM = 1 << 28
"""Bytes of meshes that are kept for each volume; the one used longest ago goes first."""

OFF = 2.0**-19
"""How far rays start off a face, as a share of the half extent of its mesh: what rounding to single precision may move
a triangle, an origin and a hit, four times over."""


@dataclass(frozen=True, eq=False)
class LevelMesh:
    """The solid of one field at one level: a closed mesh, and the tree over it.

    Parameters
    ----------
    vertices : (k, 3) float64
    faces : (m, 3) int32
        Counterclockwise from outside.
    facing : (m, 3) float64
        Unit normals of the faces as the tree has them, in single precision; 0 where a face has no area.
    cap : (m,) bool
        Faces on the border of the volume.
    tree : Tree
    """

    vertices: Floats
    faces: NDArray[np.int32]
    facing: Floats
    cap: NDArray[np.bool_]
    tree: bvh.Tree

    @property
    def size(self) -> int:
        """Bytes."""
        return int(sum(a.nbytes for a in (self.vertices, self.faces, self.facing, self.cap, self.tree.memory)))


def _build(volume: Volume, level: float, inside: Side) -> LevelMesh:
    """Extract a level set with caps, and build its tree."""
    index, faces = extract(volume, level, inside, capped=True)
    corners, last = index[faces], np.array(volume.shape) - 1
    cap = ((corners == 0).all(axis=1) | (corners == last).all(axis=1)).any(axis=1)
    vertices = index * volume.spacing
    tree = bvh.build(vertices, faces)
    triangles = ((vertices - tree.centre) * tree.scale).astype(np.float32)[faces].astype(float)
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(across, axis=1, keepdims=True)
    return LevelMesh(vertices, faces.astype(np.int32), across / np.where(area > 0, area, 1.0), cap, tree)


_kept: "weakref.WeakKeyDictionary[Volume, OrderedDict[tuple[Side, float], LevelMesh]]" = weakref.WeakKeyDictionary()


def level_mesh(field: Field, level: float) -> LevelMesh:
    """Mesh of the solid of a field; from the last ones built for its volume, if it is among them."""
    kept = _kept.setdefault(field.volume, OrderedDict())
    key = field.inside, level
    mesh = kept.pop(key, None) or _build(field.volume, level, field.inside)
    kept[key] = mesh
    while len(kept) > 1 and sum(m.size for m in kept.values()) > ROOM:
        kept.popitem(last=False)
    return mesh


def row_groups(scene: Scene, level: Floats) -> Iterator[tuple[Floats, NDArray[np.int64]]]:
    """Rows of levels (F,) that differ, and the queries (n,) that ask for each.

    Levels are rounded to a millionth of the field's range, whatever else is in the batch: an answer depends on the
    query alone.

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
        "memory",  # (...) float32: the trees of all fields, one after the other
        "tree_start",  # (F,) int64: where each begins
        "centre",  # (F, 3) frame position that is the origin of the tree's space
        "scale",  # (F,) into that space
        "facing",  # (m, 3) unit normals of the faces of all fields, in the frame
        "cap",  # (m,) bool
        "face_start",  # (F,) int64: number of the first face of each
        "off",  # (F,) how far rays start off a face
        "stack",  # (...) int32: room for the traversal, one for each thread
    ),
)
"""A `Marchable` with the meshes of one row of levels: what compiled kernels cast rays at."""


def meshed(scene: Scene, row: Floats) -> Any:
    """Lay out a scene under one row of levels (F,) as a `Meshed`; one field costs no copy."""
    fields = marchable(scene)
    meshes = [level_mesh(field, level) for field, level in zip(scene.fields, row.tolist())]
    trees = [mesh.tree for mesh in meshes]
    memory = [tree.memory for tree in trees]
    scale = np.array([tree.scale for tree in trees])
    layout: Any = Meshed
    return layout(
        *fields,
        memory=memory[0] if len(trees) == 1 else np.concatenate(memory),
        tree_start=np.cumsum([0, *(len(m) for m in memory)], dtype=np.int64)[:-1],
        centre=np.array([tree.centre for tree in trees]) + fields.origin,
        scale=scale,
        facing=np.concatenate([mesh.facing for mesh in meshes]),
        cap=np.concatenate([mesh.cap for mesh in meshes]),
        face_start=np.cumsum([0, *(len(mesh.faces) for mesh in meshes)], dtype=np.int64)[:-1],
        off=OFF / scale,
        stack=bvh.stack_for(*trees),
    )
