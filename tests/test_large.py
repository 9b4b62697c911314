"""Large fields are looked at in slabs, cubes and columns: here small ones are, and nothing or little changes."""

import re
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.accuracy.points import unseen_in_volume
from illumgrid.backends import numba_
from illumgrid.field import boundaries, bricks, diagnosis
from illumgrid.field.boundaries import suggest_range
from illumgrid.field.bricks import lay_bricks
from illumgrid.field.coarse import block_means
from illumgrid.field.diagnosis import diagnose, turning
from illumgrid.field.lattice import nodes_over
from illumgrid.field.plateaus import plateaus
from illumgrid.field.scene import Field
from illumgrid.field.volume import Volume, histogram, interpolate, slabs, world_to_index
from illumgrid.grid import reading
from illumgrid.grid.nodes import Nodes, reachable
from illumgrid.interpolators import bilateral, nearest
from illumgrid.interpolators.bilateral import Bilateral
from illumgrid.interpolators.nearest import Nearest
from illumgrid.io.readers import paged
from illumgrid.samplers import coarea, direct
from illumgrid.samplers.coarea import points_on_level_sets
from illumgrid.show.camera import outline_of
from illumgrid.show.viewer.arrays import field_steps
from illumgrid.transport import walk
from illumgrid.transport.tracer import prepare
from shapes import ball, sky


def lumps(kind=np.float32, shape=(23, 14, 19)):
    """A field with plateaus that go through many slabs, and gaps in none."""
    x, y, z = np.meshgrid(*(np.linspace(-4, 4, n) for n in shape), indexing="ij")
    return Volume((100 + 60 * np.sin(x) * np.cos(y + z)).clip(80, 120).astype(kind))


def noisy_ball(n):
    noise = np.random.default_rng(0).normal(0, 0.05, (n, n, n))
    return Volume((ball(n).values + noise).astype(np.float32))


def everything(volume):
    field = Field("f", volume, range=(79, 118))
    flat = [(value, share, place.tolist()) for value, share, place in plateaus(volume)]
    laid = lay_bricks(volume.values, -1.0)
    steps, *about = field_steps(volume, (85.0, 115.0))
    outline = outline_of(sky(volume, (85, 115)), np.array([105.0]))
    found = [
        flat, [one.sentence for one in diagnose(field, nodes_over(volume))], suggest_range(volume),
        histogram(volume, 30)[0].tolist(), laid.records.tolist(), steps.tolist(), about,
        block_means(volume, (2, 3, 4)).values.tolist(), reachable(field, nodes_over(volume, 9)).tolist(),
        sorted(map(tuple, outline.tolist())), volume.gaps, volume.extremes,
    ]  # fmt: skip
    assert len(flat) == 2 and found[1]
    return found


@pytest.mark.parametrize("kind", ["uint8", "float32"])
def test_slabs_change_nothing(monkeypatch, kind):
    whole = everything(lumps(kind))
    monkeypatch.setattr(slabs, "__defaults__", (14 * 19 * 2,))
    monkeypatch.setattr(bricks, "AT_ONCE", 1)
    parts = everything(lumps(kind))
    for one, other in zip(whole, parts):
        assert one == other


def test_slabs_are_the_array_in_order():
    found = list(slabs((10, 3, 4), 30))
    assert [(s.start, s.stop) for s in found] == [(0, 2), (2, 4), (4, 6), (6, 8), (8, 10)]
    assert [(s.start, s.stop) for s in slabs((3, 100, 100), 1)] == [(0, 1), (1, 2), (2, 3)]


def test_all_cubes_together_turn_as_the_whole(monkeypatch):
    volume = lumps()
    whole = [turning(volume, 85, 115, blur) for blur in (0.0, 1.0)]
    monkeypatch.setattr(diagnosis, "_LOOKED_AT", 0)
    monkeypatch.setattr(diagnosis, "_BLOCK", 6)
    parts = [turning(volume, 85, 115, blur) for blur in (0.0, 1.0)]
    np.testing.assert_allclose(parts, whole, rtol=1e-6)
    monkeypatch.setattr(diagnosis, "_ENOUGH", 1)
    assert turning(volume, 85, 115) == pytest.approx(whole[0], rel=0.3)


@pytest.mark.parametrize("inside", ["above", "below"])
def test_cubes_suggest_nearly_the_range_of_the_whole(monkeypatch, inside):
    volume = Volume(np.round(100 / (1 + np.exp(-20 * (ball(40).values - 0.5)))).astype(np.uint8))
    whole = suggest_range(volume, inside)[:2]
    monkeypatch.setattr(boundaries, "_SLABBED", 0)
    monkeypatch.setattr(boundaries, "_CUBE", 6)
    np.testing.assert_allclose(suggest_range(volume, inside)[:2], whole, atol=10)


def test_points_in_some_columns_are_even_over_the_range(monkeypatch):
    scene = sky(ball(30))
    monkeypatch.setattr(coarea, "_LOOKED_AT", 6000)  # of 27000 voxels
    asked = unseen_in_volume(scene, 2000, seed=0)
    volume = scene.fields[0].volume
    place = scene.fields[0].place(interpolate(volume, world_to_index(volume, asked.point)))
    counts, _ = np.histogram(place, 8, (0, 1))
    assert len(asked) > 1500 and counts.sum() == len(asked)
    np.testing.assert_allclose(counts / counts.mean(), 1, atol=0.1)
    away = np.linalg.norm(asked.point, axis=1)  # level c is the sphere of radius 1.2 - c
    np.testing.assert_allclose(1.2 - away, asked.level[:, 0], atol=0.01)


