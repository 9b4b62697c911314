"""Scenes whose light has a closed form, for testing backends.

Each case bounds the deviation of its discrete surface from the formula; the bounds are derived, not fitted. Spheres are
level sets of -|x|², sampled at voxels of spacing s. Between voxels each term -x² becomes a chord, at most s²/4 below
it. The solid {h >= -R²} is therefore a convex polyhedron with one facet per cell; it contains the ball of radius² R² -
3s²/4 and lies in that of radius R; marching cubes finds the same facets. Interpolated central differences of x² are
exact: the gradient normal is x/|x|. The normal of a facet is that at the centre of its cell, at most √3 s/2 away.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from illumgrid.field.lights import Distant, Sky, pixel_directions
from illumgrid.field.rooms import box_around, upright
from illumgrid.field.scene import Field, Material, Quad, Scene
from illumgrid.field.upright import sky_axes
from illumgrid.field.volume import Floats, Volume, index_to_world
from illumgrid.transport.samples import Queries, join_queries
from illumgrid.transport.stages import on_level_sets

_TURN = np.array([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 3  # no axis of the array is a world axis
_ROUNDING = 1e-6  # relative: light is float32
_RADIUS = 12.0  # of the spheres, in voxels
_GRAY = np.array([0.8, 0.5, 0.2])


@dataclass(frozen=True, eq=False)
class Case:
    """A scene, queries and their exact light.

    Parameters
    ----------
    expected : (n, 3) or (1, 3) float64
        Irradiance at each query; or, with `area`, one number for all of them.
    bound : (n,) or (1,) float64
        Largest deviation from `expected` by discretisation of the surface and rounding.
    area : (n,) float64, optional
        The formula holds for the sum of area · (E - kept · E of one bounce fewer). Queries come in pairs: two random
        points of one cell of a surface, each of which represents half of it.
    kept : (n, 3) float64, optional
        Albedo at each query; without it the sum is that of area · E.
    voxels : bool
        The queries lie on voxels, each on the level set through itself. Such a level set may have no mesh (at a peak it
        is a point), so only backends that march are tested.
    """

    name: str
    scene: Scene
    queries: Queries
    expected: Floats
    bound: Floats
    bounces: int
    reason: str
    area: Floats | None = None
    kept: Floats | None = None
    voxels: bool = False


def _case(
    name: str, scene: Scene, queries: Queries, expected: ArrayLike, bounces: int, reason: str, bound: ArrayLike = 0.0
) -> Case:
    """A case with a value for each query; rounding is added to the bound."""
    truth = np.broadcast_to(np.asarray(expected, float), (len(queries), 3))
    return Case(name, scene, queries, truth, bound + _ROUNDING * truth.max(axis=1), bounces, reason)


def _field(name: str, values: Floats, limits: ArrayLike, albedo: ArrayLike, glows: bool, **place: Any) -> Field:
    color = np.asarray(albedo) * np.ones(3)
    material = Material(color, 1 - color if glows else np.zeros(3))
    return Field(name, Volume(values.astype(np.float32), **place), material, np.asarray(limits, float))


def on_quad(scene: Scene, number: int, level: float, shares: Floats, back: bool = False) -> Queries:
    """Queries at `shares` (n, 2) of the edges of quad `number`, on its front or back, while field 0 is at `level`."""
    quad, target = scene.quads[number], len(scene.fields) + number
    return Queries(
        id=np.arange(len(shares), dtype=np.uint64) | np.uint64((2 * target + back) << 40),
        point=quad.corner + shares @ np.stack([quad.edge_u, quad.edge_v]),
        normal=np.tile(-quad.normal if back else quad.normal, (len(shares), 1)),
        level=np.tile(scene.levels_through(0, level), (len(shares), 1)),
        target=np.full(len(shares), target, np.int32),
    )


def _pairs(cells: int, seed: int) -> Floats:
    """Fractions (2 cells², 2): two consecutive random points in each cell of a square divided into cells²."""
    corner = np.repeat(np.argwhere(np.ones((cells, cells))), 2, axis=0)
    return np.asarray((corner + np.random.default_rng(seed).random(corner.shape)) / cells)


def ball(albedo: ArrayLike = 0.0, glows: bool = False) -> Field:
    """Field -|x|² around the world's origin, s = 1, with a border of three voxels around the sphere of `_RADIUS`."""
    x = np.arange(-_RADIUS - 3, _RADIUS + 4)
    values = -(x[:, None, None] ** 2 + x[:, None] ** 2 + x**2)
    limits = -((_RADIUS + np.array([1, -2])) ** 2)
    return _field("ball", values, limits, albedo, glows, origin=_TURN @ np.full(3, x[0]), direction=_TURN)


