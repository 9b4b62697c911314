"""Light transport by plain loops: the oracle that every backend is compared with, path by path.

Written from the specification alone, one ray and one cell at a time, to be evidently correct rather than fast: cells
come from sorting all crossings of the ray with the planes of the lattice, roots from bisection between stationary
points. Points, directions and normals are lists of three floats in the frame of the scene (see
`illumgrid.field.scene.Scene`).
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np

from illumgrid.field.lights import Distant, Sky
from illumgrid.field.upright import sky_axes
from illumgrid.rng import draw, draw_pair, mix, net_size, sharing, stream

WALL = 1e-10
"""A wall reaches this share of its size farther than its corners say."""
SNAP = 1e-7
"""A ray that starts this close to a plane of voxels, in index coordinates, starts on it."""


@dataclass(frozen=True)
class Hit:
    """The end of a ray: on a level set, on a cap, or at once because the ray starts inside a solid.

    Parameters
    ----------
    t : float
        Distance along the ray.
    field : int
        Number of the surface that is hit: fields first, then quads.
    x : list of float
        Position in the frame.
    normal : list of float or None
        Outward unit normal in the frame; None where no light can be followed (within a solid, on a plateau).
    cap : bool
        True on the border of the field's box.
    """

    t: float
    field: int
    x: list
    normal: list | None
    cap: bool = False


class Solid:
    """The solid {v >= level} of one field in the box of its voxel centres; v is h, or -h where `inside` is "below"."""

    def __init__(self, scene, levels, number, turned=False):
        field = scene.fields[number]
        self.number = number
        self.sign = 1.0 if (field.inside == "above") != turned else -1.0
        self.level = self.sign * float(levels[number])
        self.values = field.volume.values
        self.origin = [float(c) for c in scene.to_frame(field.volume.origin)]
        self.spacing = [float(c) for c in field.volume.spacing]
        self.last = [n - 1 for n in field.volume.shape]

    def v(self, voxel):
        """Value at a voxel."""
        return self.sign * float(self.values[voxel])

    def corners(self, cell):
        """Values at the corners of a cell, by corner (0 or 1 along each axis)."""
        return {c: self.v(tuple(i + j for i, j in zip(cell, c))) for c in product((0, 1), repeat=3)}

    def index(self, x):
        """Index coordinates of a frame position, on a plane of voxels where they nearly are."""
        u = [(x[a] - self.origin[a]) / self.spacing[a] for a in range(3)]
        return [float(round(c)) if abs(c - round(c)) < SNAP else c for c in u]

    def holds(self, x):
        """Whether a frame position lies in the solid, its border included."""
        u = self.index(x)
        if any(not 0 <= u[a] <= self.last[a] for a in range(3)):
            return False
        cell = [min(math.floor(u[a]), self.last[a] - 1) for a in range(3)]
        return along(self.corners(cell), [u[a] - cell[a] for a in range(3)], [0.0] * 3)[0] >= self.level


# Polynomials are lists of coefficients, the constant first.


def value(p, s):
    """Value of a polynomial (Horner)."""
    total = 0.0
    for coefficient in reversed(p):
        total = total * s + coefficient
    return total


def blend(p0, p1, x, dx):
    """Polynomial p0 + (p1 - p0) (x + s dx), counted from the nearer end: exact at x = 0 and at x = 1."""
    start, x = (p0, x) if x <= 0.5 else (p1, x - 1.0)
    result = [*start, 0.0]
    for i, c in enumerate(b - a for a, b in zip(p0, p1)):
        result[i] += c * x
        result[i + 1] += c * dx
    return result


def along(corners, f, df):
    """Cubic in s: the trilinear cell at its local position f + s df."""
    p = {c: [v] for c, v in corners.items()}
    for axis in range(3):
        p = {rest: blend(p[0, *rest], p[1, *rest], f[axis], df[axis]) for rest in product((0, 1), repeat=2 - axis)}
    return p[()]


def bisect(p, a, b):
    """The end, on the side of b, of the last interval of floats between a and b over which the sign of p changes."""
    side = value(p, b) >= 0
    while a < (middle := 0.5 * (a + b)) < b:
        if (value(p, middle) >= 0) == side:
            b = middle
        else:
            a = middle
    return b


def changes(p, low, high):
    """All places between low and high where the sign of p changes: one at most between stationary points."""
    if len(p) < 2:
        return []
    slope = [i * c for i, c in enumerate(p)][1:]
    knots = [low, *changes(slope, low, high), high]
    return [bisect(p, a, b) for a, b in pairwise(knots) if (value(p, a) >= 0) != (value(p, b) >= 0)]


def first_rise(p, length):
    """Smallest s from 0 to length with p(s) >= 0, or None."""
    if p[0] >= 0:
        return 0.0
    slope = [i * c for i, c in enumerate(p)][1:]
    for a, b in pairwise([0.0, *changes(slope, 0.0, length), length]):
        if value(p, b) >= 0:
            return bisect(p, a, b)
    return None


# Rays in index coordinates: u + t du, where t is the distance in the frame.


def span(solid, u, du):
    """First and last t of the line within the box, and the axis of the face where it enters; None if it misses."""
    t_in, t_out, axis = -math.inf, math.inf, 0
    for a in range(3):
        if du[a] == 0:
            if not 0 <= u[a] <= solid.last[a]:
                return None
            continue
        near, far = sorted(((0 - u[a]) / du[a], (solid.last[a] - u[a]) / du[a]))
        if near > t_in:
            t_in, axis = near, a
        t_out = min(t_out, far)
    return (t_in, t_out, axis) if t_in <= t_out else None


def advance(u, du, t):
    """Index coordinates at t, exactly on a plane of voxels that is crossed at t."""
    result = [u[a] + t * du[a] for a in range(3)]
    for a in range(3):
        plane = float(round(result[a]))
        if du[a] != 0 and (plane - u[a]) / du[a] == t:
            result[a] = plane
    return result


def intervals(solid, u, du, t_in, t_out):
    """Yield (t0, t1, cell) for the cells between t_in and t_out, in order."""
    stops = {t_in, t_out}
    for a in range(3):
        if du[a] != 0:
            stops.update(t for plane in range(solid.last[a] + 1) if t_in < (t := (plane - u[a]) / du[a]) < t_out)
    for t0, t1 in pairwise(sorted(stops)):
        middle = [u[a] + 0.5 * (t0 + t1) * du[a] for a in range(3)]
        yield t0, t1, [min(max(math.floor(middle[a]), 0), solid.last[a] - 1) for a in range(3)]


def entered(solid, u, du):
    """Cell entered by a ray that starts at u, or None if the ray leaves the box."""
    cell = [math.floor(u[a]) - (1 if u[a] == math.floor(u[a]) and du[a] < 0 else 0) for a in range(3)]
    return cell if all(0 <= cell[a] < solid.last[a] for a in range(3)) else None


def cubic(solid, cell, at, du):
    """Cubic f(s) = v - level along the ray in a cell, s = 0 at the index coordinates `at`."""
    p = along(solid.corners(cell), [at[a] - cell[a] for a in range(3)], du)
    return [p[0] - solid.level, *p[1:]]


def march(solid, u, du, t_in, t_out):
    """First (t, cell) between t_in and t_out with v >= level, or None."""
    for t0, t1, cell in intervals(solid, u, du, t_in, t_out):
        if max(solid.corners(cell).values()) < solid.level:
            continue  # a trilinear cell lies between its corners
        s = first_rise(cubic(solid, cell, advance(u, du, t0), du), t1 - t0)
        if s is not None:
            return t0 + s, cell
    return None


def meet_own(solid, x, d, on):
    """Hit of a ray that starts on the level set of this very solid, or None."""
    u, du = solid.index(x), [d[a] / solid.spacing[a] for a in range(3)]
    cell = entered(solid, u, du)
    if cell is None:
        return None
    t_out = span(solid, u, du)[1]
    t1 = next(intervals(solid, u, du, 0.0, t_out))[1]
    f = cubic(solid, cell, u, du)[1:]  # its constant term is 0: divided by t
    while f and f[0] == 0:
        f = f[1:]
    if not f or f[0] > 0:
        return Hit(0.0, solid.number, x, on.normal)  # dips under the surface; a cell flat at the level is solid
    t = first_rise(f, t1)
    found = (t, cell) if t is not None else march(solid, u, du, t1, t_out)
    return level_set_hit(solid, x, d, *found) if found else None


def meet_other(solid, x, d):
    """Hit of a ray that does not start on this solid, or None."""
    u, du = solid.index(x), [d[a] / solid.spacing[a] for a in range(3)]
    box = span(solid, u, du)
    if box is None or box[1] <= 0:
        return None
    t_in, t_out, axis = box
    found = march(solid, u, du, max(t_in, 0.0), t_out)
    if found is None:
        return None
    if found[0] <= 0 and t_in <= 0:
        return Hit(0.0, solid.number, x, None)  # starts inside, or on the border
    if found[0] == t_in:
        normal = [0.0, 0.0, 0.0]
        normal[axis] = -math.copysign(1.0, d[axis])
        return Hit(t_in, solid.number, [x[a] + t_in * d[a] for a in range(3)], normal, cap=True)
    return level_set_hit(solid, x, d, *found)


def level_set_hit(solid, x, d, t, cell):
    """Hit in a cell."""
    at = [x[a] + t * d[a] for a in range(3)]
    f = [min(max((at[a] - solid.origin[a]) / solid.spacing[a] - cell[a], 0.0), 1.0) for a in range(3)]
    return Hit(t, solid.number, at, outward_normal(solid, cell, f))


def outward_normal(solid, cell, f):
    """Gradient normal at the local position f of a cell; that of the trilinear cell where it is 0; None if both are."""
    smooth = [0.0, 0.0, 0.0]
    for corner in product((0, 1), repeat=3):
        weight = math.prod(f[a] if corner[a] else 1 - f[a] for a in range(3))
        voxel = [i + j for i, j in zip(cell, corner)]
        for a in range(3):
            smooth[a] += weight * central_difference(solid, voxel, a) / solid.spacing[a]
    steps = [[1.0 / solid.spacing[a] if a == b else 0.0 for a in range(3)] for b in range(3)]
    sharp = [along(solid.corners(cell), f, step)[1] for step in steps]
    for gradient in (smooth, sharp):
        if largest := max(map(abs, gradient)):
            scaled = [c / largest for c in gradient]  # the square of a tiny gradient would be 0
            return [-c / math.hypot(*scaled) for c in scaled]
    return None


def central_difference(solid, voxel, axis):
    """Central difference of v at a voxel, per voxel; one-sided at the border."""
    before, after = list(voxel), list(voxel)
    before[axis] = max(voxel[axis] - 1, 0)
    after[axis] = min(voxel[axis] + 1, solid.last[axis])
    return (solid.v(tuple(after)) - solid.v(tuple(before))) / (after[axis] - before[axis])


# Walls and lamps.


class Wall:
    """One quad in the frame of the scene; its front is edge_u x edge_v in the world."""

    def __init__(self, scene, number):
        quad, axes = scene.quads[number], scene.fields[0].volume.direction
        self.number = len(scene.fields) + number
        self.corner = scene.to_frame(quad.corner).tolist()
        self.u, self.v = (quad.edge_u @ axes).tolist(), (quad.edge_v @ axes).tolist()
        self.normal = (np.cross(quad.edge_u, quad.edge_v) @ axes).tolist()
        self.area = math.hypot(*self.normal)
        self.normal = [c / self.area for c in self.normal]
        self.emission = quad.material.emission

    def power(self):
        return float(self.emission.mean()) * self.area

    def meet(self, x, d):
        """Hit of a ray, or None: Cramer's rule for x + t d = corner + a u + b v."""
        matrix = np.array([self.u, self.v, [-c for c in d]]).T
        if sum(a * b for a, b in zip(self.normal, d)) == 0:
            return None
        offset = [x[i] - self.corner[i] for i in range(3)]
        a, b, t = np.linalg.solve(matrix, offset)
        approach = sum(a * b for a, b in zip(self.normal, d))
        height = sum(a * b for a, b in zip(self.normal, offset))
        behind = height < -WALL * sum(map(abs, [*offset, *self.u, *self.v]))  # what lies on it is in front of it
        if behind != (approach > 0):
            return None
        if t < 0:
            t, (a, b) = 0.0, np.linalg.lstsq(matrix[:, :2], np.array(offset), rcond=None)[0]
        if not (-WALL <= a <= 1 + WALL and -WALL <= b <= 1 + WALL):
            return None
        side = -1.0 if approach > 0 else 1.0
        return Hit(float(t), self.number, [x[i] + t * d[i] for i in range(3)], [side * c for c in self.normal])


