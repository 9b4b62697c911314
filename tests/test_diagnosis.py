"""Warnings before any light is computed: each in its case, and none on clean data."""

import json
from pathlib import Path

import numpy as np
import pytest

from illumgrid.errors import WARNINGS, tell
from illumgrid.field.builtin import SCENES
from illumgrid.field.diagnosis import critical_isovalues, diagnose, topology, turning
from illumgrid.field.filters import smooth
from illumgrid.field.plateaus import plateaus
from illumgrid.field.scene import Field
from illumgrid.field.volume import Volume, interpolate, world_to_index
from illumgrid.grid import GridSpec
from shapes import DIRECTIONS, ball, sampled


def findings(volume, limits, grid=None, inside="above"):
    spec = GridSpec.over(volume, grid or max(volume.shape))
    return {found.name: found.sentence for found in diagnose(Field("f", volume, range=limits, inside=inside), spec)}


def hills(n=48, seed=0, noise=0.0):
    """A sum of Gaussians in the centre of a unit cube, plus white noise."""
    random = np.random.default_rng(seed)
    peaks = [(random.uniform(0.3, 0.7, 3), random.uniform(0.06, 0.1)) for _ in range(20)]
    volume = sampled(
        lambda x: sum(np.exp(-((x - at) ** 2).sum(axis=1) / (2 * width**2)) for at, width in peaks),
        (n, n, n), spacing=np.full(3, 1 / (n - 1)),
    )  # fmt: skip
    return volume.with_stored(volume.values + noise * random.standard_normal(volume.shape))


def torus(n=40):
    def height(x):
        return 0.5 - np.hypot(np.hypot(x[:, 0], x[:, 1]) - 0.8, x[:, 2])

    return sampled(height, (n, n, n), origin=(-1.4,) * 3, spacing=np.full(3, 2.8 / (n - 1)))


@pytest.mark.parametrize("volume, limits", [(ball(20), (0.3, 0.9)), (ball(32), (0.3, 0.9)), (hills(), (0.3, 1.5)),
                                            (torus(), (0.05, 0.4))])  # fmt: skip
@pytest.mark.parametrize("inside", ["above", "below"])
def test_clean_data_are_left_alone(volume, limits, inside):
    if inside == "below":
        volume, limits = volume.with_stored(-volume.values), (-limits[1], -limits[0])
    assert findings(volume, limits, inside=inside) == {}


def test_the_built_in_scenes_are_clean():
    for preset in SCENES.values():
        for field in preset.make().fields:
            assert diagnose(field, GridSpec.over(field.volume, preset.grid)) == []


@pytest.mark.parametrize("axes", DIRECTIONS)
def test_every_plateau_is_named_with_its_share_and_place(axes):
    values = ball(20).values.copy()
    values[values > 0.625] = 0.625
    values[2:8, 2:6, 2:7] = 0.25
    volume = Volume(values, (5, 6, 7), (1, 1.5, 0.8), DIRECTIONS[axes])
    found = plateaus(volume)
    assert [value for value, _, _ in found] == [0.25, 0.625]
    assert found[0][1] == pytest.approx(5 * 3 * 4 / 19**3)
    for value, _, place in found:
        at = world_to_index(volume, place[None])
        assert interpolate(volume, at)[0] == pytest.approx(value)
    assert list(findings(volume, (0.3, 0.5))) == []
    found = findings(volume, (0.3, 0.625))
    assert list(found) == ["plateau"] and "0.625 (" in found["plateau"] and "0.25 (" not in found["plateau"]
    assert "--range" in found["plateau"]


def test_flat_spots_of_integers_are_no_plateaus():
    assert plateaus(Volume(np.round(20 * hills().values))) != []  # the empty border is one
    values = np.random.default_rng(0).integers(0, 3, (12, 12, 12))
    values[4:7, 4:7, 4:6] = 1  # 2 x 2 x 1 cells
    assert plateaus(Volume(values)) == []


def test_noise_is_reported_with_what_a_blur_would_bring():
    found = findings(hills(noise=0.1), (0.3, 1.5))
    assert "noise" in found and "--smooth 1" in found["noise"]
    assert "on a grid of 48 nodes" in found["noise"]
    before, after = (float(text.split("%")[0].split()[-1]) for text in found["noise"].split("about ")[1:])
    assert before > 4 * after
    finer = findings(hills(noise=0.1), (0.3, 1.5), grid=96)["noise"]
    assert float(finer.split("%")[0].split()[-1]) == pytest.approx(before / 2**0.7, abs=1)


