"""The illumination grid itself as a block of light, whole or with the corner towards the eye cut out (Figure 6)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from illumgrid.grid import GridSpec
from illumgrid.preview import software
from illumgrid.preview.camera import Camera
from illumgrid.preview.meshes import Colored, squares
from illumgrid.preview.shade import Colors, Shown
from illumgrid.scene import upright
from illumgrid.volume import Floats, index_to_world

NEAR = 1e-9  # index units: a ray that comes this close to the corner that was cut out is in it


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

    def color(self, points: Floats) -> Colors:
        """Display-linear colours (n, 3) of the light at world points, as a surface there would show it."""
        return self.shown.field(self.number, points, np.zeros(len(points)))

    def draw(self, camera: Camera, width: int, height: int, background: Colors) -> Colors:
        """Display-linear picture (height, width, 3)."""
        start = self.index(camera.eye)

        def seen(directions: Floats) -> Colors:
            slope = directions @ self.spec.direction / self.spec.spacing
            t, far = _through(start, slope, np.zeros(3), self.last)
            hit = (t < far) & (far > 0)
            if self.cut:
                low, high = self.octant
                entry = start + np.where(hit, t, 0.0)[:, None] * slope
                open_ = hit & ((entry >= low - NEAR) & (entry <= high + NEAR)).all(axis=1)
                t = np.where(open_, _through(start, slope, low, high)[1], t)
                hit &= t < far * (1 - NEAR)
            color = np.tile(background, (len(directions), 1))
            color[hit] = self.color(camera.eye + t[hit, None] * directions[hit])
            return color

        return software.traced(seen, camera, width, height)

    def sheets(self) -> list[Colored]:
        """Draw the faces as triangles between the nodes."""
        low, high = self.octant
        found = []
        for axis in range(3):
            u, v = (k for k in range(3) if k != axis)
            inner, outer = (low, high) if low[axis] > 0 else (high, low)
            for plane in {0.0, self.last[axis], inner[axis]} if self.cut else {0.0, self.last[axis]}:
                i, j = (x.ravel() for x in np.indices((self.spec.shape[u], self.spec.shape[v])))
                index = np.insert(np.stack([i, j], axis=1).astype(float), axis, plane, axis=1)
                faces = squares(self.spec.shape[u], self.spec.shape[v])
                middle = index[faces].mean(axis=1)[:, [u, v]]
                gone = self.cut & ((middle > low[[u, v]]) & (middle < high[[u, v]])).all(axis=1)
                if plane in (inner[axis], outer[axis]):
                    faces = faces[gone if self.cut and plane == inner[axis] else ~gone]
                points = index_to_world(self.spec, index)
                found.append(Colored(points, faces, self.color(points)))
        return found


def _through(start: Floats, slope: Floats, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Where rays (n) from one point enter and leave a box; entered after it is left where they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        one, two = (low - start) / slope, (high - start) / slope
    # A ray within the plane of a face is 0/0 away from it: that face does not bound it.
    return np.fmin(one, two).max(axis=1, initial=-np.inf), np.fmax(one, two).min(axis=1, initial=np.inf)
