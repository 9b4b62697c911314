"""Distant lights: skies, discs such as the sun, and the spherical harmonics that stand for any smooth sky.

Directions to a sky have the axes right, back and up of the scene (see `illumgrid.field.upright.sky_axes`).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats

MOST_PIXELS = 1 << 22  # of an image of the sky
MOST_DEGREE = 4  # of spherical harmonics


def _checked(name: str, what: str, value: ArrayLike, shapes: str, fits: bool, least: float = 0.0) -> Floats:
    array = np.array(value, dtype=float)
    if not fits or not np.isfinite(array).all() or (array < least).any():
        shown = array.tolist() if array.size <= 6 else f"an array of shape {array.shape}"
        raise BadInput(f"the {what} of light {name!r} is {shown}; expected {shapes}")
    array.setflags(write=False)
    return array


def _check_name(name: object) -> None:
    if not (isinstance(name, str) and name and name.isprintable() and "=" not in name):
        raise BadInput(f"a light's name is {name!r}; expected a printable text without =")


@dataclass(frozen=True, eq=False)
class Sky:
    """Light from all directions outside.

    Parameters
    ----------
    name : str
        Lights of one name are one layer.
    radiance : array_like
        Linear RGB. (3,): constant. (2, 3): that of the nadir and of the zenith, linear in the height between them.
        (H, W, 3): an image in latitude and longitude, seen from the middle looking to the back: row 0 is the zenith,
        the middle column lies behind the object, columns right of it to the right.
    """

    name: str
    radiance: Floats

    def __post_init__(self) -> None:
        _check_name(self.name)
        shape = np.shape(self.radiance)
        fits: bool = shape in ((3,), (2, 3)) or (len(shape) == 3 and shape[2] == 3 and min(shape) > 1)
        fits = bool(fits and np.prod(shape) <= 3 * MOST_PIXELS)
        expected = "numbers from 0 up: (3,) RGB, (2, 3) those of nadir and zenith, or (H, W, 3) an image"
        object.__setattr__(self, "radiance", _checked(self.name, "radiance", self.radiance, expected, fits))


@dataclass(frozen=True, eq=False)
class Distant:
    """A disc of the sky of constant radiance: the sun, a soft key.

    Parameters
    ----------
    name : str
        Lights of one name are one layer.
    direction : (3,) array_like
        World direction towards its middle, of any length.
    angle : float
        Half of its angular size, in degrees: 0.27 for the sun.
    irradiance : (3,) array_like
        Linear RGB irradiance of a surface that faces it: π sin²(angle) times its radiance.
    """

    name: str
    direction: Floats
    angle: float
    irradiance: Floats

    def __post_init__(self) -> None:
        _check_name(self.name)
        fits = np.shape(self.direction) == (3,) and bool(np.any(self.direction))
        vector = _checked(self.name, "direction", self.direction, "three numbers, not all 0", fits, -np.inf)
        unit = vector / np.linalg.norm(vector)
        unit.setflags(write=False)
        angle = float(_checked(self.name, "angle", self.angle, "0.01 to 90 degrees", 0.01 <= self.angle <= 90))
        fits = np.shape(self.irradiance) == (3,)
        irradiance = _checked(self.name, "irradiance", self.irradiance, "three numbers from 0 up", fits)
        for key, value in {"direction": unit, "angle": angle, "irradiance": irradiance}.items():
            object.__setattr__(self, key, value)

    @property
    def radiance(self) -> Floats:
        """Linear RGB (3,) of the disc."""
        return np.asarray(self.irradiance / (np.pi * np.sin(np.radians(self.angle)) ** 2))


@dataclass(frozen=True, eq=False)
class Harmonics:
    """A smooth sky in the real spherical harmonics; each of them is a layer, so that any such sky can take its place.

    Parameters
    ----------
    name : str
    coefficients : (B, 3) array_like
        Linear RGB for each of the B = (degree + 1)² basis functions (see `basis`), degree 0 to 4.
    """

    name: str
    coefficients: Floats

    def __post_init__(self) -> None:
        _check_name(self.name)
        fits = np.shape(self.coefficients) in [((n + 1) ** 2, 3) for n in range(MOST_DEGREE + 1)]
        expected = "three numbers for each of 1, 4, 9, 16 or 25 functions"
        checked = _checked(self.name, "coefficients", self.coefficients, expected, fits, -np.inf)
        object.__setattr__(self, "coefficients", checked)


Light = Sky | Distant | Harmonics


def basis(degree: int, directions: ArrayLike) -> Floats:
    """Real spherical harmonics (n, (degree + 1)²) at unit directions (n, 3), orthonormal on the sphere.

    Function n² + n + m has degree n and order m: cosines of the azimuth for m > 0, sines for m < 0.

    References
    ----------
    .. [1] P.-P. Sloan, "Efficient spherical harmonic evaluation", JCGT 2(2), 2013.
    """
    x, y, z = np.asarray(directions, float).reshape(-1, 3).T
    xx, yy, zz, one = x * x, y * y, z * z, np.ones_like(x)
    functions = [
        0.28209479177387814 * one,
        0.4886025119029199 * y, 0.4886025119029199 * z, 0.4886025119029199 * x,
        1.0925484305920792 * x * y, 1.0925484305920792 * y * z, 0.31539156525252005 * (3 * zz - 1),
        1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
        0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z, 0.4570457994644658 * y * (5 * zz - 1),
        0.3731763325901154 * z * (5 * zz - 3), 0.4570457994644658 * x * (5 * zz - 1),
        1.445305721320277 * z * (xx - yy), 0.5900435899266435 * x * (xx - 3 * yy),
        2.5033429417967046 * x * y * (xx - yy), 1.7701307697799304 * y * z * (3 * xx - yy),
        0.9461746957575601 * x * y * (7 * zz - 1), 0.6690465435572892 * y * z * (7 * zz - 3),
        0.10578554691520431 * (35 * zz * zz - 30 * zz + 3), 0.6690465435572892 * x * z * (7 * zz - 3),
        0.47308734787878004 * (xx - yy) * (7 * zz - 1), 1.7701307697799304 * x * z * (xx - 3 * yy),
        0.6258357354491761 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
    ]  # fmt: skip
    return np.stack(functions[: (degree + 1) ** 2], axis=1)


def pixel_directions(rows: int, columns: int) -> tuple[Floats, Floats]:
    """Directions (rows, columns, 3) to the middles of an image of the sky, and their solid angles (rows,)."""
    height = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)
    azimuth = 2 * np.pi * ((np.arange(columns) + 0.5) / columns - 0.5)
    level = np.cos(height)[:, None]
    parts = level * np.sin(azimuth), level * np.cos(azimuth), np.sin(height)[:, None] + 0 * azimuth
    edges = np.sin(np.pi * (0.5 - np.arange(rows + 1) / rows))
    return np.stack(parts, axis=-1), -np.diff(edges) * 2 * np.pi / columns


def projected(light: Sky | Distant | Harmonics, degree: int, axes: Floats) -> Floats:
    """Coefficients ((degree + 1)², 3) of a light in the basis of this degree; `axes` are the rows right, back, up."""
    count = (degree + 1) ** 2
    result = np.zeros((count, 3))
    if isinstance(light, Harmonics):
        known = min(count, len(light.coefficients))
        result[:known] = light.coefficients[:known]
    elif isinstance(light, Distant):
        # A zonal function: by Funk and Hecke, the mean over the disc of each degree times the basis at its middle.
        cosine = np.cos(np.radians(light.angle))
        nodes, weights = np.polynomial.legendre.leggauss(MOST_DEGREE + 2)
        t, w = 0.5 * (1 + cosine + (1 - cosine) * nodes), 0.5 * (1 - cosine) * weights
        shares = [2 * np.pi * float(w @ np.polynomial.Legendre.basis(n)(t)) for n in range(degree + 1)]
        each = np.repeat(shares, [2 * n + 1 for n in range(degree + 1)])
        result = (each * basis(degree, axes @ light.direction)[0])[:, None] * light.radiance
    elif light.radiance.ndim == 3:
        rows, columns, _ = light.radiance.shape
        directions, solid = pixel_directions(rows, columns)
        for d, angle, colors in zip(directions, solid, light.radiance):
            result += angle * basis(degree, d).T @ colors
    else:
        nadir, zenith = np.broadcast_to(light.radiance, (2, 3))
        result[0] = np.sqrt(np.pi) * (nadir + zenith)
        if degree:
            result[2] = np.sqrt(np.pi / 3) * (zenith - nadir)
    return result


def rotated(coefficients: Floats, degrees: float) -> Floats:
    """Coefficients (B, 3) of the sky turned about up: by 90 degrees, what was in the back is on the right."""
    turned, count = np.array(coefficients, float), len(coefficients)
    for n in range(1, int(np.sqrt(count))):
        for m in range(1, n + 1):
            cosines, sines = coefficients[n * n + n + m], coefficients[n * n + n - m]
            c, s = np.cos(m * np.radians(degrees)), np.sin(m * np.radians(degrees))
            turned[n * n + n + m], turned[n * n + n - m] = c * cosines + s * sines, c * sines - s * cosines
    return turned
