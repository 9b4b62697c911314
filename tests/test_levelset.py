"""Level sets as meshes (known area, closed, oriented outwards) and as bricks for marching."""

import numpy as np
import pytest
from numba import typeof

from illumgrid.field import cubes
from illumgrid.field.bricks import lay_bricks
from illumgrid.field.levelset import extract, isosurface, marchable, off_the_data, turned_levels
from illumgrid.field.scene import Field, Material, Scene
from illumgrid.field.signed import signed_pair
from illumgrid.field.volume import Volume, world_to_index
from illumgrid.transport.samples import Queries, in_frame
from shapes import DIRECTIONS, MIRRORED, ball, refused, sampled, sky

UNEVEN = np.array([0.5, 1.25, 3.0])


def radius(x):
    return np.linalg.norm(x, axis=1)


# Area, volume, side


@pytest.mark.parametrize("spacing", [(0.1, 0.1, 0.1), (0.05, 0.1, 0.15)], ids=["even", "uneven"])
def test_area_and_volume_of_a_ball_are_underestimated_by_less_than_the_chords_allow(spacing):
    shape = tuple(int(np.ceil(2.4 / s)) + 1 for s in spacing)
    volume = sampled(lambda x: -radius(x), shape, (-1.2, -1.2, -1.2), spacing)
    mesh = isosurface(volume, -1.0)
    # A chord of length d lies inside by at most d²/8: taken along edges, and again within the faces, twice each.
    sag = max(spacing) ** 2 / 8 * 4
    assert 4 * np.pi * (1 - sag) ** 2 < mesh.area < 4 * np.pi
    assert 4 / 3 * np.pi * (1 - sag) ** 3 < mesh.volume < 4 / 3 * np.pi
    away = radius(mesh.vertices)
    assert away.max() < 1 + 1e-6 and away.min() > 1 - sag


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
@pytest.mark.parametrize("inside", ["above", "below"])
def test_faces_turn_outwards_and_lie_in_the_world(direction, inside):
    sign = -1 if inside == "above" else 1
    centre = np.array([100, -50, 7.0])
    origin = centre - direction @ np.full(3, 1.2)
    volume = sampled(lambda x: sign * radius(x - centre), (25, 25, 25), origin, np.full(3, 0.1), direction)
    mesh = isosurface(volume, sign * 1.0, inside)
    assert mesh.is_watertight and mesh.volume == pytest.approx(4 / 3 * np.pi, rel=0.01)
    outwards = (mesh.face_normals * (mesh.triangles_center - centre)).sum(axis=1)
    assert outwards.min() > 0.9
    np.testing.assert_allclose(radius(mesh.vertices - centre), 1, atol=0.005)


@pytest.mark.parametrize("inside", ["above", "below"])
def test_the_side_that_is_solid_turns_the_faces_and_nothing_else(inside):
    volume = ball(16)
    one, other = isosurface(volume, 0.5, "above"), isosurface(volume, 0.5, "below")
    assert np.allclose(one.bounds, other.bounds) and one.area == pytest.approx(other.area)
    assert one.volume == pytest.approx(-other.volume) and one.volume > 0


@pytest.mark.parametrize("capped", [False, True])
@pytest.mark.parametrize("inside", ["above", "below"])
@pytest.mark.parametrize("planes", [0.3, 0.9, 2, 5])
def test_pieces_give_the_faces_of_one_call(monkeypatch, inside, capped, planes):
    """Noise has all cases of cells; levels at data values put vertices of several edges into one corner."""
    values = np.random.default_rng(0).integers(0, 5, (14, 9, 11))
    values[6:9] = 0  # a slab without a surface
    volume = Volume(values)
    for level in (2.0, 2.3):
        whole, faces = extract(volume, level, inside, capped)
        with monkeypatch.context() as patch:
            patch.setattr(cubes, "AT_ONCE", int(planes * (8 + 2 * capped) * (10 + 2 * capped)))
            points, again = extract(volume, level, inside, capped)
        assert len(faces) > 1000 and np.array_equal(again, faces)
        kept = 1 if planes > 1 else 2  # axes that are not cut
        assert np.array_equal(points[:, kept:], whole[:, kept:])
        np.testing.assert_allclose(points[:, :kept], whole[:, :kept], rtol=0, atol=2.0**-21)  # half a unit of 8 to 16