def lamps(scene):
    """(wall, probability) of every quad that emits: in proportion to power, all together as much as one disc."""
    walls = [wall for k in range(len(scene.quads)) if (wall := Wall(scene, k)).power() > 0]
    total = sum(wall.power() for wall in walls)
    return [(wall, wall.power() / total / (1 + len(distant(scene)))) for wall in walls]


def lamp_density(scene, number, distance, d):
    """Probability per solid angle that `ask_a_lamp` looks along d, to a point of this quad at this distance."""
    for wall, chance in lamps(scene):
        facing = -sum(a * b for a, b in zip(wall.normal, d))
        if wall.number == number and facing > 0:
            return chance / wall.area * distance**2 / facing
    return 0.0


def ask_a_lamp(scene, levels, hit, u, v, choice, within=frozenset()):
    """Radiance (3,) from one point of one lamp, weighted by the balance heuristic, per cosine-distributed path."""
    total = 0.0
    for wall, chance in lamps(scene):  # noqa: B007
        total += chance
        if choice < total:
            break
    target = [wall.corner[i] + u * wall.u[i] + v * wall.v[i] for i in range(3)]
    way = [target[i] - hit.x[i] for i in range(3)]
    distance = math.hypot(*way)
    if distance == 0 or wall.number == hit.field:
        return np.zeros(3)
    d = [c / distance for c in way]
    by_cosine = sum(a * b for a, b in zip(hit.normal, d)) / math.pi
    by_lamp = lamp_density(scene, wall.number, distance, d)
    if by_cosine <= 0 or by_lamp <= 0:
        return np.zeros(3)
    met, share = dimmed(scene, levels, hit, d, within)
    seen = met is not None and met.field == wall.number
    return share * wall.emission * by_cosine / (by_cosine + by_lamp) if seen else np.zeros(3)


