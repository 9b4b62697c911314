"""Tests of the conformance suites: each check fails for stages that violate its requirement."""

from dataclasses import dataclass, field, make_dataclass, replace
from itertools import count
from typing import ClassVar

import numpy as np
import pytest

from illumgrid.backends.numba_ import Numba
from illumgrid.grid import GridSpec
from illumgrid.interpolators.nearest import Nearest
from illumgrid.stages import on_level_sets
from illumgrid.testing import BackendTests, InterpolatorTests, SamplerTests


def sampler(change):
    """A sampler with modified batches: `change` takes the scene, the number of the batch and the batch."""

    @dataclass(frozen=True)
    class Changed:
        name: ClassVar[str] = "changed"

        def queries(self, scene, specs, seed):
            batches = on_level_sets(scene, scene.levels([0.2, 0.6]), seed, points=30)
            return [new for number, batch in enumerate(batches) if (new := change(scene, number, batch)) is not None]

    return Changed()


def backend(change=lambda asked, answer, paths: answer, before=lambda asked: asked, more=0, quick=lambda paths: paths):
    """The backend `numba` with modified queries and samples."""

    @dataclass(frozen=True)
    class Changed:
        name: ClassVar[str] = "changed"
        geometry: ClassVar[str] = "levelset"

        def solve(self, scene, queries, *, paths, bounces, seed):
            asked = before(queries)
            answer = Numba(threads=1).solve(scene, asked, paths=quick(paths), bounces=bounces + more, seed=seed)
            return change(queries, answer, paths)

    return Changed()


def interpolator(change=lambda samples, grid: grid, before=lambda samples: samples):
    """The interpolator `nearest` with modified samples and grids."""

    @dataclass(frozen=True)
    class Changed:
        name: ClassVar[str] = "changed"

        def fill(self, samples, nodes):
            return change(samples, Nearest().fill(before(samples), nodes))

    return Changed()


def options(
    kind, default, doc="Parameters\n    ----------\n    x : int\n        Said.\n", frozen=True, eq=True, **about
):
    """A stage with one option."""
    made = make_dataclass("Changed", [("x", kind, field(default=default, **about))], frozen=frozen, eq=eq)
    made.__doc__, made.name = f"Changed.\n\n    {doc}", "changed"
    return made()


def buried_get_light(asked, answer, paths):
    hole = (answer.paths == 0) & asked.normal.any(axis=1)
    return replace(answer, paths=np.where(hole, len(paths), answer.paths).astype(np.int32))


def spoil(queries):
    queries.point[0] += 1e-9
    return queries


def dimmed(light):
    """The light of all as it is, and half of each single light."""
    return np.concatenate([light[..., :3], light[..., 3:] / 2], axis=-1)


def changed_if_several(samples, change):
    return replace(samples, mean=change(samples.light), m2=samples.spread) if len(samples.channels) > 3 else samples


def stateful(asked, answer, paths, calls=count()):  # noqa: B008
    return replace(answer, mean=answer.mean * np.float32(1 + 0.01 * next(calls)))


def shuffled(scene, number, q, random=np.random.default_rng()):  # noqa: B008
    return q[random.permutation(len(q))]


def everywhere(samples, grid):
    return replace(grid, support=np.ones_like(grid.support), error=np.where(np.isinf(grid.error), 1, grid.error))


def averaged(samples, grid):
    return replace(grid, values=np.broadcast_to(grid.values[grid.support > 0].mean(axis=0), grid.values.shape))


def black_holes(samples, grid):
    return replace(grid, values=np.where(grid.support[..., None] > 0, grid.values, 0))


def all_good(samples):
    return replace(samples, paths=np.full_like(samples.paths, 4))


def fewer(change):
    return lambda scene, number, q: change(q)


