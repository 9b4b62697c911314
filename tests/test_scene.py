"""Scenes: accepted values, the suggested range, the common sweep, and the frame."""

import re
from pathlib import Path

import numpy as np
import pytest

from illumgrid.errors import IllumgridWarning
from illumgrid.field.boundaries import suggest_range
from illumgrid.field.scene import Field, Material, Scene, level_table
from illumgrid.field.volume import Volume
from illumgrid.io.readers import read_volume
from shapes import DIRECTIONS, MIRRORED, OBLIQUE, ball, refused, sky

VOLUMES = Path(__file__).parents[2] / "shared" / "volumes"


def two(**more):
    """A scene of two fields with different ranges."""
    volume = ball()
    first, second = (Field(n, volume, range=r) for n, r in (("a", (0.2, 0.6)), ("b", (0.5, 1.1))))
    return Scene((first, second), **more)


# What is taken


@pytest.mark.parametrize(
    "color", [(1, 1), 0.8, (0.5, 0.5, 1.1), (-0.1, 0.5, 0.5), (np.nan, 0, 0), (np.inf, 0, 0), ((1, 1, 1),)]
)
def test_an_albedo_that_is_no_colour_is_refused(color):
    refused(lambda: Material(color), "albedo", "three numbers (red, green, blue) from 0 to 1")


@pytest.mark.parametrize("color", [(1, 1), (-1, 0, 0), (np.nan, 0, 0), (np.inf, 0, 0)])
def test_an_emission_or_background_that_is_no_light_is_refused(color):
    refused(lambda: Material(emission=color), "emission", "from 0 up")
    refused(lambda: two(background=color), "background", "from 0 up")


def test_a_material_keeps_its_own_copy():
    color = np.array([0.1, 0.2, 0.3])
    material = Material(color, color * 100)
    color[:] = 1
    assert material.albedo.tolist() == [0.1, 0.2, 0.3] and not material.albedo.flags.writeable
    assert Material().albedo.tolist() == [0.8, 0.8, 0.8] and Material().emission.tolist() == [0, 0, 0]


@pytest.mark.parametrize("limits", [(0.9, 0.3), (0.5, 0.5), (0.3, np.nan), (-np.inf, 0.5), (0.3,), (0.1, 0.2, 0.3)])
def test_a_range_that_is_none_is_refused(limits):
    refused(lambda: Field("a", ball(), range=limits), "range of field 'a'", "isovalue")


@pytest.mark.parametrize("limits", [(2, 3), (-9, -8)])
def test_a_range_beside_the_data_is_refused_with_the_range_of_the_data(limits):
    refused(lambda: Field("a", ball(), range=limits), f"range {limits[0]} to {limits[1]}", "-0.5", "1.1", "choose")


def test_a_range_wider_than_the_data_is_taken():
    assert Field("a", ball(), range=(-9, 9)).range.tolist() == [-9, 9]


@pytest.mark.parametrize("name", ["", "a\nb", None, 3])
def test_a_field_needs_a_printable_name(name):
    refused(lambda: Field(name, ball()), "name", "printable")


def test_a_side_that_is_none_is_refused():
    refused(lambda: Field("a", ball(), inside="left"), "'left'", "'above' or 'below'")


@pytest.mark.parametrize(
    ("odd", "said"),
    [([np.nan], {"NaN"}), ([np.inf, -np.inf], {"infinities"}), ([np.nan, np.inf], {"NaN", "infinities"})],
)
def test_a_field_replaces_what_is_not_finite_and_says_so(odd, said):
    values = ball(6).values.copy()
    values[0, 0, : len(odd)] = odd
    with pytest.warns(IllumgridWarning, match=f"{len(odd)} of 216 voxels") as noted:
        field = Field("a", Volume(values), range=(0.3, 0.9))
    assert np.isfinite(field.volume.values).all()
    assert {word for word in ("NaN", "infinities") if f"{word} became" in str(noted[0].message)} == said


