"""What is lit: fields, quads and their materials, and the background light."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.errors import BadInput, shown_range
from illumgrid.field.boundaries import suggest_range
from illumgrid.field.lights import Light
from illumgrid.field.volume import UPWARD, Floats, Side, Volume, finite, index_to_world


def _rgb(value: ArrayLike, name: str, at_most: float) -> Floats:
    color = np.array(value, dtype=float)
    if color.shape != (3,) or not np.isfinite(color).all() or (color < 0).any() or (color > at_most).any():
        upper = "up" if at_most == np.inf else f"to {at_most:g}"
        raise BadInput(
            f"{name} is {np.asarray(value).tolist()}; expected three numbers (red, green, blue) from 0 {upper}"
        )
    color.setflags(write=False)
    return color


@dataclass(frozen=True, eq=False)
class Material:
    """A Lambertian surface.

    Parameters
    ----------
    albedo : (3,) array_like
        Fraction of the light that is reflected, linear RGB, 0 to 1.
    emission : (3,) array_like
        Emitted radiance, linear RGB.
    transmission : float
        Fraction of the light that goes straight through, 0 to 1: the solid of a field is then a thin shell, with light
        inside. What is neither reflected nor transmitted is absorbed.
    roughness : float, optional
        Of a clear coat, from 0, a mirror, to 1. Pictures only: light paths know nothing of coats. None: no coat.
    translucent : float
        Share of what lies behind that pictures show through the surface. Pictures only: light does not enter the solid;
        what `transmission` lets through is seen anyway.
    """

    albedo: Floats = field(default_factory=lambda: np.full(3, 0.8))
    emission: Floats = field(default_factory=lambda: np.zeros(3))
    transmission: float = 0.0
    roughness: float | None = None
    translucent: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "albedo", _rgb(self.albedo, "albedo", 1.0))
        object.__setattr__(self, "emission", _rgb(self.emission, "emission", np.inf))
        if not 0.0 <= self.transmission <= 1.0:
            raise BadInput(f"transmission is {self.transmission}; expected a number from 0 to 1")
        if self.transmission > 0 and self.albedo.max() + self.transmission > 1.0 + 1e-9:
            raise BadInput(
                f"transmission is {self.transmission} and albedo {self.albedo.tolist()}; expected no more than 1 "
                "together: a surface cannot send on more light than it gets"
            )
        if self.transmission > 0 and self.emission.any():
            raise BadInput("a material with transmission has an emission; expected one of the two: leave one out")
        if self.roughness is not None and not 0.0 <= self.roughness <= 1.0:
            raise BadInput(f"roughness is {self.roughness}; expected a number from 0 (a mirror) to 1")
        if not 0.0 <= self.translucent <= 1.0:
            raise BadInput(f"translucent is {self.translucent}; expected a number from 0 to 1")

    @property
    def plain(self) -> bool:
        """Whether pictures need no rays for it: no coat, and nothing is seen through it."""
        return self.roughness is None and not (self.transmission or self.translucent)


_HELD = 1e-5
"""Half the width of the range of a level that is held, as a share of the data's: nodes beside it are on it."""