SAMPLERS = {
    "test_batches_have_shapes_and_types": [
        sampler(fewer(lambda q: None)),
        sampler(fewer(lambda q: replace(q, point=q.point.astype(np.float32)))),
        sampler(fewer(lambda q: replace(q, level=q.level[:, :1]))),
        sampler(fewer(lambda q: replace(q, id=q.id.astype(np.int64)))),
        sampler(fewer(lambda q: replace(q, normal=q.normal * np.nan))),
    ],
    "test_every_field_is_asked": [sampler(lambda scene, number, q: q if q.target[0] == 0 else None)],
    "test_ids_are_unique_over_the_run": [sampler(fewer(lambda q: replace(q, id=np.arange(len(q), dtype=np.uint64))))],
    "test_points_lie_on_their_level_sets": [
        sampler(fewer(lambda q: replace(q, point=q.point + 1e-3 * q.normal))),
        sampler(fewer(lambda q: replace(q, level=q.level + 1e-4))),
        sampler(fewer(lambda q: replace(q, level=q.level[:, ::-1]))),
    ],
    "test_normals_are_unit_and_outward": [
        sampler(fewer(lambda q: replace(q, normal=-q.normal))),
        sampler(fewer(lambda q: replace(q, normal=1.01 * q.normal))),
        sampler(fewer(lambda q: replace(q, normal=0 * q.normal))),
        sampler(fewer(lambda q: replace(q, normal=np.roll(q.normal, 1, axis=0)))),
        sampler(lambda scene, number, q: replace(q, normal=q.normal @ scene.fields[0].volume.direction)),
    ],
    "test_equal_seeds_give_equal_queries": [sampler(shuffled)],
    "test_the_smallest_volume_is_sampled": [
        sampler(lambda scene, number, q: replace(q, point=q.point / (len(scene.fields) - 1 + 0 * q.point))),
    ],
    "test_options_are_the_fields_of_a_frozen_dataclass": [
        options(complex, 1j),
        options(int, 1, doc="Nothing."),
        options(int, 1, repr=False),
        options(int, 1, frozen=False),
        options(int, 1, eq=False),
    ],
}

BACKENDS = {
    "test_answers_have_shapes_and_types": [
        backend(before=spoil),
        backend(lambda asked, answer, paths: answer[::-1]),
        backend(lambda asked, answer, paths: replace(answer, mean=answer.mean.astype(float))),
        backend(lambda asked, answer, paths: replace(answer, paths=answer.paths[:, None])),
        backend(lambda asked, answer, paths: replace(answer, mean=answer.mean * np.float32(np.nan))),
        backend(lambda asked, answer, paths: replace(answer, mean=-answer.mean)),
        backend(quick=lambda paths: range(paths.start, paths.stop - 1)),
        backend(lambda asked, answer, paths: replace(answer, mean=0 * answer.mean)),
    ],
    "test_equal_seeds_give_equal_answers": [backend(stateful)],
    "test_lights_add_up": [
        backend(lambda asked, answer, paths: replace(answer, mean=dimmed(answer.light), m2=answer.spread)),
    ],
    "test_answers_do_not_depend_on_the_batch": [
        backend(lambda asked, answer, paths: replace(answer, mean=answer.mean * np.float32(1 + 1e-4 * len(asked)))),
        backend(before=lambda asked: replace(asked, id=np.arange(len(asked), dtype=np.uint64))),
    ],
    "test_ranges_of_paths_combine": [backend(quick=lambda paths: range(len(paths)))],
    "test_holes_are_marked": [
        backend(buried_get_light),
        backend(lambda asked, answer, paths: replace(answer, mean=answer.mean + np.float32(1e-3))),
        backend(before=lambda asked: replace(asked, normal=np.where(asked.normal == 0, 1.0, asked.normal))),
    ],
    "test_no_query_and_no_path_are_no_trouble": [
        backend(quick=lambda paths: paths if len(paths) else range(1)),
        backend(quick=lambda paths: paths if len(paths) > 1 else range(2 * len(paths))),
    ],
    "test_error_bars_are_honest": [
        backend(lambda asked, answer, paths: replace(answer, m2=answer.m2 / 16)),
        backend(lambda asked, answer, paths: replace(answer, m2=answer.m2 * 16)),
    ],
    "test_light_is_as_its_closed_forms_say": [
        backend(lambda asked, answer, paths: replace(answer, mean=answer.mean * np.float32(1.02))),
        backend(more=1),
        backend(before=lambda asked: replace(asked, normal=-asked.normal)),
    ],
}

