"""What is lit: fields and their materials, and the light from everywhere outside."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from illumgrid.errors import BadInput
from illumgrid.volume import Floats, Side, Volume, finite


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
        Share of the light that is reflected, linear RGB, 0 to 1.
    emission : (3,) array_like
        Radiance that leaves the surface by itself, linear RGB.
    """

    albedo: Floats = field(default_factory=lambda: np.full(3, 0.8))
    emission: Floats = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        object.__setattr__(self, "albedo", _rgb(self.albedo, "albedo", 1.0))
        object.__setattr__(self, "emission", _rgb(self.emission, "emission", np.inf))


def suggest_range(volume: Volume, inside: Side = "above") -> tuple[float, float, str]:
    """Isovalues worth sweeping, and why, from the histogram.

    Returns
    -------
    low, high : float
        Otsu's threshold parts background from object; the other end leaves the inmost half of the object inside.
        With `inside` "below" the same is done for -h.
    why : str
        One sentence that says so, with the numbers.

    Raises
    ------
    BadInput
        If the values are constant: no level set is a surface.

    References
    ----------
    .. [1] N. Otsu, "A threshold selection method from gray-level histograms", IEEE Trans. SMC 9(1), 1979.
    """
    from skimage.filters import threshold_otsu

    # np.float64, not float: NumPy keeps the edges of float32 values in float32, too few of them far from zero.
    lowest, highest = np.float64(np.nanmin(volume.values)), np.float64(np.nanmax(volume.values))
    if not (np.isfinite(lowest) and np.isfinite(highest)):
        volume = finite(volume, inside)
        lowest, highest = np.float64(volume.values.min()), np.float64(volume.values.max())
    if lowest == highest:
        raise BadInput(f"the values are all {lowest:g}; expected a field that varies, or there is no isosurface")
    counts, edges = np.histogram(volume.values, 1024, (lowest, highest))
    depth = 0.5 * (edges[1:] + edges[:-1])
    if inside == "below":
        counts, depth = counts[::-1], -depth[::-1]
    sign = 1.0 if inside == "above" else -1.0
    threshold = float(threshold_otsu(hist=(counts, depth)))
    within = np.where(depth > threshold, counts, 0)
    # The bin at which half of the object is passed; at least one bin deeper than the threshold.
    deep = float(
        depth[max(np.searchsorted(np.cumsum(within), 0.5 * within.sum()), np.searchsorted(depth, threshold) + 1)]
    )
    share = within.sum() / counts.sum()
    low, high = sorted((sign * threshold, sign * deep))
    why = (
        f"Otsu's threshold {sign * threshold:.4g} parts the object ({share:.1%} of the voxels) from the background, "
        f"and half of the object lies {'above' if inside == 'above' else 'below'} {sign * deep:.4g}"
    )
    return low, high, why


@dataclass(frozen=True, eq=False)
class Field:
    """A volume whose level sets are surfaces.

    Parameters
    ----------
    name : str
    volume : Volume
        Voxels that are not finite are replaced, with a warning (see `illumgrid.volume.finite`).
    material : Material
    range : (2,) array_like, optional
        Lowest and highest isovalue that the user may sweep; by default as `suggest_range` says.
    inside : {"above", "below"}
        Which side of the level set is solid: h >= c or h <= c.
    """

    name: str
    volume: Volume
    material: Material = field(default_factory=Material)
    range: Floats = None  # type: ignore[assignment]
    inside: Side = "above"

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and self.name and self.name.isprintable()):
            raise BadInput(f"a field's name is {self.name!r}; expected a printable text")
        if self.inside not in ("above", "below"):
            raise BadInput(f"inside of field {self.name!r} is {self.inside!r}; expected 'above' or 'below'")
        volume = finite(self.volume, self.inside)
        asked = suggest_range(volume, self.inside)[:2] if self.range is None else self.range
        limits = np.array(asked, dtype=float)
        if limits.shape != (2,) or not np.isfinite(limits).all() or not limits[0] < limits[1]:
            raise BadInput(
                f"the range of field {self.name!r} is {np.asarray(asked).tolist()}; expected a low and a high isovalue"
            )
        low, high = float(volume.values.min()), float(volume.values.max())
        if limits[1] < low or limits[0] > high:
            raise BadInput(
                f"the range {limits[0]:g} to {limits[1]:g} of field {self.name!r} misses its data, "
                f"which run from {low:g} to {high:g}; choose isovalues between them"
            )
        limits.setflags(write=False)
        object.__setattr__(self, "volume", volume)
        object.__setattr__(self, "range", limits)


@dataclass(frozen=True, eq=False)
class Levels:
    """A table of isovalues: row k is one setting of all sliders.

    Parameters
    ----------
    table : (K, F) float64
        Isovalue of each field; every column strictly monotone.
    """

    table: Floats


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that the light meets.

    Parameters
    ----------
    fields : sequence of Field
        At least one; their axes are parallel (equal `direction`), their names differ.
    background : (3,) array_like
        Constant radiance from everywhere outside, linear RGB.

    Notes
    -----
    A scene is computed in one frame: the axes of its first field, from its origin. `to_frame` and `from_frame` convert.
    """

    fields: tuple[Field, ...]
    background: Floats = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        fields = tuple(self.fields)
        if not fields:
            raise BadInput("the scene has no field; expected at least one")
        names = [f.name for f in fields]
        for name in names:
            if names.count(name) > 1:
                raise BadInput(f"two fields have the name {name!r}; expected names that differ")
        for other in fields[1:]:
            if np.abs(other.volume.direction - fields[0].volume.direction).max() > 1e-6:
                raise BadInput(
                    f"the axes of field {other.name!r} differ from those of {fields[0].name!r}; "
                    "expected one direction for all fields: resample one onto the lattice of the other"
                )
        object.__setattr__(self, "fields", fields)
        object.__setattr__(self, "background", _rgb(self.background, "background", np.inf))

    @classmethod
    def sky(
        cls,
        volume: Volume,
        albedo: ArrayLike = (0.8, 0.8, 0.8),
        range: ArrayLike | None = None,
        inside: Side = "above",
        name: str = "field",
    ) -> "Scene":
        """One field under a white sky of radiance 1."""
        return cls((Field(name, volume, Material(np.asarray(albedo)), range, inside),), np.ones(3))  # type: ignore[arg-type]

    def levels(self, t: ArrayLike) -> Floats:
        """Settings (n, F) of all sliders for t (n,) from 0, the lowest isovalues, to 1, the highest (clamped)."""
        low, high = np.array([f.range for f in self.fields]).T
        share = np.clip(np.atleast_1d(np.asarray(t, float)), 0.0, 1.0)[:, None]
        return np.asarray((1 - share) * low + share * high)

    def levels_through(self, field: int, isovalues: ArrayLike) -> Floats:
        """Settings (n, F) with field number `field` at `isovalues` (n,), the others as the common sweep has them."""
        own = np.atleast_1d(np.asarray(isovalues, float))
        low, high = self.fields[field].range
        rows = self.levels((own - low) / (high - low))
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

    def number_of(self, name: str) -> int:
        """Position of the field with this name.

        Raises
        ------
        BadInput
            If no field has it.
        """
        names = [f.name for f in self.fields]
        if name not in names:
            raise BadInput(f"no field is named {name!r}; expected one of {', '.join(names)}")
        return names.index(name)


def level_table(scene: Scene, count: int) -> Levels:
    """`count` equal steps of the common sweep, both ends included."""
    if count < 2:
        raise BadInput(f"{count} isovalues were asked for; expected at least 2")
    return Levels(scene.levels(np.linspace(0.0, 1.0, count)))
