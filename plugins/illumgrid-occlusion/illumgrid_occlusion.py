"""A backend for illumgrid: ambient occlusion within a radius, depth without light transport."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.ndimage import map_coordinates

from illumgrid.rng import draw, stream
from illumgrid.stages import Samples, hookimpl

CHUNK = 1 << 17  # directions at once: bounds the memory


def cosine_directions(normal, key, paths):
    """Unit directions (n, p, 3), cosine-distributed about normals (n, 3), for the queries' keys and paths."""
    with np.errstate(over="ignore"):  # the integers of a random number wrap around, on purpose
        u, v = (draw(key[:, None], paths[None], np.uint64(number)) for number in (0, 1))
    radius, angle = np.sqrt(u), 2 * np.pi * v
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    side = np.cross(normal, axis)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(normal, side)
    part = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - u)
    return sum(p[..., None] * e[:, None] for p, e in zip(part, (side, other, normal)))


def in_solid(field, level, point):
    """Which world points (n, 3) lie in the solid of a field at isovalues (n,)."""
    volume, sign = field.volume, 1.0 if field.inside == "above" else -1.0
    index = (point - volume.origin) @ volume.direction / volume.spacing
    height = map_coordinates(sign * volume.stored, index.T, order=1, mode="constant", cval=np.finfo(np.float32).min)
    return height >= sign * volume.to_stored(level)


def meets_quad(quad, origin, direction, reach):
    """Which rays from (n, 3) along unit directions (n, 3) meet a parallelogram within `reach`."""
    across = np.cross(quad.edge_u, quad.edge_v)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = ((quad.corner - origin) @ across) / (direction @ across)
        hit = origin + t[:, None] * direction - quad.corner
    share = hit @ np.linalg.pinv(np.stack([quad.edge_u, quad.edge_v]))
    return (t > 1e-6 * reach) & (t < reach) & (share >= 0).all(axis=1) & (share <= 1).all(axis=1)


@dataclass(frozen=True)
class Occlusion:
    """Share of the directions, weighted by their cosine, that meet nothing within a radius: ambient occlusion.

    The answer is that of a white sky which begins at the radius: π where nothing is near. Albedo, lamps, background and
    bounces do not matter.

    Parameters
    ----------
    radius : float
        How far a direction is followed, in voxels.
    step : float
        Distance between the points where the field is read, in voxels; what is thinner may be missed.
    """

    name: ClassVar[str] = "occlusion"
    contract: ClassVar[int] = 2
    geometry: ClassVar[str] = "levelset"
    transport: ClassVar[bool] = False
    radius: float = 8.0
    step: float = 0.5

    def __post_init__(self):
        if not 0 < self.step <= self.radius < np.inf:
            raise ValueError(f"step is {self.step} and radius {self.radius}; expected 0 < step <= radius")

    def solve(self, scene, queries, *, paths, bounces, seed):
        """Follow one direction a path from every query: see `illumgrid.stages.Backend`."""
        n, count = len(queries), len(paths)
        open_to = np.zeros(n)
        good = self._outside(scene, queries) & (count > 0)
        rows = np.flatnonzero(good)
        size = max(1, CHUNK // max(count, 1))
        numbers = np.arange(paths.start, paths.stop, dtype=np.uint64)
        for first in range(0, len(rows), size):
            chunk = rows[first : first + size]
            open_to[chunk] = self._open(scene, queries[chunk], numbers, seed)
        total = np.where(good, count, 0)
        mean = np.divide(np.pi * open_to, total, out=np.zeros(n), where=good)
        # A share near 0 or 1 is less sure than its spread says: Agresti and Coull add one of each (Am. Stat. 52, 1998).
        share = (open_to + 1) / (total + 2)
        m2 = np.pi**2 * total * share * (1 - share)
        gray = [np.repeat(x[:, None], 3, axis=1).astype(np.float32) for x in (mean, m2)]
        return Samples(queries, *gray, total.astype(np.int32))

    @staticmethod
    def _outside(scene, queries):
        """Queries with a normal, outside the solids of other fields."""
        good = queries.normal.any(axis=1)
        for number, field in enumerate(scene.fields):
            good &= (queries.target == number) | ~in_solid(field, queries.level[:, number], queries.point)
        return good

    def _open(self, scene, queries, paths, seed):
        """Number (n,) of the paths of each query that meet nothing."""
        with np.errstate(over="ignore"):
            key = stream(np.uint64(seed), queries.id)
        ray = cosine_directions(queries.normal, key, paths).reshape(-1, 3)
        voxel = float(np.prod(scene.fields[0].volume.spacing) ** (1 / 3))
        owner = np.repeat(np.arange(len(queries)), len(paths))
        free = np.ones(len(ray), bool)
        for quad in scene.quads:
            free &= ~meets_quad(quad, queries.point[owner], ray, self.radius * voxel)
        for k in range(1, round(self.radius / self.step) + 1):
            left = np.flatnonzero(free)
            point = queries.point[owner[left]] + k * self.step * voxel * ray[left]
            for number, field in enumerate(scene.fields):
                free[left] &= ~in_solid(field, queries.level[owner[left], number], point)
        return free.reshape(len(queries), len(paths)).sum(axis=1)


@hookimpl
def register_backends():
    """Name the backend to illumgrid."""
    return [Occlusion]