def test_a_scene_needs_a_field_and_names_that_differ():
    refused(lambda: Scene(()), "no field", "at least one")
    refused(lambda: Scene((Field("a", ball()), Field("a", ball(12)))), "two parts", "'a'", "differ")


def test_fields_whose_axes_are_not_parallel_are_refused():
    one = Field("a", ball())
    turned = Volume(one.volume.values, direction=OBLIQUE)
    refused(lambda: Scene((one, Field("b", turned))), "axes of field 'b'", "'a'", "one direction", "resample")


def test_fields_on_different_lattices_of_one_direction_are_taken():
    place = [((0, 0, 0), (1, 1, 1)), ((5, 6, 7), (0.5, 2, 1))]
    fields = [Field(f"{k}", Volume(ball(6).values, *at, MIRRORED)) for k, at in enumerate(place)]
    assert len(Scene(fields).fields) == 2


def test_a_field_is_found_by_its_name():
    scene = two()
    assert scene.number_of("b") == 1
    refused(lambda: scene.number_of("c"), "'c'", "a, b")


# The suggested range


@pytest.mark.parametrize("inside, share", [("above", 0.1), ("below", 0.9)])
def test_the_suggested_range_holds_the_boundary_between_two_modes(inside, share):
    mode = np.where(((np.indices((30, 30, 30)) - 14.7) ** 2).sum(axis=0) < 8.64**2, 100, 10)  # 0.1 of the volume
    values = np.random.default_rng(0).normal(mode, 5)
    low, high, why = suggest_range(Volume(values), inside)
    middle = 0.5 * (low + high)
    assert 25 < middle < 85  # between the modes, which end at 10 + 3 sigma and 100 - 3 sigma
    solid = values > middle if inside == "above" else values < middle
    assert solid.mean() == pytest.approx(share, abs=0.01)
    assert low < 50 < high and "the boundary of the object" in why


def test_the_suggestion_for_below_is_that_for_above_of_the_opposite_field():
    values = np.random.default_rng(1).gamma(2.0, size=(9, 9, 9))
    low, high, _ = suggest_range(Volume(values), "above")
    assert suggest_range(Volume(-values), "below")[:2] == pytest.approx((-high, -low))


def test_two_values_only_still_give_a_range():
    values = np.zeros((4, 4, 4))
    values[2:] = 7
    low, high, _ = suggest_range(Volume(values))
    assert 0 <= low < high <= 7
    assert Field("a", Volume(values)).range.tolist() == [low, high]


@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf])
@pytest.mark.filterwarnings("ignore::illumgrid.IllumgridWarning")
def test_what_is_not_finite_does_not_disturb_the_suggestion(odd):
    values = ball(10).values.copy()
    expected = suggest_range(Volume(values))[:2]
    values[0, 0, 0] = odd
    assert suggest_range(Volume(values))[:2] == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("offset, scale", [(0, 1e-30), (0, 1e30), (1e6, 1), (-1e6, 1)])
def test_the_suggestion_moves_with_the_values(offset, scale):
    values = np.round(ball(10).values.astype(float) * 16) / 16
    low, high, _ = suggest_range(Volume(values))
    moved = suggest_range(Volume(values * scale + offset))
    assert (np.array(moved[:2]) - offset) / scale == pytest.approx([low, high], abs=0.05)


@pytest.mark.parametrize("inside", ["above", "below"])
def test_constant_values_have_no_isosurface(inside):
    refused(lambda: suggest_range(Volume(np.full((3, 3, 3), -7.5)), inside), "all -7.5", "varies")
    refused(lambda: Field("a", Volume(np.zeros((3, 3, 3))), inside=inside), "all", "0", "varies")


def known_isovalues():
    """Recommended isovalues by file, from the table of SOURCES.md: only plain ranges such as 40-200."""
    rows = (VOLUMES / "SOURCES.md").read_text("utf-8").splitlines()
    cells = [[c.strip() for c in row.split("|")[1:-1]] for row in rows if row.startswith("|")]
    column = cells[0].index("isovalues")
    return {row[0]: [tuple(map(float, r)) for r in re.findall(r"([\d.]+)-([\d.]+)", row[column])] for row in cells[2:]}