def dimmed(scene, levels, hit, d, within):
    """What a ray from a hit meets behind all films, and the share of light that they let through."""
    shares = [1.0]
    met = behind_films(scene, levels, d, hit, set(within), lambda film, share: shares.append(share) or True)
    return met, math.prod(shares)


# Light.


def films(scene, levels, hit):
    """Numbers of the fields that transmit and within whose shells a hit on another surface lies."""
    return {
        k
        for k, field in enumerate(scene.fields)
        if k != hit.field and field.material.transmission > 0 and Solid(scene, levels, k).holds(hit.x)
    }


def leave(scene, levels, number, x, d, on):
    """Hit of a ray within the shell of a field: its inner side, or the border of the volume."""
    outside = Solid(scene, levels, number, turned=True)
    own = on is not None and on.field == number and not on.cap
    hit = meet_own(outside, x, d, on) if own else meet_other(outside, x, d)
    if hit is not None:
        return hit
    u, du = outside.index(x), [d[a] / outside.spacing[a] for a in range(3)]
    ends = [((outside.last[a] if du[a] > 0 else 0) - u[a]) / du[a] if du[a] else math.inf for a in range(3)]
    t, axis, normal = max(min(ends), 0.0), ends.index(min(ends)), [0.0, 0.0, 0.0]
    normal[axis] = -math.copysign(1.0, d[axis])
    return Hit(t, number, [x[a] + t * d[a] for a in range(3)], normal, cap=True)


