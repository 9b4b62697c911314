"""A run that is stopped goes on where it was: the bits of one that never stopped, and never those of another run."""

import errno
import itertools
import sys

import numpy as np
import pytest

import illumgrid as ig
from illumgrid import unfinished
from illumgrid.bake import bake
from illumgrid.field.lattice import specs_over
from illumgrid.field.scene import level_table
from illumgrid.interpolators.nearest import Nearest
from illumgrid.io import identity, partial
from illumgrid.io.partial import Partial
from illumgrid.samplers.direct import Direct
from illumgrid.transport import walk
from illumgrid.transport.tracer import prepare
from shapes import ball

RUN = ("run", "v.npy", "--scene", "floor", "--range", "0.3", "0.9", "--grid", "9", "--texels", "6", "--isovalues", "3",
       "--bounces", "1", "--no-preview")  # fmt: skip


@pytest.fixture
def pieces(monkeypatch):
    """Small pieces of work, each written at once; `pieces(n)` stops the run when n of them are done."""
    monkeypatch.setattr(walk, "PIECE", 600)
    monkeypatch.setattr(walk, "GROWTH", 1.0)
    monkeypatch.setattr(partial, "EVERY", 0.0)
    monkeypatch.setattr(partial, "CHUNK", 64)
    monkeypatch.setattr(sys.modules["illumgrid.cli.outcome"], "judged_light", lambda light, stages, folder: light)
    real = walk.answer
    asked = []

    def stop_after(count):
        done = itertools.count()

        def counted(tracer, bounces, seed, work):
            if next(done) == count:
                raise KeyboardInterrupt
            asked.append((len(work[0]), work[1]))
            return real(tracer, bounces, seed, work)

        monkeypatch.setattr("illumgrid.bake.accumulator.answer", counted)
        asked.clear()
        return asked

    return stop_after


def light(folder):
    found = ig.load(folder)
    return [found.grids[0].light, found.grids[0].error, *(wall.light for wall in found.walls)]


