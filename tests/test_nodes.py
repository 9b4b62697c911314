"""Nodes to fill: position, level and normal; interpolators with the former signature run unchanged."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

import illumgrid as ig
from illumgrid import registry
from illumgrid.field.volume import Volume, interpolate, outward_normals, slabs, world_to_index
from illumgrid.grid import GREY, Nodes, fill_holes, nodes
from illumgrid.stages import IlluminationGrid
from illumgrid.testing import InterpolatorTests
from illumgrid.transport.stages import fill_nodes
from shapes import MIRRORED, ball, sky

SPEC = ig.GridSpec((5, 4, 6), (1, 2, 3), (0.5, 1.25, 3.0), MIRRORED)


@pytest.mark.parametrize("inside", ["above", "below"])
def test_nodes_know_their_place_their_level_and_their_normal(inside):
    volume = Volume(ball(9).values, (1, -2, 3), (0.5, 1.0, 2.0), MIRRORED)
    field = ig.Field("f", volume, range=(0.3, 0.9), inside=inside)
    spec = ig.GridSpec.over(volume, 7)
    (block,) = Nodes(spec, field).blocks()
    index = world_to_index(volume, spec.nodes())
    assert np.array_equal(block.point, spec.nodes())
    assert np.array_equal(block.level, interpolate(volume, index))
    assert np.array_equal(block.normal, outward_normals(volume, index, inside) @ MIRRORED.T)


def test_thick_layers_of_a_coarse_grid_are_looked_at_in_parts(monkeypatch):
    field, seen, crossed = sky(ball(30), (0.5, 0.55)).fields[0], [], nodes._crossed_cells
    whole = [nodes.reached(field, ig.GridSpec.over(field.volume, n)) for n in (2, 3, 30)]
    monkeypatch.setattr(nodes, "slabs", lambda shape: slabs(shape, 5 * 30 * 30))
    monkeypatch.setattr(nodes, "_crossed_cells", lambda f, rows: (seen.append(rows), crossed(f, rows))[1])
    parts = [nodes.reached(field, ig.GridSpec.over(field.volume, n)) for n in (2, 3, 30)]
    assert all(np.array_equal(a, b) for a, b in zip(whole, parts)) and any(not a.all() for a in whole)
    assert max(rows.stop - rows.start for rows in seen) == 5


def test_blocks_are_all_nodes_or_those_asked_for_some_at_a_time():
    nodes = Nodes(SPEC, sky(ball(6)).fields[0])
    assert len(nodes) == 120
    sizes, flat = zip(*((len(b.flat), b.flat) for b in nodes.blocks(size=50)))
    assert sizes == (50, 50, 20) and np.array_equal(np.concatenate(flat), np.arange(120))
    chosen = np.array([7, 3, 119])
    (block,) = nodes.blocks(chosen)
    assert np.array_equal(block.flat, chosen) and np.array_equal(block.point, SPEC.nodes()[chosen])
    assert not list(nodes.blocks(chosen[:0]))


def test_a_grid_of_flat_arrays_has_its_holes_filled():
    support = np.arange(120) % 5
    light = np.where(support > 0, 2.0, 0.0)[:, None]
    grid = Nodes(SPEC, sky(ball(6)).fields[0]).grid(light, np.where(support > 0, 0.1, np.inf), support)
    assert grid.channels == GREY and (grid.values == 2).all() and grid.values.shape == (5, 4, 6, 3)
    assert np.array_equal(grid.support.ravel(), support) and np.isinf(grid.error.ravel()[::5]).all()


@dataclass(frozen=True)
class Bins:
    """The example of the plugins page when an interpolator took (samples, spec, field)."""

    name: ClassVar[str] = "bins"

    def fill(self, samples, spec, field):
        good = samples[samples.paths > 0]
        index = np.round(world_to_index(spec, good.queries.point)).astype(int)
        node = np.ravel_multi_index(index.T, spec.shape, mode="clip")
        size = int(np.prod(spec.shape))
        support = np.bincount(node, minlength=size)
        total = [np.bincount(node, good.mean[:, rgb], size) for rgb in range(3)]
        spread = np.bincount(node, np.square(good.error, dtype=float), size)
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.where(support > 0, total / support, 0.0).T
            error = np.where(support > 0, np.sqrt(spread) / support, np.inf)
        light, count = values.reshape(*spec.shape, 3).astype(np.float32), support.reshape(spec.shape)
        return IlluminationGrid(spec, fill_holes(spec.spacing, light, count), error.reshape(spec.shape), count)


class TestBins(InterpolatorTests):
    stage = Bins


def test_an_interpolator_that_takes_a_spec_and_a_number_gets_them():
    seen = []
    former = SimpleNamespace(fill=lambda samples, spec, field: seen.append((samples, spec, field)))
    present = SimpleNamespace(fill=lambda samples, nodes: seen.append((samples, nodes)))
    nodes = Nodes(SPEC, sky(ball(6)).fields[0], 1)
    fill_nodes(former, "samples", nodes)
    fill_nodes(present, "samples", nodes)
    assert seen == [("samples", SPEC, 1), ("samples", nodes)]


def test_a_run_takes_an_interpolator_of_either_kind():
    light = ig.run(sky(ball(8)), interpolator=Bins(), grid=6, paths=2, bounces=0, isovalues=2)
    assert (light.grids[0].support > 0).any()


def test_the_registry_takes_interpolators_of_either_kind():
    assert registry._fault("interpolator", Bins) is None
    strange = dataclass(frozen=True)(type("Strange", (), {"name": "strange", "fill": lambda self, samples: None}))
    assert "expected the arguments" in registry._fault("interpolator", strange)