def behind_films(scene, levels, d, on, within, passes):
    """First hit of a ray along d after the films that it passes: number k, of this share, where passes(k, share).

    `within`, the shells that the ray is in, changes with them.
    """
    length, start = 0.0, on
    for k in range(64):
        hit = first_hit(scene, levels, start.x, d, on=start, within=within)
        if hit is None:
            return None
        length += hit.t
        share = scene.fields[hit.field].material.transmission if hit.field < len(scene.fields) else 0.0
        if share == 0 or not passes(k, share):
            break
        within ^= {hit.field}
        start = hit
    return replace(hit, t=length)


def first_hit(scene, levels, x, d, on=None, within=frozenset()):
    """First hit of a ray.

    Parameters
    ----------
    scene : Scene
    levels : (F,) sequence of float
        Isovalue of each field.
    x, d : sequence of float
        Start and unit direction in the frame.
    on : Hit, optional
        The surface on which the ray starts.
    within : set of int
        Fields within whose shells the ray starts.

    Returns
    -------
    Hit or None
        None if the ray escapes. A hit without a normal carries no light.
    """
    x, d = [float(c) for c in x], [float(c) for c in d]
    walls = [Wall(scene, k) for k in range(len(scene.quads))]
    hits = [wall.meet(x, d) for wall in walls if on is None or on.field != wall.number]
    for number in range(len(scene.fields)):
        solid = Solid(scene, levels, number)
        if number in within:
            hits.append(leave(scene, levels, number, x, d, on))
        elif on is None or on.field != number:
            hits.append(meet_other(solid, x, d))
        elif not on.cap:  # a ray from a cap leaves the convex box
            hits.append(meet_own(solid, x, d, on))
    hits = [hit for hit in hits if hit is not None]
    inside = [hit for hit in hits if hit.t == 0 and hit.normal is None]
    return min(inside or hits, key=lambda hit: hit.t, default=None)  # of equals, min takes the first


