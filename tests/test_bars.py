"""The error bar of a lookup, noise and interpolation, against a reference at unvisited isovalues."""

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.grid import GridSpec, IlluminationGrid
from illumgrid.stages import on_level_sets
from illumgrid.transport.samples import join_queries
from shapes import sampled


def grid(values, error=0.0, support=1.0):
    values = np.asarray(values, np.float32)
    shape = values.shape[:3]
    spec = GridSpec(shape)
    return IlluminationGrid(spec, values, np.broadcast_to(error, shape), np.broadcast_to(support, shape))


def polynomial(shape, terms):
    x = np.stack(np.indices(shape), axis=-1)
    return np.repeat((x**2 @ np.asarray(terms, float))[..., None], 3, axis=-1)


def test_a_straight_line_has_no_bar():
    x, y, z = np.indices((6, 5, 4))
    assert grid(np.repeat((3.0 * x - 2 * y + z)[..., None], 3, axis=-1)).bar.max() < 1e-5


def test_a_parabola_is_off_by_an_eighth_of_its_bend_in_the_middle():
    """Midway between nodes i and i + 1 of x² linear interpolation is off by 1/4 = 2/8, the value of the bar."""
    lone = grid(polynomial((7, 3, 3), (1, 0, 0)))
    np.testing.assert_allclose(lone.bar, 0.25, rtol=1e-5)
    middle = lone.lookup([[2.5, 1, 1]])[0, 0] - 2.5**2
    assert middle == pytest.approx(0.25) and lone.uncertainty([[2.5, 1, 1]])[0] == pytest.approx(0.25)
    all_three = grid(polynomial((5, 6, 7), (1, 2, 3)))
    np.testing.assert_allclose(all_three.bar, np.sqrt(1 + 4 + 9) / 4, rtol=1e-5)


def test_noise_counts_once_and_as_a_lookup_averages_it():
    random = np.random.default_rng(0)
    noisy = grid(random.normal(5, 0.1, (40, 40, 40, 3)), error=0.1)
    inner = noisy.bar[1:-1, 1:-1, 1:-1].astype(float)
    off = noisy.lookup(random.uniform(5, 34, (20000, 3))) - 5
    true = np.sqrt((off**2).mean())
    assert true == pytest.approx(0.1 * np.sqrt(8 / 27), rel=0.03)
    # What noise of its own the second differences keep by chance is left in, at most that much again.
    assert true <= np.sqrt((inner**2).mean()) <= 1.5 * true


def test_holes_have_no_bar_and_harm_no_neighbour():
    values = polynomial((6, 6, 6), (1, 1, 1))
    support, error = np.ones((6, 6, 6)), np.zeros((6, 6, 6))
    support[2, 3, 4], error[2, 3, 4] = 0, np.inf
    pierced = grid(values, error, support)
    assert np.isinf(pierced.bar[2, 3, 4]) and np.isfinite(pierced.bar).sum() == 215
    assert np.isinf(pierced.uncertainty([[2.4, 3, 4]])[0]) and np.isfinite(pierced.uncertainty([[4.5, 3, 4]])[0])
    assert np.isinf(grid(values, np.inf).bar).all()  # one path: nobody knows


def test_two_nodes_give_no_curve():
    assert grid(polynomial((2, 2, 2), (1, 1, 1))).bar.max() == 0


def test_resolution_is_four_on_a_curve_and_one_on_noise():
    assert grid(polynomial((9, 9, 9), (1, 2, 3))).resolution == pytest.approx(4, rel=1e-5)
    random = np.random.default_rng(1)
    assert grid(random.random((20, 20, 20, 3))).resolution == pytest.approx(1, rel=0.05)
    assert grid(np.ones((9, 9, 9, 3))).resolution == np.inf
    assert grid(np.ones((2, 2, 2, 3))).resolution == np.inf


def hills(noise):
    random = np.random.default_rng(0)
    peaks = [(random.uniform(0.3, 0.7, 3), random.uniform(0.08, 0.12)) for _ in range(8)]
    volume = sampled(
        lambda x: sum(np.exp(-((x - at) ** 2).sum(axis=1) / (2 * width**2)) for at, width in peaks),
        (24, 24, 24), spacing=(1 / 23,) * 3,
    )  # fmt: skip
    return volume.with_stored(volume.values + noise * random.standard_normal(volume.shape)), (0.3, 1.5)


def melting():
    volume = sampled(
        lambda x: 1.2 - np.minimum(*(np.linalg.norm(x - [a, 0, 0], axis=1) for a in (-0.5, 0.5))),
        (30, 20, 20), origin=(-1.5, -1, -1), spacing=(3 / 29, 2 / 19, 2 / 19),
    )  # fmt: skip
    return volume, (0.5, 0.9)


@pytest.mark.parametrize("field", [hills(0.0), hills(0.05), melting()], ids=["smooth", "noisy", "melting"])
def test_bars_cover_the_truth_at_unseen_isovalues_and_are_not_too_long(field):
    volume, (low, high) = field
    scene = ig.Scene.sky(volume, range=(low, high))
    light = ig.run(scene, grid=max(volume.shape), paths=32, bounces=3, isovalues=2).grids[0]
    rows = low + (high - low) * np.array([0.11, 0.29, 0.43, 0.61, 0.83])
    asked = join_queries(list(on_level_sets(scene, rows, 3, points=200)))
    truth = ig.backend("numba").solve(scene, asked, paths=range(512), bounces=3, seed=9)
    truth = truth[truth.paths > 0]
    off = np.sqrt(((light.lookup(truth.queries.point) - truth.mean) ** 2).mean(axis=1))
    bar = np.hypot(light.uncertainty(truth.queries.point), truth.error)
    assert np.isfinite(bar).mean() > 0.99
    assert (off <= 1.96 * bar).mean() >= 0.9
    assert np.median(bar) <= 2 * np.sqrt((off**2).mean())
