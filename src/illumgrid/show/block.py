"""The illumination grid as a block of light, whole or with the corner towards the eye cut out (Figure 6).

Only light is drawn: places that no isosurface of the range passes are transparent, so that an isosurface behind shows.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.upright import axes_of
from illumgrid.field.volume import Floats, interpolate, world_to_index
from illumgrid.grid import GridSpec, read_lattice
from illumgrid.show.camera import Camera
from illumgrid.show.engines import software
from illumgrid.show.shade import Colors, Shown, opaque
from illumgrid.tone import curve

NEAR = 1e-9  # index units: a ray this close to the octant that was cut out enters it
FACES = 0.8, 0.9, 1.0  # tones of faces across, along and above the view from the front, so that edges show
STEP = 0.7  # nodes: step of a ray that searches for light
HALVINGS = 6  # of such a step: precision of the place where light begins


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

    @cached_property
    def glow(self) -> NDArray[np.float32]:
        """Light (nx, ny, nz, 4) as it is exposed, and how far the isovalue of a node is within the range, its span 1.

        Holes have the light of their surroundings, smoothed: that of the nearest node would show as shards.
        """
        light = self.shown.light
        grid, field = light.grids[self.number], light.scene.fields[self.number]
        albedo = field.material.albedo / np.pi * self.shown.exposure
        filled = _filled(grid.values * albedo.astype(np.float32), grid.support > 0)
        low, high = field.range
        isovalue = interpolate(field.volume, world_to_index(field.volume, self.spec.nodes()))
        within = np.minimum(isovalue - low, high - isovalue) / (high - low)
        return np.concatenate([filled, within.reshape(*self.spec.shape, 1).astype(np.float32)], axis=-1)

    def color(self, points: Floats, tone: Floats) -> Colors:
        """Display-linear colours (n, 3) at world points (n, 3) on something of this tone (n,)."""
        light = read_lattice(self.spec, self.glow, points)[:, :3]
        return np.asarray(tone[:, None] * curve(light), np.float32)

    def lit(self, directions: Floats, near: Floats, far: Floats, slope: Floats) -> Floats:
        """Distances (n,) at which rays from the eye along `directions` meet light between near and far; inf if none."""
        found = np.full(len(near), np.inf)
        step = STEP / np.abs(slope).max(axis=1)
        active, t = np.arange(len(near)), near * 1.0
        while len(active):
            here = self.eye + t[active, None] * directions[active]
            inside = read_lattice(self.spec, self.glow, here)[:, 3] >= 0
            found[active[inside]] = t[active[inside]]
            active = active[~inside]
            t[active] += step[active]
            active = active[t[active] < far[active]]
        again = np.flatnonzero(np.isfinite(found) & (found > near))
        high = found[again]
        low = high - step[again]
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            points = self.eye + middle[:, None] * directions[again]
            inside = read_lattice(self.spec, self.glow, points)[:, 3] >= 0
            low, high = np.where(inside, low, middle), np.where(inside, middle, high)
        found[again] = high
        return found

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
            rays = np.flatnonzero(hit)
            found = self.lit(directions[rays], t[rays], far[rays], slope[rays])
            lit = np.isfinite(found)
            rays, found = rays[lit], found[lit]
            tone = np.where(found > t[rays], 1.0, self.tones[axis[rays]])  # isosurfaces show their own shades
            color[rays] = opaque(self.color(self.eye + found[:, None] * directions[rays], tone))
            return color

        return software.traced(seen, camera, width, height)


def _filled(light: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Light (nx, ny, nz, 3), where it is not known the mean around by Gaussian weights, as narrow as knows any."""
    from scipy.ndimage import gaussian_filter

    filled, missing, sigma = light.copy(), ~known, 1.0
    while missing.any() and known.any():
        weight = gaussian_filter(known.astype(np.float32), sigma, mode="nearest")
        near = missing & (weight > 1e-3)
        for color in range(3):
            total = gaussian_filter(np.where(known, light[..., color], 0).astype(np.float32), sigma, mode="nearest")
            filled[near, color] = total[near] / weight[near]
        missing &= ~near
        sigma *= 2
    return filled


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
