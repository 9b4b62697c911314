"""Meshes from files: PLY, STL, OBJ and glTF, by trimesh."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from illumgrid.errors import BadInput

if TYPE_CHECKING:
    import trimesh

ENDINGS = (".ply", ".stl", ".obj", ".glb")

Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""World axes in glTF: its up, +y, is the world's +z, and its front, +z, the world's -y (in LPS, the face)."""


def read_mesh(path: str | os.PathLike[str]) -> "trimesh.Trimesh":
    """Read a mesh of triangles: its vertices in their order, in world units, with their colours if it has any.

    Parameters
    ----------
    path : str or path-like
        A ``.ply``, ``.stl``, ``.obj``, or a ``.glb``: that one is turned from glTF's y up to the world's z up, as it is
        written here.

    Raises
    ------
    BadInput
        If it is not such a file, or contains no triangles.
    """
    import trimesh

    file = Path(path)
    if file.suffix.lower() not in ENDINGS:
        raise BadInput(f"the mesh is {file.name!r}; expected a file name that ends in {', '.join(ENDINGS)}")
    if not file.is_file():
        raise BadInput(f"{file}: there is no such file; expected a mesh; check the path")
    try:
        mesh = trimesh.load_mesh(file, process=file.suffix.lower() == ".stl", skip_materials=True)
        mesh = mesh.to_mesh() if isinstance(mesh, trimesh.Scene) else mesh
        faces = len(mesh.faces)
    except Exception as problem:  # whatever a parser raises on a file that is damaged
        reason = " ".join(str(problem).split())[:200]
        raise BadInput(f"{file.name}: cannot be read as a mesh ({type(problem).__name__}: {reason})") from None
    if not faces:
        raise BadInput(f"{file.name}: there are no triangles; expected a mesh")
    if file.suffix.lower() == ".glb":
        mesh.vertices = np.asarray(mesh.vertices) @ Y_UP
    return mesh