def cosine_direction(n, u1, u2):
    """Cosine-distributed direction around n, in the tangent frame of Duff et al. (JCGT 6(1), 2017)."""
    r, phi = math.sqrt(u1), 2 * math.pi * u2
    local = (r * math.cos(phi), r * math.sin(phi), math.sqrt(1 - u1))
    sign = 1.0 if n[2] >= -1e-6 else -1.0  # 0 comes out as -1e-17 in a turned frame
    a = -1 / (sign + n[2])
    b = n[0] * n[1] * a
    tangent = (1 + sign * n[0] * n[0] * a, sign * b, -sign * n[0])
    bitangent = (b, sign + n[1] * n[1] * a, -n[1])
    return [local[0] * tangent[i] + local[1] * bitangent[i] + local[2] * n[i] for i in range(3)]


def on_query(scene, query):
    """Surface on which the one query in `query` lies, as a hit; its normal is 0 if none is defined."""
    normal = query.normal[0] @ scene.fields[0].volume.direction
    return Hit(0.0, int(query.target[0]), scene.to_frame(query.point[0]).tolist(), normal.tolist())


def is_hole(scene, query):
    """Whether the one query in `query` has no normal or lies in the solid of another field."""
    at = on_query(scene, query)
    others = (k for k, f in enumerate(scene.fields) if k != at.field and f.material.transmission == 0)
    return not any(at.normal) or any(Solid(scene, query.level[0], k).holds(at.x) for k in others)


