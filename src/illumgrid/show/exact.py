"""Exact pictures: rays from the visible points gather light, which is blended with the lookup by their accuracies.

Under an open sky a gathered ray is reflected once and ends at its second hit, in the light that grids and walls hold
there: their error enters only through two reflections, averaged over hemispheres, and shadows are as sharp as the
pixels. In a closed room it ends at its first hit: there a second would add more noise than it removes error, and would
take as long again. See `illumgrid.grid.cache`, and the docs for figures.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from illumgrid.bake.accumulator import Progress
from illumgrid.bake.bounces import enough_bounces
from illumgrid.errors import BadInput
from illumgrid.field.volume import Floats
from illumgrid.grid import IlluminationGrid
from illumgrid.grid.cache import Cache, cache_of
from illumgrid.light import Illumination
from illumgrid.rng import shifted_seed
from illumgrid.show.camera import Camera
from illumgrid.show.engines import software
from illumgrid.show.engines.software import SIDE, Hits
from illumgrid.show.looks import LAYERS, Layer, arriving, coated, layers_of
from illumgrid.show.shade import Coat, Colors, Shown
from illumgrid.transport.samples import Queries

MOST_PATHS = 1 << 20
MOST_PIXELS = 1 << 24
FEWEST_TRUST, MOST_TRUST = 4.0, 4096.0
"""Bounds on the number of gathered paths that a lookup is worth."""

_PILOT_RAYS, _PILOT_PATHS, _PILOT_LEAST = 4096, 16, 64
_LEAST_SHAPE = 0.1  # least ratio of a lookup's variance to the usual one: grids do not know all of their errors
_FAR = 100.0  # times the median of a surface's known variances: excludes nodes without an error
_BAND = 1 << 17  # sub-samples that are traced together: bounds the memory


@dataclass(frozen=True)
class Exact:
    """How a picture is lit beyond lookups.

    Parameters
    ----------
    paths : int
        Rays from each pixel.
    full : bool
        Trace paths to their ends and use no lookup: the reference, slow.
    """

    paths: int
    full: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.paths <= MOST_PATHS:
            raise BadInput(f"got {self.paths} paths per pixel; expected 1 to {MOST_PATHS}")


def cache_at(light: Illumination, share: float) -> Cache:
    """The light as a cache for one position in the sweep, 0 to 1, at which the light of held levels is taken."""
    held = [grid if not grid.rows else _mixed(grid, share) for grid in light.grids]
    cache = cache_of(light.scene, held, light.walls, after=int(light.scene.open))
    for number, field in enumerate(light.scene.fields):
        if field.isovalue is not None:  # a stretch around its level, in which this has the same position
            cache.sweep[number] += np.array([-share, 1.0 - share]) * max(1.0, abs(cache.sweep[number, 0]))
    return cache


def _mixed(grid: IlluminationGrid, share: float) -> IlluminationGrid:
    place = share * (len(grid.rows) - 1)
    below = min(int(place), len(grid.rows) - 2)
    one, other = (row.light for row in grid.rows[below : below + 2])
    light = one + np.float32(place - below) * (other - one)
    return IlluminationGrid(grid.spec, light, grid.error, grid.support, grid.channels)


def tracer_of(
    light: Illumination, full: bool, share: float = 0.5
) -> tuple["Callable[..., tuple[Colors, NDArray[np.int32]]]", int]:
    """A function that answers queries, with irradiance (n, 3) in the mix of the light and paths (n,); and its bounces.

    It is kept with the light for further pictures; if levels are held, for those at one position in the sweep.
    """
    from illumgrid.backends.numba_ import Numba
    from illumgrid.transport.tracer import prepare

    key = "_followed" if full else "_gathered"
    if not full and any(grid.rows for grid in light.grids):
        key += f"_{share!r}"
    if key not in light.__dict__:
        if full:
            tracer = prepare(Numba(), light.scene)
            bounces = 2 * enough_bounces(light.scene, tracer)[0]  # twice as many omit its square
        else:
            tracer = prepare(Numba(), light.scene, cache_at(light, share))
            bounces = int(light.recipe.get("bounces", 8)) + 2
        light.__dict__[key] = tracer, bounces
    tracer, bounces = light.__dict__[key]

    def solve(queries: Queries, paths: range, seed: int) -> tuple[Colors, NDArray[np.int32]]:
        answer = tracer.solve(queries, paths=paths, bounces=bounces, seed=seed)
        same = answer.channels.names == light.grids[0].channels.names
        return (light.grids[0].channels if same else answer.channels).rgb(answer.light), answer.paths

    return solve, bounces


def looked_up(shown: Shown, hits: Hits) -> tuple[Colors, Floats]:
    """Irradiance (n, 3) of lookups where rays hit, and its variance (n,) by the grids' error bars, 1 on walls."""
    light, variance = np.zeros((len(hits.what), 3), np.float32), np.ones(len(hits.what))
    for k, grid in enumerate(shown.light.grids):
        lit = hits.lit(k)
        light[lit] = grid.lookup(hits.point[lit], shown.share)
        variance[lit] = np.square(grid.uncertainty(hits.point[lit]), dtype=float)
    for k, wall in enumerate(shown.light.walls):
        lit = hits.lit(len(shown.light.grids) + k)
        light[lit] = wall.lookup(*software.place_on(shown, k, hits.point[lit]), shown.share)
    return light, variance


