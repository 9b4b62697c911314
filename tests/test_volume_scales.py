"""Fields with a large offset, or a tiny or huge scale, keep their digits: isovalues are in their own units."""

from dataclasses import replace

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.errors import BadInput, shown, shown_range
from illumgrid.field.diagnosis import critical_isovalues, diagnose
from illumgrid.field.lattice import GridSpec
from illumgrid.field.plateaus import plateaus
from illumgrid.field.storing import NATIVE
from illumgrid.field.volume import interpolate
from illumgrid.samplers.adaptive import adaptive_rows
from illumgrid.transport.samples import in_frame

MAPS = [(0.2, 1e6), (5.0, 101325.0), (1e-58, 0.0), (1e302, 0.0), (1.0, -1e9)]


def ball(n=17):
    grid = np.indices((n, n - 1, n + 1)) - (n - 1) / 2
    return 1.0 - np.sqrt((grid**2).sum(axis=0)) / n


@pytest.mark.parametrize(("scale", "offset"), MAPS)
def test_mesh_is_that_of_the_plain_field(scale, offset):
    plain, mapped = ig.Volume(ball()), ig.Volume(offset + scale * ball())
    assert mapped.stored.dtype == np.float32
    assert np.allclose(mapped.values, offset + scale * ball(), rtol=1e-15, atol=1e-7 * scale)
    for level in (0.6, 0.75):
        here, there = ig.isosurface(plain, level), ig.isosurface(mapped, offset + scale * level)
        assert len(there.faces) == len(here.faces)
        # Rounding of the offset itself: 1e6 + 0.2 h has 9 digits for h in double precision.
        assert np.abs(there.vertices - here.vertices).max() < 1e-3
    low, high = mapped.extremes
    assert np.allclose(
        [low, high], offset + scale * np.array([ball().min(), ball().max()]), rtol=1e-12, atol=1e-7 * scale
    )


@pytest.mark.parametrize(("scale", "offset"), MAPS)
def test_light_is_that_of_the_plain_field(scale, offset):
    lights = []
    for a, b in ((1.0, 0.0), (scale, offset)):
        scene = ig.Scene.sky(ig.Volume(b + a * ball()), range=(b + a * 0.55, b + a * 0.8))
        lights.append(ig.run(scene, grid=8, paths=8, bounces=1, isovalues=4))
    one, other = (light.grids[0] for light in lights)
    assert np.array_equal(one.support > 0, other.support > 0)
    # Levels of nodes differ by rounding, so that a path may graze here and miss there.
    assert np.median(np.abs(one.values - other.values)) < 1e-4
    assert np.allclose(one.values, other.values, atol=0.3)


def test_marching_and_mesh_agree_at_a_large_offset():
    scene = ig.Scene.sky(ig.Volume(1e6 + 0.2 * ball()), range=(1e6 + 0.11, 1e6 + 0.16))
    mesh = ig.isosurface(scene.fields[0].volume, 1e6 + 0.13)
    asked = ig.Queries.at(scene, mesh.vertices[:50], level=1e6 + 0.13)
    assert asked.normal.any(axis=1).all()
    assert np.abs(asked.point - mesh.vertices[:50]).max() < 0.02
    # As the kernels see it: the stored value at the point is the stored level.
    _, _, level = in_frame(scene, asked)
    index = asked.point  # unit lattice
    stored = scene.fields[0].volume.to_stored(interpolate(scene.fields[0].volume, index))
    assert np.allclose(stored, level[:, 0], atol=1e-7)


@pytest.mark.parametrize(("scale", "offset"), MAPS)
def test_samplers_and_diagnosis_are_those_of_the_plain_field(scale, offset):
    def seen(a, b):
        field = ig.Field("f", ig.Volume(b + a * ball()), range=(b + a * 0.1, b + a * 0.9))
        scene = ig.Scene((field,))
        found = diagnose(field, GridSpec.over(field.volume, 8))
        rows = (adaptive_rows(scene, 6)[:, 0] - b) / a
        return [f.name for f in found], rows, [what for _, what in critical_isovalues(field)]

    names, rows, critical = seen(1.0, 0.0)
    here, there, changes = seen(scale, offset)
    assert here == names and changes == critical
    assert np.allclose(there, rows, atol=1e-3)


def test_suggestions_and_plateaus_are_in_units():
    values = np.where(ball() > 0.6, 1e6 + 0.15, 1e6 + 0.1 * ball())
    volume = ig.Volume(values)
    low, high, why = ig.suggest_range(volume)
    assert 1e6 < low < high < 1e6 + 0.16 and "1000000.1" in why
    assert [value for value, *_ in plateaus(volume)] == pytest.approx([1e6 + 0.15], abs=1e-6)


def test_a_run_keeps_the_map(tmp_path):
    scene = ig.Scene.sky(ig.Volume(1e6 + 0.2 * ball(), unit="µm"), range=(1e6 + 0.11, 1e6 + 0.16))
    ig.run(scene, grid=6, paths=2, bounces=0, isovalues=3).save(tmp_path / "out", preview=False)
    back = ig.load(tmp_path / "out").scene.fields[0]
    assert np.array_equal(back.volume.values, scene.fields[0].volume.values) and back.volume.unit == "µm"
    assert back.volume.extremes == scene.fields[0].volume.extremes and np.array_equal(
        back.range, (1e6 + 0.11, 1e6 + 0.16)
    )
    assert len(ig.isosurface(back.volume, 1e6 + 0.13).faces) > 100