def path_worth(scene, query, path, bounces, seed, known=None):
    """Radiance (3,) that one path contributes to a query (a `Queries` of length 1 that is not a hole).

    `known` is (grids, walls, alike), in which it may end: see `cached`.
    """
    with np.errstate(over="ignore"):
        key = stream(np.uint64(seed), query.id[0])
        u = [[float(c) for c in draw_pair(key, np.uint64(path), np.uint64(k))] for k in range(bounces + 1)]
        choices = [float(draw(key, np.uint64(path), np.uint64(k))) for k in range(bounces + 1)]
    hit, worth, throughput = on_query(scene, query), np.zeros(3), np.ones(3)
    within = films(scene, query.level[0], hit)
    for k in range(bounces + 1):

        def by_chance(film, share, k=k):
            with np.errstate(over="ignore"):
                return float(draw(mix(key + np.uint64(film + 1)), np.uint64(path), np.uint64(k))) < share

        if choices[k] < lamp_chance(scene):
            worth = worth + throughput * ask_a_lamp(scene, query.level[0], hit, *u[k], choices[k], within)
        elif distant(scene):
            worth = worth + throughput * ask_the_sky(scene, query.level[0], hit, *u[k], choices[k], within)
        d = cosine_direction(hit.normal, u[k][0], u[k][1])
        start, hit = hit, behind_films(scene, query.level[0], d, hit, within, by_chance)
        if hit is None:
            p = sum(a * b for a, b in zip(start.normal, d)) / math.pi
            asked = radiance_of_discs(scene, d) * p / (p + sky_density(scene, d))
            return worth + throughput * (scene.background + smooth_sky(scene, d) + asked)
        if hit.normal is None:
            return worth
        emission, albedo = surface(scene, hit, start, d)
        worth = worth + throughput * emission
        throughput = throughput * albedo
        if (
            known
            and hit.field not in within
            and k < bounces
            and (light := cached(scene, query.level[0], hit, start, d, *known)) is not None
        ):
            return worth + throughput * light / math.pi
    return worth


def cached(scene, levels, hit, start, d, grids, walls, alike):
    """Irradiance (3,) that grids and walls hold where a ray from `start` along d met a surface; None to go on."""
    places = [float(field.place(level)) for field, level in zip(scene.fields, levels)]
    if max(places) - min(places) > 1e-6 or min(places) < -1e-6 or max(places) > 1 + 1e-6:
        return None  # no row of the sweep
    if hit.cap or (hit.t == 0 and hit.field == start.field):
        return None
    if hit.field < len(scene.fields):
        grid = grids[hit.field]
        away = np.linalg.inv(grid.spec.direction) @ (scene.from_frame(hit.x) - grid.spec.origin)
        place, near = away / grid.spec.spacing, max(grid.spec.spacing)
    else:
        wall, grid = Wall(scene, hit.field - len(scene.fields)), walls[hit.field - len(scene.fields)]
        if sum(a * b for a, b in zip(wall.normal, d)) >= 0:
            return None
        sides = np.array([wall.u, wall.v]).T
        u, v = np.linalg.lstsq(sides, np.array(hit.x) - wall.corner, rcond=None)[0]
        rows, nv, nu, _ = grid.values.shape
        place = [places[0] * (rows - 1), v * nv - 0.5, u * nu - 0.5]
        near = max(math.hypot(*wall.u) / nu, math.hypot(*wall.v) / nv)
    if hit.t < near:
        return None
    support, light = np.asarray(grid.support), np.asarray(grid.values)
    mean = np.mean([light[node].mean() for node in np.ndindex(support.shape) if support[node] > 0])
    nodes = [()]
    for p, n in zip(place, support.shape):
        p = min(max(p, 0), n - 1)
        below = math.floor(p)
        nodes = [(*node, i) for node in nodes for i in ((below, 1 - p + below), (min(below + 1, n - 1), p - below))]
    found = [light[tuple(i for i, _ in node)].astype(float) for node in nodes]
    if not all(support[tuple(i for i, _ in node)] for node in nodes):
        return None
    shown = [one.mean() for one in found]
    if max(shown) - min(shown) > alike * mean:
        return None
    return sum(math.prod(w for _, w in node) * one for node, one in zip(nodes, found))