def _on_ball(scene: Scene, count: int) -> Queries:
    """Queries uniform over the ball: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    height, angle = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - height**2)
    unit = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
    return Queries.at(scene, _RADIUS * unit, level=-(_RADIUS**2))


def _dips() -> float:
    """Largest share of directions, cosine-distributed around x/|x|, that point below a facet of the ball.

    The share is (1 - cos δ)/2 for an angle δ between the normals (the projection of the hemisphere's cap), and
    sin δ <= (√3 s/2)/|x| with |x|² >= R² - 3s²/4.
    """
    sine = np.sqrt(0.75 / (_RADIUS**2 - 0.75))
    return float(0.5 * (1 - np.sqrt(1 - sine**2)))


def _asked(scene: Scene, on_voxels: bool) -> Queries:
    """Queries on the voxels of field 0 in the middle of its values, or uniform by area on three of its level sets."""
    volume = scene.fields[0].volume
    if on_voxels:
        return Queries.at(scene, index_to_world(volume, np.argwhere(np.abs(volume.stored - 0.5) < 0.25)))
    queries = join_queries(list(on_level_sets(scene, [0.41, 0.5, 0.59], 0, points=60)))
    return queries[np.flatnonzero(queries.normal.any(axis=1))]


def furnace(on_voxels: bool = False) -> Case:
    """White furnace: E = π(1 - a^(B+1)) to π, for any geometry.

    Radiance 1 arrives from all directions: sky 1, surfaces of albedo a and emission 1 - a. A path that escapes
    contributes Σ a^k (1 - a) + a^n = 1, one truncated after B reflections 1 - a^(B+1). E lies between these, and the
    bound is their difference, π a^(B+1). The field is noise, over a floor that paths see from its front only.
    """
    albedo, bounces = np.array([0.5, 0.4, 0.2]), 21
    place = {"spacing": np.array([1.0, 0.7, 1.9]), "direction": _TURN * [1, 1, -1]}
    field = _field("noise", np.random.default_rng(3).random((6, 5, 6)), (0.3, 0.7), albedo, True, **place)
    floor = replace(Scene.floor(field.volume).quads[0], material=field.material)
    scene = Scene((field,), (floor,), np.ones(3))
    queries = _asked(scene, on_voxels)
    queries = queries[(queries.point - floor.corner) @ floor.normal > 1e-3]
    bound = np.pi * albedo.max() ** (bounces + 1)
    case = _case("white furnace, noise", scene, queries, np.pi, bounces, "E = π", bound)
    return replace(case, name="white furnace, voxels", voxels=True) if on_voxels else case


def cavity(on_voxels: bool = False) -> Case:
    """White furnace, sealed: E = π(1 - a^(B+1)) on every path, for any geometry.

    A shell of solid voxels encloses noise; the k-th of B + 1 hits adds (1 - a) a^k. A leak would show a sky of 1000.
    """
    bounces = 3
    values = np.pad(np.random.default_rng(4).random((7, 6, 8)), 1, constant_values=9.0)
    field = _field("noise", values, (0.3, 0.7), _GRAY, True, spacing=np.array([1.0, 0.7, 1.9]), direction=_TURN)
    scene = Scene((field,), background=np.full(3, 1e3))
    queries, truth = _asked(scene, on_voxels), np.pi * (1 - _GRAY ** (bounces + 1))
    case = _case("sealed furnace, noise", scene, queries, truth, bounces, "E = π(1 - a^(B+1))")
    return replace(case, name="sealed furnace, voxels", voxels=True) if on_voxels else case


def glowing_box() -> Case:
    """White furnace, sealed by six walls that are lamps, a ball inside: E = π(1 - a^(B+1)) on ball and walls.

    The sum is the same, but much of it comes from rays that sample the lamps, so that weights which do not add up to 1
    are detected. A direction below a facet of the ball is one reflection like all others: no discretisation error.
    """
    bounces = 2
    field = ball(_GRAY, glows=True)
    scene = Scene((field,), tuple(replace(q, material=field.material) for q in box_around(field.volume)[:6]))
    on_walls = (on_quad(scene, number, -(_RADIUS**2), _pairs(4, 5)[::2]) for number in range(6))
    queries = join_queries([_on_ball(scene, 64), *on_walls])
    truth = np.pi * (1 - _GRAY ** (bounces + 1))
    return _case("sealed furnace, glowing walls", scene, queries, truth, bounces, "E = π(1 - a^(B+1))")


def plane() -> Case:
    """Linear field under a unit sky: E = π on every path, exactly, since its solid is a convex box with caps."""
    values = np.tensordot([2.0, 3.0, -5.0], np.indices((6, 7, 5)), axes=1)
    field = _field("plane", values, (-15.0, 22.0), _GRAY, False, direction=_TURN * [1, 1, -1])
    scene = Scene((field,), background=np.ones(3))
    index = 0.5 + np.random.default_rng(6).random((200, 3)) * [4.0, 4.0, 3.0]
    queries = Queries.at(scene, index_to_world(field.volume, index))
    return _case("linear field, unit sky", scene, queries, np.pi, 3, "E = π")


def convex() -> Case:
    """Black ball under a unit sky: E = π, minus at most the share of directions that point below its facets."""
    scene = Scene((ball(),), background=np.ones(3))
    return _case("ball, unit sky", scene, _on_ball(scene, 256), np.pi, 0, "E = π", np.pi * _dips())


def lambert(point: Floats, normal: Floats, quad: Quad) -> float:
    """Irradiance at `point` (3,) from a quad of radiance 1 that lies above its horizon: |Σ Θ_k n·Γ_k| / 2.

    Θ_k is the angle that edge k subtends and Γ_k the unit normal of the plane through it and the point (J. H. Lambert,
    "Photometria", 1760; P. Schröder, P. Hanrahan, "On the form factor between two polygons", SIGGRAPH 1993).
    """
    u, v = quad.edge_u, quad.edge_v
    ray = quad.corner + np.array([0 * u, u, u + v, v]) - point
    following = np.roll(ray, -1, axis=0)
    across = np.cross(ray, following)
    length = np.linalg.norm(across, axis=1)
    angle = np.arctan2(length, (ray * following).sum(axis=1))
    return float(abs((angle * (across @ normal) / length).sum()) / 2)


def luminaire() -> Case:
    """Lambert's formula: a black plane below a tilted rectangular lamp, no sky (see `lambert`). Exact."""
    field = _field("plane", -np.indices((9, 9, 9))[2], (-6.0, -1.0), 0.0, False, direction=_TURN)
    radiance = np.array([10.0, 5.0, 1.0])
    corner, u, v = np.array([2.0, 3.0, 6.0]), np.array([0.5, 3.0, 0.5]), np.array([3.0, -0.5, 1.5])
    lamp = Quad("lamp", _TURN @ corner, _TURN @ u, _TURN @ v, Material(np.zeros(3), radiance))
    scene = Scene((field,), (lamp,))
    index = np.column_stack([0.3 + 7.4 * _pairs(6, 7), np.full(72, 4.0)])
    queries = Queries.at(scene, index_to_world(field.volume, index))
    truth = np.array([lambert(x, n, lamp) for x, n in zip(queries.point, queries.normal)])
    return _case("rectangular lamp", scene, queries, truth[:, None] * radiance, 0, "E = L/2 Σ Θ n·Γ")


def _ground(height: float, half: float) -> Quad:
    """Black square of half edge `half`, `height` below the centre of the ball, facing it."""
    u, v, up = _TURN.T * [[half], [half], [1.0]]
    return Quad("floor", -height * up - u - v, 2 * u, 2 * v, Material(np.zeros(3)))


def shadow() -> Case:
    """Black floor beside a black ball under a unit sky: E = π(1 - (r/d)² cos θ).

    The configuration factor of a sphere that does not intersect the receiver's plane (J. R. Howell, "A catalog of
    radiation heat transfer configuration factors", B-27). The polyhedron hides more than its inscribed ball and less
    than its circumscribed one: r² = R² - 3s²/8 ± 3s²/8.
    """
    height = 1.5 * _RADIUS
    scene = Scene((ball(),), (_ground(height, 3 * _RADIUS),), np.ones(3))
    queries = on_quad(scene, 0, -(_RADIUS**2), _pairs(9, 8))
    distance = np.linalg.norm(queries.point, axis=1)
    per_square = np.pi * height / distance**3
    truth = np.pi - per_square * (_RADIUS**2 - 0.375)
    reason, bound = "E = π(1 - (r/d)² cos θ)", 0.375 * per_square
    return _case("floor beside a ball", scene, queries, truth[:, None], 0, reason, bound)


def half_sky() -> Case:
    """Black ball over a wide black floor under a unit sky: E = π(1 + n·up)/2, the sky's share of a tilted plane.

    A finite floor leaves a band of sky, ε below the horizon: tan ε = z/D, with the height z of the point and its
    distance D from the nearest edge. There n·ω is at most |n_h| cos φ + |n_z| sin ε, so the band adds at most
    sin ε (2 |n_h| + 2π |n_z| sin ε). Directions below a facet subtract at most the share `_dips`.
    """
    half = 2000 * _RADIUS
    scene = Scene((ball(),), (_ground(1.25 * _RADIUS, half),), np.ones(3))
    queries = _on_ball(scene, 256)
    tilt = queries.normal @ _TURN[:, 2]
    sine = 2.25 * _RADIUS / (half - _RADIUS)
    band = sine * (2 * np.sqrt(1 - np.minimum(tilt**2, 1)) + 2 * np.pi * np.abs(tilt) * sine)
    truth, bound = 0.5 * np.pi * (1 + tilt), band + np.pi * _dips()
    return _case("ball over a floor", scene, queries, truth[:, None], 0, "E = π(1 + n·up)/2", bound)


def _slanted_box(albedo: Floats | None, cells: int = 16) -> tuple[Scene, Queries, Floats, Floats, Floats]:
    """The box with its lamp below a slanted plane: scene, pairs of queries on all of it, areas, albedos, power.

    The volume is wider than the box, so that its level set ends at the walls and no cap is visible; walls continue into
    the solid, where queries are holes and count as 0. The field is linear: no discretisation error. All surfaces have
    `albedo`, or each its own and the front wall 0: it absorbs what would escape through an open front.
    """
    right, _, up = upright(_TURN)
    slopes = np.round(4 * (up + 0.25 * right) @ _TURN) / 4
    level = float(slopes.sum() * 4) + 1.0
    color = np.array([0.7, 0.5, 0.3]) if albedo is None else albedo
    values = np.tensordot(slopes, np.indices((9, 9, 9)), axes=1)
    field = _field("plane", values, (level - 1, level + 1), color, False, direction=_TURN)
    quads = []
    for quad in box_around(field.volume, margin=-0.25):
        own = np.zeros(3) if quad.name == "front" else quad.material.albedo
        quads.append(replace(quad, material=Material(own if albedo is None else albedo, quad.material.emission)))
    scene = Scene((field,), tuple(quads))
    # The plane over the floor's parallelogram: each point of the floor is moved up along the box.
    floor, slope = scene.quads[0], _TURN @ slopes
    edges = np.stack([floor.edge_u, floor.edge_v])
    edges = edges - (edges @ slope / (up @ slope))[:, None] * up
    middle = index_to_world(field.volume, np.full(3, 4.0)) + up / (up @ slope)
    parts = [Queries.at(scene, middle + (_pairs(cells, 20) - 0.5) @ edges, level=level)]
    areas, kept = [float(np.linalg.norm(np.cross(*edges)))], [color]
    for number, quad in enumerate(scene.quads):
        for back in (False, True) if quad.name == "lamp" else (False,):
            parts.append(on_quad(scene, number, level, _pairs(cells, 21 + number + 10 * back), back=back))
            areas.append(quad.area)
            kept.append(quad.material.albedo)
    count = 2 * cells * cells
    power = np.pi * quads[-1].area * quads[-1].material.emission
    return scene, join_queries(parts), np.repeat(areas, count) / count, np.repeat(kept, count, axis=0), power


def gray_box() -> Case:
    """Sealed cavity, all of albedo a, with a lamp of power Φ: ∫ E dA = Φ (1 - a^(B+1)) / (1 - a).

    The arriving power is Φ at first, and is multiplied by a at each reflection. The lamp has two sides.
    """
    bounces, reason = 4, "∫ E dA = Φ(1 - a^(B+1))/(1 - a)"
    scene, queries, area, _, power = _slanted_box(_GRAY)
    truth = power * (1 - _GRAY ** (bounces + 1)) / (1 - _GRAY)
    bound = np.array([_ROUNDING * truth.max()])
    return Case("gray box with a lamp", scene, queries, truth[None], bound, bounces, reason, area)


def balance() -> Case:
    """Energy balance in the coloured box: Φ = Σ (1 - a) ∫ E dA + escaped power + power truncated after B reflections.

    The truncated part is the light of B reflections that the walls would reflect again: Σ a ∫ (E_B - E_(B-1)) dA;
    together Φ = Σ ∫ (E_B - a E_(B-1)) dA.
    """
    scene, queries, area, kept, power = _slanted_box(None)
    bound, reason = np.array([_ROUNDING * power.max()]), "Φ = Σ ∫ (1 - a)E dA + escaped + cut off"
    return Case("energy in the box", scene, queries, power[None], bound, 3, reason, area, kept)


def _facing_up() -> tuple[Field, Queries, Floats]:
    """Black plane whose solid is below in the array, queries on it, and its normal in the world."""
    field = _field("plane", -np.indices((9, 9, 9))[2], (-6.0, -1.0), 0.0, False, direction=_TURN)
    index = np.column_stack([0.3 + 7.4 * _pairs(6, 9), np.full(72, 4.0)])
    queries = Queries.at(Scene((field,)), index_to_world(field.volume, index))
    return field, queries, queries.normal[0]


def _tilted(normal: Floats, angle: float) -> Floats:
    """Unit vector (3,) at this angle from a normal."""
    across = np.cross(normal, [0.6, -0.3, 0.7])
    return np.asarray(np.cos(angle) * normal + np.sin(angle) * across / np.linalg.norm(across))


def disc() -> Case:
    """Discs of the sky: E = π L sin²α cos θ for half-angle α at angle θ from the normal, θ + α <= π/2. Exact.

    A soft key, and a sun, which hardly any path finds by chance. The same rays sample both.
    """
    field, queries, normal = _facing_up()
    lights = tuple(
        Distant(name, _tilted(normal, theta), alpha, np.array(color))
        for name, theta, alpha, color in (("key", 0.7, 25.0, (3.0, 2.0, 1.0)), ("sun", -0.5, 0.27, (1.0, 2.0, 0.5)))
    )
    truth = sum(light.irradiance * (light.direction @ normal) for light in lights)
    scene = Scene((field,), lights=lights)
    return _case("discs of the sky", scene, queries, truth, 0, "E = π L sin²α cos θ")


def _pictured(name: str, radiance: Any, reason: str, expected: float, field: Field, queries: Queries) -> Case:
    """Case under an image of a sky, brightest at 1; `radiance` of the cosine to the normal's tilted axis.

    The image is bilinear: h²/8 of the second derivative, at most n for the n-th power of a cosine, along both axes.
    """
    rows = 128
    axes = sky_axes(Scene((field,)))
    image = radiance(pixel_directions(rows, 2 * rows)[0] @ axes)
    scene = Scene((field,), lights=(Sky(name, np.repeat(image[..., None], 3, axis=-1)),))
    bound = 2 * np.pi * (np.pi / rows) ** 2 / 8 * 4 * expected
    return _case(f"{name} sky", scene, queries, expected, 0, reason, bound)


def clamped_cosine() -> Case:
    """Sky of radiance max(0, ω·k) at angle γ from the normal: E = ⅔ (sin γ + (π - γ) cos γ)."""
    field, queries, normal = _facing_up()
    axis, angle = _tilted(normal, 1.1), 1.1
    truth = 2 / 3 * (np.sin(angle) + (np.pi - angle) * np.cos(angle))
    reason = "E = ⅔(sin γ + (π - γ)cos γ)"
    return _pictured("cosine", lambda d: np.maximum(d @ axis, 0.0), reason, truth, field, queries)


def lobe() -> Case:
    """Sky of radiance max(0, ω·n)⁴ above the normal: E = 2π/6."""
    field, queries, normal = _facing_up()
    return _pictured("lobe", lambda d: np.maximum(d @ normal, 0.0) ** 4, "E = 2π/(n + 2)", np.pi / 3, field, queries)


def shell() -> Case:
    """A ball that reflects all, within a closed shell of albedo 0.3 and transmission 0.5, under a sky of 1."""
    outer = ball()
    film = replace(outer, name="shell", material=Material(np.full(3, 0.3), transmission=0.5))
    inner = -((_RADIUS / 2) ** 2)
    scene = Scene((film, replace(ball(1.0), isovalue=inner)), background=np.ones(3))
    points = 0.5 * _on_ball(Scene((outer,)), 100).point
    queries = Queries.at(scene, points, field=1, level=inner)
    # Radiance X is the same everywhere inside, X = 0.5 + 0.3 X; between two reflections at the ball one is at it.
    reason = "E = π τ L / (1 - a) inside"
    return replace(_case("within a film", scene, queries, np.pi * 0.5 / 0.7, 24, reason, 0.3**12), voxels=True)


CASES: tuple[Callable[[], Case], ...] = (
    shell, furnace, partial(furnace, on_voxels=True), cavity, partial(cavity, on_voxels=True), glowing_box, plane,
    convex, luminaire, shadow, half_sky, gray_box, balance, disc, clamped_cosine, lobe,
)  # fmt: skip
"""Makers of the cases."""
