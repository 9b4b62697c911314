"""The illumination grid itself as a block of light, whole or with the corner towards the eye cut out (Figure 6)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.scene import upright
from illumgrid.field.volume import Floats, index_to_world
from illumgrid.grid import GridSpec, read_lattice
from illumgrid.show import software
from illumgrid.show.camera import Camera
from illumgrid.show.meshes import Colored, squares
from illumgrid.show.shade import Colors, Shown

NEAR = 1e-9  # index units: a ray that comes this close to the corner that was cut out is in it
FACES = 0.8, 0.9, 1.0  # tones of faces across, along and above the view from the front: unlit, they would run together
STEPS = 256  # squares along a side, at least about: what is bilinear between nodes is then linear to the eye
HOLE = 0.3  # tone of a place between holes only: no level set within the range goes there


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
        nudge = self.spec.direction.T @ sum(upright(self.spec.direction))
        upper = self.index(self.eye) - self.last / 2 + 1e-6 * self.last * nudge > 0
        return np.where(upper, middle, 0.0), np.where(upper, self.last, middle)

    @cached_property
    def tones(self) -> Floats:
        """Tone (3,) of the faces across each axis."""
        across = np.abs(self.spec.direction.T @ np.stack(upright(self.spec.direction), axis=1))
        return np.asarray(across @ [FACES[0], FACES[1], FACES[2]])

    def color(self, points: Floats, axis: NDArray[np.integer]) -> Colors:
        """Display-linear colours (n, 3) at world points (n, 3) in faces across these axes (n,)."""
        grid = self.shown.light.grids[self.number]
        known = read_lattice(self.spec, (grid.support > 0)[..., None].astype(np.float32), points)
        tone = (HOLE + (1 - HOLE) * known) * self.tones[axis][:, None]
        return np.asarray(tone * self.shown.field(self.number, points, np.zeros(len(points))), dtype=np.float32)

    def draw(self, camera: Camera, width: int, height: int, background: Colors) -> Colors:
        """Display-linear picture (height, width, 3)."""
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
            color[hit] = self.color(camera.eye + t[hit, None] * directions[hit], axis[hit])
            return color

        return software.traced(seen, camera, width, height)

    def sheets(self) -> list[Colored]:
        """Draw the faces as triangles between the nodes."""
        low, high = self.octant
        steps = max(1, STEPS // max(self.spec.shape))
        found = []
        for axis in range(3):
            u, v = (k for k in range(3) if k != axis)
            inner, outer = (low, high) if low[axis] > 0 else (high, low)
            for plane in {0.0, self.last[axis], inner[axis]} if self.cut else {0.0, self.last[axis]}:
                nu, nv = (steps * int(self.last[k]) + 1 for k in (u, v))
                i, j = (x.ravel() / steps for x in np.indices((nu, nv)))
                index = np.insert(np.stack([i, j], axis=1), axis, plane, axis=1)
                faces = squares(nu, nv)
                middle = index[faces].mean(axis=1)[:, [u, v]]
                gone = self.cut & ((middle > low[[u, v]]) & (middle < high[[u, v]])).all(axis=1)
                if plane in (inner[axis], outer[axis]):
                    faces = faces[gone if self.cut and plane == inner[axis] else ~gone]
                points = index_to_world(self.spec, index)
                found.append(Colored(points, faces, self.color(points, np.full(len(points), axis))))
        return found


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
