"""The suggested range contains what people look for: the boundaries of the classes that the data hold."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, label
from scipy.signal import find_peaks

from illumgrid.field.boundaries import _peaks, boundaries, otsu_threshold, suggest_range
from illumgrid.field.filters import smooth
from illumgrid.field.volume import Volume

GRID = np.indices((48, 44, 40)) - np.array([24, 22, 20])[:, None, None, None]
RADIUS = np.sqrt((GRID**2).sum(axis=0))


def head(noise=2.0, seed=0):
    """Air at 0, tissue at 60 out to 19 voxels, bone at 130 between 9 and 14: as in computed tomography."""
    values = np.where(RADIUS < 19, 60.0, 0.0)
    values[(RADIUS > 9) & (RADIUS < 14)] = 130
    return Volume(gaussian_filter(values, 1.0) + np.random.default_rng(seed).normal(0, noise, values.shape))


def neurites(noise=0.0):
    """Thin fibres along x from faint (30) to bright (255), all else 0 or noise: as in microscopy of a neuron."""
    values = np.zeros((48, 60, 40))
    for k, bright in enumerate(np.linspace(30, 255, 10)):
        values[:, 6 * k + 2, 20 + 3 * (k % 2)] = bright * 8
    values = np.minimum(gaussian_filter(values, 1.0), 255)
    values[values < 4] = 0
    return Volume(np.round(values) + np.random.default_rng(0).normal(0, noise, values.shape) * (noise > 0))


def test_two_boundaries_are_named_and_lie_in_the_range_with_the_middle_at_the_inner_one():
    volume = head()
    found = boundaries(volume)
    assert len(found) == 2 and found[0] == pytest.approx(30, abs=8) and found[1] == pytest.approx(95, abs=12)
    low, high, why = suggest_range(volume)
    assert low < 30 and 95 < high < 130  # bone itself is 130
    assert 72 < 0.5 * (low + high) < 118  # beyond tissue, whose level sets are noise
    assert all(f"{at:.3g}" in why for at in found)


def test_faint_and_bright_fibres_are_in_the_range():
    volume = neurites()
    low, high, _ = suggest_range(volume)
    middle = 0.5 * (low + high)
    whole, fibres = ((volume.values >= at).any(axis=0) for at in (low, middle))
    assert label(whole)[1] == label(fibres)[1] == 10  # the middle still shows all of them
    assert low < middle < high < 0.7 * volume.values.max()


def test_blurred_fibres_are_still_fibres():
    """`run` proposes a blur for rough data: the middle must not leave the faint fibres then."""
    volume = smooth(neurites(), 1.5)
    low, high, _ = suggest_range(volume)
    axes = np.array([volume.values[24, 6 * k + 2, 20 + 3 * (k % 2)] for k in range(10)])
    assert (axes[1:] > 0.5 * (low + high)).all() and low < axes[0]


def test_a_noisy_background_holds_no_boundary():
    values = np.random.default_rng(0).normal(0, 3.0, RADIUS.shape) + 50 * gaussian_filter((RADIUS < 14) * 1.0, 1.0)
    low, high, _ = suggest_range(Volume(values))
    assert 6 < low < 25 < high < 47  # noise has a standard deviation of 3


def test_a_smooth_hill_is_swept_about_its_steepest_level():
    values = np.exp(-((RADIUS / 9) ** 2) / 2)  # steepest at one standard deviation: exp(-1/2) = 0.61
    low, high, _ = suggest_range(Volume(values))
    assert low < 0.61 < high
    assert boundaries(Volume(values)) == [pytest.approx(0.61, abs=0.05)]


@pytest.mark.parametrize("make", [head, neurites])
def test_below_is_above_of_the_opposite_field(make):
    volume = make()
    low, high, _ = suggest_range(volume)
    turned = suggest_range(volume.with_stored(-volume.values), "below")
    assert turned[:2] == pytest.approx((-high, -low), abs=1e-4)


def test_the_range_moves_with_offset_and_scale():
    low, high, _ = suggest_range(head())
    for scale, offset in ((1e-30, 0), (1e30, 0), (1, 1e6), (-2, 5)):
        inside = "above" if scale > 0 else "below"
        moved = suggest_range(Volume(head().values.astype(float) * scale + offset), inside)[:2]
        assert sorted((np.array(moved) - offset) / scale) == pytest.approx([low, high], abs=0.1)


def test_spacing_decides_what_is_steep_and_large_volumes_are_looked_at_in_slabs(monkeypatch):
    volume = head()
    whole = suggest_range(volume)[:2]
    monkeypatch.setattr("illumgrid.field.boundaries._VOXELS", volume.values.size // 2)
    assert suggest_range(volume)[:2] == pytest.approx(whole, abs=6)


def test_without_boundaries_the_histogram_decides():
    volume = Volume(np.linspace(0, 1, 5**3).reshape(5, 5, 5))  # of equal slope everywhere
    low, _, why = suggest_range(volume)
    assert "Otsu" in why and low == pytest.approx(otsu_threshold(volume)) and boundaries(volume) == []


def halo():
    """Clumps whose density falls off from the middle: haze, of which the border cuts a good part, and bodies within."""
    clumps = gaussian_filter(np.random.default_rng(0).normal(size=RADIUS.shape), 1.6)
    density = np.exp(clumps / clumps.std()) / (1 + (RADIUS / 20) ** 2)
    return Volume(255 * np.minimum(density / np.quantile(density, 0.9995), 1))


def test_the_range_leaves_haze_that_the_border_cuts():
    volume = halo()
    faces = np.concatenate([np.take(volume.values, end, axis=axis).ravel() for axis in range(3) for end in (0, -1)])
    assert (faces > 27).mean() > 0.1  # the middle of 13 to 40, where most of the boundaries are
    low, high, why = suggest_range(volume)
    assert (faces > low).mean() == pytest.approx(0.05, abs=0.01) and low < high < 0.7 * volume.values.max()
    assert "begins where the solid has left most of the volume's border" in why  # the boundary named lies below
    opposite = suggest_range(volume.with_stored(-volume.values), "below")
    assert opposite[:2] == pytest.approx((-high, -low), rel=1e-3)


def test_a_crop_that_cuts_skin_keeps_it_in_the_range():
    crop = Volume(head().values[12:36, 11:33, 10:30])  # tissue fills the border, air is in its corners alone
    wide = Volume(head().values[6:42, 5:39, 4:36])
    for volume in (crop, wide):
        low, high, _ = suggest_range(volume)
        assert low < 95 < high


def test_peaks_are_those_of_scipy():
    random, several = np.random.default_rng(0), 0
    for _ in range(300):
        density = random.integers(0, 12, 64) / random.integers(1, 30)  # steps, so that plateaus are frequent
        density = gaussian_filter(density, random.choice([0.0, 1.0, 2.0]), mode="constant")
        density /= density.max()
        padded = np.pad(density, 1)
        expected, about = find_peaks(padded, height=0.1, prominence=0.1)
        expected = expected[about["prominences"] > 0.5 * padded[expected]]
        assert _peaks(density) == [(int(k) - 0.5) / 64 for k in expected]
        several += len(expected) > 1
    assert several > 100


def test_a_range_is_suggested_without_the_import_of_scipy_signal():
    """It takes half a second, for which the first picture of `view` would wait."""
    what = "import sys, numpy as np; from illumgrid import Volume; from illumgrid.field.boundaries import suggest_range"
    what += "; x = np.indices((20, 20, 20)) - 9.5; suggest_range(Volume(np.tanh(5 - np.sqrt((x**2).sum(axis=0)))))"
    what += "; assert 'scipy.ndimage' in sys.modules and not {'scipy.signal', 'scipy.stats'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", what], check=True)
