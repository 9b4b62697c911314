"""What a command is going to need is said before it takes any of it."""

import re

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.constants import BASE
from illumgrid.errors import BadInput
from illumgrid.field.lattice import specs_over
from illumgrid.field.scene import Field, Scene, level_table
from illumgrid.field.volume import Volume
from illumgrid.grid import channels_of
from illumgrid.grid.nested import finer, halvings
from illumgrid.grid.nodes import reachable
from illumgrid.io import exports, needs
from shapes import ball, lit, sky


@pytest.fixture
def free(monkeypatch):
    """Says how many bytes are free."""
    return lambda count: monkeypatch.setattr(needs, "free_memory", lambda: int(count))


def test_a_grid_beyond_memory_is_refused_with_one_that_fits(call, free):
    free(4e9)
    last = call("run", "v.npy", "--grid", "60000", code=2).splitlines()[-1]
    assert last.startswith("illumgrid: the run needs ") and "of memory, 4 GB are free; --grid " in last
    scene = Scene.sky(ball(10))
    levels = level_table(scene, 2)
    with pytest.raises(BadInput) as reason:
        needs.check_run(scene, specs_over(scene, 60000), levels)
    said = re.search(r"grid=(\d+) would need ([\d.]+) GB", str(reason.value))
    assert float(said[2]) < 4
    needs.check_run(scene, specs_over(scene, int(said[1])), levels)  # what is proposed is accepted
    free(float(said[2]) * 0.5e9)
    with pytest.raises(BadInput):
        needs.check_run(scene, specs_over(scene, int(said[1])), levels)


def test_nodes_that_no_isosurface_of_the_range_meets_take_little():
    scene = Scene.sky(ball(20), range=(0.5, 0.52))
    wide = Scene.sky(ball(20), range=(0.05, 0.95))
    for tested in (scene, wide):
        (spec,) = specs_over(tested, 20)
        asked = len(reachable(tested.fields[0], spec)) / np.prod(spec.shape)
        assert needs._share(tested.fields[0], spec) == pytest.approx(asked, abs=0.1)
    assert needs._share(scene.fields[0], spec) < 0.4 * needs._share(wide.fields[0], spec)


def test_voxels_that_are_looked_at_some_at_a_time_give_the_same_share(monkeypatch):
    scene = Scene.sky(ball(20), range=(0.5, 0.52))
    (spec,) = specs_over(scene, 20)
    share = needs._share(scene.fields[0], spec)
    monkeypatch.setattr(needs, "_NEAR", 77)
    assert 0 < share < 1 and needs._share(scene.fields[0], spec) == share


def test_a_denser_grid_and_layers_of_light_are_counted(free):
    scene = Scene.studio(ball(10)).in_harmonics(2)
    specs, levels = specs_over(scene, 40), level_table(scene, 2)
    needed = {}
    for density in (1, 2):
        free(0)
        with pytest.raises(BadInput) as reason:
            needs.check_run(scene, specs, levels, density)
        needed[density] = float(re.search(r"needs ([\d.]+) GB", str(reason.value))[1])
    layers = len(channels_of(scene))
    values = 4 * 40**3 * layers * (2**3 - 1)  # single precision, at eight times the nodes
    assert layers >= 9 and needed[2] - needed[1] > values / 1e9


def needed(free, *of, **options):
    """Bytes that a run needs."""
    free(0)
    with pytest.raises(BadInput) as reason:
        needs.check_run(*of, **options)
    size, unit = re.search(r"needs ([\d.]+) (.B)", str(reason.value)).groups()
    return float(size) * {"GB": 1e9, "MB": 1e6}[unit]


def test_blocks_are_counted_and_no_finest_lattice(free):
    """In a narrow range few blocks can be, in a wide one no more than fill the lattice; none holds more."""
    narrow, wide = (Scene.sky(ball(60), range=limits) for limits in ((0.5, 0.51), (0.05, 0.95)))
    specs, levels = specs_over(narrow, None, BASE), level_table(narrow, 2)
    finest = np.prod(finer(specs[0], halvings(specs)).shape)
    low, high = (needed(free, scene, specs, levels, at_nodes=True, refining=True) for scene in (narrow, wide))
    assert low < 0.5 * high and low < 44 * finest  # what a dense lattice takes
    free(1e11)
    for scene, most in ((narrow, low), (wide, high)):
        light = ig.run(scene, paths=1, bounces=1, judge=False, seed=0)
        each = needs._BLOCK + needs._BLOCK_CHANNEL * len(light.grids[0].channels.names)
        held = light.grids[0].held
        assert len(held.layout) > 1 and held.support.size * each < most


def test_queries_of_nodes_are_held_in_pieces(free):
    """`benchmarks/memory.py 32 120 sky`: 1,728,000 queries of one channel take 71 MB; other samplers keep theirs."""
    scene = Scene.sky(ball(32), range=(0.05, 0.95))
    specs, levels = specs_over(scene, 120), level_table(scene, 2)
    pieces, whole = (needed(free, scene, specs, levels, at_nodes=at_nodes) for at_nodes in (True, False))
    assert pieces < 110e6 and whole > 3 * pieces


def test_so_are_those_that_are_read_by_level_and_normal(monkeypatch):
    asked = []
    monkeypatch.setattr(needs, "check_run", lambda *of, **options: asked.append(options["at_nodes"]))
    for sampler in ("direct", "uniform"):
        ig.run(sky(ball(8)), sampler=sampler, interpolator="bilateral", grid=4, paths=1, bounces=0, judge=False)
    assert asked == [True, False]


def test_an_isosurface_beyond_memory_is_refused_before_it_is_extracted(free, tmp_path):
    noise = Field("noise", Volume(np.random.default_rng(0).random((33, 20, 7))), range=(0.2, 0.8))
    crossed = sum(int((np.diff(noise.volume.values > 0.5, axis=axis)).sum()) for axis in range(3))
    free(needs._CROSSING * crossed + needs.TO_EXTRACT * noise.volume.values.size)
    needs.check_surface(noise, 0.5, "")
    free(needs._CROSSING * crossed)
    with pytest.raises(BadInput, match=r"the surface needs"):
        needs.check_surface(noise, 0.5, "")
    light = lit(sky())
    free(1000)
    with pytest.raises(BadInput, match=r"the surface needs .* smooth the volume"):
        exports.write(light, tmp_path / "a.ply")


def test_the_library_and_info_refuse_as_well_and_an_export_needs_nothing(refuse, tmp_path, free):
    light = lit(sky())
    free(1000)
    with pytest.raises(BadInput, match=r"the run needs .* cut or downsample the volume"):
        ig.run(Scene.sky(ball(10)), paths=1)
    with pytest.raises(BadInput, match=r"the run needs .* use fewer isovalues or texels"):
        ig.run(Scene.floor(ball(10)), paths=1, isovalues=100_000)
    exports.write(light, tmp_path / "a.exr", on="field")  # a part at a time
    refuse("info", "v.npy", words=["info needs", "--downsample"])


def test_of_a_large_field_only_its_parts_are_counted():
    """Bricks are laid before a run asks, and the field is there, or paged."""
    for each in (needs.TO_LIGHT, needs.TO_DESCRIBE):
        assert needs.of_field(1024**3, each) == needs.of_field(260**3, each) < 0.5e9
        assert needs.of_field(256**3, each) == each * 256**3