def test_pieces_of_plateaus_are_forgotten_when_they_end(monkeypatch):
    monkeypatch.setattr(slabs, "__defaults__", (60 * 60 * 6,))
    values = ((np.indices((60, 60, 60)) // 3).sum(axis=0) % 7).astype(np.uint8)  # a piece in every 27 voxels
    peaks = []
    for volume in (Volume(values), Volume(np.concatenate([values] * 5))):
        plateaus(volume)  # compiles
        tracemalloc.start()
        assert plateaus(volume) == []
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


# Samples around a slab are a tenth of all on so small a grid, and less on a larger one.
@pytest.mark.parametrize(("interpolator", "most"), [(Nearest(), 60), (Bilateral(1.0), 62)])
def test_a_further_lit_node_takes_60_bytes(monkeypatch, interpolator, most):
    for module, name, value in ((walk, "MOST", 2000), (walk, "LOOKED_AT", 4000), (nearest, "_SLAB", 2000)):
        monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(bilateral, "_BLOCK", 1000)
    monkeypatch.setattr(bilateral, "_SLAB", 1)
    monkeypatch.setattr(direct, "_BATCH", 1000)
    monkeypatch.setattr(reading, "MOVED", 0.0)  # nodes beyond the range, of which there are none here, move that far
    scene = ig.Scene.sky(ball(20), range=(-1.0, 1.3), albedo=(0.8, 0.5, 0.3))  # every node is lit, in three channels
    peaks, nodes = [], []
    for grid in (8, 50, 64):  # the first compiles
        tracemalloc.start()
        light = ig.run(scene, grid=grid, paths=1, bounces=0, judge=False, interpolator=interpolator)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        nodes.append(light.recipe["queries"])
    assert nodes[1:] == [50**3, 64**3] and len(light.grids[0].channels) == 3
    assert (peaks[2] - peaks[1]) / (nodes[2] - nodes[1]) <= most


@pytest.mark.parametrize("density", [1.0, 2.3])
def test_nodes_read_slab_by_slab_are_those_read_at_once(monkeypatch, density):
    scene = ig.Scene.studio(noisy_ball(18), range=(0.4, 0.8))  # several lights: errors of each
    options = {"grid": 13, "paths": 2, "bounces": 0, "judge": False, "interpolator": Bilateral(density)}
    whole = ig.run(scene, **options).grids[0]
    monkeypatch.setattr(bilateral, "_SLAB", 1)
    monkeypatch.setattr(bilateral, "_BLOCK", 100)
    slabs_ = ig.run(scene, **options).grids[0]
    assert len(whole.lit) > 500 and whole.errors is not None
    for name in ("light", "error", "support", "errors"):
        np.testing.assert_array_equal(getattr(slabs_, name), getattr(whole, name))


def test_samples_in_any_order_are_read_alike(monkeypatch):
    scene = ig.Scene.sky(noisy_ball(12), range=(0.4, 0.8))
    nodes = Nodes(nodes_over(scene.fields[0].volume, 10), scene.fields[0])
    asked = next(iter(direct.Direct().queries(scene, [nodes.spec], 0)))
    samples = ig.backend("numba").solve(scene, asked, paths=range(2), bounces=0, seed=0)
    monkeypatch.setattr(bilateral, "_SLAB", 1)
    whole = Bilateral(1.5).fill(samples, nodes)
    other = Bilateral(1.5).fill(samples[np.random.default_rng(0).permutation(len(samples))], nodes)
    np.testing.assert_array_equal(other.light, whole.light)
    np.testing.assert_array_equal(other.support, whole.support)


def test_cells_among_which_points_are_chosen_are_held_once(monkeypatch):
    monkeypatch.setattr(coarea, "AT_ONCE", 1 << 15)
    monkeypatch.setattr(coarea, "_AT_ONCE", 1 << 12)
    scene = ig.Scene.sky(ball(70), range=(-1.0, 1.3))  # the range crosses all cells
    points_on_level_sets(scene, 10, (0,))  # compiles
    tracemalloc.start()
    points_on_level_sets(scene, 10, (0,))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 32 * 69**3


def test_cells_drawn_some_at_a_time_are_those_drawn_at_once(monkeypatch):
    scene = ig.Scene.sky(noisy_ball(20), range=(0.3, 0.9))
    whole = points_on_level_sets(scene, 500, (1,))
    monkeypatch.setattr(coarea, "_AT_ONCE", 77)
    parts = points_on_level_sets(scene, 500, (1,))
    assert len(whole) > 400
    np.testing.assert_array_equal(parts.point, whole.point)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_the_system_reads_no_more_of_a_paged_field_than_rays_ask_for(monkeypatch, tmp_path):
    np.save(tmp_path / "v.npy", ball(12).values.astype(np.float32))
    monkeypatch.setattr(paged, "SHARE", 1 << 60)  # every field is more than its share
    scene = ig.Scene.sky(ig.read_volume(tmp_path / "v.npy"), range=(0.3, 0.9))

    def read_singly():
        (lines,) = re.findall(r"v\.npy\n(?:\w+:.*\n)*VmFlags:(.*)", Path("/proc/self/smaps").read_text("utf-8"))
        return "rr" in lines.split()

    found = []
    share = numba_.share
    monkeypatch.setattr(numba_, "share", lambda *work: (found.append(read_singly()), share(*work)))
    tracer = prepare(ig.backend("numba"), scene)
    tracer.solve(ig.Queries.at(scene, [[7.5, 5.5, 5.5]]), paths=range(1), bounces=0, seed=0)
    assert found == [True] and not read_singly()
