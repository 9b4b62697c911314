"""Rays against the meshes of level sets, which differ from the trilinear sets by O(spacing²)."""

import numpy as np

from illumgrid import constants
from illumgrid.backends import cubics, march, normals, simd
from illumgrid.backends.march import dot
from illumgrid.backends.mesh import traversal
from illumgrid.backends.mesh.meshes import Meshed
from illumgrid.backends.mesh.traversal import View, cast
from illumgrid.backends.normals import cell_normal, normal_by_field
from illumgrid.backends.simd import address, cached
from illumgrid.backends.surfaces import begin, inside, meet_solid, solid_normal
from illumgrid.constants import BURIED, CAP, LOST, MISS, NOWHERE, SURFACE

jit = cached(simd, traversal, cubics, march, normals, constants, _nrt=False)  # as in `march`


@jit
def cast_from(scene, f, x, d, limit):
    """First face of field f's mesh along the frame ray x + t d: (t, number, whether it was met from the front)."""
    tree = View(
        address(scene.memory[scene.tree_start[f] :]),
        scene.centre[f, 0], scene.centre[f, 1], scene.centre[f, 2], scene.scale[f],
    )  # fmt: skip
    t, face, _, _ = cast(tree, address(scene.stack), x[0], x[1], x[2], d[0], d[1], d[2], limit, False)
    if face < 0:
        return np.inf, NOWHERE, False
    face += scene.face_start[f]
    return t, face, dot(scene.facing[face], d) < 0.0


@jit
def mesh_from(scene, f, level, x, n, d, own, face, limit):
    """First meeting of the frame ray x + t d with field f's mesh, t < limit: (t, what, face).

    It starts on a surface of normal n; if `own`, on this mesh, on `face`. If it dips under that face, it meets it at
    once; otherwise it is offset by the bound on rounding. If it then meets a back face, it dipped under a neighbour.
    """
    off = scene.off[f]
    if own:
        n = (scene.facing[face, 0], scene.facing[face, 1], scene.facing[face, 2])
        if dot(n, d) <= 0.0:
            return 0.0, SURFACE, face
        if scene.cap[face]:
            return np.inf, MISS, NOWHERE
    x = (x[0] + off * n[0], x[1] + off * n[1], x[2] + off * n[2])
    t, met, front = cast_from(scene, f, x, d, limit)
    if met == NOWHERE:
        return np.inf, MISS, NOWHERE
    if not front:
        return 0.0, (SURFACE if own else BURIED), face
    return t, (CAP if scene.cap[met] else SURFACE), met


@jit
def normal_on_mesh(scene, f, what, face, x, d):
    """Normal where a ray met mesh f at x: the gradient normal; that of the face on a cap, or where there is none."""
    n = normal_by_field(scene, f, SURFACE, NOWHERE, x, d)
    if what == CAP or (n[0] == 0.0 and n[1] == 0.0 and n[2] == 0.0):
        facing = scene.facing[face]
        return facing[0], facing[1], facing[2]
    return n


@jit
def in_mesh(scene, f, level, x, n):
    """Whether the frame point x lies in or on the mesh of field f: a ray from beside x along n meets a back face."""
    off = scene.off[f]
    x = (x[0] + off * n[0], x[1] + off * n[1], x[2] + off * n[2])
    _, face, front = cast_from(scene, f, x, n, np.inf)
    return face != NOWHERE and not front


@jit
def settle_along(scene, own, x, n):
    """Move the frame point x along n onto mesh `own`: (position, face).

    Accept the nearest front face along -n or back face along +n within one cell, excluding caps: nothing lies between.
    """
    pace = max(
        abs(n[0]) / scene.spacing[own, 0], abs(n[1]) / scene.spacing[own, 1], abs(n[2]) / scene.spacing[own, 2]
    )  # cells along the axis on which it advances most
    found, shift, face, near = np.inf, 0.0, LOST, 2.0 * scene.off[own]
    for k in range(2):
        along = 2.0 * k - 1.0
        d = (along * n[0], along * n[1], along * n[2])
        start = (x[0] - near * d[0], x[1] - near * d[1], x[2] - near * d[2])
        t, met, front = cast_from(scene, own, start, d, near + 1.0 / pace)
        if met != NOWHERE and front == (k == 0) and not scene.cap[met] and abs(t - near) < found:
            found, shift, face = abs(t - near), along * (t - near), met
    return (x[0] + shift * n[0], x[1] + shift * n[1], x[2] + shift * n[2]), face


@jit
def settle(scene, own, x, n):
    """Move a query onto its own mesh, which lies a little beside the trilinear set: (position, face).

    Along its normal, or, where noise tilts that, along the normal of its cell; LOST if neither reaches the mesh.
    """
    if own >= scene.twin.shape[0]:
        return x, NOWHERE
    at, face = settle_along(scene, own, x, n)
    if face == LOST:
        ux = (x[0] - scene.origin[own, 0]) / scene.spacing[own, 0]
        uy = (x[1] - scene.origin[own, 1]) / scene.spacing[own, 1]
        uz = (x[2] - scene.origin[own, 2]) / scene.spacing[own, 2]
        steep = cell_normal(scene, own, ux, uy, uz)
        if steep[0] != 0.0 or steep[1] != 0.0 or steep[2] != 0.0:
            at, face = settle_along(scene, own, x, steep)
    return at, face


for _question, _answer in (
    (meet_solid, mesh_from),
    (solid_normal, normal_on_mesh),
    (inside, in_mesh),
    (begin, settle),
):
    _question.register(Meshed, _answer)
