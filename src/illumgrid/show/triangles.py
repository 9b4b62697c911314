"""The content of a picture as coloured triangles for OpenGL."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.levelset import isosurface
from illumgrid.field.scene import Field
from illumgrid.field.volume import Floats, outward_normals, world_to_index
from illumgrid.show.caps import face_normals
from illumgrid.show.shade import Colors, Shown

WALL_STEPS = 4  # squares along each side of a texel: between these, bilinear light looks linear


@dataclass(frozen=True, eq=False)
class Colored:
    """Triangles and their colours.

    Parameters
    ----------
    points : (n, 3) float64
        World.
    faces : (m, 3) int
    colors : (n, 3) float32
        Display-linear.
    cover : (n,) float32, optional
        Share that hides the background; by default all.
    """

    points: Floats
    faces: NDArray[np.integer]
    colors: Colors
    cover: NDArray[np.float32] | None = None


def seen(shown: Shown, eye: Floats) -> list[Colored]:
    """Surfaces, caps and walls of one setting of the sweep, as seen from `eye`; walls from their front only."""
    found = []
    for number, field in enumerate(shown.scene.fields):
        found += solid(shown, number, field, eye)
    for number, quad in enumerate(shown.scene.quads):
        if (eye - quad.corner) @ quad.normal > 0:
            found.append(wall(shown, number, eye))
    return found


def solid(shown: Shown, number: int, field: Field, eye: Floats) -> list[Colored]:
    """The level set of one field, and its caps."""
    mesh = isosurface(field.volume, float(shown.row[number]), field.inside, capped=True)
    if not len(mesh.faces):
        return []
    points = np.asarray(mesh.vertices)
    index = world_to_index(field.volume, points)
    face = _caps(index, mesh.faces, field)
    facing = np.zeros(len(points))
    if shown.local or shown.trust:
        toward = eye - points
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        normals = outward_normals(field.volume, index, field.inside) @ field.volume.direction.T
        facing = np.einsum("ij,ij->i", normals, toward)
    found = [Colored(points, mesh.faces[face < 0], shown.field(number, points, facing))]
    for k, normal in enumerate(face_normals(field.volume)):
        used, faces = np.unique(mesh.faces[face == k], return_inverse=True)
        if len(used):
            toward = eye - points[used]
            facing = toward @ normal / np.linalg.norm(toward, axis=1)
            colors = shown.cap(number, points[used], np.full(len(used), k), facing)
            found.append(Colored(points[used], faces.reshape(-1, 3), colors))
    return found


def _caps(index: Floats, faces: NDArray[np.integer], field: Field) -> NDArray[np.int64]:
    """The face of the volume (m,) in which each face of the mesh lies, -1 for none: the mesh is exact there."""
    cut = np.full(len(faces), -1)
    for axis, last in enumerate(np.array(field.volume.shape) - 1):
        for end, plane in enumerate((0, last)):
            cut[(index[:, axis] == plane)[faces].all(axis=1)] = 2 * axis + end
    return cut


def squares(nu: int, nv: int) -> NDArray[np.int64]:
    """Triangles (m, 3) that join (nu, nv) points in C order into a sheet."""
    corner = (np.arange(nu - 1)[:, None] * nv + np.arange(nv - 1)).reshape(-1, 1)
    return np.asarray((corner + np.array([[0, nv, nv + 1, 0, nv + 1, 1]])).reshape(-1, 3))


def wall(shown: Shown, number: int, eye: Floats) -> Colored:
    """One quad, its triangles wound so that they face its front."""
    quad = shown.scene.quads[number]
    nu, nv = (WALL_STEPS * n + 1 for n in quad.texels)
    u, v = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, nu), np.linspace(0, 1, nv), indexing="ij"))
    points = quad.corner + u[:, None] * quad.edge_u + v[:, None] * quad.edge_v
    toward = eye - points
    facing = toward @ quad.normal / np.linalg.norm(toward, axis=1)
    return Colored(points, squares(nu, nv), shown.wall(number, u, v, facing), shown.fade(number, u, v))
