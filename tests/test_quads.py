"""Quads and presets: refused values, front sides, and positions."""

import itertools

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.field.levelset import marchable
from illumgrid.field.rooms import box_around, upright
from illumgrid.field.scene import Field, Material, Quad, Scene
from illumgrid.field.volume import Volume, index_to_world
from shapes import DIRECTIONS, ball, refused

X, Y, Z = np.eye(3)
PERMUTED = {
    f"{axes} {signs}": np.eye(3)[:, list(axes)] * signs
    for axes in itertools.permutations(range(3))
    for signs in ((1, 1, 1), (-1, 1, 1), (1, -1, -1))
}
ALL = DIRECTIONS | PERMUTED


def volume(direction):
    """A volume without symmetry, far from the world's origin."""
    return Volume(np.random.default_rng(0).random((4, 6, 9)), (10, -20, 30), (0.5, 1.0, 0.25), direction)


def corners(of):
    return index_to_world(of, np.array(list(np.ndindex(2, 2, 2))) * (np.array(of.shape) - 1))


# One quad.


def test_a_quad_knows_its_front_and_its_area():
    quad = Quad("wall", (1, 2, 3), (2, 0, 0), (1, 3, 0))
    assert quad.normal.tolist() == [0, 0, 1] and quad.area == pytest.approx(6)
    assert Quad("wall", (1, 2, 3), (1, 3, 0), (2, 0, 0)).normal.tolist() == [0, 0, -1]
    assert quad.texels == (16, 16) and quad.material.albedo.tolist() == [0.8] * 3
    assert quad.corner.dtype == quad.edge_u.dtype == float and not quad.corner.flags.writeable
    assert ig.Quad is Quad


@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1e6, 1e30])
def test_a_quad_may_be_of_any_size(scale):
    quad = Quad("wall", (0, 0, 0), scale * X, scale * (Y + X))
    np.testing.assert_allclose(quad.normal, Z, atol=1e-15)
    assert quad.area == pytest.approx(scale**2)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"name": ""}, ["name is ''", "printable"]),
        ({"name": "a\nb"}, ["printable"]),
        ({"name": 7}, ["name is 7", "printable"]),
        ({"corner": (1, 2)}, ["corner of quad 'wall'", "three finite"]),
        ({"corner": (1, 2, np.nan)}, ["corner of quad 'wall'", "three finite"]),
        ({"edge_u": (np.inf, 0, 0)}, ["edge_u of quad 'wall'", "three finite"]),
        ({"edge_v": [[0, 1, 0]]}, ["edge_v of quad 'wall'", "three finite"]),
        ({"edge_v": (2, 0, 0)}, ["edges of quad 'wall'", "parallel or zero"]),
        ({"edge_v": (-2, 1e-9, 0)}, ["parallel or zero"]),
        ({"edge_u": (0, 0, 0)}, ["parallel or zero"]),
        ({"texels": (0, 4)}, ["texels of quad 'wall'", "(0, 4)", "from 1 up"]),
        ({"texels": (4,)}, ["texels of quad 'wall'", "two whole numbers"]),
        ({"texels": (4, 4, 4)}, ["texels of quad 'wall'", "two whole numbers"]),
    ],
)
def test_what_is_no_quad_is_refused(change, words):
    good = {"name": "wall", "corner": (0, 0, 0), "edge_u": (1, 0, 0), "edge_v": (0, 1, 0)}
    Quad(**good)
    refused(lambda: Quad(**(good | change)), *words)


def test_two_parts_of_a_scene_may_not_share_a_name():
    field, wall = Field("ball", ball()), Quad("wall", (0, 0, 0), X, Y)
    assert Scene((field,), (wall,)).quads == (wall,)
    refused(lambda: Scene((field,), (wall, Quad("wall", Z, X, Y))), "two parts", "'wall'", "differ")
    refused(lambda: Scene((field,), (Quad("ball", Z, X, Y),)), "two parts", "'ball'", "differ")
    refused(lambda: Scene.box(ball(), name="lamp"), "two parts", "'lamp'", "differ")


# Which way is up.


@pytest.mark.parametrize("direction", ALL.values(), ids=ALL)
def test_upright_directions_are_array_axes_and_right_handed(direction):
    right, front, up = upright(direction)
    axes = np.stack([right, front, up])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.sort(np.abs(axes @ direction), axis=1), np.tile([0, 0, 1.0], (3, 1)), atol=1e-12)
    np.testing.assert_allclose(np.cross(up, front), right, atol=1e-12)
    assert up[2] == pytest.approx(np.abs(direction[2]).max())
    assert front[1] <= 1e-12
    if (np.abs(direction).max(axis=0) == 1).all():  # the axes of the world, in some order and sense
        np.testing.assert_allclose(axes, [X, -Y, Z], atol=1e-12)