@pytest.mark.parametrize("shape", [(9, 40, 30), (3, 1100, 2), (200, 2, 700), (2, 2, 2)])
def test_no_call_has_more_cells_than_half_more_than_asked(monkeypatch, shape):
    """A plane of noise of any size is cut as well: scikit-image listens to no signal while it is at work."""
    real, cells = cubes._cubes, []

    def counting(values, *more):
        cells.append(np.prod(np.array(values.shape) - 1))
        return real(values, *more)

    monkeypatch.setattr(cubes, "_cubes", counting)
    monkeypatch.setattr(cubes, "AT_ONCE", 600)
    cubes.march(np.random.default_rng(0).random(shape, np.float32), 0.5, "ascent")
    assert max(cells) <= 1.5 * (2 * (shape[2] - 1) if shape[1] == 2 else 600)


@pytest.mark.parametrize("power", [-124, -40, 40, 100])
def test_the_mesh_does_not_depend_on_the_scale_of_the_values(power):
    values = ball(12).values.astype(float)
    expected = isosurface(Volume(values), 0.5).vertices
    mesh = isosurface(Volume(values * 2.0**power), 0.5 * 2.0**power)
    np.testing.assert_allclose(mesh.vertices, expected, atol=1e-5)


# Closed


def blobs(shape=(11, 10, 9), seed=0, top=9):
    """Smooth random integers from 0 to `top`, which tie with every integer isovalue."""
    from scipy.ndimage import gaussian_filter

    noise = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 1.5)
    return np.round((noise - noise.min()) / np.ptp(noise) * top)


@pytest.mark.parametrize("inside", ["above", "below"])
@pytest.mark.parametrize("seed", range(3))
def test_a_capped_level_set_is_closed_at_every_data_value(seed, inside):
    volume = Volume(blobs(seed=seed), spacing=UNEVEN, direction=MIRRORED)
    for level in range(10):
        mesh = isosurface(volume, level, inside, capped=True)
        assert mesh.is_watertight and mesh.is_winding_consistent, level
        if 0 < level < 9:  # at the ends the solid may be single points
            assert mesh.volume > 0, level


@pytest.mark.parametrize("inside", ["above", "below"])
@pytest.mark.parametrize("seed", range(3))
def test_a_capped_level_set_of_raw_noise_is_closed_at_and_between_data_values(seed, inside):
    volume = Volume(np.random.default_rng(seed).integers(0, 5, (8, 7, 6)))
    for level in np.arange(0, 4.1, 0.5):
        mesh = isosurface(volume, level, inside, capped=True)
        assert mesh.is_watertight and mesh.is_winding_consistent, level
        if 0 < level < 4:  # at the ends the solid may be single points
            assert mesh.volume > 0, level


def test_a_solid_that_fills_the_volume_is_capped_to_its_box():
    volume = Volume(np.ones((3, 4, 5)), (1, 2, 3), UNEVEN)
    mesh = isosurface(volume, 0.5, capped=True)
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, [[1, 2, 3], [2, 5.75, 15]])
    assert mesh.volume == pytest.approx(1 * 3.75 * 12)
    assert not len(isosurface(volume, 0.5).faces)


def test_an_uncapped_level_set_is_open_where_the_volume_ends():
    volume = ball(16, at=(1, 0, 0))
    assert not isosurface(volume, 0.6).is_watertight
    closed = isosurface(volume, 0.6, capped=True)
    assert closed.is_watertight and closed.bounds[1, 0] == pytest.approx(1, abs=1e-9)


# At and beyond the data


@pytest.mark.parametrize("inside, direction", [("above", -1), ("below", 1)])
def test_an_isovalue_that_is_a_data_value_moves_an_ulp_so_that_the_solid_stays(inside, direction):
    volume = Volume(np.arange(8.0).reshape(2, 2, 2))
    nudged = off_the_data(volume, 3.0, inside)
    assert nudged == np.nextafter(np.float32(3), np.float32(direction * np.inf))
    assert off_the_data(volume, 3.5, inside) == 3.5
    solid = volume.values >= 3 if inside == "above" else volume.values <= 3
    moved = volume.values >= nudged if inside == "above" else volume.values <= nudged
    assert np.array_equal(solid, moved)
    zero = off_the_data(volume, 0.0, inside)
    assert zero != 0 and np.sign(zero) == direction


def test_an_isovalue_that_rounds_to_a_data_value_moves_too():
    volume = Volume(np.full((2, 2, 2), 0.1) * [[[1, 2]]])
    assert np.float32(0.1) in volume.values and float(np.float32(0.1)) != 0.1
    assert off_the_data(volume, 0.1, "above") < np.float32(0.1) < off_the_data(volume, 0.1, "below")


