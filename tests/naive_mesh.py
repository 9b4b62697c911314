"""Intersection of rays with every triangle of level-set meshes, with which `naive` traces paths over meshes.

`path_worth` and `is_hole` are those of `naive`, with hits from this module. Double precision, no tree, no grouping.
"""

from dataclasses import dataclass

import numpy as np

import naive
from illumgrid.field.levelset import isosurface

OFF = 1e-6  # of the extent: how far a ray starts beside a surface


@dataclass(frozen=True)
class MeshHit(naive.Hit):
    """A hit that knows the normal of its face."""

    facing: tuple | None = None


class Mesh:
    """The closed mesh of one field at one level, in the frame of the scene."""

    def __init__(self, scene, levels, number):
        field = scene.fields[number]
        mesh = isosurface(field.volume, float(levels[number]), field.inside, capped=True)
        corners = scene.to_frame(mesh.vertices)[mesh.faces]
        if np.linalg.det(field.volume.direction) < 0:
            corners = corners[:, ::-1]  # outward by the right hand, in the frame too
        low = scene.to_frame(field.volume.origin)
        high = low + (np.array(field.volume.shape) - 1) * field.volume.spacing
        near = 1e-9 * (high - low).max()
        self.cap = np.any([(np.abs(corners - end) < near).all(axis=1) for end in (low, high)], axis=0).any(axis=1)
        self.a, self.e1, self.e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        self.out = np.cross(self.e1, self.e2)
        size = np.linalg.norm(self.out, axis=1, keepdims=True)
        self.out = self.out / np.where(size > 0, size, 1)
        self.off = OFF * (np.ptp(corners, axis=(0, 1)).max() if len(corners) else 1.0)

    def first(self, x, d, limit=np.inf):
        """(t, face) of the first triangle, or None."""
        p = np.cross(d, self.e2)
        with np.errstate(all="ignore"):
            det = (self.e1 * p).sum(axis=1)
            s = x - self.a
            u, q = (s * p).sum(axis=1) / det, np.cross(s, self.e1)
            v, t = (q @ d) / det, (self.e2 * q).sum(axis=1) / det
            met = np.flatnonzero((u >= -1e-12) & (v >= -1e-12) & (u + v <= 1 + 1e-12) & (t > 0) & (t < limit))
        return min(((float(t[k]), int(k)) for k in met), default=None)


MESHES = {}


def mesh_of(scene, levels, number):
    key = id(scene), float(levels[number]), number
    if key not in MESHES:
        MESHES[key] = scene, Mesh(scene, levels, number)  # the scene is kept, so that its id stays its own
    return MESHES[key][1]


def first_hit(scene, levels, x, d, on=None, within=frozenset()):
    """First hit of a ray over meshes, of which no field transmits: see `naive.first_hit`."""
    assert not within
    x, d = np.array(x, float), np.array(d, float)
    walls = [naive.Wall(scene, k) for k in range(len(scene.quads))]
    hits = [wall.meet(x.tolist(), d.tolist()) for wall in walls if on is None or on.field != wall.number]
    for number in range(len(scene.fields)):
        mesh, own = mesh_of(scene, levels, number), on is not None and on.field == number
        beside = np.array(on.facing if own else on.normal)
        dip = MeshHit(0.0, number, on.x, on.normal, facing=on.facing) if own else None
        if own and beside @ d <= 0:
            hits.append(dip)
            continue
        found = None if own and on.cap else mesh.first(x + mesh.off * beside, d)
        if found is None:
            continue
        t, face = found
        if mesh.out[face] @ d >= 0:
            hits.append(dip if own else naive.Hit(0.0, number, x.tolist(), None))
            continue
        at = x + t * d
        solid = naive.Solid(scene, levels, number)
        u = [(at[a] - solid.origin[a]) / solid.spacing[a] for a in range(3)]
        cell = [min(max(int(np.floor(u[a])), 0), solid.last[a] - 1) for a in range(3)]
        normal = naive.outward_normal(solid, cell, [min(max(u[a] - cell[a], 0.0), 1.0) for a in range(3)])
        facing = tuple(mesh.out[face])
        if mesh.cap[face] or normal is None:
            normal = list(facing)
        hits.append(MeshHit(t, number, at.tolist(), normal, bool(mesh.cap[face]), facing))
    return min((hit for hit in hits if hit is not None), key=lambda hit: hit.t, default=None)


def settled(scene, query):
    """The query as a hit on its mesh, or None if there is none within a cell."""
    at = naive.on_query(scene, query)
    if at.field >= len(scene.fields):
        return MeshHit(0.0, at.field, at.x, at.normal)
    mesh, solid = mesh_of(scene, query.level[0], at.field), naive.Solid(scene, query.level[0], at.field)
    u = [(at.x[a] - solid.origin[a]) / solid.spacing[a] for a in range(3)]
    cell = [min(max(int(np.floor(u[a])), 0), solid.last[a] - 1) for a in range(3)]
    corners = solid.corners(cell)
    f = [min(max(u[a] - cell[a], 0.0), 1.0) for a in range(3)]
    steps = [[1.0 / solid.spacing[a] if a == b else 0.0 for a in range(3)] for b in range(3)]
    steep = -np.array([naive.along(corners, f, step)[1] for step in steps])
    for way in (np.array(at.normal), steep):
        if not way.any():
            continue
        way = way / np.linalg.norm(way)
        reach, near = 1 / max(abs(way[a]) / solid.spacing[a] for a in range(3)), 2 * mesh.off
        found = []
        for sign in (-1.0, 1.0):
            hit = mesh.first(np.array(at.x) - sign * near * way, sign * way, near + reach)
            if hit and not mesh.cap[hit[1]] and (mesh.out[hit[1]] @ way > 0):
                found.append((abs(hit[0] - near), sign * (hit[0] - near), hit[1]))
        if found:
            _, shift, face = min(found)
            x = (np.array(at.x) + shift * way).tolist()
            return MeshHit(0.0, at.field, x, at.normal, facing=tuple(mesh.out[face]))
    return None


def is_hole(scene, query):
    """Whether a query has no normal, no mesh within a cell, or lies in another solid."""
    at = settled(scene, query)
    if at is None or not any(at.normal):
        return True
    for number in range(len(scene.fields)):
        if number != at.field:
            mesh = mesh_of(scene, query.level[0], number)
            n = np.array(at.normal)
            found = mesh.first(np.array(at.x) + mesh.off * n, n)
            if found and mesh.out[found[1]] @ n >= 0:
                return True
    return False


def use(monkeypatch):
    """Let `naive` trace paths over meshes."""
    on_query = naive.on_query
    monkeypatch.setattr(naive, "first_hit", first_hit)

    def start(scene, query):
        monkeypatch.setattr(naive, "on_query", on_query)
        try:
            return settled(scene, query)
        finally:
            monkeypatch.setattr(naive, "on_query", start)

    monkeypatch.setattr(naive, "on_query", start)
