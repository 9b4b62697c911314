"""Light at queries by Mitsuba: one scene of meshes for each row of levels, and two ways to sample it.

At a Lambertian surface the irradiance is gathered: emitters are sampled, and a path is followed along a
direction with the density of the cosine, with weights of the balance heuristic. Of a field with a material of its own
light is taken that leaves it, averaged over directions by the cosine and divided by the field's albedo: for a
Lambertian surface that is the irradiance, too, and a picture, which multiplies by the albedo, shows what leaves.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from illumgrid import isosurface
from illumgrid.field.volume import cell_gradient, interpolate, outward_normals, world_to_index
from illumgrid.rng import draw, mix, stream
from illumgrid.stages import Samples
from illumgrid_mitsuba import described, sky

mi.set_variant("llvm_ad_rgb")

LANES = 1 << 20
"""Paths at once: bounds the memory."""
SPECK = 1e-7
"""Size of the triangle that stands for an empty level set, in a scene of size 2."""
SAME_LEVEL = 1e-6
"""Levels that this share of a field's range rounds to the same number share a mesh."""
MOST_ROWS = 256
"""Rows of levels in one request, each of which needs meshes of its own."""
NO_ROULETTE = 1 << 20
STEP = np.uint64(0x9E3779B97F4A7C15)
DTYPES = {mi.Float: np.float32, mi.UInt64: np.uint64, mi.UInt32: np.uint32, mi.Bool: np.bool_}


class Numbers(mi.Sampler):
    """Random numbers for Mitsuba's integrators, a pure function of a key for each path."""

    def __init__(self, key):
        super().__init__(mi.Properties())
        self.key, self.count = lanes(mi.UInt64, key), mi.UInt64(0)

    def next_1d(self, active=True):
        """A uniform number: the finalizer of `illumgrid.rng.mix`, whose upper 24 bits single precision holds."""
        self.count += 1
        x = self.key + self.count * mi.UInt64(int(STEP))
        x = (x ^ (x >> 30)) * mi.UInt64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> 27)) * mi.UInt64(0x94D049BB133111EB)
        return mi.Float((x ^ (x >> 31)) >> 40) * mi.Float(2.0**-24)

    def next_2d(self, active=True):
        """Two of them."""
        return mi.Point2f(self.next_1d(), self.next_1d())


def lanes(kind, array):
    """Numbers (n,) as an array of Mitsuba's, at an address that is a multiple of 128.

    Memory of NumPy is taken over as it lies, and code is compiled anew for each combination of addresses that are
    multiples of the width of a vector register and that are not.
    """
    values = np.asarray(array, DTYPES[kind]).reshape(-1)
    room = np.empty(values.nbytes + 128, np.uint8)
    first = -room.ctypes.data % 128
    own = room[first : first + values.nbytes].view(values.dtype)
    own[:] = values
    return kind(own)


def vectors(kind, array):
    """Rows of (n, 3) as Mitsuba's vectors."""
    return kind(*(lanes(mi.Float, column) for column in array.T))


def color(value):
    """Linear RGB as Mitsuba takes it."""
    return {"type": "rgb", "value": [float(x) for x in value]}


