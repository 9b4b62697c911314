"""Fields of both signs: the surfaces at +c and -c move outward together, and their light is that of equals."""

import json

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.field.boundaries import has_both_signs, suggest_magnitudes, suggest_range
from illumgrid.field.scene import Field, Scene, level_table
from illumgrid.field.signed import signed_pair
from illumgrid.field.volume import Volume
from illumgrid.samplers.adaptive import adaptive_rows
from illumgrid.show.viewer.packing import packed
from shapes import ball, lit, refused, sampled

QUICK = ("--grid", "8", "--paths", "2", "--bounces", "1", "--no-preview")


def orbital(n=16):
    """Antisymmetric in z, on -2 to 2: two lobes of opposite sign."""
    return sampled(lambda x: x[:, 2] * np.exp(-(x * x).sum(axis=1)), (n, n, n), (-2, -2, -2), np.full(3, 4 / (n - 1)))


def test_both_surfaces_move_outward_by_the_same_magnitude():
    scene = Scene(signed_pair("o", orbital(), (0.1, 0.4)))
    rows = level_table(scene, 7).table
    np.testing.assert_allclose(rows[:, 0], np.linspace(0.1, 0.4, 7))
    np.testing.assert_allclose(rows[:, 1], -rows[:, 0])
    np.testing.assert_allclose(scene.levels_through(1, [-0.3]), [[0.3, -0.3]])
    np.testing.assert_allclose(scene.fields[1].place([-0.1, -0.4]), [0, 1])
    assert scene.fields[0].volume is scene.fields[1].volume
    assert [f.inside for f in scene.fields] == ["above", "below"]


def test_opposite_lobes_have_equal_light():
    fields = signed_pair("o", orbital(), (0.1, 0.3), ig.Material(np.full(3, 0.5)))
    one, other = ig.run(Scene(fields, background=np.ones(3)), grid=16, paths=32).grids
    known = (one.support > 0) & (other.support[:, :, ::-1] > 0)
    assert known.sum() > 500
    light, mirrored = one.values[known], other.values[:, :, ::-1][known]
    bars = np.sqrt(one.error[known] ** 2 + other.error[:, :, ::-1][known] ** 2)
    assert np.square(light - mirrored).mean() < 1.5 * np.square(bars).mean()  # the bars are made to cover
    assert light.min() < 0.8 * light.max()  # each lobe is in the way of the other's light


def test_adaptive_rows_fall_with_the_field():
    rows = adaptive_rows(Scene(signed_pair("o", orbital(), (0.05, 0.4))), 9)
    assert (np.diff(rows[:, 0]) > 0).all()
    np.testing.assert_allclose(rows[:, 1], -rows[:, 0])


def test_a_falling_field_alone_is_swept_from_high_to_low_with_the_same_distances():
    rising = Field("a", ball(12), range=(0.3, 0.9))
    falling = Field("a", ball(12), range=(0.3, 0.9), falling=True)
    up, down = (adaptive_rows(Scene((field,)), 8) for field in (rising, falling))
    np.testing.assert_allclose(down[::-1], up, atol=1e-3)


def test_the_direction_of_the_sweep_survives_the_disk_and_reaches_the_page(tmp_path):
    made = lit(Scene(signed_pair("o", orbital(8), (0.1, 0.4))))
    made.save(tmp_path / "out", preview=False)
    again = ig.load(tmp_path / "out").scene
    assert [f.falling for f in again.fields] == [False, True]
    fields = packed(made)[0]["fields"]
    assert [f["sweep"] for f in fields] == [[0.1, 0.4], [-0.1, -0.4]]
    assert [f["range"] for f in fields] == [[0.1, 0.4], [-0.4, -0.1]]


def test_voxels_without_value_are_in_no_solid():
    values = orbital(8).values.copy()
    values[0, 0, 0], values[1, 0, 0], values[2, 0, 0] = np.nan, np.inf, -np.inf
    with pytest.warns(ig.IllumgridWarning, match="3 of 512"):
        one, other = signed_pair("o", Volume(values), (0.1, 0.4))
    assert not one.volume.values[:3, 0, 0].any() and other.volume is one.volume


def test_what_has_no_two_signs_is_refused():
    refused(lambda: signed_pair("o", ball(8), (0.7, 0.9)), "both signs", "-0.5")
    for limits in ((0, 0.4), (-0.4, -0.1), (0.4, 0.1)):
        refused(lambda: signed_pair("o", orbital(8), limits), "0 < LO < HI")  # noqa: B023