def test_values_that_single_precision_holds_are_kept_as_they_are():
    for values in (
        ball(),
        ball().astype("f4") * np.float32(1e-38),
        np.arange(8).reshape(2, 2, 2) + 2**20,
        100 + ball(),
    ):
        volume = ig.Volume(values)
        assert (volume.slope, volume.intercept) == (1.0, 0.0)
        assert np.array_equal(volume.values, values.astype(np.float32))
    fill = ball()
    fill[0, 0, 0] = np.nan
    assert np.isnan(ig.Volume(1e6 + 0.2 * fill).values[0, 0, 0])


def test_a_map_that_is_given():
    volume = ig.Volume(np.arange(8, dtype=np.uint8).reshape(2, 2, 2), slope=0.5, intercept=-3)
    assert volume.extremes == (-3.0, 0.5) and np.array_equal(volume.stored.ravel(), np.arange(8))
    assert np.array_equal(volume.values.ravel(), 0.5 * np.arange(8) - 3) and volume.stored.dtype == np.uint8
    with pytest.raises(BadInput, match=r"slope and intercept are 0.0 and 1.0"):
        ig.Volume(np.zeros((2, 2, 2)), slope=0, intercept=1)


@pytest.mark.parametrize("kind", [kind for kind in NATIVE if kind.kind != "f"])
def test_a_negative_slope_turns_whole_numbers_within_their_type(kind):
    ends = np.iinfo(kind)
    given = np.array([ends.min, ends.max, 1, 3, 5, 7, 9, 11], kind).reshape(2, 2, 2)
    volume = ig.Volume(given, slope=-0.5, intercept=-3)
    assert volume.slope == 0.5 and volume.stored.dtype == kind
    assert np.array_equal(volume.values, -0.5 * given - 3.0)


@pytest.mark.parametrize(
    ("kind", "slope", "intercept", "kept"),
    [
        *(("uint16", 1, -1024, "int16"), ("int16", 2, 1000, "int16"), ("uint8", 1, -128, "int8")),
        *(("int8", 1, 128, "uint8"), ("uint16", -1, 65535, "uint16"), ("int16", -1, 0, "int16")),
        *(("uint8", 1, -1024, None), ("uint8", 2, 200, None), ("uint16", 0.1, 0, None), ("int16", 1, 0.5, None)),
    ],
)
def test_whole_numbers_stay_as_small_as_they_come(kind, slope, intercept, kept):
    given = np.array([0, 1, 2, 3, 40, 50, 60, 100]).astype(kind).reshape(2, 2, 2)
    volume = ig.Volume(given, slope=slope, intercept=intercept)
    assert np.array_equal(volume.values, slope * given.astype(float) + intercept)
    assert volume.stored.itemsize == given.itemsize and volume.plain == (kept is not None)
    assert volume.stored.dtype == (kept or kind) and (not kept or volume.values is volume.stored)


def test_a_volume_with_something_replaced_is_the_same_field():
    volume = ig.Volume(np.arange(8, dtype=np.uint8).reshape(2, 2, 2), slope=-0.5, intercept=-3)
    moved = replace(volume, origin=(1, 2, 3), unit="mm")
    assert np.array_equal(moved.values, volume.values) and moved.origin.tolist() == [1, 2, 3] and moved.unit == "mm"
    assert np.shares_memory(moved.stored, volume.stored)
    with pytest.raises(BadInput, match="expected one of them"):  # mapped once, or twice?
        replace(volume, values=volume.values)


def test_a_map_that_leads_beyond_double_precision_is_refused():
    with pytest.raises(BadInput, match="beyond the numbers of double precision"):
        ig.Volume(np.arange(8, dtype=np.uint8).reshape(2, 2, 2), slope=1e308)
    assert not ig.Volume(np.zeros((2, 2, 2), np.uint8), slope=1e300).values.any()


def test_numbers_are_distinguished():
    assert shown_range((101320, 101330)) == "101320 to 101330"
    assert shown_range((1e6 - 0.2, 1e6 + 0.2)) == "999999.8 to 1000000.2"
    assert shown_range((0.123456, 0.9)) == "0.1235 to 0.9" and shown(0.0) == "0"
    assert shown_range((1.5e-58, 2.5e-58)) == "1.5e-58 to 2.5e-58"


def test_exports_keep_the_digits(tmp_path):
    scene = ig.Scene.sky(ig.Volume(1e6 + 0.2 * ball()), range=(1e6 + 0.11, 1e6 + 0.16))
    light = ig.run(scene, grid=17, paths=1, bounces=0, isovalues=3)
    from illumgrid.io import exports

    for ending in ("nrrd", "vti", "npz"):
        exports.write(light, tmp_path / f"a.{ending}", on="field", array="field" if ending == "nrrd" else None)
    for back in (ig.read_volume(tmp_path / "a.nrrd"), ig.read_volume(tmp_path / "a.vti", array="field")):
        assert np.allclose(back.values, 1e6 + 0.2 * ball(), rtol=0, atol=1e-7)
    with np.load(tmp_path / "a.npz") as arrays:
        assert np.allclose(arrays["field"], 1e6 + 0.2 * ball(), rtol=0, atol=1e-7)
    with pytest.raises(ig.BadInput, match="double precision"):
        exports.write(light, tmp_path / "a.exr", on="field")


def test_a_scene_file_takes_ranges_of_any_scale(tmp_path):
    np.save(tmp_path / "a.npy", 1e302 * ball())
    text = '[[field]]\nname = "a"\nvolume = "a.npy"\nrange = [5e301, 8e301]\n'
    (tmp_path / "s.toml").write_text(text, "utf-8")
    assert ig.read_scene(tmp_path / "s.toml").fields[0].range.tolist() == [5e301, 8e301]
