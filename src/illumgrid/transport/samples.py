"""Queries to a light-transport backend, and the samples that it returns."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import reduce, wraps
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.errors import BadInput
from illumgrid.field.levelset import turned_levels
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats, index_to_world, interpolate, outward_normals, project, world_to_index
from illumgrid.grid.channels import GREY, RGB, Channels, channels_for

_Solve = TypeVar("_Solve", bound=Callable[..., "Samples"])


@dataclass(frozen=True, eq=False)
class Queries:
    """Points at which light is wanted, each on the level set of its own row of levels.

    Parameters
    ----------
    id : (n,) uint64
        Unique over a run: the random numbers of a query depend on its id and not on the batch.
    point : (n, 3) float64
        World positions, on the trilinear level set of the row.
    normal : (n, 3) float64
        World unit gradient normals, pointing outside; (0, 0, 0) marks a hole, which receives no light.
    level : (n, F) float64
        The isovalue of every field of the scene for this query.
    target : (n,) int32
        Number of the field on whose level set the point lies.
    """

    id: NDArray[np.uint64]
    point: Floats
    normal: Floats
    level: Floats
    target: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.id)

    def __getitem__(self, rows: slice | NDArray[np.bool_] | NDArray[np.integer]) -> "Queries":
        return Queries(self.id[rows], self.point[rows], self.normal[rows], self.level[rows], self.target[rows])

    @staticmethod
    def at(
        scene: Scene, points: ArrayLike, field: int = 0, level: float | ArrayLike | None = None, first_id: int = 0
    ) -> "Queries":
        """Queries at world points (n, 3), each on the level set through itself, or all on `level`.

        Parameters
        ----------
        scene : Scene
        points : (n, 3) array_like
            World positions.
        field : int
            Number of the field on whose level sets the points lie.
        level : float or (n,) array_like, optional
            Isovalue, one for all or one each: the points are projected onto that level set by Newton steps along the
            gradient. The other fields take the isovalue at the same position of the common sweep.
        first_id : int
            Id of the first query; the following ids count up.

        Returns
        -------
        Queries
            A point outside the volume, on a plateau, or more than a cell from its level set is a hole (normal 0).
        """
        world = np.asarray(points, dtype=float).reshape(-1, 3)
        if not 0 <= field < len(scene.fields):
            raise BadInput(f"field {field} was requested; expected a number from 0 to {len(scene.fields) - 1}")
        own = scene.fields[field]
        index = world_to_index(own.volume, np.where(np.isfinite(world), world, np.nan))  # infinite points lie outside
        top = np.array(own.volume.shape) - 1
        good = np.asarray((np.isfinite(index) & (index >= 0) & (index <= top)).all(axis=1))
        index = np.where(good[:, None], index, 0.0)
        if level is None:
            isovalues = interpolate(own.volume, index)
        else:
            isovalues = np.broadcast_to(np.asarray(level, dtype=float), len(world)).copy()
            index, arrived = project(own.volume, index, isovalues)
            world = np.where((good & arrived)[:, None], index_to_world(own.volume, index), world)
            good &= arrived
        normal = outward_normals(own.volume, index, own.inside) @ own.volume.direction.T
        return Queries(
            id=np.arange(first_id, first_id + len(world), dtype=np.uint64),
            point=world,
            normal=np.where(good[:, None], normal, 0.0),
            level=scene.levels_through(field, isovalues),
            target=np.full(len(world), field, dtype=np.int32),
        )


@dataclass(frozen=True, eq=False)
class Samples:
    """Irradiance at each query, with its own error.

    Parameters
    ----------
    queries : Queries
    mean : (n, C) float32
        Irradiance in C channels, never clamped: π times the mean contribution of cosine-distributed paths. Stored as
        `light`; the attribute `mean` is its linear RGB, (n, 3).
    m2 : (n, C) float32
        Equal to paths (paths - 1) stderr², which for independent paths is the sum of squared deviations. Backends of
        this package estimate it from differences within strata of the Sobol' net, so smooth variation over the
        hemisphere is not counted as noise, plus an allowance for light that so few paths may have missed. Stored as
        `spread`; `m2` is that of RGB, (n, 3).
    paths : (n,) int32
        Number of paths; 0 marks a hole, whose mean and m2 are 0.
    channels : Channels, optional
        By default grey for one channel, RGB for three.

    Attributes
    ----------
    light, spread : (n, C) float32
        The stored arrays; `mean` and `m2` are read-only views of them.
    """

    queries: Queries
    mean: NDArray[np.float32]
    m2: NDArray[np.float32]
    paths: NDArray[np.int32]
    channels: Channels = None  # type: ignore[assignment]
    light: NDArray[np.float32] = field(init=False, repr=False)
    spread: NDArray[np.float32] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        stored, channels = (self.mean, self.m2), self.channels
        if channels in (None, GREY) and all(array.shape[-1] == 3 for array in stored):
            channels = RGB
            if not any(array.strides[-1] for array in stored):  # grey light as RGB
                stored, channels = (self.mean[:, :1], self.m2[:, :1]), GREY
        widths = {array.shape[-1] for array in stored}
        if channels is None or (widths == {3} and channels.own == 3):  # a new `mean` is that of all lights together
            channels = channels_for(self.mean.shape[-1])
        if widths != {len(channels)}:
            raise BadInput(
                f"mean and m2 of {self.mean.shape[-1]} and {self.m2.shape[-1]} columns came with {len(channels)} "
                "channels; expected one column for each"
            )
        for names, array in zip((("light", "mean"), ("spread", "m2")), stored):
            shown = channels.rgb(array).view()
            shown.flags.writeable = False
            for name, value in zip(names, (array, shown)):
                object.__setattr__(self, name, value)
        object.__setattr__(self, "channels", channels)

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, rows: slice | NDArray[np.bool_] | NDArray[np.integer]) -> "Samples":
        return Samples(self.queries[rows], self.light[rows], self.spread[rows], self.paths[rows], self.channels)

    def _stderr(self, m2: NDArray[np.float32]) -> NDArray[np.float32]:
        n = self.paths[:, None].astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(n >= 2, np.sqrt(m2 / (n * (n - 1))), np.inf).astype(np.float32)

    @property
    def stderr(self) -> NDArray[np.float32]:
        """Standard error (n, 3) of the mean: stderr² = m2 / (paths (paths - 1)); infinite below two paths."""
        return self._stderr(self.m2)

    @property
    def errors(self) -> NDArray[np.float32] | None:
        """Standard error (n, C) of each channel, where lights are stored separately; else None."""
        return self._stderr(self.spread) if self.channels.mixable else None

    @property
    def error(self) -> NDArray[np.float32]:
        """Root mean square (n,) over RGB of the standard error."""
        return np.asarray(np.sqrt((self.stderr.astype(float) ** 2).mean(axis=1)), dtype=np.float32)


def check_request(paths: range, bounces: int) -> None:
    """Refuse requests that no backend can answer.

    Raises
    ------
    BadInput
        If `paths` does not count up by one, or `bounces` is negative.
    """
    if not isinstance(paths, range) or paths.step != 1 or paths.start < 0:
        raise BadInput(f"paths is {paths!r}; expected a range of path numbers from 0 up with step 1, such as range(64)")
    if bounces < 0:
        raise BadInput(f"got {bounces} bounces; expected 0 (light straight from the sky) or more")


def combine(one: Samples, other: Samples) -> Samples:
    """Merge the samples of two disjoint ranges of paths for the same queries, as if independent.

    References
    ----------
    .. [1] T. F. Chan, G. H. Golub, R. J. LeVeque, "Updating formulae and a pairwise algorithm for computing sample
           variances", Stanford STAN-CS-79-773, 1979.
    """
    if not np.array_equal(one.queries.id, other.queries.id):
        raise BadInput("the samples to combine answer different queries; expected the same ids in the same order")
    a, b = one.paths[:, None].astype(float), other.paths[:, None].astype(float)
    total = np.maximum(a + b, 1.0)
    channels, (light, more), (spread, of_more) = _in_common([one, other])
    change = more.astype(float) - light
    mean = light + change * b / total
    m2 = spread.astype(float) + of_more + change**2 * a * b / total
    return Samples(one.queries, mean.astype(np.float32), m2.astype(np.float32), one.paths + other.paths, channels)


def _in_common(parts: Sequence[Samples]) -> tuple[Channels, list[NDArray[np.float32]], list[NDArray[np.float32]]]:
    """Light and spread of samples in common channels: RGB where they differ."""
    channels = parts[0].channels
    if all(part.channels == channels for part in parts):
        return channels, [part.light for part in parts], [part.spread for part in parts]
    return RGB, [part.mean for part in parts], [part.m2 for part in parts]


LONGEST = 1 << 16
"""Largest number of paths that a backend of this package traces at once, since it stores each contribution."""


def in_turn(solve: _Solve) -> _Solve:
    """Check the arguments of a `Tracer.solve`, and call it with at most `LONGEST` paths at once."""

    @wraps(solve)
    def checked(self: Any, queries: Queries, *, paths: range, bounces: int, seed: int) -> Samples:
        check_request(paths, bounces)
        parts = [paths[i : i + LONGEST] for i in range(0, len(paths), LONGEST)] or [paths]
        return reduce(combine, (solve(self, queries, paths=part, bounces=bounces, seed=seed) for part in parts))

    return cast(_Solve, checked)


def join_queries(parts: Sequence[Queries]) -> Queries:
    """Concatenate batches of queries."""
    return Queries(
        *(np.concatenate([getattr(p, n) for p in parts]) for n in ("id", "point", "normal", "level", "target"))
    )


def join_samples(parts: Sequence[Samples]) -> Samples:
    """Concatenate batches of samples."""
    channels, light, spread = _in_common(parts)
    queries, paths = join_queries([p.queries for p in parts]), np.concatenate([p.paths for p in parts])
    return Samples(queries, np.concatenate(light), np.concatenate(spread), paths, channels)


def in_frame(scene: Scene, queries: Queries) -> tuple[Floats, Floats, Floats]:
    """Points (n, 3) and normals (n, 3) of queries in the frame of the scene, and their `turned_levels` (n, F)."""
    axes = scene.fields[0].volume.direction
    return scene.to_frame(queries.point), queries.normal @ axes, turned_levels(scene, queries.level)