INTERPOLATORS = {
    "test_a_constant_is_reproduced": [
        interpolator(lambda samples, grid: replace(grid, values=grid.values * 1.001)),
        interpolator(black_holes),
        interpolator(lambda samples, grid: replace(grid, values=grid.values[..., ::-1])),
        interpolator(lambda samples, grid: replace(grid, values=grid.values * np.nan)),
        interpolator(lambda samples, grid: replace(grid, error=np.zeros_like(grid.error))),
        interpolator(lambda samples, grid: replace(grid, support=grid.support * np.nan)),
        interpolator(lambda samples, grid: replace(grid, spec=GridSpec(grid.spec.shape))),
    ],
    "test_more_samples_come_nearer": [interpolator(averaged)],
    "test_errors_are_carried": [
        interpolator(lambda samples, grid: replace(grid, error=grid.error / 2)),
        interpolator(lambda samples, grid: replace(grid, error=grid.error * 2)),
    ],
    "test_an_error_that_nobody_knows_stays_unknown": [
        interpolator(lambda samples, grid: replace(grid, error=np.where(grid.support > 0, 0.1, np.inf))),
    ],
    "test_grey_light_is_that_of_three_equal_channels": [
        interpolator(
            before=lambda samples: samples if len(samples.channels) > 1 else replace(samples, mean=samples.mean / 2)
        ),
    ],
    "test_single_lights_are_filled_beside_all_light": [
        interpolator(before=lambda samples: changed_if_several(samples, dimmed)),
        interpolator(before=lambda samples: changed_if_several(samples, lambda light: 1.001 * light)),
    ],
    "test_holes_are_passed_over": [interpolator(before=all_good)],
    "test_nothing_is_claimed_beyond_reach": [interpolator(everywhere), interpolator(black_holes)],
    "test_the_order_of_samples_does_not_matter": [
        interpolator(lambda samples, grid: replace(grid, values=grid.values + samples.mean[:1].mean())),
    ],
    "test_samples_at_one_place_are_no_trouble": [
        interpolator(lambda samples, grid: replace(grid, values=grid.values * 3)),
    ],
    "test_no_sample_at_all_is_a_grid_of_holes": [
        interpolator(lambda samples, grid: everywhere(samples, grid) if not len(samples) else grid),
        interpolator(before=all_good),
    ],
}

SUITES = {
    "sampler": (SamplerTests, SAMPLERS),
    "backend": (BackendTests, BACKENDS),
    "interpolator": (InterpolatorTests, INTERPOLATORS),
}
CASES = [(k, check, n) for k, (_, table) in SUITES.items() for check in table for n in range(len(table[check]))]


@pytest.mark.parametrize("kind, check, number", CASES)
def test_a_broken_stage_fails_the_check_of_its_promise(kind, check, number):
    suite, table = SUITES[kind]
    broken = type("Broken", (suite,), {"stage": table[check][number], "paths": 1 << 13})
    with np.errstate(all="ignore"), pytest.raises(AssertionError) as caught:
        getattr(broken(), check)()
    assert str(caught.value), "a failure says which promise is broken"


def test_every_check_has_a_broken_stage():
    checks = {name for suite, _ in SUITES.values() for name in dir(suite) if name.startswith("test_")}
    assert checks == set(SAMPLERS) | set(BACKENDS) | set(INTERPOLATORS)


def test_the_helpers_break_nothing_by_themselves():
    for suite, stage, check in (
        (SamplerTests, sampler(fewer(lambda q: q)), "test_ids_are_unique_over_the_run"),
        (BackendTests, backend(), "test_error_bars_are_honest"),
        (InterpolatorTests, interpolator(), "test_a_constant_is_reproduced"),
    ):
        getattr(type("Right", (suite,), {"stage": stage})(), check)()