def test_turning_is_that_of_a_sphere():
    """Neighbours a step s apart on a sphere of radius r: the mean square of |n - n'| over directions is (2/3) s²/r²."""
    n = 61
    volume = ball(n)
    step = 2 / (n - 1)
    low, high = 0.55, 0.65  # radius 0.6
    expected = np.sqrt(2 / 3) * step / 0.6
    assert turning(volume, low, high) == pytest.approx(expected, rel=0.05)
    assert turning(smooth(volume, 1), low, high) == pytest.approx(expected, rel=0.05)
    assert turning(volume, 5, 6) == 0


def test_turning_does_not_depend_on_the_slabs(monkeypatch):
    """More than one slab along x gives what one gives: the same array along another axis."""
    values = np.random.default_rng(3).random((70, 9, 8)).astype(np.float32)
    long, turned = Volume(values), Volume(np.ascontiguousarray(values.transpose(1, 2, 0)))
    assert turning(long, 0.2, 0.8) == pytest.approx(turning(turned, 0.2, 0.8), rel=1e-5)


def test_thin_parts_are_reported_with_the_grid_that_would_do():
    slab = sampled(lambda x: 1 - np.abs(x[:, 2]) / 0.06, (40, 40, 40), origin=(-1,) * 3, spacing=np.full(3, 2 / 39))
    padded = slab.with_stored(np.where(np.abs(np.indices(slab.shape) - 19.5).max(axis=0) > 17, -16, slab.values))
    assert "resample" in findings(padded, (0.2, 0.6), grid=48)["thin"]
    for grid in (20, 40):  # 40 nodes would lie on the voxels, the worst place
        assert "--grid 48 has 1.2 nodes per voxel" in findings(padded, (0.2, 0.6), grid=grid)["thin"]
    assert "thin" not in findings(ball(40), (0.3, 0.9))


def test_of_a_solid_that_fills_the_border_the_other_side_is_suggested():
    assert "use --inside above" in findings(ball(20), (0.3, 0.9), inside="below")["border"]


def test_the_border_is_reported_with_its_planes():
    found = findings(ball(20, at=(0.6, 0, 0)), (0.3, 0.9))["border"]
    assert "the last x plane" in found and "first" not in found
    below = ball(20, at=(0.6, 0, 0))
    found = findings(below.with_stored(-below.values), (-0.9, -0.3), inside="below")["border"]
    assert "the last x plane" in found and "first" not in found


def test_isovalues_without_a_surface_are_reported():
    assert "1.19" in findings(ball(20), (0.3, 1.19))["empty"]
    found = findings(ball(20), (0.3, 2.0))
    assert "range" in found and "empty" in found and "2" in found["range"]


def test_long_voxels_are_reported_with_their_axes():
    found = findings(ball(20, origin=(-1,) * 3, spacing=(0.1, 0.1, 0.4)), (0.3, 0.9))
    assert "4 times longer along z than along x" in found["anisotropy"]


@pytest.mark.parametrize(
    "solid, expected",
    [
        (lambda x, y, z: x * x + y * y + z * z < 0.5, (1, 0, 0)),
        (lambda x, y, z: (np.hypot(x, y) - 0.6) ** 2 + z * z < 0.06, (1, 1, 0)),
        (lambda x, y, z: abs(x * x + y * y + z * z - 0.5) < 0.2, (1, 0, 1)),
        (lambda x, y, z: abs(x) > 0.5, (2, 0, 0)),
        (lambda x, y, z: abs(x) > 9, (0, 0, 0)),
    ],
)
def test_components_tunnels_and_cavities(solid, expected):
    at = np.meshgrid(*[np.linspace(-1, 1, 25)] * 3, indexing="ij")
    assert topology(solid(*at)) == expected
    crumbs = solid(*at)
    crumbs[0, 0, 0] ^= True
    assert topology(crumbs) == expected


def test_critical_isovalues_are_found_where_they_are():
    """Two balls whose centres are 1 apart merge at a distance of 0.5 (h = 0.7); a torus closes where its hole does."""
    pair = sampled(
        lambda x: 1.2 - np.minimum(*(np.linalg.norm(x - [a, 0, 0], axis=1) for a in (-0.5, 0.5))),
        (61, 41, 41), origin=(-1.5, -1, -1), spacing=(0.05,) * 3,
    )  # fmt: skip
    ((at, what),) = critical_isovalues(Field("pair", pair, range=(0.4, 1.0)))
    assert at == pytest.approx(0.7, abs=0.02) and what == "components 1 to 2"
    ((at, what),) = critical_isovalues(Field("ring", torus(), range=(-0.6, 0.3)))
    assert at == pytest.approx(0.5 - 0.8, abs=0.07) and what == "tunnels 0 to 1"
    assert critical_isovalues(Field("ball", ball(30), range=(0.3, 0.9))) == []
    # The same from the other side.
    negative = pair.with_stored(-pair.values)
    ((at, _),) = critical_isovalues(Field("pair", negative, range=(-1.0, -0.4), inside="below"))
    assert at == pytest.approx(-0.7, abs=0.02)