@dataclass(frozen=True, eq=False)
class Gathering:
    """Light gathered for the pixels of one picture.

    Parameters
    ----------
    shown : Shown
    camera : Camera
    width, height : int
    exact : Exact
    """

    shown: Shown
    camera: Camera
    width: int
    height: int
    exact: Exact

    def __post_init__(self) -> None:
        if self.width * self.height > MOST_PIXELS:
            raise BadInput(
                f"got an exact picture of {self.width} x {self.height} pixels; expected at most "
                f"{MOST_PIXELS / 1e6:.0f} million"
            )

    @property
    def surfaces(self) -> int:
        """Number of fields and quads."""
        return len(self.shown.scene.fields) + len(self.shown.scene.quads)

    @cached_property
    def seed(self) -> int:
        """Seed of paths that are independent of those of the grids."""
        return shifted_seed(int(self.shown.light.recipe.get("seed", 0)), 2**61)

    def asked(self, hits: Hits, rows: NDArray[np.int64], ids: NDArray[np.uint64]) -> Queries:
        """Queries with these ids (m,) at some of the hits."""
        level = np.tile(self.shown.row, (len(rows), 1))
        return Queries(ids, hits.point[rows], hits.normal[rows], level, hits.number[rows].astype(np.int32))

    @cached_property
    def trust(self) -> Floats:
        """Mean variances over each surface, (F + Q, 3): of a ray, of a lookup, and of a lookup by its error bars.

        Measured by separate rays at points spread over the picture. Weights that depend on the rays they weight would
        darken it: a pixel whose rays all missed the light would seem accurate. Two independent answers G and G' for
        the lookup L separate the two: the mean of (G - G')² is twice the variance of each, that of (L - G)(L - G') the
        squared error of L, whatever its cause. The standard error of the latter is added, which reduces trust where
        it is poorly known.
        """
        solve, _ = tracer_of(self.shown.light, False, self.shown.share)
        random = np.random.default_rng(self.seed)
        across, down = random.random((2, _PILOT_RAYS)) * 2 - 1
        camera, aspect = self.camera, self.width / self.height
        ahead = camera.forward + camera.tangent * (across[:, None] * aspect * camera.right + down[:, None] * camera.up)
        hits = software.first_hits(self.shown, camera.eye, ahead / np.linalg.norm(ahead, axis=1, keepdims=True))
        light, known = looked_up(self.shown, hits)
        rows = np.concatenate([np.zeros(0, np.int64), *(hits.lit(k) for k in range(self.surfaces))])
        ids = np.arange(len(rows), dtype=np.uint64)
        answers = [
            solve(self.asked(hits, rows, ids), range(_PILOT_PATHS), shifted_seed(self.seed, k + 1)) for k in range(2)
        ]
        good = (answers[0][1] > 0) & np.isfinite(known[rows])
        (one, _), (other, _) = answers
        of_ray = _PILOT_PATHS * 0.5 * np.square(one - other, dtype=float).mean(axis=1)
        of_lookup = ((light[rows] - one).astype(float) * (light[rows] - other)).mean(axis=1)

        def found(chosen: NDArray[np.bool_]) -> Floats:
            chosen = chosen & good
            if not chosen.any():
                return np.array([1.0, 0.0, 1.0])
            lookup = max(of_lookup[chosen].mean(), 0.0) + of_lookup[chosen].std() / np.sqrt(chosen.sum())
            own = known[rows][chosen]
            usual = np.minimum(own, _FAR * (np.median(own) or np.inf)).mean()
            return np.array([of_ray[chosen].mean(), lookup, usual])

        each = [hits.number[rows] == k for k in range(self.surfaces)]
        whole = np.ones(len(rows), bool)
        return np.array([found(own if (own & good).sum() >= _PILOT_LEAST else whole) for own in each])

    def worth_of_lookup(self, hits: Hits, known: Floats) -> Floats:
        """Number of gathered rays (n,) that each lookup is worth, from its variance (n,) by the grid's error bars.

        The error bars show where lookups are better or worse, the trial rays how accurate they are overall.
        """
        ray, lookup, usual = self.trust[np.maximum(hits.number, 0)].T
        shape = np.divide(known, usual, out=np.ones(len(known)), where=usual > 0)
        variance = lookup * np.clip(shape, _LEAST_SHAPE, 1e12)  # a lookup may be accurate even at a hole
        worth = np.divide(ray, variance, out=np.full(len(known), np.inf), where=variance > 0)
        return np.asarray(np.clip(worth, FEWEST_TRUST, MOST_TRUST))

    def blended(
        self, hits: Hits, pixel: NDArray[np.int64], total: Colors, count: NDArray[np.int32],
        inner: NDArray[np.bool_] | None = None,
    ) -> Colors:  # fmt: skip
        """Irradiance (n, 3) at sub-samples that belong to these pixels (n,), from sums (n, 3) over so many rays (n,).

        Rays of the sub-samples of a pixel on one surface are pooled; each sub-sample keeps the difference of its own
        lookup. On the `inner` sides (n,) of films lookups are worth little, since they hold light of the outer sides.
        """
        light, known = looked_up(self.shown, hits)
        worth = np.zeros(len(pixel)) if self.exact.full else self.worth_of_lookup(hits, known)
        group = self._groups(hits, pixel, inner)
        if inner is not None:
            worth[inner] = 0.0 if self.exact.full else FEWEST_TRUST

        def summed(values: NDArray[np.floating]) -> Floats:
            return np.bincount(group, values).astype(float)

        rays, members = summed(count.astype(float))[group], np.bincount(group)[group]
        share = np.divide(rays, rays + summed(worth)[group] / members, out=np.zeros(len(group)), where=rays > 0)
        for color in range(3):
            gathered = summed(total[:, color])[group] / np.maximum(rays, 1.0)
            before = light[:, color] if self.exact.full else summed(light[:, color])[group] / members
            light[:, color] = np.maximum(light[:, color] + share * (gathered - before), 0.0)
        return light

    def _groups(
        self, hits: Hits, pixel: NDArray[np.int64], inner: NDArray[np.bool_] | None = None
    ) -> NDArray[np.int64]:
        """Numbers (n,) that are equal for sub-samples of a pixel that show the same side of the same surface."""
        group = pixel * self.surfaces + np.maximum(hits.number, 0)
        return np.asarray(group if inner is None else 2 * group + inner)

    def coats(self, layer: Layer, pixel: NDArray[np.int64], total: Colors, count: NDArray[np.int32]) -> Coat:
        """Radiance of coats at sub-samples, from sums of radiance (n, 3) over so many rays (n,)."""
        rows, group = coated(self.shown, layer), self._groups(layer.hits, pixel)
        rays = np.maximum(np.bincount(group, count), 1)[group[rows]]
        found = [np.bincount(group, total[:, color])[group[rows]] / rays for color in range(3)]
        return Coat.over(layer.hits.facing, rows, np.stack(found, axis=1).astype(np.float32))

    def pictures(
        self, background: Colors, refined: bool = False, progress: Progress = lambda what, done, total: None
    ) -> Iterator[NDArray[np.uint8]]:
        """Pictures (height, width, 4), sRGB and coverage: the last one, or if `refined` each of `steps_to` it."""
        from illumgrid.backends.numba_ import cores

        steps = list(pairwise([0, *steps_to(self.exact.paths)]))
        depth = LAYERS if any(f.material.transmission for f in self.shown.displayed.fields) else 1
        kinds = 1 if self.shown.matte else 2  # light, and the reflections of coats
        total = np.zeros((kinds, depth, self.height * self.width * SIDE**2, 3), np.float32)
        count = np.zeros(total.shape[:-1], np.int32)
        per_row = self.width * SIDE**2
        rows = max(1, _BAND // per_row)
        with ThreadPoolExecutor(cores()) as pool:
            for some in [[step] for step in steps] if refined else [steps]:
                strips = []
                for first in range(0, self.height, rows):
                    band = range(first, min(first + rows, self.height))
                    part = slice(band.start * per_row, band.stop * per_row)
                    layers, lights, coats = self._layers(pool, band), [], []
                    for k, layer in enumerate(layers):
                        sums = total[:, k, part], count[:, k, part]
                        inner = None if depth == 1 else layer.inner
                        pixel = self.gather(layer.hits, band.start, some, sums[0][0], sums[1][0], inner)
                        if kinds > 1:
                            self._look(pool, layer, pixel, band.start, some, *sums)
                            coats.append(self.coats(layer, pixel, sums[0][1], sums[1][1]))
                        lights.append(self.blended(layer.hits, pixel, sums[0][0], sums[1][0], inner))
                    color = software.composed(self.shown, layers, background, lights, coats or None)
                    strips.append(software.averaged(color, self.width))
                    progress(f"{some[-1][1]} rays per pixel", band.stop, self.height)
                yield np.concatenate(strips)

    def gather(
        self, hits: Hits, first: int, steps: list[tuple[int, int]], total: Colors, count: NDArray[np.int32],
        inner: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.int64]:  # fmt: skip
        """Add light and number of these paths to those of sub-samples (n,) from picture row `first` on.

        The four sub-samples of a pixel share the paths of one sequence, a quarter of each step for each; returns the
        pixels that they belong to, counted from that row. The `inner` sides (n,) of films are left out.
        """
        solve, _ = tracer_of(self.shown.light, self.exact.full, self.shown.share)
        pixel, place = self._pixels(len(hits.what))
        lit = np.concatenate([hits.lit(k) for k in range(self.surfaces)])
        lit = lit if inner is None else lit[~inner[lit]]
        for number in range(SIDE**2):
            mine = lit[place[lit] == number]
            asked = self.asked(hits, mine, (pixel[mine] + first * self.width).astype(np.uint64))
            for rays in _quarters(steps, number):
                found, walked = solve(asked, rays, self.seed)
                total[mine] += found * walked[:, None]
                count[mine] += walked
        return pixel

    def _look(
        self, pool: Executor, layer: Layer, pixel: NDArray[np.int64], first: int, steps: list[tuple[int, int]],
        total: Colors, count: NDArray[np.int32],
    ) -> None:  # fmt: skip
        """Like `gather`, by sight: light of the inner sides of films to total[0], reflections of coats to total[1]."""
        _, place = self._pixels(len(pixel))
        for kind, (lit, factor) in enumerate(((np.flatnonzero(layer.inner), np.pi), (coated(self.shown, layer), 1.0))):
            seed = shifted_seed(self.seed, 3 + kind)

            def look(rows: NDArray[np.int64], rays: range, kind: int = kind, seed: int = seed) -> Colors:
                ids = (pixel[rows] + first * self.width).astype(np.uint64)
                return arriving(self.shown, self.camera.eye, layer, rows, ids, rays, seed, kind == 0)

            for number in range(SIDE**2):
                mine = lit[place[lit] == number]
                for rays in _quarters(steps, number) if len(mine) else ():
                    parts = pool.map(partial(look, rays=rays), np.array_split(mine, 16))
                    total[kind, mine] += np.float32(factor) * np.concatenate(list(parts))
                    count[kind, mine] += len(rays)

    def _pixels(self, many: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Pixels (n,) of sub-samples, counted from their first row, and positions (n,) within them."""
        y, x = np.divmod(np.arange(many), self.width * SIDE)
        return y // SIDE * self.width + x // SIDE, y % SIDE * SIDE + x % SIDE

    def _layers(self, pool: Executor, band: range) -> list[Layer]:
        if not self.shown.matte:
            self.shown.sight  # noqa: B018  before threads ask for it
        directions = software.directions_of(self.camera, self.width, band, self.height)
        parts = list(pool.map(partial(layers_of, self.shown, self.camera.eye), np.array_split(directions, 8)))
        found = []
        for same in zip(*parts):
            hits = Hits(*(np.concatenate(arrays) for arrays in zip(*(vars(one.hits).values() for one in same))))
            within, weight, behind = (np.concatenate(arrays) for arrays in zip(*(one[1:] for one in same)))
            found.append(Layer(hits, within, weight, behind))
        return found


def _quarters(steps: list[tuple[int, int]], number: int) -> Iterator[range]:
    """The paths of these steps that sub-sample `number` of a pixel traces."""
    for low, high in steps:
        start, stop = (low + (high - low) * k // SIDE**2 for k in (number, number + 1))
        if start < stop:
            yield range(start, stop)


def steps_to(paths: int) -> list[int]:
    """Numbers of rays per pixel after which a picture can be shown: 4, 16, 64, ... and the last."""
    return [*(4**k for k in range(1, 11) if 4**k < paths), paths]