def test_the_suggested_magnitudes_are_those_of_the_absolute_value():
    volume = orbital()
    low, high, _ = suggest_magnitudes(volume)
    assert (low, high) == ig.suggest_range(volume.with_stored(np.abs(volume.values)))[:2]
    assert 0 < low < high < volume.extremes[1]
    assert signed_pair("o", volume)[1].range.tolist() == [-high, -low]


def test_signs_are_noticed_where_both_mean_something():
    assert has_both_signs(orbital()) and has_both_signs(orbital().with_stored(-orbital().values))
    noise = np.random.default_rng(0).normal(0, 0.01, (9, 9, 9))
    noise[4, 4, 4] = 1
    scan = np.random.default_rng(1).normal(50, 15, (12, 12, 12))  # muscle and fat in Hounsfield units, near 0
    scan[:, :5] -= 150
    scan[3:5, 6:9, 6:9], scan[7:9, 6:9, 6:9] = -1000, 1000  # between air and bone
    for values in (noise, scan, ball(9).values, np.abs(orbital().values)):
        assert not has_both_signs(Volume(values))


@pytest.mark.parametrize("farther", [1, 3])
def test_without_signed_the_suggested_range_stays_on_the_solids_side_of_zero(farther):
    """A range across 0 sweeps the whole volume: one block with caps, and no lobe."""
    h = orbital().values
    volume = Volume(
        np.where(h < 0, farther * h, h).astype(float) * 10 - 5, slope=0.1, intercept=0.5
    )  # h as it is stored
    low, high, why = suggest_range(volume)
    lobe = h[h > 0.5 * (low + high)]
    assert 0 < low < high < h.max() and "positive side" in why and 20 < lobe.size < 0.2 * h.size
    assert Field("o", volume).range.tolist() == [low, high]
    if farther == 1:
        assert (low, high) == suggest_magnitudes(volume)[:2]
    least, most, why = suggest_range(volume, "below")
    assert volume.extremes[0] < least < most < 0 and "negative side" in why
    turned = suggest_range(volume.with_stored(-10 - volume.stored), "below")
    assert turned[:2] == pytest.approx((-high, -low), rel=1e-6)


def test_the_command_line_lights_both_signs(call, refuse, tmp_path):
    np.save(tmp_path / "o.npy", orbital(10).values)
    call("run", "o.npy", "--signed", "--range", "0.1", "0.3", *QUICK, "-o", "out")
    light = ig.load(tmp_path / "out")
    assert [f.name for f in light.scene.fields] == ["o-positive", "o-negative"] and len(light.grids) == 2
    one, other = (f.material.albedo for f in light.scene.fields)
    assert one[0] > one[2] and other[0] < other[2]
    call("run", "o.npy", "--signed", "--scene", "box", "--albedo", "0.5", "0.5", "0.5", *QUICK, "-o", "box")
    boxed = ig.load(tmp_path / "box").scene
    assert len(boxed.quads) == 7 and [f.material.albedo.tolist() for f in boxed.fields] == [[0.5] * 3] * 2
    refuse("run", "o.npy", "--signed", "--inside", "below", "-o", "no", words=["--signed", "--inside"])
    refuse("run", "o.npy", "--signed", "--range", "-0.3", "0.3", "-o", "no", words=["0 < LO < HI"])
    refuse("run", "nucleus", "--signed", "-o", "no", words=["--signed", "built-in"])


def test_a_scene_file_says_signed(call, refuse, tmp_path):
    np.save(tmp_path / "o.npy", orbital(10).values)
    text = '[[field]]\nname = "o"\nvolume = "o.npy"\nrange = [0.1, 0.3]\nsigned = true\n'
    (tmp_path / "s.toml").write_text(text + "[background]\nradiance = [1, 1, 1]\n")
    scene = ig.read_scene(tmp_path / "s.toml")
    assert [f.range.tolist() for f in scene.fields] == [[0.1, 0.3], [-0.3, -0.1]]
    assert scene.fields[0].volume is scene.fields[1].volume
    call("run", "s.toml", *QUICK, "-o", "out")
    about = json.loads((tmp_path / "out" / "run.json").read_text("utf-8"))["scene"]["fields"]
    assert [field["falling"] for field in about] == [False, True]
    for more, words in (('inside = "below"\n', ["signed", "inside"]), ("falling = 3\n", ["falling is 3"])):
        (tmp_path / "bad.toml").write_text(text + more)
        refuse("run", "bad.toml", "-o", "no", words=words)
