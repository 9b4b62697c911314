"""The kernels keep the promises of all backends on one core; a simulated card gives the same answers, node by node."""

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from illumgrid_cuda import Cuda, ranks

import illumgrid as ig
from illumgrid.testing import BackendTests


class TestCuda(BackendTests):
    stage = Cuda(device="processor")


SIMULATED = """
import warnings
import numpy as np
import illumgrid as ig
from illumgrid.grid.cache import cache_of
from illumgrid.transport.tracer import prepare
from illumgrid_cuda import Cuda

warnings.simplefilter("ignore", RuntimeWarning)      # random numbers wrap around, on purpose
grid = np.linspace(-1, 1, 7)
x, y, z = np.meshgrid(grid, grid, grid, indexing="ij")
volume = ig.Volume((1.2 - np.sqrt(x * x + y * y + z * z) + 0.2 * np.sin(4 * x + 2 * y)).astype(np.float32))
box = ig.Scene.box(volume, range=(0.3, 0.9))
other = ig.Volume((np.sqrt(x * x + y * y + z * z)).astype(np.float32), origin=(5.2, 0.3, 0.1))
key = ig.Distant("key", (1, -2, 3), 20.0, (3.0, 2.0, 1.0))
two = ig.Scene((ig.Field("one", volume, range=(0.3, 0.9)), ig.Field("two", other, range=(0.3, 0.9), inside="below")),
               (), (0.1, 0.2, 0.3), (key, ig.Sky("dome", ((0, 0, 0), (1, 1, 1)))))
for scene, cached in ((box, False), (box, True), (two, False)):
    points = np.random.default_rng(0).uniform(1.2, 4.8, (20, 3))
    asked = ig.Queries.at(scene, points)
    more = {}
    if cached:
        light = ig.run(scene, sampler="direct", backend="numba", interpolator="nearest", grid=7, paths=8, bounces=2,
                       isovalues=4, judge=False)
        more = {"cache": cache_of(light.scene, light.grids, light.walls)}
    how = {"paths": range(2, 6), "bounces": 2, "seed": 5}
    one = prepare(ig.backend("numba"), scene, **more).solve(asked, **how)
    other = prepare(Cuda(), scene, **more).solve(asked, **how)
    assert one.mean.any() and np.array_equal(one.paths, other.paths)
    near = np.abs(one.mean - other.mean).max(axis=1) <= 1e-3 * one.mean.mean()
    assert near.mean() >= 0.999, near.mean()
    assert np.abs(other.mean.mean() / one.mean.mean() - 1) < 1e-3
    assert np.allclose(one.m2, other.m2, rtol=1e-3, atol=1e-6)
print("the same")
"""


def test_a_simulated_card_gives_the_answers_of_numba_node_by_node():
    path = os.pathsep.join(p for p in sys.path if p)
    environment = {**os.environ, "PYTHONPATH": path, "NUMBA_ENABLE_CUDASIM": "1"}
    done = subprocess.run([sys.executable, "-c", SIMULATED], env=environment, capture_output=True, text=True)
    assert done.stdout.strip().endswith("the same"), done.stdout + done.stderr


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")
def test_ranks_are_compared_eight_at_a_time():
    random = np.random.default_rng(0)
    for memory in (random.integers(0, 256, 192, np.uint8), np.arange(192, dtype=np.uint8), np.full(192, 128, np.uint8)):
        for rank in (0, 1, 127, 128, 129, 255):
            base = ranks.address(memory) + 64
            expected = sum(1 << k for k in range(64) if memory[64 + k] >= rank)
            assert ranks.at_least(base, 0, rank) == expected
            assert ranks.count_below(base, 8, rank) == (memory[72:80] < rank).sum()


def test_without_a_card_it_is_refused_by_name_with_the_reason():
    if Cuda.available() is None:
        pytest.skip("there is a card")
    with pytest.raises(ig.BadInput, match=r"'cuda' cannot run here; .* install an NVIDIA card with its driver \("):
        ig.backend("cuda")


def has_compiler():
    try:
        from cuda.pathfinder import load_nvidia_dynamic_lib
        from numba.cuda.cudadrv.nvvm import NVVM

        NVVM()
        load_nvidia_dynamic_lib("nvrtc")
    except Exception:
        return False
    return True


@pytest.mark.skipif(not has_compiler(), reason="no libnvvm and libnvrtc here: pip install 'illumgrid-cuda[cu12]'")
def test_the_kernels_compile_for_a_card_that_is_not_there(monkeypatch):
    import numba.cuda.dispatcher
    from illumgrid_cuda.kernels import launchers
    from illumgrid_cuda.tracer import Asked
    from numba import cuda
    from numba.cuda import types

    from illumgrid.grid.cache import NO_CACHE
    from illumgrid.transport.tracer import laid_out

    card = SimpleNamespace(compute_capability=(9, 0))
    monkeypatch.setattr(numba.cuda.dispatcher, "get_current_device", lambda: card)

    def array(kind, axes):
        return types.Array({"bool": types.boolean}.get(str(kind)) or getattr(types, str(kind)), axes, "C")

    def together(arrays):
        parts = [array(a.dtype, a.ndim) if isinstance(a, np.ndarray) else types.int64 for a in arrays]
        return types.NamedTuple(parts, type(arrays))

    values = np.arange(27, dtype=np.float32).reshape(3, 3, 3)
    channels, fields = laid_out(ig.Scene.sky(ig.Volume(values), range=(5, 20)))
    asked = Asked(np.zeros(1, np.uint64), *np.zeros((2, 1, 3)), np.zeros((1, 1)), np.zeros(1, np.int64))
    scene, cache, asked, whole = together(fields), together(NO_CACHE), together(asked), types.int64
    begun = array("float64", 2), array("int64", 1), array("int64", 1), array("float64", 1), array("uint64", 1)
    begun = *begun, array("int32", 1)
    worth, light = array("float64", 3), array("float32", 2)
    begin, walk, judge = launchers("card", len(channels)).kernels
    for kernel, arguments in (
        (begin, (scene, cache, asked, types.uint64, *begun, whole)),
        (walk, (scene, cache, asked, *begun, whole, whole, worth)),
        (judge, (scene, begun[-1], whole, worth, light, light)),
    ):
        code, _ = cuda.compile_ptx(kernel.py_func, arguments, cc=(9, 0))
        assert ".visible .entry" in code and "sm_90" in code


@pytest.mark.skipif(Cuda.available() is not None, reason="no card here")
def test_a_card_gives_the_answers_of_numba_node_by_node():
    grid = np.linspace(-1, 1, 24)
    x, y, z = np.meshgrid(grid, grid, grid, indexing="ij")
    scene = ig.Scene.box(ig.Volume((1.2 - np.sqrt(x * x + y * y + z * z)).astype(np.float32)), range=(0.3, 0.9))
    asked = ig.Queries.at(scene, np.random.default_rng(0).uniform(2, 21, (4000, 3)))
    how = {"paths": range(16), "bounces": 4, "seed": 1}
    one, other = (ig.backend(name).solve(scene, asked, **how) for name in ("numba", "cuda"))
    assert np.array_equal(one.paths, other.paths)
    assert (np.abs(one.mean - other.mean).max(axis=1) <= 1e-3 * one.mean.mean()).mean() >= 0.999
    assert np.abs(other.mean.mean(dtype=float) / one.mean.mean(dtype=float) - 1) < 1e-3