class MitsubaTracer:
    """A scene set up for Mitsuba."""

    def __init__(self, backend, scene):
        self.backend, self.scene = backend, scene
        self.special = scene.number_of(backend.field or None) if backend.bsdf or backend.medium else -1
        if self.special >= 0 and not scene.fields[self.special].material.albedo.all():
            raise ValueError("the field with a material of Mitsuba has an albedo of 0; expected colours above 0")
        corners = np.concatenate([_box(field.volume) for field in scene.fields])
        self.centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
        self.scale = 2 / np.ptp(corners, axis=0).max()
        self._light = sky.emitters(scene)
        self._made, self._row, self._shapes = None, None, []

    def __reduce__(self):
        return type(self), (self.backend, self.scene)

    def solve(self, queries, *, paths, bounces, seed):
        """Trace paths from every query: see `illumgrid.stages.Backend`."""
        n, count = len(queries), len(paths)
        mean, m2 = np.zeros((2, n, 3), np.float32)
        done = np.zeros(n, np.int32)
        if not n or not count:
            return Samples(queries, mean, m2, done)
        open_to = ~holes(self.scene, queries)
        with np.errstate(over="ignore"):
            keys = stream(np.uint64(seed % 2**64), queries.id)
        size = max(1, LANES // count)
        for row, members in self._rows(queries.level):
            members = members[open_to[members]]
            scene = self._built(row) if len(members) else None
            for first in range(0, len(members), size):
                rows = members[first : first + size]
                worth, good = self._worth(scene, queries[rows], keys[rows], paths, bounces)
                light = np.pi * np.ascontiguousarray(
                    worth.transpose(0, 2, 1), float
                )  # (n, 3, paths): one order of sums
                mean[rows] = light.mean(axis=2)
                m2[rows] = ((light - light.mean(axis=2, keepdims=True)) ** 2).sum(axis=2)
                done[rows] = np.where(good, count, 0)
        mean[done == 0], m2[done == 0] = 0, 0
        return Samples(queries, mean, m2, done)

    def _rows(self, level):
        """Rows of levels (F,) that differ, and the queries that ask for each."""
        limits = np.array([field.range for field in self.scene.fields])
        step = SAME_LEVEL * (limits[:, 1] - limits[:, 0])
        rows, group = np.unique(np.rint((level - limits[:, 0]) / step), axis=0, return_inverse=True)
        if len(rows) > MOST_ROWS:
            raise ValueError(
                f"these {len(level)} queries lie on {len(rows)} different level sets, each of which needs a mesh; "
                f"expected at most {MOST_ROWS}: choose a sampler whose queries share level sets, such as uniform"
            )
        for number, row in enumerate(rows):
            yield limits[:, 0] + row * step, np.flatnonzero(group.reshape(-1) == number)

    def _built(self, row):
        """Mitsuba's scene with the meshes of one row of levels, and the shape of each field; None where there is none.

        One scene serves all rows, with other vertices: its compiled code knows each object by a number.
        """
        meshes = [self._solid(f, level) for f, level in enumerate(row)]
        if self._made is None:
            shapes = {f"field{f}": self._shape(f, *mesh) for f, mesh in enumerate(meshes)}
            shapes |= {f"quad{q}": self._wall(quad) for q, quad in enumerate(self.scene.quads)}
            self._made = mi.load_dict({"type": "scene", **shapes, **self._light})
            self._shapes = list(shapes.values())
        elif not np.array_equal(row, self._row):
            params = mi.traverse(self._made)
            for f, mesh in enumerate(meshes):
                _set_mesh(params, *mesh, prefix=f"field{f}.")
            params.update()
        self._row = row
        return self._made, [shape if solid[3] else None for shape, solid in zip(self._shapes, meshes)]

    def _solid(self, f, level):
        """Vertices, faces and perhaps normals of a field's solid, and whether there is any; else a speck."""
        field = self.scene.fields[f]
        mesh = isosurface(field.volume, float(level), inside=field.inside, capped=True)
        vertices, faces, there = mesh.vertices, mesh.faces, bool(len(mesh.faces))
        if not there:
            vertices, faces = _box(field.volume)[0] + np.eye(3) * SPECK / self.scale, np.array([[0, 1, 2]])
        normals = None
        if f == self.special:
            index = world_to_index(field.volume, vertices)
            normals = outward_normals(field.volume, index, field.inside) @ field.volume.direction.T
        return (vertices - self.centre) * self.scale, faces, normals, there

    def _shape(self, f, vertices, faces, normals, there):
        material = self.scene.fields[f].material
        parts = {"bsdf": {"type": "diffuse", "reflectance": color(material.albedo)}}
        return self._mesh(
            f"field{f}", vertices, faces, self._own_material() if f == self.special else parts, material, normals
        )

    def _own_material(self):
        """BSDF and medium as described; without a BSDF the medium has an invisible border."""
        parts = {"bsdf": described("bsdf", self.backend.bsdf) or {"type": "null"}}
        if medium := described("medium", self.backend.medium):
            parts["interior"] = {**medium, "scale": float(medium.get("scale", 1.0)) / self.scale}
        return parts

    def _wall(self, quad):
        """A quad reflects on both sides."""
        corners = quad.corner + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) @ np.array([quad.edge_u, quad.edge_v])
        diffuse = {"type": "diffuse", "reflectance": color(quad.material.albedo)}
        parts, faces = {"bsdf": {"type": "twosided", "bsdf": diffuse}}, np.array([[0, 1, 2], [0, 2, 3]])
        return self._mesh("quad", (corners - self.centre) * self.scale, faces, parts, quad.material)

    def _mesh(self, name, vertices, faces, parts, material, normals=None):
        props = mi.Properties()
        for part, description in parts.items():
            props[part] = mi.load_dict(description)
        if material.emission.any():
            props["emitter"] = mi.load_dict({"type": "area", "radiance": color(material.emission)})
        props["face_normals"] = normals is None
        mesh = mi.Mesh(name, len(vertices), len(faces), has_vertex_normals=normals is not None, props=props)
        params = mi.traverse(mesh)
        _set_mesh(params, vertices, faces, normals)
        params.update()
        return mesh

    def _worth(self, built, queries, keys, paths, bounces):
        """What each path of each query is worth (n, paths, 3), and which queries found their mesh."""
        scene, shapes = built
        point, facing, good = self._begun(scene, shapes, queries)
        lane = np.repeat(np.flatnonzero(good), len(paths))
        number = np.tile(np.arange(paths.start, paths.stop, dtype=np.uint64), int(good.sum()))
        worth = np.zeros((len(queries) * len(paths), 3))
        at = lane * len(paths) + np.tile(np.arange(len(paths)), int(good.sum()))
        special = queries.target[lane] == self.special
        with np.errstate(over="ignore"):
            key = mix(keys[lane] ^ mix(number + STEP))
        own = _Lanes(point[lane], facing[lane], queries.normal[lane], keys[lane], number, key, queries.target[lane])
        worth[at[~special]] = self._received(scene, own[~special], bounces)
        worth[at[special]] = self._left(scene, own[special], bounces)
        return worth.reshape(len(queries), len(paths), 3), good

    def _begun(self, scene, shapes, queries):
        """Where paths begin (n, 3), the normals of the faces there, and whether the mesh was found within a cell."""
        point = (queries.point - self.centre) * self.scale
        facing, good = queries.normal.copy(), np.ones(len(point), bool)
        for f, shape in enumerate(shapes):
            mine = np.flatnonzero(queries.target == f)
            good[mine] = False
            if not len(mine) or shape is None:
                continue
            field = self.scene.fields[f]
            cell = cell_gradient(field.volume, world_to_index(field.volume, queries.point[mine]))
            cell = -field.upward * cell @ field.volume.direction.T
            length = np.linalg.norm(cell, axis=1, keepdims=True)
            for along in (queries.normal[mine], cell / np.where(length > 0, length, 1.0)):
                ask = mine[~good[mine] & along.any(axis=1)]
                if len(ask):
                    d = along[~good[mine] & along.any(axis=1)]
                    point[ask], facing[ask], good[ask] = self._settled(scene, shape, field, point[ask], d)
        return point, facing, good

    def _settled(self, scene, shape, field, point, normal):
        """Points moved onto a shape: a front against the normal, or a back along it, the nearer one within a cell."""
        reach = float(np.linalg.norm(field.volume.spacing)) * self.scale
        found, place, facing, near = np.full(len(point), np.inf), point.copy(), normal.copy(), 1e-4
        for along in (-1.0, 1.0):
            d = along * normal
            start = point - near * d
            si = scene.ray_intersect(mi.Ray3f(vectors(mi.Point3f, start), vectors(mi.Vector3f, d)))
            t, n = np.array(si.t, float), np.array(si.n, float).T
            hit = np.array(si.is_valid() & (si.shape == mi.ShapePtr(shape)))
            away = np.abs(t - near)
            take = hit & (((n * d).sum(axis=1) < 0) == (along < 0)) & (t < near + reach) & (away < found)
            found[take], place[take], facing[take] = away[take], (start + t[:, None] * d)[take], n[take]
        return place, facing, np.isfinite(found)

    def _received(self, scene, own, bounces):
        """Light at Lambertian surfaces, along paths that may dip under their own face and reflect there."""
        worth, share = np.zeros((len(own), 3)), np.ones((len(own), 3))
        albedo, emission = (
            np.array([getattr(thing.material, part) for thing in (*self.scene.fields, *self.scene.quads)])[own.target]
            for part in ("albedo", "emission")
        )
        left = np.arange(len(own))
        for dips in range(bounces + 1):
            now = own[left]
            with np.errstate(over="ignore"):
                u = [draw(now.keys, now.number, np.uint64(4 * dips + k)) for k in range(4)]
            d = cosine_direction(now.normal, u[0], u[1])
            under = (now.facing * d).sum(axis=1) <= 0
            worth[left] += share[left] * self._gathered(scene, now, d, u[2:], ~under, bounces - dips, dips)
            left = left[under]
            worth[left] += share[left] * emission[left]
            share[left] *= albedo[left]
            if not len(left):
                break
        return worth

    def _gathered(self, scene, own, d, u, traced, bounces, dips):
        """Light (n, 3), divided by π, from emitters that are asked, and along directions that are `traced`."""
        if not len(own):
            return np.zeros((0, 3))
        at = mi.Interaction3f(0.0, 0.0, [], vectors(mi.Point3f, own.point), vectors(mi.Normal3f, own.facing))
        n, wo = vectors(mi.Normal3f, own.normal), vectors(mi.Vector3f, d)
        active = lanes(mi.Bool, traced)
        ds, light = scene.sample_emitter_direction(at, mi.Point2f(*(lanes(mi.Float, x) for x in u)), True)
        cosine = dr.maximum(dr.dot(n, ds.d), 0) / dr.pi
        asked = (ds.pdf > 0) & (dr.dot(at.n, ds.d) > 0)
        total = dr.select(asked, light * cosine * dr.select(ds.delta, 1, ds.pdf / (ds.pdf + cosine)), 0)
        ray = at.spawn_ray(wo)
        si = scene.ray_intersect(ray, active)
        seen = si.emitter(scene)
        emitted = seen.eval(si, active)
        by_light = scene.pdf_emitter_direction(at, mi.DirectionSample3f(scene, si, at), active)
        by_cosine = dr.maximum(dr.dot(n, wo), 0) / dr.pi
        weight = dr.select(by_cosine > 0, by_cosine / (by_cosine + by_light), 1)
        total += dr.select(active, emitted * weight, 0)
        if bounces > 0:
            total += dr.select(
                active, self._along(scene, ray, own.key + np.uint64(dips), bounces + 1, active) - emitted, 0
            )
        return np.array(total, float).T

    def _left(self, scene, own, bounces):
        """Light that leaves surfaces with materials of their own, along directions by the cosine; over their albedo."""
        if not len(own):
            return np.zeros((0, 3))
        with np.errstate(over="ignore"):
            d = cosine_direction(own.normal, *(draw(own.keys, own.number, np.uint64(k)) for k in range(2)))
        below = np.minimum((own.facing * d).sum(axis=1, keepdims=True), 0)
        d = d - 2 * below * own.facing
        ray = mi.Ray3f(vectors(mi.Point3f, own.point + 1e-3 * d), vectors(mi.Vector3f, -d))
        light = self._along(scene, ray, own.key, bounces + 2, mi.Bool(True))
        return np.array(light, float).T / self.scene.fields[self.special].material.albedo

    def _along(self, scene, ray, key, depth, active):
        """Radiance along rays, from at most `depth` segments."""
        kind = "prbvolpath" if self.backend.medium else "prb"
        integrator = mi.load_dict({"type": kind, "max_depth": depth, "rr_depth": NO_ROULETTE})
        sampler = Numbers(key)
        light, *_ = integrator.sample(
            mode=dr.ADMode.Primal, scene=scene, sampler=sampler, ray=ray, δL=None, state_in=None, active=active
        )
        return light


