"""The sampler keeps the promises of all samplers, and its own."""

import numpy as np
from illumgrid_quantile import Quantile

import illumgrid as ig
from illumgrid.testing import SamplerTests


class TestQuantile(SamplerTests):
    stage = Quantile(count=4)


def test_between_two_isovalues_lie_equally_many_voxels():
    values = np.random.default_rng(0).random((12, 12, 12)) ** 3
    scene = ig.Scene.sky(ig.Volume(values), range=(0.1, 0.8))
    levels = np.unique(np.concatenate([batch.level for batch in Quantile(count=5).queries(scene, None, 0)]))
    assert len(levels) == 5
    counts = np.histogram(values, [0.1, *levels, 0.8])[0]
    assert np.ptp(counts[1:-1]) <= 2 and abs(counts[1:-1].mean() - 2 * counts[0]) <= 3


def test_it_is_found_by_its_name():
    assert ig.sampler("quantile", count=7) == Quantile(count=7)