def _around(volume: Volume, name: str, isovalue: float) -> Floats:
    """The range (2,) of a level that is held."""
    low, high = volume.extremes
    if not low <= isovalue <= high:
        raise BadInput(
            f"the isovalue {isovalue:g} of field {name!r} misses its data, which run from "
            f"{shown_range((low, high), 6)}; choose one between them"
        )
    return isovalue + _HELD * max(high - low, abs(isovalue) * 1e-3) * np.array([-1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Field:
    """A volume whose level sets are surfaces.

    Parameters
    ----------
    name : str
    volume : Volume
        Voxels that are not finite are replaced, with a warning (see `illumgrid.field.volume.finite`).
    material : Material
    range : (2,) array_like, optional
        Lowest and highest isovalue of the sweep; by default those of `suggest_range`.
    inside : {"above", "below"}
        Which side of the level set is solid: h >= c or h <= c.
    falling : bool
        Whether the sweep runs from the high end of the range to the low end.
    isovalue : float, optional
        A level that is held while the other fields sweep: a fixed body beside them. It takes the place of `range`, and
        the body's light is known at several places of the sweep: see `IlluminationGrid.lookup`.
    """

    name: str
    volume: Volume
    material: Material = field(default_factory=Material)
    range: Floats = None  # type: ignore[assignment]
    inside: Side = "above"
    falling: bool = False
    isovalue: float | None = None

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and self.name and self.name.isprintable()):
            raise BadInput(f"a field's name is {self.name!r}; expected a printable text")
        if self.inside not in UPWARD:
            raise BadInput(f"inside of field {self.name!r} is {self.inside!r}; expected 'above' or 'below'")
        volume = finite(self.volume, self.inside)
        if self.isovalue is not None:
            object.__setattr__(self, "isovalue", float(self.isovalue))
            object.__setattr__(self, "range", _around(volume, self.name, float(self.isovalue)))
        asked = suggest_range(volume, self.inside)[:2] if self.range is None else self.range
        limits = np.array(asked, dtype=float)
        largest = np.finfo(np.float32).max  # stored values are float32
        if limits.shape != (2,) or not limits[0] < limits[1] or not (abs(volume.to_stored(limits)) <= largest).all():
            raise BadInput(
                f"the range of field {self.name!r} is {np.asarray(asked).tolist()}; expected a low and a high isovalue"
            )
        low, high = volume.extremes
        if limits[1] < low or limits[0] > high:
            raise BadInput(
                f"the range {limits[0]:g} to {limits[1]:g} of field {self.name!r} misses its data, "
                f"which run from {shown_range((low, high), 6)}; choose isovalues between them"
            )
        limits.setflags(write=False)
        object.__setattr__(self, "volume", volume)
        object.__setattr__(self, "range", limits)

    @property
    def upward(self) -> float:
        """+1 or -1: the sign for h and its isovalues with which the solid is where values are high."""
        return UPWARD[self.inside]

    @property
    def stored_range(self) -> Floats:
        """The range (2,) in terms of the volume's stored values, with which it can be compared."""
        return self.volume.to_stored(self.range)

    @property
    def widest(self) -> float:
        """Isovalue of the range with the largest solid, which contains the solids of all others."""
        return float(self.range[0] if self.upward > 0 else self.range[1])

    def solid(self, values: ArrayLike, isovalues: ArrayLike) -> NDArray[np.bool_]:
        """Whether points with these values of h lie in the solids of these isovalues; or both as stored values."""
        values, isovalues = np.asarray(values), np.asarray(isovalues)
        return np.asarray(values >= isovalues if self.upward > 0 else values <= isovalues)

    @property
    def sweep(self) -> Floats:
        """Isovalues (2,) at t = 0 and t = 1: the ends of the range, the high one first if the field is `falling`."""
        if self.isovalue is not None:
            return np.full(2, self.isovalue)
        return self.range[::-1] if self.falling else self.range

    def place(self, isovalues: ArrayLike) -> Floats:
        """Position of isovalues in the sweep: 0 at its first isovalue, 1 at its last, not clamped.

        Of a level that is held, the middle: it says nothing of the other fields.
        """
        if self.isovalue is not None:
            return np.full(np.shape(isovalues), 0.5)
        first, last = self.sweep
        return np.asarray((np.asarray(isovalues, float) - first) / (last - first))


@dataclass(frozen=True, eq=False)
class Quad:
    """A parallelogram: a wall, a floor, a luminaire.

    It reflects on both sides and emits on its front only: the side of edge_u × edge_v in the world.

    Parameters
    ----------
    name : str
    corner, edge_u, edge_v : (3,) array_like
        World position of one corner, and the two edges that start there.
    material : Material
    texels : (2,) tuple of int
        Resolution of its light texture along edge_u and edge_v.
    light : str, optional
        Name of its light if it emits: lights of one name are one layer. By default that of the quad.
    """

    name: str
    corner: Floats
    edge_u: Floats
    edge_v: Floats
    material: Material = field(default_factory=Material)
    texels: tuple[int, int] = (16, 16)
    light: str | None = None

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and self.name and self.name.isprintable()):
            raise BadInput(f"a quad's name is {self.name!r}; expected a printable text")
        for name in ("corner", "edge_u", "edge_v"):
            vector = np.array(getattr(self, name), dtype=float)
            if vector.shape != (3,) or not np.isfinite(vector).all():
                raise BadInput(f"{name} of quad {self.name!r} is {vector.tolist()}; expected three finite numbers")
            vector.setflags(write=False)
            object.__setattr__(self, name, vector)
        if not self.material.plain:
            raise BadInput(
                f"quad {self.name!r} has a transmission, a coat or is translucent; expected that of a field only"
            )
        lengths = np.linalg.norm(self.edge_u) * np.linalg.norm(self.edge_v)
        if not np.linalg.norm(np.cross(self.edge_u, self.edge_v)) > 1e-6 * lengths:
            raise BadInput(f"the edges of quad {self.name!r} are parallel or zero; expected two that span an area")
        texels = tuple(int(n) for n in self.texels)
        if len(texels) != 2 or min(texels) < 1:
            raise BadInput(f"texels of quad {self.name!r} are {self.texels}; expected two whole numbers from 1 up")
        object.__setattr__(self, "texels", texels)

    @property
    def normal(self) -> Floats:
        """Unit vector (3,) towards the front."""
        across = np.cross(self.edge_u, self.edge_v)
        return np.asarray(across / np.linalg.norm(across))

    @property
    def area(self) -> float:
        """Area in squared world units."""
        return float(np.linalg.norm(np.cross(self.edge_u, self.edge_v)))


