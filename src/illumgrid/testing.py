"""Requirements of stages, as tests: a plugin's suite is a subclass of one of these with the attribute ``stage``.

``stage`` is a stage, or a callable that makes one, such as the class itself for a stage with its defaults. pytest
collects classes whose name begins with Test. Each failure message states the violated requirement.
"""

import json
import unittest
from collections.abc import Sequence
from dataclasses import asdict, is_dataclass, replace
from typing import Any, ClassVar, cast

import numpy as np

from illumgrid.field.layers import layers_of
from illumgrid.field.scene import Field, Material, Quad, Scene
from illumgrid.field.volume import Floats, Volume, interpolate, outward_normals, world_to_index
from illumgrid.grid import GridSpec, IlluminationGrid, Nodes
from illumgrid.grid.channels import channels_of, mixed
from illumgrid.registry.options import expected, options
from illumgrid.stages import on_level_sets
from illumgrid.transport.agreement import applies, judge, line, sidak
from illumgrid.transport.analytic import CASES, on_quad
from illumgrid.transport.samples import Queries, Samples, combine, join_queries
from illumgrid.transport.stages import capabilities, fill_nodes

__all__ = ["BackendTests", "InterpolatorTests", "SamplerTests"]

_MIRRORED = np.array([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 3 * [1, -1, 1]
_PARTS = ("id", "point", "normal", "level", "target")


def _scene() -> Scene:
    """Two balls that overlap, one solid above its isovalue and one below, over a floor and under a lamp and a sky."""
    place: dict[str, Any] = {
        "origin": np.array([50.0, -30.0, 20.0]),
        "spacing": np.array([1.0, 0.7, 1.3]),
        "direction": _MIRRORED,
    }
    index = np.indices((12, 14, 10))
    local = (index - np.array([5.5, 6.5, 4.5])[:, None, None, None]) * place["spacing"][:, None, None, None]
    radius = [np.sqrt(((local - np.array([x, 0.2, -0.1])[:, None, None, None]) ** 2).sum(axis=0)) for x in (-1.5, 2.0)]
    solids = [Volume(values.astype(np.float32), **place) for values in (8.0 - radius[0], radius[1])]
    above = Field("above", solids[0], Material(np.array([0.8, 0.6, 0.4])), np.array([4.5, 5.5]))
    below = Field("below", solids[1], Material(np.full(3, 0.5)), np.array([1.8, 2.8]), "below")
    (floor,) = Scene.floor(above.volume).quads
    up = 14 * floor.normal
    lamp = Quad("lamp", floor.corner + up, floor.edge_v, floor.edge_u, Material(np.zeros(3), np.full(3, 0.5)))
    return Scene((above, below), (floor, lamp), np.array([1.0, 0.7, 0.4]))


def _questions(scene: Scene, points: int) -> Queries:
    """Queries on both fields' level sets in the middle of the sweep, including those inside the other solid."""
    return join_queries(list(on_level_sets(scene, scene.levels([0.5]), 0, points=points)))


def _same(one: Any, other: Any, names: Sequence[str]) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


class _StageTests:
    """Requirements of any stage."""

    stage: ClassVar[Any]

    @classmethod
    def make(cls) -> Any:
        """The stage under test."""
        return cls.stage() if callable(cls.stage) else cls.stage

    def test_options_are_the_fields_of_a_frozen_dataclass(self) -> None:
        """Equal options give equal, immutable stages with a complete repr."""
        stage = self.make()
        frozen = is_dataclass(stage) and cast(Any, stage).__dataclass_params__.frozen
        assert frozen, f"{type(stage).__name__} is not a frozen dataclass"
        for option in options(type(stage)):
            assert expected(option.type), f"the option {option.name} is of type {option.type}, which --set cannot read"
            assert option.meaning, f"the docstring says nothing of the option {option.name} under Parameters"
            assert f"{option.name}=" in repr(stage), f"repr leaves out {option.name}"
        twin = replace(stage)
        assert stage == twin and hash(stage) == hash(twin), "stages of equal options differ"
        assert json.dumps({"name": stage.name, **asdict(stage)}), "the options are not what a record can hold"


class SamplerTests(_StageTests):
    """Requirements of a sampler. ``stage``: a sampler, or its class."""

    def asked(self, seed: int = 0) -> list[Queries]:
        """All batches for the scene of these tests."""
        scene = _scene()
        specs = [GridSpec.over(field.volume, 8) for field in scene.fields]
        return list(self.make().queries(scene, specs, seed))

    def test_batches_have_shapes_and_types(self) -> None:
        """Every array matches `illumgrid.Queries`."""
        batches = self.asked()
        assert sum(map(len, batches)), "no question was asked"
        for batch in batches:
            n = len(batch)
            wanted = zip(_PARTS, [(n,), (n, 3), (n, 3), (n, 2), (n,)], ["u8", "f8", "f8", "f8", "i4"])
            for name, shape, kind in wanted:
                array = getattr(batch, name)
                assert array.shape == shape, f"{name} has shape {array.shape}; expected {shape}"
                assert array.dtype == np.dtype(kind), f"{name} is {array.dtype}; expected {np.dtype(kind)}"
                assert np.isfinite(array).all(), f"{name} is not finite"

    def test_every_field_is_asked(self) -> None:
        """Each field needs samples of its own."""
        targets = set(np.concatenate([batch.target for batch in self.asked()]).tolist())
        assert targets == {0, 1}, f"of two fields these were asked: {targets}"

    def test_ids_are_unique_over_the_run(self) -> None:
        """Two queries of one id would share their random numbers."""
        ids = join_queries(self.asked()).id
        assert len(np.unique(ids)) == len(ids), "two queries have the same id"

    def test_points_lie_on_their_level_sets(self) -> None:
        """At each point, the field has the isovalue of the query's own row."""
        scene, queries = _scene(), join_queries(self.asked())
        for number, field in enumerate(scene.fields):
            own = queries[(queries.target == number) & queries.normal.any(axis=1)]
            off = interpolate(field.volume, world_to_index(field.volume, own.point)) - own.level[:, number]
            worst = float(np.abs(off).max(initial=0.0) / np.ptp(field.range))
            assert worst < 1e-6, f"a point is off its level set by {worst:.1e} of the range"

    def test_normals_are_unit_and_outward(self) -> None:
        """Gradient normals, pointing out of the solid; (0, 0, 0) marks a hole."""
        scene, queries = _scene(), join_queries(self.asked())
        for number, field in enumerate(scene.fields):
            own = queries[(queries.target == number) & queries.normal.any(axis=1)]
            assert len(own), f"every query on field {number} is a hole"
            off = np.abs(np.linalg.norm(own.normal, axis=1) - 1).max()
            assert off < 1e-6, f"a normal's length is off 1 by {off:.1e}"
            index = world_to_index(field.volume, own.point)
            outward = outward_normals(field.volume, index, field.inside) @ field.volume.direction.T
            worst = float((own.normal * outward).sum(axis=1).min())
            assert worst > 1 - 1e-6, f"the cosine between a normal and the outward gradient is {worst:.3f}"

    def test_equal_seeds_give_equal_queries(self) -> None:
        """No random state outlives a call."""
        one, again = join_queries(self.asked(7)), join_queries(self.asked(7))
        assert _same(one, again, _PARTS), "the same seed gave other queries"

    def test_the_smallest_volume_is_sampled(self) -> None:
        """2 x 2 x 2 voxels, and a range with few level sets."""
        scene = Scene.sky(Volume(np.arange(8, dtype=np.float32).reshape(2, 2, 2)), range=(6.5, 9.0))
        specs = [GridSpec.over(scene.fields[0].volume, 2)]
        for batch in self.make().queries(scene, specs, 0):
            assert np.isfinite(batch.point).all(), "a point is not finite"


class BackendTests(_StageTests):
    """Requirements of a backend. ``stage``: a backend, or its class.

    Every backend is tested against closed forms of light unless it sets ``transport = False``. ``paths`` is the
    approximate number of paths per check, fewer for a slow backend; ``cases`` are the closed forms.
    """

    paths: ClassVar[int] = 1 << 14
    cases: ClassVar[Sequence[Any]] = CASES

    def solve(self, queries: Queries, count: int | range = 8, seed: int = 3) -> Samples:
        """Samples in the scene of these tests."""
        paths = range(count) if isinstance(count, int) else count
        answer: Samples = self.make().solve(_scene(), queries, paths=paths, bounces=1, seed=seed)
        return answer

    def questions(self) -> Queries:
        """Some queries on both fields."""
        return _questions(_scene(), int(np.clip(self.paths // 512, 6, 30)))

    def test_answers_have_shapes_and_types(self) -> None:
        """Every query gets a sample, in order, and is left unchanged."""
        scene = _scene()
        walls = [on_quad(scene, number, 5.0, np.array([[0.5, 0.5], [0.4, 0.6]])) for number in range(2)]
        asked = join_queries([self.questions(), *walls])
        before = join_queries([asked])
        answer, n = self.solve(asked), len(asked)
        assert _same(asked, before, _PARTS), "solve changed the queries"
        assert _same(answer.queries, before, _PARTS), "the answers are not those of the queries, in their order"
        for name, shape, kind in zip(("mean", "m2", "paths"), [(n, 3), (n, 3), (n,)], ["f4", "f4", "i4"]):
            array = getattr(answer, name)
            assert array.shape == shape, f"{name} has shape {array.shape}; expected {shape}"
            assert array.dtype == np.dtype(kind), f"{name} is {array.dtype}; expected {np.dtype(kind)}"
            assert np.isfinite(array).all() and (array >= 0).all(), f"{name} is negative or not finite"
        assert set(answer.paths.tolist()) <= {0, 8}, "paths is neither the requested number nor 0"
        assert answer.paths.any() and answer.mean.any(), "nothing was answered"

    def test_equal_seeds_give_equal_answers(self) -> None:
        """Bit for bit."""
        asked = self.questions()
        assert _same(self.solve(asked), self.solve(asked), ("mean", "m2", "paths")), "the same seed gave other answers"

    def test_answers_do_not_depend_on_the_batch(self) -> None:
        """The sample of a query is the same alone and in a batch, bit for bit."""
        asked = self.questions()
        whole = self.solve(asked)
        for rows in (np.arange(len(asked))[::-3], np.array([5])):
            part = self.solve(asked[rows])
            assert _same(part, whole[rows], ("mean", "m2", "paths")), "an answer depends on the batch it came in"

    def test_ranges_of_paths_combine(self) -> None:
        """Work can be continued: the mean of two ranges equals that of the whole."""
        asked = self.questions()
        both = combine(self.solve(asked, range(8)), self.solve(asked, range(8, 24)))
        off = np.abs(both.mean - self.solve(asked, 24).mean).max()
        assert off <= 1e-5, f"ranges of paths combine to a mean that is off by {off:.1e}"

    def test_holes_are_marked(self) -> None:
        """No normal, or inside the solid of another field: paths 0, mean 0, stderr infinite."""
        scene = _scene()
        asked = _questions(scene, 60)
        blind = asked.id % 5 == 0
        asked = replace(asked, normal=np.where(blind[:, None], 0.0, asked.normal))
        buried = np.zeros(len(asked), bool)
        for number, field in enumerate(scene.fields):
            value = interpolate(field.volume, world_to_index(field.volume, asked.point))
            buried |= (asked.target != number) & field.solid(value, asked.level[:, number] + 0.1 * field.upward)
        assert buried.any() and not (blind | buried).all()
        holes = self.solve(asked, 2)[blind | buried]
        marked = not holes.paths.any() and not holes.mean.any() and np.isinf(holes.stderr).all()
        assert marked, "a query without a normal, or inside another field's solid, got an answer"

    def test_no_query_and_no_path_are_no_trouble(self) -> None:
        """No queries give no samples; without paths every sample is a hole; one path has no error of its own."""
        asked = _questions(_scene(), 5)
        assert len(self.solve(asked[:0])) == 0, "no query got an answer"
        none = self.solve(asked, 0)
        assert not none.paths.any() and not none.mean.any() and not none.m2.any(), "no path gave light"
        assert np.isinf(self.solve(asked, 1).stderr).all(), "the error of a single path is not infinite"

    def test_lights_add_up(self) -> None:
        """Where the lights of the scene have channels of their own, their sum is the light of all."""
        answer = self.solve(self.questions())
        if len(answer.channels) > 3:
            every = mixed(answer.channels, layers_of(_scene()), {}).rgb(answer.light)
            off = np.abs(every - answer.mean).max()
            assert off <= 1e-5 * answer.mean.max(), f"the sum of the lights is off that of all by {off:.1e}"

    def test_error_bars_are_honest(self) -> None:
        """Bars of 95 % cover at least 90 % of the references; their median is at most 1.5 times the true RMS error.

        The reference is the backend's own, from 8 times the paths with another seed; its error is added. The bounds
        allow for chance deviations of a correct backend, exceeded once in a thousand.
        """
        asked = _questions(_scene(), int(np.clip(self.paths // 128, 16, 128)))  # on each of two fields
        few, truth = self.solve(asked, 32), self.solve(asked, 256, seed=4)
        good = few.paths > 0
        off = (few.mean - truth.mean)[good, 1].astype(float)
        bar = np.hypot(few.stderr, truth.stderr)[good, 1].astype(float)
        covered, least = (np.abs(off) <= 1.96 * bar + 1e-6).mean(), 0.9 - 3.1 * (0.09 / len(off)) ** 0.5
        assert covered >= least, f"bars of 95 % cover {covered:.0%} of the truths; expected at least {least:.0%}"
        ratio, most = np.median(bar) / np.sqrt((off**2).mean() + 1e-12), 1.5 * (1 + 3.1 / (2 * len(off)) ** 0.5)
        assert ratio <= most, f"the median bar is {ratio:.2f} times the true error; expected at most {most:.2f}"

    def test_light_is_as_its_closed_forms_say(self) -> None:
        """Scenes with known light, on level sets or their meshes: see `transport.analytic`."""
        stage = self.make()
        if not capabilities(stage).transport:
            raise unittest.SkipTest("the backend says that it is no light transport")
        cases = [case for make in self.cases if applies(case := make(), stage)]
        limit, each = (sidak(3 * n, 5e-4) for n in (len(cases), sum(len(case.expected) for case in cases)))
        rows = [judge(case, stage, self.paths, 0, limit, each) for case in cases]
        assert all(row.agrees for row in rows), "\n".join(line(row) for row in rows if not row.agrees)


class InterpolatorTests(_StageTests):
    """Requirements of an interpolator. ``stage``: an interpolator, or its class."""

    def fill(self, light: Any = 1.0, m2: Any = 1.0, paths: Any = 4, rows: Any = slice(None), **density: int) -> Any:
        """Grid filled from samples on level sets of field 0, whose light may be a function of the points."""
        samples, spec = _answers(light, m2, paths, **density)
        grid = fill_nodes(self.make(), samples[rows], Nodes(spec, _scene().fields[0]))
        self.check(grid, spec)
        return grid

    @staticmethod
    def check(grid: IlluminationGrid, spec: GridSpec) -> None:
        """Requirements of any grid."""
        steps, asked = np.array(grid.spec.shape) - 1, np.array(spec.shape) - 1
        whole = np.allclose(grid.spec.spacing * steps, spec.spacing * asked, rtol=1e-9) and (steps >= asked).all()
        assert whole and _same(grid.spec, spec, ("origin", "direction")), "another grid; expected these nodes or denser"
        assert np.isfinite(grid.values).all(), "a value is not finite"
        assert (grid.support >= 0).all() and np.isfinite(grid.support).all(), "a support is negative or not finite"
        assert (grid.error >= 0).all(), "an error is negative or NaN"
        assert np.isinf(grid.error[grid.support == 0]).all(), "a node without support has a finite error"

    def test_a_constant_is_reproduced(self) -> None:
        """Weights add up to 1, and holes have the value of their neighbours."""
        light = np.array([0.25, 1.0, 3.0])
        grid = self.fill(light)
        assert (grid.support > 0).any(), "no node is supported"
        off = np.abs(grid.values / light - 1).max()
        assert off < 1e-5, f"a constant is off by {off:.1e}"

    def test_more_samples_come_nearer(self) -> None:
        """The error of light that is linear in space shrinks if samples are three times as dense."""
        slope = np.array([0.3, -0.2, 0.4])
        errors = []
        for density in ({"levels": 4, "points": 40}, {"levels": 12, "points": 360}):
            grid = self.fill(lambda x: (x - [50, -30, 20]) @ slope + 10, **density)
            near = (grid.support > 0).ravel()
            off = grid.values[..., 1].ravel() - ((grid.spec.nodes() - [50, -30, 20]) @ slope + 10)
            inside = near & _between(grid.spec)
            errors.append(float(np.sqrt((off[inside] ** 2).mean())))
        assert errors[1] < 0.7 * errors[0], f"with more samples the error went from {errors[0]:.3g} to {errors[1]:.3g}"

    def test_errors_are_carried(self) -> None:
        """The errors of nodes agree with the effect of noise of a known size."""
        random, sigma = np.random.default_rng(5), 0.1
        noisy = self.fill(lambda x: 1 + sigma * random.standard_normal(len(x)), 12 * sigma**2)
        good = noisy.support > 0
        true = float(np.sqrt(((noisy.values[good, :1] - 1) ** 2).mean()))
        stated = float(np.sqrt((noisy.error[good].astype(float) ** 2).mean()))
        assert 0.7 * true <= stated <= 1.5 * true, f"the errors say {stated:.3g}; noise moved the nodes by {true:.3g}"

    def test_an_error_that_nobody_knows_stays_unknown(self) -> None:
        """Samples of one path have no error of their own, and neither have nodes that depend on them."""
        grid = self.fill(1.0, 0.0, 1)
        assert (grid.support > 0).any() and np.isinf(grid.error).all(), "single paths gave a finite error"

    def test_holes_are_passed_over(self) -> None:
        """Samples without paths are ignored."""
        count = len(_answers(1.0)[0])
        hole = np.arange(count) % 3 == 0
        light = np.where(hole, 0.0, 1.0 + np.arange(count) % 2)
        marked = self.fill(light, paths=np.where(hole, 0, 4))
        without = self.fill(light, rows=~hole)
        assert _same(marked, without, ("values", "error", "support")), "an answer without paths was used"

    def test_nothing_is_claimed_beyond_reach(self) -> None:
        """A node more than four cell diagonals from every sample is a hole, which has the light of a neighbour."""
        samples, spec = _answers(1.0)
        corner = np.linalg.norm(samples.queries.point - samples.queries.point[0], axis=1) < 0.5
        grid = self.fill(2.0, rows=corner)
        distance = np.linalg.norm(grid.spec.nodes() - samples.queries.point[0], axis=1)
        far = (distance > 0.5 + 4.5 * np.linalg.norm(spec.spacing)).reshape(grid.spec.shape)
        assert far.any() and not grid.support[far].any(), "a node far from every sample claims support"
        assert np.allclose(grid.values, 2.0, rtol=1e-5), "a hole does not hold the light of its neighbours"

    def test_grey_light_is_that_of_three_equal_channels(self) -> None:
        """Samples of one channel give the values, errors and support of RGB samples."""
        samples, spec = _answers(np.random.default_rng(6).random(len(_answers(1.0)[0])))
        grey = Samples(samples.queries, samples.mean[:, :1], samples.m2[:, :1], samples.paths)
        nodes = Nodes(spec, _scene().fields[0])
        one, three = (fill_nodes(self.make(), asked, nodes) for asked in (grey, samples))
        for name in ("values", "error", "support"):
            same = np.allclose(getattr(one, name), getattr(three, name), rtol=1e-6)
            assert same, f"samples of one channel give other {name} than samples of three equal channels"

    def test_single_lights_are_filled_beside_all_light(self) -> None:
        """They change nothing about the light of all, and a constant one is reproduced."""
        samples, spec = _answers(lambda x: 1 + np.sin(x[:, :1]))
        constant, rest = np.full_like(samples.mean, 0.25), samples.mean - np.float32(0.25)
        light = np.concatenate([samples.mean, constant, rest], axis=1)
        several = replace(samples, mean=light, m2=np.tile(samples.m2, 3), channels=channels_of(_scene()))
        nodes = Nodes(spec, _scene().fields[0])
        alone, together = (fill_nodes(self.make(), asked, nodes) for asked in (samples, several))
        assert np.allclose(together.values, alone.values, rtol=1e-5), "single lights change the light of all"
        if len(together.channels) > 3:
            off = np.abs(together.light[..., 3:6] - 0.25).max()
            assert off <= 1e-5, f"a constant single light is off by {off:.1e}"

    def test_the_order_of_samples_does_not_matter(self) -> None:
        """Up to rounding."""
        light = np.random.default_rng(6).random(len(_answers(1.0)[0]))
        one, other = self.fill(light), self.fill(light, rows=slice(None, None, -1))
        assert np.allclose(one.values, other.values, atol=1e-4), "the order of the samples changes the light"

    def test_samples_at_one_place_are_no_trouble(self) -> None:
        """Their light lies between that of the samples."""
        samples, spec = _answers(np.arange(len(_answers(1.0)[0])) % 2 + 1.0)
        point = np.repeat(samples.queries.point[:4], len(samples) // 4 + 1, axis=0)[: len(samples)]
        moved = replace(samples, queries=replace(samples.queries, point=point))
        grid = fill_nodes(self.make(), moved, Nodes(spec, _scene().fields[0]))
        self.check(grid, spec)
        values = grid.values[grid.support > 0]
        assert len(values) and values.min() > 1 - 1e-3 and values.max() < 2 + 1e-3, "coincident samples overshoot"

    def test_no_sample_at_all_is_a_grid_of_holes(self) -> None:
        """Values 0, support 0, errors infinite, and no NaN; the same if every sample is a hole."""
        for grid in (self.fill(rows=slice(0)), self.fill(0.0, 0.0, 0)):
            empty = not grid.values.any() and not grid.support.any() and np.isinf(grid.error).all()
            assert empty, "a grid without samples claims light"


def _between(spec: GridSpec) -> Any:
    """Nodes (n,) between the first and the last level set of field 0 of the scene."""
    field = _scene().fields[0]
    (every,) = Nodes(spec, field).blocks()
    return (every.level > field.range[0]) & (every.level < field.range[1])


def _answers(light: Any, m2: Any = 1.0, paths: Any = 4, levels: int = 8, points: int = 160) -> tuple[Samples, GridSpec]:
    """Samples of the given light on level sets of field 0 of the scene."""
    scene = _scene()
    spec = GridSpec.over(scene.fields[0].volume, 14)
    rows = scene.levels(np.linspace(0, 1, levels))
    asked = join_queries([q for q in on_level_sets(scene, rows, 1, points=points) if q.target[0] == 0])
    own: Floats = np.asarray(light(asked.point) if callable(light) else light, float)
    mean = np.broadcast_to(own if own.shape == (3,) else own.reshape(-1, 1), (len(asked), 3)).astype(np.float32)
    spread = np.full((len(asked), 3), m2, np.float32)
    return Samples(asked, mean, spread, np.broadcast_to(paths, len(asked)).astype(np.int32)), spec