def _set_mesh(params, vertices, faces, normals, there=True, prefix=""):
    params[prefix + "vertex_positions"] = lanes(mi.Float, vertices)
    params[prefix + "faces"] = lanes(mi.UInt32, faces)
    if normals is not None:
        params[prefix + "vertex_normals"] = lanes(mi.Float, normals)


class _Lanes:
    """Paths: where they begin (n, 3), normals of face and field there, keys of query and path, numbers, targets."""

    def __init__(self, *parts):
        self.parts = parts
        self.point, self.facing, self.normal, self.keys, self.number, self.key, self.target = parts

    def __len__(self):
        return len(self.point)

    def __getitem__(self, rows):
        return _Lanes(*(part[rows] for part in self.parts))


def _box(volume):
    index = np.array(list(np.ndindex(2, 2, 2))) * (np.array(volume.shape) - 1)
    return volume.origin + index * volume.spacing @ volume.direction.T


def holes(scene, queries):
    """Queries without a normal, or inside the solid of another field."""
    hole = ~queries.normal.any(axis=1)
    for number, field in enumerate(scene.fields):
        index = world_to_index(field.volume, queries.point)
        within = ((index >= 0) & (index <= np.array(field.volume.shape) - 1)).all(axis=1)
        solid = field.solid(interpolate(field.volume, index), queries.level[:, number])
        hole |= (queries.target != number) & within & solid
    return hole


def cosine_direction(normal, u, v):
    """Unit directions (n, 3) with the density cosine / π about normals (n, 3)."""
    radius, angle = np.sqrt(u), 2 * np.pi * v
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    side = np.cross(normal, axis)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    parts = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - u)
    return sum(p[:, None] * e for p, e in zip(parts, (side, np.cross(normal, side), normal)))
