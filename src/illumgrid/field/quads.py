"""Materials, and parallelograms with a material: walls and lamps."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats


def rgb(value: ArrayLike, name: str, at_most: float) -> Floats:
    """Check a colour: read-only (3,), or a refusal that begins with its name."""
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
        Of a clear coat, from 0, a mirror, to 1; None for no coat. Pictures only: light paths do not include coats.
    translucent : float
        Share of what lies behind that pictures show through the surface. Pictures only: light does not enter the solid.
        Pictures show what lies behind a surface with `transmission` in any case.
    """

    albedo: Floats = field(default_factory=lambda: np.full(3, 0.8))
    emission: Floats = field(default_factory=lambda: np.zeros(3))
    transmission: float = 0.0
    roughness: float | None = None
    translucent: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "albedo", rgb(self.albedo, "albedo", 1.0))
        object.__setattr__(self, "emission", rgb(self.emission, "emission", np.inf))
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
        """Whether pictures need no rays for it: no coat and no translucency."""
        return self.roughness is None and not (self.transmission or self.translucent)


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
        Name of its light if it emits; lights with the same name are one layer. By default the name of the quad.
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