def same(one, other):
    for a, b in zip(light(one), light(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("count", [1, 4, 9])
def test_a_run_that_was_stopped_goes_on_and_gives_the_same_bits(call, pieces, tmp_path, count):
    whole = pieces(-1)
    call(*RUN, "--paths", "4", "-o", "whole")
    total = list(whole)
    assert len(total) > 10 and not (tmp_path / "whole.partial").exists()
    pieces(count)
    said = call(*RUN, "--paths", "4", "-o", "out", code=130)
    assert "is kept in out.partial; the same command goes on" in said and not (tmp_path / "out").exists()
    went_on = pieces(-1)
    assert "going on with out.partial" in call(*RUN, "--paths", "4", "-o", "out")
    assert went_on == total[count:]
    same("whole", "out")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "v.npy", "whole"]


def test_a_row_counts_only_when_all_of_it_is_there(call, pieces, monkeypatch):
    """The process dies between the writing of light and that of the number of paths, which comes last."""
    pieces(-1)
    call(*RUN, "--paths", "4", "-o", "whole")
    real, calls = Partial._sync, itertools.count()

    def dying(self, part, key, rows):
        real(self, part, key, rows)
        if next(calls) >= 7:
            raise KeyboardInterrupt

    monkeypatch.setattr(Partial, "_sync", dying)
    call(*RUN, "--paths", "4", "-o", "out", code=130)
    monkeypatch.setattr(Partial, "_sync", real)
    call(*RUN, "--paths", "4", "-o", "out")
    same("whole", "out")


def test_blocks_that_hold_nothing_but_zeros_are_kept_as_well(call, pieces):
    """One path has no spread, and the library leaves out chunks that hold only what they are filled with."""
    pieces(3)
    call(*RUN, "--paths", "1", "-o", "out", code=130)
    pieces(-1)
    call(*RUN, "--paths", "1", "-o", "out")
    call(*RUN, "--paths", "1", "-o", "whole")
    same("whole", "out")


def test_a_full_disk_is_one_sentence_and_what_was_written_before_stays_valid(call, pieces, monkeypatch):
    pieces(-1)
    call(*RUN, "--paths", "4", "-o", "whole")
    real, calls = Partial._add, itertools.count()

    def full(self, paths, some):
        if next(calls) >= 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(self, paths, some)

    monkeypatch.setattr(Partial, "_add", full)
    said = call(*RUN, "--paths", "4", "-o", "out", code=2).splitlines()[-1]
    assert "out.partial" in said and "No space left on device" in said and "stays valid" in said
    monkeypatch.setattr(Partial, "_add", real)
    went_on = pieces(-1)
    call(*RUN, "--paths", "4", "-o", "out")
    same("whole", "out")
    assert len(went_on) > 5


def test_more_paths_on_a_finished_run_walk_the_others_only(call, pieces):
    pieces(-1)
    call(*RUN, "--paths", "4", "-o", "out")
    more = pieces(-1)
    assert "continuing after the 4 paths of out" in call(*RUN, "--paths", "8", "-o", "out", "--resume")
    weights = {paths.start // 4 for _, paths in more}
    assert {(paths.start, paths.stop) for _, paths in more} == {(4 * w, 8 * w) for w in weights} and 1 in weights
    found = ig.load("out")
    assert found.recipe["paths"] == 8
    scene, specs = found.scene, specs_over(found.scene, 9)
    both = bake(
        scene, specs, level_table(scene, 3), Direct(), prepare(ig.backend("auto"), scene), Nearest(),
        paths=[range(4), range(4, 8)], bounces=1,
    )  # fmt: skip
    np.testing.assert_allclose(found.grids[0].light, both.grids[0].light, rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(found.walls[0].light, both.walls[0].light)
    assert "nothing is left to do" in call(*RUN, "--paths", "8", "-o", "out", "--resume")


def test_more_paths_that_are_stopped_go_on_as_well(call, pieces):
    pieces(-1)
    for folder in ("whole", "out"):
        call(*RUN, "--paths", "4", "-o", folder)
    call(*RUN, "--paths", "8", "-o", "whole", "--resume")
    pieces(5)
    call(*RUN, "--paths", "8", "-o", "out", "--resume", code=130)
    pieces(-1)
    call(*RUN, "--paths", "8", "-o", "out", "--resume")
    same("whole", "out")


@pytest.mark.parametrize(
    "options, word",
    [
        (("--seed", "1"), "seed (0, not 1)"), (("--albedo", "0.5", "0.5", "0.5"), "field 'v'"),
        (("--paths", "2"), "paths (4, not 2)"), (("--set", "backend.surface=mesh"), "backend"),
        (("--scene", "box"), "quads"),
    ],
)  # fmt: skip
def test_another_run_is_noticed_and_never_mixed_in(call, pieces, options, word):
    pieces(3)
    call(*RUN, "--paths", "4", "-o", "out", code=130)
    pieces(-1)
    said = call(*RUN, "--paths", "4", "-o", "out", *options, code=2)
    assert word in said and "expected the command that began it" in said and "--overwrite" in said


def test_a_changed_input_and_another_version_are_noticed(call, pieces, monkeypatch, tmp_path):
    pieces(3)
    call(*RUN, "--paths", "4", "-o", "out", code=130)
    pieces(-1)
    monkeypatch.setattr(identity, "version", lambda name: "0.0.1")
    assert "versions" in call(*RUN, "--paths", "4", "-o", "out", code=2)
    call(*RUN, "--paths", "4", "-o", "out", "--any-machine")
    values = ball(10).values.copy()
    values[5, 5, 5] += 1e-3
    np.save(tmp_path / "v.npy", values)
    assert "field 'v'" in call(*RUN, "--paths", "8", "-o", "out", "--resume", "--any-machine", code=2)


def test_overwrite_begins_anew_and_leaves_nothing_of_the_other_run(call, pieces, tmp_path):
    pieces(3)
    call(*RUN, "--paths", "4", "--seed", "1", "-o", "out", code=130)
    pieces(-1)
    call(*RUN, "--paths", "4", "-o", "whole")
    call(*RUN, "--paths", "4", "-o", "out", "--overwrite")
    same("whole", "out")
    assert not (tmp_path / "out.partial").exists()


def test_a_short_run_removes_what_a_killed_one_left(call, tmp_path):
    (tmp_path / ".out.partial-abcdef12" / "new").mkdir(parents=True)
    call(*RUN, "--paths", "1", "-o", "out")
    assert {p.name for p in tmp_path.iterdir()} == {"v.npy", "out"}


def test_two_processes_do_not_work_on_one_partial_run(call, pieces):
    pieces(3)
    call(*RUN, "--paths", "4", "-o", "out", code=130)
    holder = partial.disk.lock(partial.beside(partial.Path("out")))
    if holder is None:
        pytest.skip("no locks here")
    assert "another process is at work" in call(*RUN, "--paths", "4", "-o", "out", code=2)


def test_every_fourth_node_comes_first(call, pieces):
    """Ranks of nodes and texels: 0 for every fourth along each axis, 1 for every second, 2 for the others."""
    from illumgrid.bake.targets import coarse_first
    from illumgrid.bake.walls import wall_queries

    scene = ig.Scene.floor(ball(10), range=(0.3, 0.9))
    specs, levels = specs_over(scene, 9), level_table(scene, 5)
    (nodes,) = Direct().queries(scene, specs, 0)
    index = np.stack(np.unravel_index(nodes.id.astype(int), specs[0].shape), axis=1)
    step = np.where((index % 4 == 0).all(axis=1), 0, np.where((index % 2 == 0).all(axis=1), 1, 2))
    inner = np.all((nodes.level > 0.3) & (nodes.level < 0.9), axis=1)  # others are moved onto the ends of the range
    np.testing.assert_array_equal(coarse_first(scene, specs, levels, nodes)[inner], step[inner])
    (texels,) = wall_queries(scene, levels)
    ranks = coarse_first(scene, specs, levels, texels).reshape(5, *scene.quads[0].texels[::-1])
    assert (ranks[::4, ::4, ::4] == 0).all() and (ranks == 0).sum() == ranks[::4, ::4, ::4].size


def test_a_run_on_its_way_can_be_looked_at(call, pieces, tmp_path):
    """Every second node is finished, with the light that it will have; its neighbours show that until then."""
    pieces(-1)
    call(*RUN, "--paths", "4", "-o", "whole")
    pieces(6)
    call(*RUN, "--paths", "4", "-o", "out", code=130)
    assert "of a run" in call("preview", "out", "-o", "a.png") and (tmp_path / "a.png").exists()
    call("view", "out.partial", "--export", "page.html")
    found, share = unfinished.load(tmp_path / "out.partial")
    lit, done = found.grids[0], ig.load("whole").grids[0]
    assert 0 < share < 0.9 and not np.array_equal(lit.light, done.light)
    (asked,) = Direct().queries(found.scene, specs_over(found.scene, 9), 0)
    own = np.all((asked.level > 0.3) & (asked.level < 0.9), axis=1)  # others are moved onto the ends of the range
    nodes = np.stack(np.unravel_index(asked.id[own].astype(int), lit.spec.shape))
    second = tuple(nodes[:, (nodes % 2 == 0).all(axis=0)])
    assert len(second[0]) > 10
    np.testing.assert_array_equal(lit.light[second], done.light[second])


def test_nodes_far_from_all_that_is_finished_are_striped():
    scene = ig.Scene.sky(ball(30), range=(0.3, 0.9))
    spec = ig.GridSpec.over(scene.fields[0].volume, 30)
    grid = ig.IlluminationGrid(spec, *(np.ones((*spec.shape, *c)) for c in ((1,), (), ())))
    known = ig.Samples(
        ig.Queries.at(scene, spec.nodes([0])), *np.ones((2, 1, 1), np.float32), np.ones(1, np.int32), grid.channels
    )
    marked = unfinished._marked(grid, known)
    far = np.linalg.norm(np.stack(np.indices(spec.shape)), axis=0) > unfinished.REACH
    np.testing.assert_array_equal(marked.support == 0, far)
    assert set(np.unique(marked.light[far])) == {0.0, 1.5} and (marked.light[~far] == 1).all()


@pytest.mark.parametrize("order", ["C", "F"])
def test_a_digest_is_of_every_voxel_and_number(order):
    volume = ball(6)
    scene = ig.Scene.floor(volume, range=(0.3, 0.9))
    one = identity.digest(scene)
    values = np.array(volume.values, order=order)
    again = ig.Volume(values.copy(order=order), volume.origin, volume.spacing)
    before = identity.digest(again)
    values[5, 0, 3] = np.nextafter(values[5, 0, 3], np.float32(9))
    assert identity.digest(ig.Volume(values, volume.origin, volume.spacing)) != before
    assert identity.digest(ig.Volume(again.values, volume.origin, volume.spacing)) == before
    assert identity.digest(ig.Scene.floor(volume, range=(0.3, 0.9))) == one
    assert identity.digest(ig.Scene.floor(volume, range=(0.3, 0.91))) != one
