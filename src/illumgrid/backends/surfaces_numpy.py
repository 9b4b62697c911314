"""The first surface that rays meet, in pure NumPy: fields, quads, and surfaces behind films."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from illumgrid.backends.lights_numpy import Bools, Ints
from illumgrid.constants import CAP, MISS, MOST_FILMS, NOWHERE, ON_A_WALL, QUAD, SURFACE
from illumgrid.field.levelset import Marchable
from illumgrid.field.volume import Floats


class Surfaces(Protocol):
    """The solids of all fields. A `face` is the axis of a cap, or the face of a mesh, or NOWHERE."""

    @property
    def scene(self) -> Marchable:
        """The rest of the scene."""

    def meet(
        self, f: int, level: Floats, x: Floats, normal: Floats, d: Floats, own: Bools, face: Ints
    ) -> tuple[Floats, Ints, Ints]:
        """First meeting (t, what, face), each (n,), of frame rays with field f; `own` rays start on it, on `face`."""

    def normal(self, f: int, what: Ints, face: Ints, x: Floats, d: Floats) -> Floats:
        """Normals (n, 3) where rays along d met field f at x."""

    def begin(self, own: Ints, x: Floats, normal: Floats) -> tuple[Floats, Ints]:
        """Move queries onto the surface that represents their level set: (position, face); LOST if there is none."""

    def inside(self, f: int, level: Floats, x: Floats, normal: Floats) -> Bools:
        """Whether points x on other surfaces lie inside the solid of field f."""


def meet_quad(scene: Marchable, q: int, x: Floats, d: Floats) -> Floats:
    """Distance (n,) at which frame rays meet quad q, inf if they do not.

    A point on the quad up to a rounding error counts as in front of it: a ray towards the back meets it at once.
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
    """Share (n,) of the light that passes straight through the surfaces that rays met."""
    share = np.zeros(len(number))
    if len(scene.transmission):
        film = ((what == SURFACE) | (what == CAP)) & (number >= 0) & (number < len(scene.twin))
        share[film] = scene.transmission[number[film]]
    return share


def followed(
    surfaces: Surfaces, level: Floats, x: Floats, normal: Floats, d: Floats, on: Ints, on_face: Ints, within: Ints,
    passes: Callable[[int, Ints, Floats], Bools],
) -> tuple[Floats, Ints, Ints, Ints]:  # fmt: skip
    """Like `nearest_hit`, beyond films: rays (m,) of these shares pass number k where passes(k, rays, shares) is true.

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
