"""The nearest sample at every node: the identity for `direct`, and holes beyond its reach."""

import numpy as np
import pytest

from illumgrid.field.volume import Volume
from illumgrid.grid import GridSpec, Nodes
from illumgrid.interpolators import nearest
from illumgrid.interpolators.nearest import Nearest, on_nodes
from illumgrid.samplers.direct import Direct
from illumgrid.stages import Interpolator
from illumgrid.transport.samples import Queries, Samples, join_queries
from shapes import MIRRORED, ball, sky

UNEVEN = np.array([0.5, 1.25, 3.0])
FIELD = sky(ball(6), (0.3, 0.9)).fields[0]


def answers(points, mean, paths=None, m2=None):
    """Samples at world points; the interpolator may read only the points of the queries."""
    n = len(points)
    mean = np.broadcast_to(np.asarray(mean, np.float32), (n, 3)).copy()
    paths = np.full(n, 4) if paths is None else np.asarray(paths)
    nothing, ids = np.zeros((n, 3)), np.arange(n, dtype=np.uint64)
    queries = Queries(ids, np.asarray(points, float), nothing, nothing[:, :1], np.zeros(n, np.int32))
    return Samples(queries, mean, np.ones_like(mean) if m2 is None else m2, paths.astype(np.int32))


@pytest.mark.parametrize("origin", [(0, 0, 0), (1e7, -2e7, 3e7)])
def test_nearest_is_the_identity_on_direct_queries(origin):
    volume = Volume(ball(14).values, origin, UNEVEN, MIRRORED)
    scene = sky(volume, (0.4, 0.8))
    spec = GridSpec.over(volume, 14)
    queries = join_queries(list(Direct().queries(scene, [spec], 0)))
    at_node = np.flatnonzero((np.abs(queries.point - spec.nodes(queries.id.astype(int))) < 1e-6).all(axis=1))
    assert len(at_node) > 200
    random = np.random.default_rng(0)
    mean, m2 = random.random((2, len(queries), 3)).astype(np.float32)
    samples = Samples(queries, mean, m2, np.full(len(queries), 8, np.int32))
    grid = Nearest().fill(samples, Nodes(spec, FIELD))
    node = queries.id[at_node].astype(int)
    assert np.array_equal(grid.values.reshape(-1, 3)[node], mean[at_node])
    assert np.array_equal(grid.error.ravel()[node], samples.error[at_node])
    assert (grid.support.ravel()[node] == 1).all()


def test_every_node_takes_the_nearest_sample_in_the_world():
    spec = GridSpec((5, 6, 4), (1, 2, 3), UNEVEN, MIRRORED)
    random = np.random.default_rng(1)
    points = spec.nodes()[random.integers(0, 120, 300)] + random.normal(scale=0.5, size=(300, 3))
    mean = random.random((300, 3)).astype(np.float32)
    grid = Nearest().fill(answers(points, mean), Nodes(spec, FIELD))
    distance = np.linalg.norm(spec.nodes()[:, None] - points[None], axis=2)
    near = distance.min(axis=1) <= np.linalg.norm(UNEVEN)
    assert near.sum() > 80
    assert np.array_equal(grid.values.reshape(-1, 3)[near], mean[distance.argmin(axis=1)[near]])
    assert np.array_equal(grid.support.ravel() > 0, near)


def test_nodes_beyond_a_cells_diagonal_are_holes_with_the_light_of_the_nearest_node():
    spec = GridSpec((12, 3, 3))
    grid = Nearest().fill(answers([[0, 1, 1], [11, 1, 1]], [[1, 2, 3], [4, 5, 6]]), Nodes(spec, FIELD))
    supported = np.linalg.norm(spec.nodes() - [0, 1, 1], axis=1) <= 3**0.5
    supported |= np.linalg.norm(spec.nodes() - [11, 1, 1], axis=1) <= 3**0.5
    assert np.array_equal(grid.support.ravel() > 0, supported)
    assert np.array_equal(np.isinf(grid.error.ravel()), ~supported)
    assert (grid.values[:6] == [1, 2, 3]).all() and (grid.values[6:] == [4, 5, 6]).all()


def test_answers_without_paths_are_passed_over():
    spec = GridSpec((3, 3, 3))
    grid = Nearest().fill(answers([[1, 1, 1], [1, 1, 1.4]], [[0, 0, 0], [1, 2, 3]], paths=[0, 4]), Nodes(spec, FIELD))
    assert (grid.values[1, 1, 1] == [1, 2, 3]).all()
    assert grid.support[1, 1, 1] == 1


def test_one_path_supports_a_node_though_its_error_is_unknown():
    grid = Nearest().fill(answers([[1, 1, 1]], 2.0, paths=[1]), Nodes(GridSpec((3, 3, 3)), FIELD))
    assert (grid.support == 1).all() and np.isinf(grid.error).all() and (grid.values == 2).all()


@pytest.mark.parametrize("count", [0, 3])
def test_no_answer_at_all_is_a_grid_of_holes_without_nan(count):
    spec = GridSpec((3, 4, 5))
    grid = Nearest().fill(answers(np.ones((count, 3)), 0.0, paths=np.zeros(count)), Nodes(spec, FIELD))
    assert not grid.values.any() and not grid.support.any() and np.isinf(grid.error).all()
    assert np.isfinite(grid.lookup(spec.nodes())).all()


def test_many_samples_at_one_place_are_no_trouble():
    grid = Nearest().fill(answers(np.ones((500, 3)), np.full((500, 3), 7.0)), Nodes(GridSpec((3, 3, 3)), FIELD))
    assert (grid.values == 7).all()


def test_slabs_of_nodes_do_not_show(monkeypatch):
    spec, random = GridSpec((6, 7, 5)), np.random.default_rng(0)
    samples = answers(random.random((40, 3)) * [5, 6, 4], random.random((40, 3)))
    whole = Nearest().fill(samples, Nodes(spec, FIELD))
    monkeypatch.setattr(nearest, "_SLAB", 17)
    parts = Nearest().fill(samples, Nodes(spec, FIELD))
    for name in ("values", "error", "support"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name))


def test_nearest_is_an_interpolator_without_options():
    assert isinstance(Nearest(), Interpolator) and Nearest.name == "nearest" and Nearest() == Nearest()


def test_samples_on_nodes_fill_them_without_a_search_and_coincident_ones_are_searched():
    spec = GridSpec.over(Volume(np.zeros((4, 4, 4))), 4)
    points = np.array([[1.0, 1, 1], [1 + 1e-8, 2, 2], [1, 1, 2], [1, 1, 2 + 1e-9], [2.4, 1, 1]])
    node, sample = on_nodes(spec, points)
    assert sample.tolist() == [0, 1, 2, 3]
    assert node.tolist() == [1 * 16 + 1 * 4 + 1, 1 * 16 + 2 * 4 + 2, 1 * 16 + 1 * 4 + 2, 1 * 16 + 1 * 4 + 2]
    queries = Queries(np.arange(5, dtype=np.uint64), points, np.ones((5, 3)), np.ones((5, 1)), np.zeros(5, np.int32))
    mean = np.arange(1.0, 6, dtype=np.float32)[:, None]
    grid = Nearest().fill(Samples(queries, mean, 0 * mean, np.full(5, 2, np.int32)), Nodes(spec, FIELD))
    assert grid.light[1, [1, 2, 1], [1, 2, 2], 0].tolist() == [1, 2, 3]