def distant(scene):
    """Discs of the sky that shine."""
    return [light for light in scene.lights if isinstance(light, Distant)]


def lamp_chance(scene):
    """Probability with which lamps are asked, among lamps and discs in equal parts."""
    return bool(lamps(scene)) / (1 + len(distant(scene)))


def within(scene, disc, d):
    """Whether a frame direction lies in a disc."""
    towards = scene.fields[0].volume.direction.T @ disc.direction
    return float(np.dot(towards, d)) >= math.cos(math.radians(disc.angle))


def sky_density(scene, d):
    """Density per solid angle with which `ask_the_sky` asks for a frame direction."""
    parts = bool(lamps(scene)) + len(distant(scene))
    solid = [2 * math.pi * (1 - math.cos(math.radians(disc.angle))) for disc in distant(scene)]
    return sum(1 / (parts * s) for disc, s in zip(distant(scene), solid) if within(scene, disc, d))


def radiance_of_discs(scene, d):
    """Radiance (3,) of all discs along a frame direction."""
    shining = [disc.irradiance / (math.pi * math.sin(math.radians(disc.angle)) ** 2) for disc in distant(scene)]
    return sum((L for disc, L in zip(distant(scene), shining) if within(scene, disc, d)), np.zeros(3))


def smooth_sky(scene, d):
    """Radiance (3,) of constant skies and gradients along a frame direction."""
    up = scene.fields[0].volume.direction.T @ sky_axes(scene)[2]
    height, total = float(np.dot(up, d)), np.zeros(3)
    for sky in (light for light in scene.lights if isinstance(light, Sky)):
        nadir, zenith = np.broadcast_to(sky.radiance, (2, 3))
        total = total + nadir * (1 - height) / 2 + zenith * (1 + height) / 2
    return total


def ask_the_sky(scene, levels, hit, u1, u2, choice, within=frozenset()):
    """Light (3,) from one direction within one disc, if nothing is in the way, weighted against the cosine."""
    first, count = lamp_chance(scene), len(distant(scene))
    disc = distant(scene)[min(count - 1, int((choice - first) * count / (1 - first)))]
    cosine = 1 - u1 * (1 - math.cos(math.radians(disc.angle)))
    # The frame is that of a cosine-distributed direction, whose own cosine is sqrt(1 - u).
    d = cosine_direction(scene.fields[0].volume.direction.T @ disc.direction, 1 - cosine * cosine, u2)
    p = sum(a * b for a, b in zip(hit.normal, d)) / math.pi
    if p <= 0:
        return np.zeros(3)
    met, share = dimmed(scene, levels, hit, d, within)
    return share * radiance_of_discs(scene, d) * p / (p + sky_density(scene, d)) if met is None else np.zeros(3)


def surface(scene, hit, start, d):
    """Emission towards the ray that came from `start` along d, weighted against `ask_a_lamp`, and albedo of a hit."""
    if hit.field < len(scene.fields):
        material = scene.fields[hit.field].material
        reflected = max(1 - material.transmission, 1e-300)  # of what is not sent straight on
        return material.emission, material.albedo / reflected
    quad = scene.quads[hit.field - len(scene.fields)]
    if sum(a * b for a, b in zip(Wall(scene, hit.field - len(scene.fields)).normal, d)) >= 0:
        return np.zeros(3), quad.material.albedo  # the back
    by_cosine = sum(a * b for a, b in zip(start.normal, d)) / math.pi
    by_lamp = lamp_density(scene, hit.field, hit.t, d)
    return quad.material.emission * by_cosine / (by_cosine + by_lamp), quad.material.albedo


