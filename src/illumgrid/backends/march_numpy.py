"""Rays that march the trilinear fields, in pure NumPy: all rays of a batch go from cell to cell together."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.backends.lights_numpy import Bools, Ints
from illumgrid.constants import BURIED, CAP, MISS, NOWHERE, ON_A_VOXEL, SURFACE
from illumgrid.field.levelset import Marchable
from illumgrid.field.volume import Floats, central_differences, unit

CORNERS = np.array(list(np.ndindex(2, 2, 2)))


def voxels(scene: Marchable, f: int) -> NDArray[Any]:
    """The values of field f, axes x, y, z."""
    nx, ny, nz = scene.shape[f]
    return np.asarray(scene.values[scene.start[f] : scene.start[f] + nx * ny * nz].reshape(nx, ny, nz))


def index_of(scene: Marchable, f: int, x: Floats) -> Floats:
    """Index coordinates (n, 3) of frame points, moved onto a plane of voxels if they are within rounding of it."""
    u = (x - scene.origin[f]) / scene.spacing[f]
    nearest = np.round(u)
    return np.asarray(np.where(np.abs(u - nearest) < ON_A_VOXEL, nearest, u))


def cubic(scene: Marchable, f: int, level: Floats, cell: Ints, e: Floats, d: Floats) -> Floats:
    """Coefficients (n, 4) of sign v - level along e + t d, local in the cell: three blends, each one degree higher."""
    value = voxels(scene, f)[tuple((cell[:, None, :] + CORNERS).transpose(2, 0, 1))]
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

    # A ray that starts in the solid meets a cap if it comes from outside; otherwise it starts inside.
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
        """A ray from a cap cannot meet the convex box again: see `Surfaces`."""
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
        """By the trilinear value; the border counts as inside."""
        u, last = index_of(self.scene, f, x), self.scene.shape[f] - 1
        cell = np.clip(np.floor(u), 0, last - 1).astype(np.int64)
        q = cubic(self.scene, f, level, cell, u - cell, np.zeros_like(u))
        return np.asarray(((u >= 0) & (u <= last)).all(axis=1) & (q[:, 0] >= 0))
