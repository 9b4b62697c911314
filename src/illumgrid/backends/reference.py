"""The same paths in pure NumPy, written to be read: all rays of a batch take each step together.

The path loop has the headings of `kernels.walk`; everything that Numba's kernels do for speed is left out. The surfaces
are an argument: the trilinear level set here, its mesh in `embree`.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from illumgrid.backends.lights_numpy import (
    Bools,
    Ints,
    asked_radiance,
    cosine_direction,
    distant_density,
    distant_direction,
    lamp_density,
    sky_seen,
)
from illumgrid.backends.march_numpy import CORNERS, Marching
from illumgrid.backends.spread import spread
from illumgrid.backends.surfaces_numpy import Surfaces, followed
from illumgrid.constants import BURIED, LOST, MISS, OFF_SWEEP, QUAD, SAME_ROW, SURFACE
from illumgrid.field.levelset import Marchable
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats
from illumgrid.grid.cache import NO_CACHE, Cache
from illumgrid.grid.channels import Channels
from illumgrid.rng import draw, draw_pair, mix, stream
from illumgrid.stages import Backend, hookimpl
from illumgrid.transport.samples import Queries, Samples, in_frame, in_turn
from illumgrid.transport.tracer import laid_out, solve_once

BATCH = 1 << 15  # rays that take each step together


def light_asked(
    surfaces: Surfaces, u: Floats, level: Floats, on: Ints, on_face: Ints, x: Floats, normal: Floats, within: Ints
) -> tuple[Floats, Floats]:
    """Sample one light at x: weight (n,), and the emission or radiance (n, C) to which it applies.

    A lamp is chosen in proportion to its power, the point uniform by area, from the numbers u (n, 3). The weight is
    that of the balance heuristic: cosine density over the sum of both densities (Veach & Guibas 1995).
    """
    scene, count = surfaces.scene, len(x)
    d, by_light, number = np.zeros((count, 3)), np.zeros(count), np.full(count, -1)
    light = np.zeros((count, len(scene.background)))
    some = np.flatnonzero(u[:, 2] < scene.asked[0])
    if len(some):
        lamp = np.minimum(np.searchsorted(scene.lamp_share, u[some, 2], side="right"), len(scene.lamps) - 1)
        q = scene.lamps[lamp]
        target = scene.quad_corner[q] + np.einsum("ni,nij->nj", u[some, :2], scene.quad_edges[q])
        distance = np.linalg.norm(target - x[some], axis=1)
        d[some] = (target - x[some]) / np.where(distance > 0, distance, 1.0)[:, None]
        by_light[some], number[some] = lamp_density(scene, q, distance, d[some]), len(scene.twin) + q
        by_light[some[distance == 0]] = 0.0
        light[some] = scene.emission[number[some]]
    some = np.flatnonzero(u[:, 2] >= scene.asked[0])
    if len(some):
        d[some] = distant_direction(scene, u[some])
        by_light[some], light[some] = distant_density(scene, d[some]), asked_radiance(scene, d[some])
    by_cosine = np.einsum("ij,ij->i", normal, d) / np.pi
    ask = np.flatnonzero((by_cosine > 0) & (by_light > 0) & ((number != on) | (number < 0)))
    # The ray may meet only this lamp, or nothing, and films before it, which let a share through.
    through = np.ones(len(ask))

    def dimmed(film: int, ray: Ints, share: Floats) -> Bools:
        through[ray] *= share
        return np.ones(len(ray), bool)

    start = level[ask], x[ask], normal[ask], d[ask], on[ask], on_face[ask], within[ask]
    _, met, _, _ = followed(surfaces, *start, dimmed)
    weight = np.zeros(count)
    weight[ask] = np.where(met == number[ask], through * by_cosine[ask] / (by_cosine[ask] + by_light[ask]), 0.0)
    return weight, light


def place_in_sweep(cache: Cache, level: Floats) -> Floats:
    """Position in the sweep, 0 to 1, of rows of levels (n, F); `OFF_SWEEP` if they do not belong to one setting."""
    if not len(cache.start):
        return np.full(len(level), OFF_SWEEP)
    first, last = cache.sweep.T
    with np.errstate(divide="ignore", invalid="ignore"):  # a held level has no position
        share = (level - first) / (last - first)
    on = (np.abs(share - share[:, :1]) <= SAME_ROW) & (share >= -SAME_ROW) & (share <= 1 + SAME_ROW)
    return np.where(on.all(axis=1), np.clip(share[:, 0], 0, 1), OFF_SWEEP)


def cached_light(
    scene: Marchable, cache: Cache, place: Floats, number: Ints, what: Ints, t: Floats, x: Floats, d: Floats
) -> tuple[Floats, Bools]:
    """Cached irradiance (n, C) where rays met surfaces at x, and whether (n,) paths end there: see `gathering`."""
    light, ends = np.zeros((len(x), cache.light.shape[1])), np.zeros(len(x), bool)
    fields = len(scene.twin)
    for lattice, (start, shape) in enumerate(zip(cache.start, cache.shape)):
        here = (number == lattice) & (place != OFF_SWEEP) & (t >= cache.near[lattice])
        if lattice < fields:
            rows = np.flatnonzero(here & (what == SURFACE))
            index = (x[rows] - cache.origin[lattice]) / cache.spacing[lattice]
        else:
            quad = lattice - fields
            rows = np.flatnonzero(here & (what == QUAD) & (d @ scene.quad_normal[quad] < 0))
            u, v = scene.quad_duals[quad] @ (x[rows] - scene.quad_corner[quad]).T
            index = np.stack([place[rows] * (shape[0] - 1), v * shape[1] - 0.5, u * shape[2] - 0.5], axis=1)
        index = np.clip(index, 0, shape - 1)
        cell = index.astype(np.int64)
        good = cache.trusted[start + np.ravel_multi_index(tuple(cell.T), tuple(shape))]
        rows, cell, e = rows[good], cell[good], (index - cell)[good]
        for corner in CORNERS:
            node = tuple(np.minimum(cell + corner, shape - 1).T)
            weight = np.where(corner, e, 1 - e).prod(axis=1)
            light[rows] += weight[:, None] * cache.light[start + np.ravel_multi_index(node, tuple(shape))]
        ends[rows] = True
    return light, ends


def emission_weight(
    scene: Marchable, normal: Floats, t: Floats, number: Ints, wall: Bools, approach: Floats, d: Floats
) -> Floats:
    """Weight (n,) of what surfaces emit towards the ends of rays that left along d, by the cosine about `normal`.

    It is 1 but on walls. A quad emits on its front only, where `approach`, the cosine for each wall, is negative. A
    lamp is also sampled directly, so it has the weight of the balance heuristic.
    """
    weight = np.ones(len(t))
    by_cosine = np.einsum("ij,ij->i", normal[wall], d[wall]) / np.pi
    by_lamp = lamp_density(scene, number[wall] - len(scene.twin), t[wall], d[wall])
    weight[wall] = np.where(approach < 0, by_cosine / (by_cosine + by_lamp), 0.0)
    return weight


def walk(
    surfaces: Surfaces,
    cache: Cache,
    key: NDArray[np.uint64],
    path: NDArray[np.uint64],
    bounces: int,
    level: Floats,
    own: Ints,
    own_face: Ints,
    x: Floats,
    normal: Floats,
    within: Ints,
) -> Floats:
    """Contribution (n, C) of one path from each point of a surface: the irradiance is π times the mean.

    `keep` is the share of the light that comes back along the path; `within` (n,) has the bits of the fields in
    whose shells it starts.
    """
    scene, within = surfaces.scene, within.copy()
    worth, keep = np.zeros((len(x), len(scene.background))), np.ones((len(x), len(scene.background)))
    place = place_in_sweep(cache, level)
    x, normal, on, on_face = x.copy(), normal.copy(), own.astype(np.int64), own_face.copy()
    alive, fields = np.arange(len(x)), len(scene.twin)
    for segment in range(bounces + 1):
        # Sample a lamp or the sky, weighted against the chance that the ray below finds it. One pair of numbers
        # serves both: each keeps its mean, and their shared boxes keep the error bars short.
        u1, u2 = draw_pair(key[alive], path[alive], np.uint64(segment))
        if len(scene.lamps) or scene.asked[0] < 1:
            u = np.stack([u1, u2, draw(key[alive], path[alive], np.uint64(segment))], axis=1)
            at = (level[alive], on[alive], on_face[alive], x[alive], normal[alive], within[alive])
            weight, light = light_asked(surfaces, u, *at)
            worth[alive] += keep[alive] * weight[:, None] * light

        # Choose a direction, cosine-distributed about the normal.
        d = cosine_direction(u1, u2, normal[alive])

        # Follow the ray to the nearest surface, through films by chance; one that dips under its own meets it at once.
        start, shells = (level[alive], x[alive], normal[alive]), within[alive]

        def by_chance(film: int, ray: Ints, share: Floats, alive: Ints = alive, segment: int = segment) -> Bools:
            own_key = mix(key[alive[ray]] + np.uint64(film + 1))
            return np.asarray(draw(own_key, path[alive[ray]], np.uint64(segment)) < share)

        t, number, what, face = followed(surfaces, *start, d, on[alive], on_face[alive], shells, by_chance)
        within[alive] = shells

        # A path that escapes sees the sky and ends.
        escaped, away = alive[what == MISS], d[what == MISS]
        for weight, light in sky_seen(scene, normal[escaped], away):
            worth[escaped] += keep[escaped] * weight * light

        # A path inside a solid carries no light.
        goes_on = (what != MISS) & (what != BURIED)
        alive, t, d, number, what, face = (array[goes_on] for array in (alive, t, d, number, what, face))

        # Account for what the surface emits.
        wall = what == QUAD
        approach = np.einsum("ij,ij->i", scene.quad_normal[number[wall] - fields], d[wall])
        weight = emission_weight(scene, normal[alive], t, number, wall, approach, d)
        worth[alive] += keep[alive] * weight[:, None] * scene.emission[number]

        # Reflect: multiply by the albedo, and continue from the hit.
        keep[alive] *= scene.albedo[number]
        on[alive], on_face[alive] = number, face
        moved = (t > 0) | wall
        x[alive] += np.where(moved, t, 0.0)[:, None] * d
        for f in range(fields):
            here = np.flatnonzero(moved & (number == f))
            side = np.where((within[alive[here]] >> f & 1) & (what[here] == SURFACE), -1.0, 1.0)
            normal[alive[here]] = side[:, None] * surfaces.normal(f, what[here], face[here], x[alive[here]], d[here])
        normal[alive[wall]] = -np.sign(approach)[:, None] * scene.quad_normal[number[wall] - fields]

        # End where the cache is trusted.
        goes_on = normal[alive].any(axis=1)
        if cache.after <= segment < bounces and len(cache.start):
            inner = ~wall & (within[alive] >> np.where(wall, 0, number) & 1 == 1)  # within a shell: not in the grid
            met = np.where(moved & ~inner, what, MISS)
            light, ends = cached_light(scene, cache, place[alive], number, met, t, x[alive], d)
            worth[alive] += keep[alive] * light / np.pi
            goes_on &= ~ends
        alive = alive[goes_on]
    return worth


def answer(
    surfaces: Surfaces, cache: Cache, key: NDArray[np.uint64], level: Floats, target: Ints, x: Floats, normal: Floats,
    paths: range, bounces: int,
) -> tuple[Floats, Floats, Bools]:  # fmt: skip
    """Mean (n, C) and m2 (n, C) of the irradiance at queries in the frame, and which (n,) are not holes.

    A hole has no normal, no surface within reach, or lies inside the solid of a field that is not its own.
    """
    mean, m2 = np.zeros((2, len(x), len(surfaces.scene.background)))
    x, face = surfaces.begin(target, x, normal)
    good = normal.any(axis=1) & (face != LOST)
    within = np.zeros(len(x), np.int64)
    for f, twin in enumerate(surfaces.scene.twin):
        there = (target != f) & surfaces.inside(f, level[:, f], x, normal)
        good &= ~there | (twin >= 0)
        within |= there.astype(np.int64) << f
    asked = np.flatnonzero(good) if len(paths) else np.zeros(0, np.int64)
    step = max(1, BATCH // max(len(paths), 1))
    for at in range(0, len(asked), step):
        rows = asked[at : at + step]
        every = np.repeat(rows, len(paths))
        block = np.tile(np.arange(paths.start, paths.stop, dtype=np.uint64), len(rows))
        with np.errstate(over="ignore"):  # the random numbers wrap around, on purpose
            light = walk(
                surfaces, cache, key[every], block, bounces, level[every], target[every], face[every], x[every],
                normal[every], within[every],
            )  # fmt: skip
        light = light.reshape(len(rows), len(paths), -1).swapaxes(0, 1)
        mean[rows] = np.pi * light.mean(axis=0)
        m2[rows] = np.pi**2 * spread(light, paths.start, surfaces.scene.usual, surfaces.scene.lamplight)
    return mean, m2, good


@dataclass(frozen=True)
class Reference:
    """The same paths as `numba`, in pure NumPy: slow and easy to check."""

    name: ClassVar[str] = "reference"
    geometry: ClassVar[Literal["mesh", "levelset", "both"]] = "levelset"

    def prepare(self, scene: Scene) -> "ReferenceTracer":
        """Lay the fields out."""
        channels, fields = laid_out(scene)
        return ReferenceTracer(scene, channels, Marching(fields))

    solve = solve_once


@dataclass(frozen=True, eq=False)
class ReferenceTracer:
    """A scene set up for `Reference`."""

    scene: Scene
    channels: Channels
    surfaces: Marching
    cache: Cache = NO_CACHE

    @in_turn
    def solve(self, queries: Queries, *, paths: range, bounces: int, seed: int) -> Samples:
        """Trace paths from every query: see `illumgrid.stages.Backend`."""
        point, normal, level = in_frame(self.scene, queries)
        with np.errstate(over="ignore"):
            key = stream(np.uint64(seed), queries.id)
        target = queries.target.astype(np.int64)
        mean, m2, good = answer(self.surfaces, self.cache, key, level, target, point, normal, paths, bounces)
        count = np.where(good, len(paths), 0).astype(np.int32)
        return Samples(queries, mean.astype(np.float32), m2.astype(np.float32), count, self.channels)


@hookimpl
def register_backends() -> list[type[Backend]]:
    """Register the stage of this file, as a plugin does."""
    return [Reference]
