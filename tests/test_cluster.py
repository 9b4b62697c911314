"""Workers of dask.distributed: the same bits for any number of them, also when some die; others are refused."""

import os
import signal
import sys

import numpy as np
import pytest

import illumgrid as ig
from illumgrid import cluster as clusters
from illumgrid.transport import walk
from shapes import ball, refused

OPTIONS = {"grid": 9, "paths": 8, "bounces": 1, "isovalues": 3, "interpolator": "nearest"}


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
def test_a_worker_that_dies_changes_nothing(monkeypatch):
    """A cluster of two processes, one of which is killed in the middle of the run; then one is of another kind."""
    monkeypatch.setattr(walk, "PIECE", 800)
    monkeypatch.setattr(walk, "GROWTH", 1.0)
    scene = ig.Scene.floor(ball(10), range=(0.3, 0.9))
    alone = ig.run(scene, **OPTIONS)
    with clusters.cluster(2) as (over, about):
        assert about.startswith("2 workers with 2 threads")
        done = []

        def killing(function, work):
            for number, result in enumerate(over(function, work)):
                if number == 2:
                    pids = over.client.run(os.getpid)
                    os.kill(next(iter(pids.values())), signal.SIGKILL)
                done.append(result)
                yield result

        light = ig.run(scene, **OPTIONS, map=killing)
        assert len(done) > 10
        np.testing.assert_array_equal(light.grids[0].light, alone.grids[0].light)
        np.testing.assert_array_equal(light.grids[0].error, alone.grids[0].error)
        np.testing.assert_array_equal(light.walls[0].light, alone.walls[0].light)

        monkeypatch.setattr(clusters, "machine", lambda: {"processor": "z80"})
        scheduler = over.client.scheduler.address
        refused(lambda: list(clusters.ClusterMap(over.client, {"processor": "z80"})(abs, [1])), "z80", "any_machine")
        with clusters.cluster(address=scheduler, any_machine=True) as (joined, _):
            assert list(joined(abs, [-1, 2])) == [1, 2]


def test_without_the_extra_one_sentence_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ig.BadInput, match=r"illumgrid\[dask\]"), clusters.cluster(2):
        pass


@pytest.mark.parametrize("address", ["", "nonsense", "host:port", "x://host:1"])
def test_an_address_that_is_none_is_refused_before_there_is_a_client(address, monkeypatch):
    """A client that was never connected takes minutes to close."""
    made = []
    monkeypatch.setattr("distributed.Client", lambda *about, **how: made.append(about))
    with pytest.raises(ig.BadInput, match="tcp://host:8786"), clusters.cluster(address=address):
        pass
    assert not made


def test_workers_and_dask_are_one_of_two(refuse):
    refuse("run", "v.npy", "--range", "0.3", "0.9", "--workers", "2", "--dask", "tcp://x:1", "-o", "out",
           words=["--workers", "--dask", "expected one"])  # fmt: skip