def solve(scene, queries, paths, bounces, seed):
    """Irradiance of queries.

    Returns
    -------
    mean, m2 : (n, 3) float64
        Mean over the paths and sum of the squared deviations from it.
    paths : (n,) int
        Number of paths, 0 for holes.
    """
    mean, m2, count = np.zeros((len(queries), 3)), np.zeros((len(queries), 3)), np.zeros(len(queries), dtype=int)
    for i in range(len(queries)):
        query = queries[i : i + 1]
        if len(paths) == 0 or is_hole(scene, query):
            continue
        light = np.array([math.pi * path_worth(scene, query, path, bounces, seed) for path in paths])
        mean[i], count[i] = light.mean(axis=0), len(paths)
        m2[i] = [
            spread(list(light[:, c]), paths.start, math.pi * scene.background[c], lamplight(scene, c)) for c in range(3)
        ]
    return mean, m2, count


def box_of_four(size, a):
    """Masks from a path of a net to the two that share a half of its box of 4 / size, 2^-a by 2^-b, with it."""
    b = size.bit_length() - 3 - a
    return sharing(a + 1, b), sharing(a, b + 1)


def mixed_differences(worth, many):
    """Variance of a path, from the four paths of each box of the squarest shapes."""
    last, found = len(worth).bit_length() - 3, []
    for a in sorted(range(last + 1), key=lambda a: abs(2 * a - last - 0.5))[:many]:
        first, second = box_of_four(len(worth), a)
        seen = set()
        for i in range(len(worth)):
            box = i, i ^ first, i ^ second, i ^ first ^ second
            if i not in seen:
                found.append((worth[box[0]] - worth[box[1]] - worth[box[2]] + worth[box[3]]) ** 2 / 4)
                seen.update(box)
    return math.fsum(found) / len(found)


def net_variance(worth):
    """Variance of a path, extrapolated to the next finer net."""
    if len(worth) == 2:
        return (worth[0] - worth[1]) ** 2 / 2
    many = 2 if len(worth) in (128, 512, 2048, 8192) else 3
    fine, quarter = mixed_differences(worth, many), len(worth) // 4
    if quarter < 4:
        return fine
    coarse = sum(mixed_differences(worth[k * quarter : (k + 1) * quarter], many) for k in range(4)) / 4
    if fine >= coarse:
        return fine
    return fine * max(0.5, fine / coarse)


def lamplight(scene, channel):
    """Irradiance from all lamps if their power were spread over a box around the scene, along the axes of field 0."""
    points = []
    for volume in (field.volume for field in scene.fields):
        points += [volume.origin, volume.origin + volume.direction @ (volume.spacing * (np.array(volume.shape) - 1))]
    for quad in scene.quads:
        far = quad.corner + quad.edge_u + quad.edge_v
        points += [quad.corner, quad.corner + quad.edge_u, quad.corner + quad.edge_v, far]
    along = [[float(np.dot(point, axis)) for point in points] for axis in scene.fields[0].volume.direction.T]
    a, b, c = (max(places) - min(places) for places in along)
    flux = sum(
        math.pi * quad.material.emission[channel] * np.linalg.norm(np.cross(quad.edge_u, quad.edge_v))
        for quad in scene.quads
    )
    discs = sum(
        math.pi * disc.irradiance[channel] * (1 - math.cos(math.radians(disc.angle)))
        / (2 * math.pi * math.sin(math.radians(disc.angle)) ** 2)
        for disc in distant(scene)
    )  # fmt: skip
    return float(flux / (2 * (a * b + b * c + c * a)) + discs)


def spread(worth, first, sky, lamps):
    """The m2 of the light of paths number `first` on (a list), under a sky and lamps of these irradiances."""
    count, nets = len(worth), []
    while sum(map(len, nets)) < count:
        at = sum(map(len, nets))
        nets.append(worth[at : at + net_size(first + at, count - at)])
    known = [net for net in nets if len(net) > 1] or ([worth] if count == 2 else [])
    per_path = sum(len(net) * net_variance(net) for net in known) / max(1, sum(map(len, known)))
    usual = max(sum(worth) / count, sky)
    one_more = math.hypot(0.2 * usual, max(worth) - min(usual, max(worth)), lamps)
    return count * (count - 1) * (per_path / count + (one_more / count) ** 2)
