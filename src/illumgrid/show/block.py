"""The illumination grid as a block of light, whole or with the corner towards the eye cut out (Figure 6)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.upright import axes_of
from illumgrid.field.volume import Floats, index_to_world
from illumgrid.grid import GridSpec, read_lattice
from illumgrid.show.camera import Camera
from illumgrid.show.engines import software
from illumgrid.show.shade import Colors, Shown, opaque
from illumgrid.show.triangles import Colored, squares

NEAR = 1e-9  # index units: a ray this close to the octant that was cut out enters it
FACES = 0.8, 0.9, 1.0  # tones of faces across, along and above the view from the front, so that edges show
STEPS = 256  # squares along a side, at least about: between nodes light is bilinear, in triangles linear
HOLE = 0.3  # tone between holes only: no level set within the range passes there


@dataclass(frozen=True, eq=False)
class Block:
    """The grid of one field.

    Parameters
    ----------
    shown : Shown
    number : int
        Of the field.
    eye : (3,) float64
        World.
    cut : bool
        Whether the octant towards the eye is left out: three faces through the middle are then seen.
    """

    shown: Shown
    number: int
    eye: Floats
    cut: bool

    @property
    def spec(self) -> GridSpec:
        """Where the nodes lie."""
        return self.shown.light.grids[self.number].spec

    @cached_property
    def last(self) -> Floats:
        """Index (3,) of the last node."""
        return np.array(self.spec.shape) - 1.0

    def index(self, points: Floats) -> Floats:
        """Fractional index of world points."""
        return np.asarray(((points - self.spec.origin) @ self.spec.direction) / self.spec.spacing)

    @cached_property
    def octant(self) -> tuple[Floats, Floats]:
        """Lowest and highest index (3,) of the corner that is cut out; its inner faces lie on nodes."""
        middle = np.floor(self.last / 2 + 0.5)
        # Seen along an axis no corner is nearest: the right, upper, front one, by a nudge too small to decide else.
        nudge = self.spec.direction.T @ sum(axes_of(self.spec.direction))
        upper = self.index(self.eye) - self.last / 2 + 1e-6 * self.last * nudge > 0
        return np.where(upper, middle, 0.0), np.where(upper, self.last, middle)

    @cached_property
    def tones(self) -> Floats:
        """Tone (3,) of the faces across each axis."""
        across = np.abs(self.spec.direction.T @ np.stack(axes_of(self.spec.direction), axis=1))
        return np.asarray(across @ [FACES[0], FACES[1], FACES[2]])

    def color(self, points: Floats, axis: NDArray[np.integer]) -> Colors:
        """Display-linear colours (n, 3) at world points (n, 3) in faces across these axes (n,)."""
        grid = self.shown.light.grids[self.number]
        known = read_lattice(self.spec, (grid.support > 0)[..., None].astype(np.float32), points)
        tone = (HOLE + (1 - HOLE) * known) * self.tones[axis][:, None]
        return np.asarray(tone * self.shown.field(self.number, points, np.zeros(len(points))), dtype=np.float32)

    def draw(self, camera: Camera, width: int, height: int, background: Colors) -> NDArray[np.uint8]:
        """Picture (height, width, 4), sRGB and coverage."""
        start = self.index(camera.eye)

        def seen(directions: Floats) -> Colors:
            slope = directions @ self.spec.direction / self.spec.spacing
            t, far, axis, _ = _through(start, slope, np.zeros(3), self.last)
            hit = (t < far) & (far > 0)
            if self.cut:
                low, high = self.octant
                entry = start + np.where(hit, t, 0.0)[:, None] * slope
                open_ = hit & ((entry >= low - NEAR) & (entry <= high + NEAR)).all(axis=1)
                _, inner, _, inner_axis = _through(start, slope, low, high)
                t, axis = np.where(open_, inner, t), np.where(open_, inner_axis, axis)
                hit &= t < far * (1 - NEAR)
            color = np.tile(background, (len(directions), 1))
            color[hit] = opaque(self.color(camera.eye + t[hit, None] * directions[hit], axis[hit]))
            return color

        return software.traced(seen, camera, width, height)

    def sheets(self) -> list[Colored]:
        """The faces as triangles between the nodes, with those of the middle where the octant is cut out."""
        low, high = self.octant
        found = []
        for axis in range(3):
            inner, outer = (low, high) if low[axis] > 0 else (high, low)
            found.append(self._sheet(axis, self.last[axis] - outer[axis], cut=False, inside=False))
            found.append(self._sheet(axis, outer[axis], cut=self.cut, inside=False))
            if self.cut:
                found.append(self._sheet(axis, inner[axis], cut=True, inside=True))
        return found

    def _sheet(self, axis: int, plane: float, cut: bool, inside: bool) -> Colored:
        """The plane of this index across an axis; if `cut`, its part `inside` the octant or the rest of it."""
        low, high = self.octant
        steps = max(1, STEPS // max(self.spec.shape))
        u, v = (k for k in range(3) if k != axis)
        nu, nv = (steps * int(self.last[k]) + 1 for k in (u, v))
        i, j = (x.ravel() / steps for x in np.indices((nu, nv)))
        index = np.insert(np.stack([i, j], axis=1), axis, plane, axis=1)
        faces = squares(nu, nv)
        if cut:
            middle = index[faces].mean(axis=1)[:, [u, v]]
            within = ((middle > low[[u, v]]) & (middle < high[[u, v]])).all(axis=1)
            faces = faces[within == inside]
        points = index_to_world(self.spec, index)
        return Colored(points, faces, self.color(points, np.full(len(points), axis)))


def _through(
    start: Floats, slope: Floats, low: Floats, high: Floats
) -> tuple[Floats, Floats, NDArray[np.integer], NDArray[np.integer]]:
    """Where rays (n) from one point enter and leave a box, and across which axes; leave comes first where they miss."""
    with np.errstate(divide="ignore", invalid="ignore"):
        one, two = (low - start) / slope, (high - start) / slope
    # A ray in the plane of a face is 0/0 away from it: that axis does not bound it.
    enter = np.nan_to_num(np.fmin(one, two), nan=-np.inf, posinf=np.inf, neginf=-np.inf)
    leave = np.nan_to_num(np.fmax(one, two), nan=np.inf, posinf=np.inf, neginf=-np.inf)
    return enter.max(axis=1), leave.min(axis=1), enter.argmax(axis=1), leave.argmin(axis=1)