def test_a_solid_voxel_at_exactly_the_isovalue_is_kept():
    values = np.zeros((5, 5, 5))
    values[2, 2, 2] = 1
    assert len(isosurface(Volume(values), 1.0, "above").faces) == 8
    assert not len(isosurface(Volume(values), 1.0, "below").faces)
    assert len(isosurface(Volume(1 - values), 0.0, "below").faces) == 8


@pytest.mark.parametrize("level", [-5.0, 1.2, 3e38])
def test_a_level_that_no_voxel_edge_crosses_is_an_empty_mesh(level):
    for inside in ("above", "below"):
        mesh = isosurface(ball(), level, inside)
        assert len(mesh.vertices) == len(mesh.faces) == 0 and mesh.area == 0


@pytest.mark.parametrize("level", [np.nan, np.inf])
def test_an_isovalue_that_is_no_number_is_refused(level):
    refused(lambda: isosurface(ball(), level), f"{level}", "finite")
    refused(lambda: isosurface(ball(), 0.5, "left"), "'left'", "'above' or 'below'")


# To march through


def test_two_fields_lie_one_after_the_other_in_the_frame_of_the_first():
    random = np.random.default_rng(0)
    one = Volume(random.random((5, 6, 7)), (1, 2, 3), UNEVEN, MIRRORED)
    two = Volume(random.random((9, 3, 4)), (4, 4, 4), UNEVEN * 2, MIRRORED)
    fields = (Field("a", one, Material((0.1, 0.2, 0.3), (1, 2, 3))), Field("b", two, inside="below"))
    scene = Scene(fields, background=(0.4, 0.5, 0.6))
    layout = marchable(scene)
    for f, (volume, sign) in enumerate(((one, 1), (two, -1))):
        size, bricks = volume.values.size, lay_bricks(sign * volume.values)
        assert layout.shape[f].tolist() == list(volume.shape)
        assert np.array_equal(layout.values[layout.start[f] :][:size], volume.values.ravel()) and layout.sign[f] == sign
        records = layout.bricks[128 * layout.brick_start[f] :][: bricks.records.size]
        assert np.array_equal(records, bricks.records.ravel()) and np.array_equal(layout.steps[f], bricks.steps)
        assert layout.brick_shape[f].tolist() == list(bricks.shape)
        np.testing.assert_allclose(layout.origin[f], (volume.origin - one.origin) @ one.direction, atol=1e-15)
        assert np.array_equal(layout.spacing[f], volume.spacing)
        assert np.array_equal(layout.albedo[f], fields[f].material.albedo)
        assert np.array_equal(layout.emission[f], fields[f].material.emission)
    assert layout.background.tolist() == [0.4, 0.5, 0.6]
    assert turned_levels(scene, np.array([[2.0, 3.0]])).tolist() == [[2, -3]]
    assert np.shares_memory(marchable(sky(one, inside="below")).values, one.values)
    signed = marchable(Scene(signed_pair("a", Volume(one.values - 0.5), (0.1, 0.4))))
    assert signed.values.size == one.values.size and signed.start.tolist() == [0, 0] and signed.sign.tolist() == [1, -1]


def test_queries_reach_a_backend_in_the_frame_with_levels_turned_up():
    volume = Volume(ball(12).values, (1, 2, 3), UNEVEN, MIRRORED)
    scene = sky(volume, inside="below")
    queries = Queries.at(scene, volume.origin + (np.array([[3, 4, 5], [6.5, 2, 8]]) * UNEVEN) @ MIRRORED.T)
    point, normal, level = in_frame(scene, queries)
    np.testing.assert_allclose(point / UNEVEN, world_to_index(volume, queries.point), atol=1e-12)
    np.testing.assert_allclose(normal @ volume.direction.T, queries.normal, atol=1e-12)
    assert np.array_equal(level, -queries.level)


def test_all_scenes_are_laid_out_as_one_type_so_that_kernels_compile_once():
    above, below = Scene.sky(ball(6), range=(0.3, 0.9)), Scene.sky(ball(6), range=(0.3, 0.9), inside="below")
    two = Scene((*above.fields, Field("other", ball(5), range=(0.3, 0.9))), Scene.box(ball(6)).quads)
    assert len({str(typeof(marchable(scene))) for scene in (above, below, two)}) == 1