# The box.


@pytest.mark.parametrize("direction", ALL.values(), ids=ALL)
def test_the_walls_of_the_box_look_inward_and_red_is_left(direction):
    of = volume(direction)
    quads = {q.name: q for q in box_around(of)}
    assert list(quads) == ["floor", "ceiling", "left", "right", "back", "front", "lamp"]
    centre = corners(of).mean(axis=0)
    right, front, up = upright(direction)
    towards = {"floor": -up, "ceiling": up, "left": -right, "right": right, "back": -front, "front": front}
    for name, way in towards.items():
        quad = quads[name]
        np.testing.assert_allclose(quad.normal, -way, atol=1e-12)
        middle = quad.corner + 0.5 * (quad.edge_u + quad.edge_v)
        np.testing.assert_allclose(np.cross(middle - centre, way), 0, atol=1e-9)  # straight that way from the centre
        assert ((corners(of) - quad.corner) @ quad.normal).min() > 0.1
        assert not quad.material.emission.any()
    # seen from the front, looking back: the cross product of up and of the way to the eye is the right hand
    left_to_right = quads["right"].corner - quads["left"].corner
    assert left_to_right @ np.cross(up, front) > 0
    red, green = (quads[side].material.albedo for side in ("left", "right"))
    assert red[0] > 3 * red[1:].max() and green[1] > 3 * green[[0, 2]].max()
    for name in ("floor", "ceiling", "back", "front"):
        assert np.ptp(quads[name].material.albedo) == 0

    lamp, floor = quads["lamp"], quads["floor"]
    np.testing.assert_allclose(lamp.normal, up, atol=1e-12)
    height = (lamp.corner - floor.corner) @ up
    lowest = ((corners(of) - floor.corner) @ up).min()
    assert 0 < height < lowest and lamp.material.emission.min() > 0 and not lamp.material.albedo.any()


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_the_walls_of_the_box_share_their_edges(direction):
    walls = box_around(volume(direction))[:6]
    vertices = [
        [q.corner + i * q.edge_u + j * q.edge_v for i in (0, 1) for j in (0, 1)] for q in walls
    ]  # each of the eight vertices belongs to three walls
    points = np.reshape(vertices, (-1, 3))
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert ((distance < 1e-9).sum(axis=1) == 3).all()
    assert sum(q.area for q in walls) > 0


def test_the_preset_of_the_box_is_closed_and_dark_but_for_its_lamp():
    scene = Scene.box(volume(np.eye(3)), (0.1, 0.2, 0.3), (0.2, 0.6), "below", "solid")
    assert not scene.background.any() and len(scene.quads) == 7
    (field,) = scene.fields
    assert field.name == "solid" and field.inside == "below" and field.range.tolist() == [0.2, 0.6]
    assert field.material.albedo.tolist() == [0.1, 0.2, 0.3]
    assert [q.name for q in scene.quads if q.material.emission.any()] == ["lamp"]


# The floor.


@pytest.mark.parametrize("direction", ALL.values(), ids=ALL)
def test_the_floor_touches_the_lowest_voxels_from_below(direction):
    of = volume(direction)
    scene = Scene.floor(of)
    (floor,) = scene.quads
    _, _, up = upright(direction)
    assert floor.name == "floor" and [light.name for light in scene.lights] == ["key", "dome"]
    np.testing.assert_allclose(floor.normal, up, atol=1e-12)
    heights = (corners(of) - floor.corner) @ floor.normal
    assert heights.min() == pytest.approx(0, abs=1e-9) and heights.max() > 1
    # it reaches well beyond them
    offset = corners(of) - floor.corner
    for edge in (floor.edge_u, floor.edge_v):
        share = offset @ edge / (edge @ edge)
        assert share.min() > 0.1 and share.max() < 0.9


def test_the_lit_side_is_that_of_the_world_also_in_a_mirrored_frame():
    for direction in DIRECTIONS.values():
        scene = Scene((Field("solid", volume(direction)),), (Quad("lamp", Z, X, Y, Material(np.zeros(3), X)),))
        layout = marchable(scene)
        np.testing.assert_allclose(direction @ layout.quad_normal[0], Z, atol=1e-12)
        np.testing.assert_allclose(scene.from_frame(layout.quad_corner), [Z], atol=1e-12)
        np.testing.assert_allclose(
            layout.quad_duals[0] @ layout.quad_edges[0].T, np.eye(2), atol=1e-12
        )  # shares along the edges