@dataclass(frozen=True, eq=False)
class Levels:
    """A table of isovalues: row k is one setting of all sliders.

    Parameters
    ----------
    table : (K, F) float64
        Isovalue of each field; every column is strictly monotone.
    """

    table: Floats


@dataclass(frozen=True, eq=False)
class Scene:
    """All surfaces and lights of a computation.

    Parameters
    ----------
    fields : sequence of Field
        At least one; their axes are parallel (equal `direction`), their names unique.
    quads : sequence of Quad
        Walls, floors, luminaires; their names are unique, also among those of the fields.
    background : (3,) array_like
        Constant radiance from all directions outside, linear RGB: the light named ``sky``.
    lights : sequence of Sky, Distant or Harmonics
        Distant lights, each by its name: see `illumgrid.field.lights`.

    Notes
    -----
    Computations use the frame of the first field: its axes and its origin. `to_frame` and `from_frame` convert.
    """

    fields: tuple[Field, ...]
    quads: tuple[Quad, ...] = ()
    background: Floats = field(default_factory=lambda: np.zeros(3))
    lights: tuple[Light, ...] = ()

    def __post_init__(self) -> None:
        fields, quads = tuple(self.fields), tuple(self.quads)
        if not fields:
            raise BadInput("the scene has no field; expected at least one")
        names = [f.name for f in fields] + [q.name for q in quads]
        for name in names:
            if names.count(name) > 1:
                raise BadInput(f"two parts of the scene have the name {name!r}; expected names that differ")
        for other in fields[1:]:
            if np.abs(other.volume.direction - fields[0].volume.direction).max() > 1e-6:
                raise BadInput(
                    f"the axes of field {other.name!r} differ from those of {fields[0].name!r}; "
                    "expected one direction for all fields: resample one onto the lattice of the other"
                )
        object.__setattr__(self, "fields", fields)
        object.__setattr__(self, "quads", quads)
        object.__setattr__(self, "background", _rgb(self.background, "background", np.inf))
        object.__setattr__(self, "lights", tuple(self.lights))

    @property
    def open(self) -> bool:
        """Whether light comes from outside; a room without such light is closed."""
        return bool(self.background.any() or self.lights)

    @classmethod
    def sky(
        cls,
        volume: Volume,
        albedo: ArrayLike | None = None,
        range: ArrayLike | None = None,
        inside: Side = "above",
        name: str = "field",
    ) -> "Scene":
        """One field under a white sky of radiance 1."""
        material = Material() if albedo is None else Material(np.asarray(albedo))
        solid = Field(name, volume, material, range, inside)  # type: ignore[arg-type]
        return cls((solid,), background=np.ones(3))

    @classmethod
    def studio(
        cls,
        volume: Volume,
        albedo: ArrayLike | None = None,
        range: ArrayLike | None = None,
        inside: Side = "above",
        name: str = "field",
    ) -> "Scene":
        """One field in the light of a studio: a soft ``key`` from the upper left front, and a dim ``dome``.

        The default albedo is a neutral grey, `illumgrid.field.presets.ALBEDO`.
        """
        from illumgrid.field.presets import ALBEDO, studio

        material = Material(np.asarray(ALBEDO if albedo is None else albedo))
        return studio(Field(name, volume, material, range, inside))  # type: ignore[arg-type]

    def in_harmonics(self, degree: int = 2) -> "Scene":
        """The same scene, its distant lights replaced by spherical harmonics of this degree, 0 to 4.

        `Illumination.under` then shows it under any smooth sky.
        """
        from illumgrid.field.layers import in_harmonics

        return in_harmonics(self, degree)

    @classmethod
    def floor(
        cls,
        volume: Volume,
        albedo: ArrayLike | None = None,
        range: ArrayLike | None = None,
        inside: Side = "above",
        name: str = "field",
    ) -> "Scene":
        """One field on a grey floor, in the light of a studio: see `Scene.studio`."""
        from illumgrid.field.presets import GROUND, studio_lights

        scene = cls.sky(volume, albedo, range, inside, name)
        right, front, up, centre, half = _upright_box(volume)
        reach = 2.2 * half[:2].max()
        ground = _wall("floor", centre - half[2] * up, reach * right, -reach * front, np.full(3, GROUND))
        ground = _square_texels(ground, 2 * _texel(volume, 2 * reach) / (2 * reach))
        scene = cls(scene.fields, (ground,))
        return replace(scene, lights=studio_lights(scene))

    @classmethod
    def box(
        cls,
        volume: Volume,
        albedo: ArrayLike | None = None,
        range: ArrayLike | None = None,
        inside: Side = "above",
        name: str = "field",
    ) -> "Scene":
        """One field in a closed box: red wall left, green right, a luminaire at the bottom (the paper's Figure 5)."""
        fields = cls.sky(volume, albedo, range, inside, name).fields
        return cls(fields, box_around(volume))

    def levels(self, t: ArrayLike) -> Floats:
        """Settings (n, F) of all sliders for t (n,) from 0, the first isovalues of the sweep, to 1, the last (clamped).

        They rise, except those of fields that are `falling`.
        """
        first, last = np.array([f.sweep for f in self.fields]).T
        share = np.clip(np.atleast_1d(np.asarray(t, float)), 0.0, 1.0)[:, None]
        return np.asarray((1 - share) * first + share * last)

    def levels_through(self, field: int, isovalues: ArrayLike) -> Floats:
        """Settings (n, F) with field number `field` at `isovalues` (n,), the others at the same sweep position."""
        own = np.atleast_1d(np.asarray(isovalues, float))
        rows = self.levels(self.fields[field].place(own))
        rows[:, field] = own
        return rows

    def to_frame(self, points: ArrayLike) -> Floats:
        """Frame coordinates (n, 3) of world points (n, 3)."""
        first = self.fields[0].volume
        local: Floats = (np.asarray(points, float) - first.origin) @ first.direction
        return local

    def from_frame(self, points: ArrayLike) -> Floats:
        """World points (n, 3) of frame coordinates (n, 3)."""
        first = self.fields[0].volume
        return first.origin + np.asarray(points, float) @ first.direction.T

    def number_of(self, name: str | None) -> int:
        """Position of the field with this name; None means the first.

        Raises
        ------
        BadInput
            If no field has this name.
        """
        names = [f.name for f in self.fields]
        if name is None:
            return 0
        if name not in names:
            raise BadInput(f"no field is named {name!r}; expected one of {', '.join(names)}")
        return names.index(name)