@pytest.mark.skipif(not VOLUMES.is_dir(), reason=f"no real volumes at {VOLUMES}")
@pytest.mark.parametrize("file", sorted(known_isovalues()) if VOLUMES.is_dir() else [])
def test_the_suggestion_for_real_data_holds_the_known_isovalues(file):
    """Of every known surface (skin, bone) some isovalues are in the range, which keeps away from the ends of the data.

    The middle, which pictures show, is not beyond all of them. For thin structures it is near the low end.
    """
    volume, known = read_volume(VOLUMES / file), known_isovalues()[file]
    low, high, _ = suggest_range(volume)
    assert all(low <= last and high >= 0.95 * first for first, last in known)
    lowest, highest = volume.extremes
    assert lowest < low and high < 0.95 * highest + 0.05 * lowest + 1e-6
    assert not known or 0.5 * (low + high) < 1.15 * max(last for _, last in known)
    if file == "rivulet_neuron.nrrd":
        assert low < 14


# The sweep


def test_the_sweep_runs_from_end_to_end_of_every_range_and_is_clamped():
    table = two().levels([-1, 0, 0.5, 1, 7])
    assert table.shape == (5, 2)
    assert table[[0, 1, 3, 4]].tolist() == [[0.2, 0.5], [0.2, 0.5], [0.6, 1.1], [0.6, 1.1]]
    np.testing.assert_allclose(table[2], [0.4, 0.8])
    assert two().levels(0.25).shape == (1, 2)


@pytest.mark.parametrize("limits", [(0.1, 0.3), (1 / 3, 0.7), (-0.3, 1.1)])
def test_the_ends_of_the_sweep_are_the_range_to_the_last_bit(limits):
    scene = sky(limits=limits)
    assert scene.levels([0, 1])[:, 0].tolist() == list(limits)
    assert level_table(scene, 7).table[[0, -1], 0].tolist() == list(limits)


def test_the_level_table_is_equal_steps_of_the_sweep():
    table = level_table(two(), 5).table
    np.testing.assert_allclose(table, two().levels(np.linspace(0, 1, 5)))
    assert (np.diff(table, axis=0) > 0).all()
    for count in (1, 0, -3):
        refused(lambda count=count: level_table(two(), count), f"{count} isovalues", "at least 2")


def test_the_other_sliders_stand_where_the_common_sweep_has_them():
    rows = two().levels_through(1, [0.5, 0.8, 1.1, 2.0, 0.0])
    np.testing.assert_allclose(rows[:, 0], [0.2, 0.4, 0.6, 0.6, 0.2])
    assert rows[:, 1].tolist() == [0.5, 0.8, 1.1, 2.0, 0.0]


# The frame


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_the_frame_has_the_axes_and_the_origin_of_the_first_field(direction):
    volume = Volume(ball(6).values, (1, 2, 3), (0.5, 1, 2), direction)
    scene = Scene.sky(volume)
    corner = volume.origin + direction @ (volume.spacing * [5, 5, 5])
    np.testing.assert_allclose(scene.to_frame([volume.origin, corner]), [[0, 0, 0], [2.5, 5, 10]], atol=1e-12)
    points = np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_allclose(scene.from_frame(scene.to_frame(points)), points, atol=1e-14)


def test_a_sky_scene_is_one_field_under_white_light():
    volume = ball()
    scene = Scene.sky(volume, albedo=(0.1, 0.2, 0.3), range=(0.3, 0.9), inside="below", name="x")
    (field,) = scene.fields
    assert field.volume is volume and field.name == "x" and field.inside == "below"
    assert field.material.albedo.tolist() == [0.1, 0.2, 0.3]
    assert scene.background.tolist() == [1, 1, 1]
