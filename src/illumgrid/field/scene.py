"""Scenes: fields, quads and their materials, and the lights."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.errors import BadInput, shown_range
from illumgrid.field.boundaries import suggest_range
from illumgrid.field.filters import finite
from illumgrid.field.lights import Light
from illumgrid.field.quads import Material as Material
from illumgrid.field.quads import Quad as Quad
from illumgrid.field.quads import rgb
from illumgrid.field.rooms import box_around, floor_under, square_texels
from illumgrid.field.volume import UPWARD, Floats, Side, Volume

_HELD = 1e-5
"""Half the width of the range of a held level, as a share of the data's span."""


def _around(volume: Volume, name: str, isovalue: float) -> Floats:
    """The range (2,) of a held level."""
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
        Voxels that are not finite are replaced, with a warning (see `illumgrid.field.filters.finite`).
    material : Material
    range : (2,) array_like, optional
        Lowest and highest isovalue of the sweep; by default those of `suggest_range`.
    inside : {"above", "below"}
        Which side of the level set is solid: h >= c or h <= c.
    falling : bool
        Whether the sweep runs from the high end of the range to the low end.
    isovalue : float, optional
        A level that is held while the other fields sweep: a body that does not change. It replaces `range`; the body's
        light is computed at several positions of the sweep: see `IlluminationGrid.lookup`.
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

        For a held level, the middle, since it does not determine the other fields.
        """
        if self.isovalue is not None:
            return np.full(np.shape(isovalues), 0.5)
        first, last = self.sweep
        return np.asarray((np.asarray(isovalues, float) - first) / (last - first))


@dataclass(frozen=True, eq=False)
class Levels:
    """A table of isovalues; each row is one setting of the common sweep.

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
        object.__setattr__(self, "background", rgb(self.background, "background", np.inf))
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
        scene = cls(scene.fields, (floor_under(volume, GROUND),))
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
        raise BadInput(f"got {count} isovalues; expected at least 2 and at most {MOST_LEVELS}")
    return Levels(scene.levels(np.linspace(0.0, 1.0, count)))


def with_texels(scene: Scene, longest: int) -> Scene:
    """The scene with square texels, `longest` of them along the longest edge of all walls; a lamp keeps its own.

    Raises
    ------
    BadInput
        If no wall reflects light: the light that falls on it would not be shown.
    """
    walls = [quad for quad in scene.quads if quad.material.albedo.any()]
    if not walls:
        raise BadInput(f"got {longest} texels for a scene without walls; expected a floor, a box or quads")
    edge = max(float(np.linalg.norm(edge)) for quad in walls for edge in (quad.edge_u, quad.edge_v))
    return replace(
        scene,
        quads=tuple(
            square_texels(quad, longest / edge) if quad.material.albedo.any() else quad for quad in scene.quads
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