MOST_LEVELS = 2**20  # rows of a level table: far more than any grid resolves


def level_table(scene: Scene, count: int) -> Levels:
    """`count` equal steps of the common sweep, both ends included."""
    if not 2 <= count <= MOST_LEVELS:
        raise BadInput(f"{count} isovalues were requested; expected at least 2 and at most {MOST_LEVELS}")
    return Levels(scene.levels(np.linspace(0.0, 1.0, count)))


def upright(direction: Floats) -> tuple[Floats, Floats, Floats]:
    """World directions (3,) right, front and up: signed axes of an array with this `direction`.

    Up is the axis nearest to world +z, front the remaining axis nearest to -y (the face, in medical coordinates).
    """
    heights = direction[2]
    vertical = int(np.argmax(np.abs(heights)))
    depths = np.where(np.arange(3) == vertical, 0.0, -direction[1])
    level = int(np.argmax(np.abs(depths)))
    up = direction[:, vertical] * np.sign(heights[vertical])
    front = direction[:, level] * (np.sign(depths[level]) or 1.0)
    return np.cross(up, front), front, up


def _upright_box(volume: Volume) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Right, front, up, and the centre and half extents (along those) of the box of a volume's voxel centres."""
    axes = np.stack(upright(volume.direction), axis=1)
    last = np.array(volume.shape) - 1.0
    half = 0.5 * np.abs(axes.T @ (volume.direction * (last * volume.spacing))).sum(axis=1)
    return axes[:, 0], axes[:, 1], axes[:, 2], index_to_world(volume, last / 2), half