# On the command line

LIMITS = ("--range", "0.3", "0.9", "--grid", "8", "--paths", "2", "--bounces", "1", "--isovalues", "2", "--no-preview")


def test_a_run_reports_and_records_and_can_be_silent(call, tmp_path):
    np.save(tmp_path / "off.npy", ball(12, at=(0.6, 0, 0)).values)
    assert "note: border: at 0.3 " in call("run", "off.npy", *LIMITS, "-o", "a")
    assert json.loads((tmp_path / "a" / "run.json").read_text("utf-8"))["recipe"]["warnings"][0].startswith("border: ")
    said = call("run", "off.npy", *LIMITS, "-o", "b", "--ignore", "border", "--ignore", "holes")
    assert "note:" not in said
    assert json.loads((tmp_path / "b" / "run.json").read_text("utf-8"))["recipe"]["warnings"] == []
    assert "note: border" in call("info", "off.npy", "--range", "0.3", "0.9")
    assert "note:" not in call("info", "off.npy", "--range", "0.3", "0.9", "--ignore", "border")


def test_info_names_plateaus_and_critical_isovalues(call, tmp_path):
    flat = np.where(ball(20).values > 0.4, 1, ball(20).values).astype(np.float32)
    np.save(tmp_path / "flat.npy", flat)
    assert "plateaus         1 (" in call("info", "flat.npy")
    assert "plateau" not in call("info", "v.npy")
    np.save(tmp_path / "ring.npy", torus().values)
    assert "critical" in call("info", "ring.npy", "--range", "-0.6", "0.3")
    np.save(tmp_path / "low.npy", -ball(20).values)
    assert "suggested range  -" in call("info", "low.npy", "--inside", "below")


def test_names_that_are_none_are_refused(refuse):
    refuse("info", "v.npy", "--ignore", "nose", words=["--ignore", "'nose'", "noise"])
    refuse("run", "v.npy", *LIMITS, "-o", "x", "--ignore", "nose", words=["--ignore", "'nose'", "noise"])
    refuse("info", "v.npy", "--inside", "left", words=["--inside", "'left'", "above or below"])


def test_a_finished_run_has_its_own_range(call, refuse):
    call("run", "v.npy", *LIMITS, "-o", "out")
    refuse("info", "out", "--range", "0", "1", words=["finished run", "--range"])


def test_one_warning_is_switched_off_by_its_name(recwarn):
    import warnings

    warnings.filterwarnings("ignore", "noise:")
    tell("noise", "is ignored")
    tell("border", "is issued")
    assert [str(w.message) for w in recwarn] == ["border: is issued"]
    assert all(name.isalpha() for name in WARNINGS)


def test_every_warning_stands_on_its_page():
    page = (Path(__file__).parents[1] / "docs" / "stability.md").read_text("utf-8")
    assert all(f"| `{name}` |" in page for name in WARNINGS)


# Smoothing as far as the noise asks


def test_the_advised_blur_leaves_no_noise_and_takes_account_of_one_already_made():
    def advice(volume, smoothed):
        found = diagnose(Field("f", volume, range=(0.3, 1.5)), GridSpec.over(volume, 48), smoothed)
        return next((f.options for f in found if f.name == "noise"), None)

    loud = hills(noise=1.5)
    asked = advice(loud, 0.0)
    sigma = float(asked.removeprefix("--smooth "))
    assert sigma > 1
    assert advice(smooth(loud, 1.0), 1.0) == asked  # not --smooth 1 again: what the data need has not changed
    assert advice(smooth(loud, sigma), sigma) is None


def test_a_run_prints_the_command_that_smooths(call, tmp_path, monkeypatch):
    np.save(tmp_path / "n.npy", hills(24, noise=0.2).values)
    words = ["run", "n.npy", "--range", "0.3", "1.5", "--grid", "8", "--paths", "1", "--bounces", "1", "--no-preview"]
    monkeypatch.setattr("sys.argv", ["illumgrid", *words, "--smooth", "0.1"])
    said = call(*words, "--smooth", "0.1")
    (line,) = [line for line in said.splitlines() if "illumgrid run" in line]
    assert line.split("illumgrid ")[1].startswith(" ".join(words)) and line.count("--smooth") == 1
    assert "--smooth 0.1" not in line and line.endswith("--overwrite")
    again = line.split("illumgrid ")[1].split()
    assert "illumgrid run" not in call(*again)
    assert "illumgrid run" not in call(*words, "--overwrite", "--ignore", "noise")
