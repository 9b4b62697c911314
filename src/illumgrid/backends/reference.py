"""The same paths in pure NumPy, written to be read: all rays of a batch take each step together.

The path loop has the headings of `kernels.walk`; everything that Numba's kernels do for speed is left out. What rays
meet is handed in: the trilinear level set here, its mesh in `embree`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from illumgrid.backends.lights_numpy import (
    Ints,
    asked_radiance,
    cosine_direction,
    distant_density,
    distant_direction,
    lamp_density,
    sky_seen,
)
from illumgrid.backends.spread import spread
from illumgrid.constants import (
    BURIED,
    CAP,
    LOST,
    MISS,
    MOST_FILMS,
    NOWHERE,
    OFF_SWEEP,
    ON_A_VOXEL,
    ON_A_WALL,
    QUAD,
    SAME_ROW,
    SURFACE,
)
from illumgrid.field.levelset import Marchable
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats, central_differences, unit
from illumgrid.grid.cache import NO_CACHE, Cache
from illumgrid.grid.channels import Channels
from illumgrid.rng import draw, draw_pair, mix, stream
from illumgrid.stages import Backend, hookimpl
from illumgrid.transport.samples import Queries, Samples, in_frame, in_turn
from illumgrid.transport.tracer import laid_out, solve_once

Bools = NDArray[np.bool_]

BATCH = 1 << 15  # rays that take a step together
_CORNERS = np.array(list(np.ndindex(2, 2, 2)))


class Surfaces(Protocol):
    """The solids of all fields, as rays meet them. A `face` is the axis of a cap, or the face of a mesh, or NOWHERE."""

    @property
    def scene(self) -> Marchable:
        """All else that there is."""

    def meet(
        self, f: int, level: Floats, x: Floats, normal: Floats, d: Floats, own: Bools, face: Ints
    ) -> tuple[Floats, Ints, Ints]:
        """First meeting (t, what, face), each (n,), of frame rays with field f; `own` rays start on it, on `face`."""

    def normal(self, f: int, what: Ints, face: Ints, x: Floats, d: Floats) -> Floats:
        """Normals (n, 3) where rays along d met field f at x."""

    def begin(self, own: Ints, x: Floats, normal: Floats) -> tuple[Floats, Ints]:
        """Move queries onto the surface that stands for their level set: (position, face); LOST if there is none."""

    def inside(self, f: int, level: Floats, x: Floats, normal: Floats) -> Bools:
        """Whether points x on other surfaces lie inside the solid of field f."""


def voxels(scene: Marchable, f: int) -> NDArray[Any]:
    """The values of field f, axes x, y, z."""
    nx, ny, nz = scene.shape[f]
    return np.asarray(scene.values[scene.start[f] : scene.start[f] + nx * ny * nz].reshape(nx, ny, nz))


def index_of(scene: Marchable, f: int, x: Floats) -> Floats:
    """Index coordinates (n, 3) of frame points, on a plane of voxels where they nearly are."""
    u = (x - scene.origin[f]) / scene.spacing[f]
    nearest = np.round(u)
    return np.asarray(np.where(np.abs(u - nearest) < ON_A_VOXEL, nearest, u))


def cubic(scene: Marchable, f: int, level: Floats, cell: Ints, e: Floats, d: Floats) -> Floats:
    """Coefficients (n, 4) of sign v - level along e + t d, local in the cell: three blends, each one degree higher."""
    value = voxels(scene, f)[tuple((cell[:, None, :] + _CORNERS).transpose(2, 0, 1))]
    corners = scene.sign[f] * value - level[:, None]
    q: Floats = corners.reshape(-1, 2, 2, 2, 1)
    for axis in range(3):
        low, rise = q[:, 0], q[:, 1] - q[:, 0]
        shape = (-1,) + (1,) * (rise.ndim - 1)
        q = np.zeros((*low.shape[:-1], low.shape[-1] + 1))
        q[..., :-1] = low + rise * e[:, axis].reshape(shape)
        q[..., 1:] += rise * d[:, axis].reshape(shape)
    return q


def evaluate(q: Floats, t: Floats) -> Floats:
    """Value (n,) of the polynomials q (n, degree + 1) at t (n,)."""
    total = np.zeros(len(q))
    for k in range(q.shape[1] - 1, -1, -1):
        total = total * t + q[:, k]
    return total


def first_rise(q: Floats, end: Floats) -> Floats:
    """Smallest t (n,) in [0, end] at which the cubics q (n, 4), below 0 at 0, reach 0; inf if none.

    The roots of the derivative part the interval into monotone pieces; the first that ends at or above 0 is halved.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        a, b, c = q[:, 1], q[:, 2], q[:, 3]
        w = -(b + np.copysign(np.sqrt(b * b - 3 * a * c), b))
        stationary = np.sort(np.stack([w / (3 * c), a / w]), axis=0)
    knots = np.stack([np.zeros(len(q)), *np.where((stationary > 0) & (stationary < end), stationary, 0.0), end])
    knots = np.maximum.accumulate(knots, axis=0)
    left, right, found = np.zeros(len(q)), np.zeros(len(q)), np.zeros(len(q), bool)
    for low, high in pairwise(knots):
        here = ~found & (evaluate(q, high) >= 0)
        left, right = np.where(here, low, left), np.where(here, high, right)
        found |= here
    for _ in range(60):
        middle = 0.5 * (left + right)
        above = evaluate(q, middle) >= 0
        left, right = np.where(above, left, middle), np.where(above, middle, right)
    return np.where(found, right, np.inf)