def _wall(name: str, centre: Floats, u: Floats, v: Floats, albedo: Floats) -> Quad:
    """Parallelogram with half edges u and v around its centre; its front is u × v."""
    return Quad(name, centre - u - v, 2 * u, 2 * v, Material(albedo))


def _square_texels(quad: Quad, per_length: float) -> Quad:
    """The quad with texels as square as they can be, so many per world unit."""
    edges = (float(np.linalg.norm(edge)) for edge in (quad.edge_u, quad.edge_v))
    nu, nv = (max(1, round(per_length * edge)) for edge in edges)
    return replace(quad, texels=(nu, nv))


def _texel(volume: Volume, longest: float) -> int:
    """Texels along a wall of this length beside a volume: one for about three voxels, at least 6 and at most 48."""
    side = float((np.array(volume.shape) * volume.spacing).max())
    return int(np.clip(round(longest / side * max(volume.shape) / 3.3), 6, 48))


def fitting_texels(quad: Quad, volume: Volume) -> Quad:
    """A wall beside a volume with square texels, as many as those of `box_around`; one where no light is reflected."""
    if not quad.material.albedo.any():
        return replace(quad, texels=(1, 1))
    longest = max(float(np.linalg.norm(edge)) for edge in (quad.edge_u, quad.edge_v))
    return _square_texels(quad, _texel(volume, longest) / longest)


def with_texels(scene: Scene, longest: int) -> Scene:
    """The scene with square texels, `longest` of them along the longest edge of all walls; a lamp keeps its own.

    Raises
    ------
    BadInput
        If no wall reflects light: the light that falls on it would not be shown.
    """
    walls = [quad for quad in scene.quads if quad.material.albedo.any()]
    if not walls:
        raise BadInput(f"{longest} texels were asked for in a scene without walls; expected a floor, a box or quads")
    edge = max(float(np.linalg.norm(edge)) for quad in walls for edge in (quad.edge_u, quad.edge_v))
    return replace(
        scene,
        quads=tuple(
            _square_texels(quad, longest / edge) if quad.material.albedo.any() else quad for quad in scene.quads
        ),
    )


def finer_texels(scene: Scene, times: float) -> Scene:
    """The scene with so many times the texels along each edge of all walls that reflect light."""
    if times == 1:
        return scene

    def finer(quad: Quad) -> Quad:
        nu, nv = (max(1, round(times * n)) for n in quad.texels)
        return replace(quad, texels=(nu, nv)) if quad.material.albedo.any() else quad

    return replace(scene, quads=tuple(map(finer, scene.quads)))


def box_around(volume: Volume, margin: float = 0.25) -> tuple[Quad, ...]:
    """Six inward-facing walls around a volume, and a luminaire close above the floor; `margin` in half extents."""
    right, front, up, centre, half = _upright_box(volume)
    half = half + margin * half.max()
    r, f, u = right * half[0], front * half[1], up * half[2]
    white, red, green = np.full(3, 0.75), np.array([0.63, 0.06, 0.05]), np.array([0.14, 0.45, 0.09])
    lamp = Quad(
        "lamp", centre - 0.98 * u - 0.4 * r + 0.4 * f, 0.8 * r, -0.8 * f, Material(np.zeros(3), np.full(3, 8.0)), (1, 1)
    )
    walls = (
        _wall("floor", centre - u, r, -f, white),
        _wall("ceiling", centre + u, r, f, white),
        _wall("left", centre - r, f, -u, red),
        _wall("right", centre + r, f, u, green),
        _wall("back", centre - f, r, u, white),
        _wall("front", centre + f, r, -u, white),
    )
    longest = 2 * float(half.max())
    fine = _texel(volume, longest) / longest  # twice that on the floor, where the lamp is near and shadows are sharp
    return (*(_square_texels(wall, 2 * fine if wall.name == "floor" else fine) for wall in walls), lamp)