def rise_from_surface(q: Floats, end: Floats) -> Floats:
    """The same for rays that start on the level set: the constant term is 0, and its root t = 0 is divided out."""
    rest = q[:, 1:].copy()
    for _ in range(2):  # zeros at the front are further roots at t = 0
        flat = rest[:, 0] == 0
        rest[flat] = np.roll(rest[flat], -1, axis=1)
    dips = rest[:, 0] > 0
    flat = ~rest.any(axis=1)  # a cell that is flat at the level is solid
    t = first_rise(np.pad(rest, ((0, 0), (0, 1))), end)
    return np.where(dips | flat, 0.0, t)


def march(
    scene: Marchable, f: int, level: Floats, u: Floats, d: Floats, on_surface: Bools
) -> tuple[Floats, Ints, Ints]:
    """Meeting of rays u + t d, in index coordinates, with {sign v >= level}: (t, what, axis of a cap), each (n,)."""
    n, last = len(u), scene.shape[f] - 1
    t_hit, what, face = np.full(n, np.inf), np.full(n, MISS), np.full(n, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_low, to_high = -u / d, (last - u) / d
    still, within = d == 0, (u >= 0) & (u <= last)
    near = np.where(still, np.where(within, -np.inf, np.inf), np.minimum(to_low, to_high))
    far = np.where(still, np.where(within, np.inf, -np.inf), np.maximum(to_low, to_high))
    t = np.maximum(near.max(axis=1), 0.0)
    entered = near.max(axis=1) > 0
    entry_axis = np.where(entered, near.argmax(axis=1), -1)

    # The cell that the ray enters; on a plane of voxels the direction decides.
    with np.errstate(invalid="ignore"):
        p = np.clip(u + np.where(np.isfinite(t), t, 0.0)[:, None] * d, 0.0, last)
    at_face = entry_axis[:, None] == np.arange(3)
    p = np.where(at_face, np.where(d > 0, 0.0, last), p)
    cell = np.floor(p).astype(np.int64)
    cell -= (p == cell) & ((d < 0) | (still & (cell == last)))
    ray = np.flatnonzero((t <= far.min(axis=1)) & ((cell >= 0) & (cell < last)).all(axis=1))

    # A ray that comes from outside and starts in the solid meets a cap, or is buried.
    solid = ray[(evaluate(cubic(scene, f, level[ray], cell[ray], p[ray] - cell[ray], d[ray]), np.zeros(len(ray))) >= 0)]
    solid = solid[~on_surface[solid]]
    t_hit[solid], what[solid], face[solid] = t[solid], np.where(entered[solid], CAP, BURIED), entry_axis[solid]
    ray = np.setdiff1d(ray, solid)

    # From cell to cell, all rays together.
    own = on_surface.copy()
    while len(ray):
        c, r = cell[ray], d[ray]
        with np.errstate(divide="ignore", invalid="ignore"):
            planes = np.where(r == 0, np.inf, (c + (r > 0)) * (1 / r) - u[ray] / r)
        t_next = np.maximum(t[ray], planes.min(axis=1))
        q = cubic(scene, f, level[ray], c, np.clip(u[ray] + t[ray, None] * r - c, 0.0, 1.0), r)
        length = t_next - t[ray]
        root = np.where(q[:, 0] >= 0, 0.0, first_rise(q, length))
        if own[ray].any():
            root[own[ray]] = rise_from_surface(q[own[ray]], length[own[ray]])
        own[ray] = False
        hit = np.isfinite(root)
        t_hit[ray[hit]], what[ray[hit]] = t[ray[hit]] + root[hit], SURFACE
        axis = planes.argmin(axis=1)
        c[np.arange(len(c)), axis] += np.where(r[np.arange(len(c)), axis] > 0, 1, -1)
        cell[ray], t[ray] = c, t_next
        ray = ray[~hit & ((c >= 0) & (c < last)).all(axis=1)]
    return t_hit, what, face


def meet_quad(scene: Marchable, q: int, x: Floats, d: Floats) -> Floats:
    """Distance (n,) at which frame rays meet quad q, inf if they do not.

    What lies on the quad but for a rounding error is in front of it: a ray that leaves for the back meets it at once.
    """
    offset = x - scene.quad_corner[q]
    approach, height = d @ scene.quad_normal[q], offset @ scene.quad_normal[q]
    behind = height < -ON_A_WALL * (np.abs(offset).sum(axis=1) + scene.quad_size[q])
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.maximum(-height / approach, 0.0)
        share = (offset + t[:, None] * d) @ scene.quad_duals[q].T
        within = ((share >= -ON_A_WALL) & (share <= 1 + ON_A_WALL)).all(axis=1)
    return np.where(within & (approach != 0) & (behind == (approach > 0)), t, np.inf)


def leave_shell(
    surfaces: Surfaces, f: int, level: Floats, x: Floats, normal: Floats, d: Floats, own: Bools, face: Ints
) -> tuple[Floats, Ints, Ints]:
    """First meeting (t, what, face), each (n,), of rays within the shell of field f with its inner side, or a cap."""
    scene, nowhere = surfaces.scene, np.full(len(x), NOWHERE)
    t, what, _ = surfaces.meet(int(scene.twin[f]), -level, x, normal, d, own & (face == NOWHERE), nowhere)
    end = scene.origin[f] + np.where(d > 0, scene.spacing[f] * (scene.shape[f] - 1), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        out = np.where(d != 0, (end - x) / d, np.inf)
    cap = what == MISS
    t, what = np.where(cap, np.maximum(out.min(axis=1), 0.0), t), np.where(cap, CAP, SURFACE)
    return t, what, np.where(cap, out.argmin(axis=1), nowhere)


def nearest_hit(
    surfaces: Surfaces, level: Floats, x: Floats, normal: Floats, d: Floats, on: Ints, on_face: Ints, within: Ints
) -> tuple[Floats, Ints, Ints, Ints]:
    """First surface along frame rays, which start on these normals: (t, number, what, face); fields come first.

    The rays start within the shells of the fields whose bits `within` (n,) has.
    """
    scene, n = surfaces.scene, len(x)
    best, number, what, face = np.full(n, np.inf), np.full(n, -1), np.full(n, MISS), np.full(n, NOWHERE)
    for q in range(len(scene.quad_corner)):
        t = np.where(on == len(scene.twin) + q, np.inf, meet_quad(scene, q, x, d))
        closer = t < best
        best[closer], number[closer], what[closer] = t[closer], len(scene.twin) + q, QUAD
    for f in range(len(scene.twin)):
        t, hit, at = surfaces.meet(f, level[:, f], x, normal, d, on == f, on_face)
        shell = np.flatnonzero(within >> f & 1)
        if len(shell):
            t[shell], hit[shell], at[shell] = leave_shell(
                surfaces, f, level[shell, f], x[shell], normal[shell], d[shell], on[shell] == f, on_face[shell]
            )
        closer = (hit != MISS) & (t < best)
        best[closer], number[closer], what[closer], face[closer] = t[closer], f, hit[closer], at[closer]
    return best, number, what, face


def lets_through(scene: Marchable, number: Ints, what: Ints) -> Floats:
    """Share (n,) of the light that goes straight through what rays met."""
    share = np.zeros(len(number))
    if len(scene.transmission):
        film = ((what == SURFACE) | (what == CAP)) & (number >= 0) & (number < len(scene.twin))
        share[film] = scene.transmission[number[film]]
    return share


def followed(
    surfaces: Surfaces, level: Floats, x: Floats, normal: Floats, d: Floats, on: Ints, on_face: Ints, within: Ints,
    passes: Callable[[int, Ints, Floats], Bools],
) -> tuple[Floats, Ints, Ints, Ints]:  # fmt: skip
    """As `nearest_hit`, after films: rays (m,) of those shares go through number k where passes(k, rays, shares) is so.

    `within` (n,) changes with them.
    """
    t, number, what, face = nearest_hit(surfaces, level, x, normal, d, on, on_face, within)
    ray = np.arange(len(x))
    for film in range(MOST_FILMS):
        share = lets_through(surfaces.scene, number[ray], what[ray])
        ray, share = ray[share > 0], share[share > 0]
        ray = ray[passes(film, ray, share)]
        if not len(ray):
            break
        within[ray] ^= 1 << number[ray]
        start = level[ray], x[ray] + t[ray, None] * d[ray], normal[ray], d[ray], number[ray], face[ray], within[ray]
        more, number[ray], what[ray], face[ray] = nearest_hit(surfaces, *start)
        t[ray] += more
    return t, number, what, face


def gradient_normal(scene: Marchable, f: int, x: Floats) -> Floats:
    """Outward unit normals (n, 3) at frame points: central differences, interpolated; of the cell where they cancel."""
    gradient = central_differences(voxels(scene, f), (x - scene.origin[f]) / scene.spacing[f])
    gradient = scene.sign[f] * gradient + 0.0  # no -0
    known = gradient.any(axis=1, keepdims=True)
    return np.where(known, unit(-gradient / scene.spacing[f]), cell_normal(scene, f, x))


def cell_normal(scene: Marchable, f: int, x: Floats) -> Floats:
    """Outward unit normals (n, 3) of the trilinear cells that hold frame points: slopes of the cubic at its entry."""
    last = scene.shape[f] - 1
    u = (x - scene.origin[f]) / scene.spacing[f]
    cell = np.clip(np.floor(u), 0, last - 1).astype(np.int64)
    steps = (np.tile(step, (len(x), 1)) for step in np.eye(3))
    slopes = [cubic(scene, f, np.zeros(len(x)), cell, np.clip(u - cell, 0.0, 1.0), step)[:, 1] for step in steps]
    return unit(-np.stack(slopes, axis=1) / scene.spacing[f])


@dataclass(frozen=True)
class Marching:
    """Rays that march the trilinear fields."""

    scene: Marchable

    def meet(
        self, f: int, level: Floats, x: Floats, normal: Floats, d: Floats, own: Bools, face: Ints
    ) -> tuple[Floats, Ints, Ints]:
        """From a cap the convex box cannot be met again: see `Surfaces`."""
        t, what, at = np.full(len(x), np.inf), np.full(len(x), MISS), np.full(len(x), NOWHERE)
        ray = np.flatnonzero(~(own & (face != NOWHERE)))
        start, step = index_of(self.scene, f, x[ray]), d[ray] / self.scene.spacing[f]
        t[ray], what[ray], at[ray] = march(self.scene, f, level[ray], start, step, own[ray])
        return t, what, at

    def normal(self, f: int, what: Ints, face: Ints, x: Floats, d: Floats) -> Floats:
        """The gradient normal, or that of the cap."""
        cap = -np.sign(d) * (face[:, None] == np.arange(3))
        return np.where((what == CAP)[:, None], cap, gradient_normal(self.scene, f, x))

    def begin(self, own: Ints, x: Floats, normal: Floats) -> tuple[Floats, Ints]:
        """Queries lie on the trilinear set."""
        return x, np.full(len(x), NOWHERE)

    def inside(self, f: int, level: Floats, x: Floats, normal: Floats) -> Bools:
        """By the trilinear value, the border included."""
        u, last = index_of(self.scene, f, x), self.scene.shape[f] - 1
        cell = np.clip(np.floor(u), 0, last - 1).astype(np.int64)
        q = cubic(self.scene, f, level, cell, u - cell, np.zeros_like(u))
        return np.asarray(((u >= 0) & (u <= last)).all(axis=1) & (q[:, 0] >= 0))


def light_asked(
    surfaces: Surfaces, u: Floats, level: Floats, on: Ints, on_face: Ints, x: Floats, normal: Floats, within: Ints
) -> tuple[Floats, Floats]:
    """Ask one light each for what arrives at x: weight (n,), and emission or radiance (n, C) that it goes with.

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
    # The ray that meets this lamp first, or nothing, has met nothing else before but films, which let a share through.
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
    """Where in the sweep, 0 to 1, rows of levels (n, F) are; `OFF_SWEEP` where they are none of its rows."""
    if not len(cache.start):
        return np.full(len(level), OFF_SWEEP)
    first, last = cache.sweep.T
    with np.errstate(divide="ignore", invalid="ignore"):  # a level that is held has no place
        share = (level - first) / (last - first)
    on = (np.abs(share - share[:, :1]) <= SAME_ROW) & (share >= -SAME_ROW) & (share <= 1 + SAME_ROW)
    return np.where(on.all(axis=1), np.clip(share[:, 0], 0, 1), OFF_SWEEP)


def cached_light(
    scene: Marchable, cache: Cache, place: Floats, number: Ints, what: Ints, t: Floats, x: Floats, d: Floats
) -> tuple[Floats, Bools]:
    """Cached irradiance (n, C) where rays met surfaces at x, and whether (n,) their paths end: `gathering`."""
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
        for corner in _CORNERS:
            node = tuple(np.minimum(cell + corner, shape - 1).T)
            weight = np.where(corner, e, 1 - e).prod(axis=1)
            light[rows] += weight[:, None] * cache.light[start + np.ravel_multi_index(node, tuple(shape))]
        ends[rows] = True
    return light, ends


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
    """Worth (n, C) of one path from each point of a surface: the irradiance is π times the mean.

    `keep` is the share of the light that comes back along the path; `within` (n,) has the bits of the fields in
    whose shells it starts.
    """
    scene, within = surfaces.scene, within.copy()
    worth, keep = np.zeros((len(x), len(scene.background))), np.ones((len(x), len(scene.background)))
    place = place_in_sweep(cache, level)
    x, normal, on, on_face = x.copy(), normal.copy(), own.astype(np.int64), own_face.copy()
    alive, fields = np.arange(len(x)), len(scene.twin)
    for segment in range(bounces + 1):
        # Ask a lamp or the sky for light, weighted against the chance that the ray below finds it. One pair of numbers
        # serves both: each keeps its mean, and their shared boxes keep the error bars short.
        u1, u2 = draw_pair(key[alive], path[alive], np.uint64(segment))
        if len(scene.lamps) or scene.asked[0] < 1:
            u = np.stack([u1, u2, draw(key[alive], path[alive], np.uint64(segment))], axis=1)
            at = (level[alive], on[alive], on_face[alive], x[alive], normal[alive], within[alive])
            weight, light = light_asked(surfaces, u, *at)
            worth[alive] += keep[alive] * weight[:, None] * light

        # Choose a direction by the cosine about the normal.
        d = cosine_direction(u1, u2, normal[alive])

        # Follow the ray to the nearest surface, by chance through films; one that dips under its own hit it already.
        start, shells = (level[alive], x[alive], normal[alive]), within[alive]

        def by_chance(film: int, ray: Ints, share: Floats, alive: Ints = alive, segment: int = segment) -> Bools:
            own_key = mix(key[alive[ray]] + np.uint64(film + 1))
            return np.asarray(draw(own_key, path[alive[ray]], np.uint64(segment)) < share)

        t, number, what, face = followed(surfaces, *start, d, on[alive], on_face[alive], shells, by_chance)
        within[alive] = shells

        # A path that escapes sees the sky, and ends.
        escaped, away = alive[what == MISS], d[what == MISS]
        for weight, light in sky_seen(scene, normal[escaped], away):
            worth[escaped] += keep[escaped] * weight * light

        # A path inside a solid carries no light.
        goes_on = (what != MISS) & (what != BURIED)
        alive, t, d, number, what, face = (array[goes_on] for array in (alive, t, d, number, what, face))

        # Account for what the surface emits: a quad on its front only, weighted if it is a lamp.
        weight, wall = np.ones(len(alive)), what == QUAD
        quad = number[wall] - fields
        by_cosine = np.einsum("ij,ij->i", normal[alive[wall]], d[wall]) / np.pi
        approach = np.einsum("ij,ij->i", scene.quad_normal[quad], d[wall])
        by_lamp = lamp_density(scene, quad, t[wall], d[wall])
        weight[wall] = np.where(approach < 0, by_cosine / (by_cosine + by_lamp), 0.0)
        worth[alive] += keep[alive] * weight[:, None] * scene.emission[number]

        # Reflect: the albedo takes its share, and the path goes on from the hit.
        keep[alive] *= scene.albedo[number]
        on[alive], on_face[alive] = number, face
        moved = (t > 0) | wall
        x[alive] += np.where(moved, t, 0.0)[:, None] * d
        for f in range(fields):
            here = np.flatnonzero(moved & (number == f))
            side = np.where((within[alive[here]] >> f & 1) & (what[here] == SURFACE), -1.0, 1.0)
            normal[alive[here]] = side[:, None] * surfaces.normal(f, what[here], face[here], x[alive[here]], d[here])
        normal[alive[wall]] = -np.sign(approach)[:, None] * scene.quad_normal[quad]

        # End where the light is known.
        goes_on = normal[alive].any(axis=1)
        if cache.after <= segment < bounces and len(cache.start):
            inner = ~wall & (within[alive] >> np.where(wall, 0, number) & 1 == 1)  # of a shell: not in the grid
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
    """Mean (n, C) and m2 (n, C) of the irradiance at queries in the frame, and which are no holes (n,).

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
    """The same paths as `numba`, in pure NumPy: slow, and easy to check."""

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
    """Name this file's stage to the registry, as a plugin does."""
    return [Reference]
