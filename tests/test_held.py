"""A level that is held while other fields sweep: its light at every place of the sweep."""

import math

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.backends.numba_ import Numba
from illumgrid.chain import load, run
from illumgrid.field.scene import Field, Material, Scene
from illumgrid.show import render
from illumgrid.transport.samples import Queries
from illumgrid.transport.tracer import prepare
from shapes import ball, refused


@pytest.fixture(scope="module")
def scene():
    """A dark body that sweeps beside a white one that is held, under a white sky."""
    dark = Field("dark", ball(14, at=(0.0, 0.0, 0.9)), Material(np.zeros(3)), (0.45, 0.95))
    held = Field("held", ball(14, at=(0.0, 0.0, -0.9)), Material(np.full(3, 0.8)), isovalue=0.7)
    return Scene((dark, held), background=np.ones(3))


@pytest.fixture(scope="module")
def light(scene):
    return run(scene, grid=14, paths=64, bounces=2, seed=0)


def test_the_sweep_passes_it_by(scene):
    assert (scene.levels([0.0, 0.3, 1.0])[:, 1] == 0.7).all()
    assert np.allclose(scene.levels_through(1, 0.7)[0], [0.7, 0.7])  # the others in the middle
    assert np.allclose(scene.levels_through(0, 0.45)[0], [0.45, 0.7])


@pytest.mark.parametrize("t", [0.0, 0.3, 0.5, 0.9, 1.0])
def test_its_light_is_that_of_every_place_of_the_sweep(scene, light, t):
    mesh = ig.isosurface(scene.fields[1].volume, 0.7)
    above = mesh.vertices[mesh.vertices[:, 2] > -0.7]  # on the side of the body that sweeps
    asked = Queries.at(scene, above, field=1, level=0.7)
    levels = np.tile(scene.levels(t)[0], (len(asked), 1))
    asked = Queries(asked.id + np.uint64(1 << 50), asked.point, asked.normal, levels, asked.target)
    truth = prepare(Numba(), scene).solve(asked, paths=range(256), bounces=2, seed=7).mean[:, 0]
    found = light.grids[1].lookup(asked.point, t)[:, 0]
    assert abs((found - truth).mean() / truth.mean()) < 0.02
    if t in (0.0, 1.0):  # the middle of the sweep would be off there: the body is larger, or smaller
        assert abs((light.grids[1].lookup(asked.point)[:, 0] - truth).mean() / truth.mean()) > 0.02


def test_only_nodes_beside_its_level_are_lit(scene, light):
    grid = light.grids[1]
    points = grid.spec.nodes()[grid.support.ravel() > 0]
    radius = np.linalg.norm(points - (0, 0, -0.9), axis=1)
    step = math.sqrt(3) * max(*grid.spec.spacing, *scene.fields[1].volume.spacing)
    assert (abs(radius - 0.5) < 1.5 * step).all() and 20 < len(points) < 0.3 * grid.support.size
    assert len(grid.rows) == 5 and all(np.array_equal(row.support > 0, grid.support > 0) for row in grid.rows)


def test_it_is_kept_and_mixed(light, tmp_path):
    light.save(tmp_path / "run", preview=False)
    again = load(tmp_path / "run")
    assert again.scene.fields[1].isovalue == 0.7 and again.scene.fields[0].isovalue is None
    points = light.grids[1].spec.nodes()[::5]
    for t in (0.0, 0.6):
        assert np.array_equal(again.grids[1].lookup(points, t), light.grids[1].lookup(points, t))
    half = light.mix(sky=0.5).grids[1]
    assert np.allclose(half.lookup(points, 0.2), 0.5 * light.grids[1].lookup(points, 0.2), rtol=1e-5)


def test_pictures_show_it_under_every_setting(light):
    small = {"width": 40, "height": 40, "view": "front"}
    camera = {"camera": ig.show.fit_camera(light.scene, light.scene.levels(0.0), 1.0)} if hasattr(ig, "show") else {}
    one, other = (render(light, isovalue=c, **small, **camera) for c in (0.46, 0.94))
    assert not np.array_equal(one, other)


def test_no_light_is_known_first_that_no_path_could_end_in():
    """In a room, whose paths are long: the rows of a level that is held are in no cache's sweep."""
    room = Scene.box(ball(8), albedo=(0.8, 0.8, 0.8), range=(0.5, 0.8))
    still = Field("still", ball(8), Material((0.8,) * 3), (0.3, 0.9), isovalue=0.4)
    lights = [run(Scene((*room.fields, *more), room.quads), grid=4, paths=1, judge=False) for more in ((), (still,))]
    assert [light.recipe["cache"] for light in lights] == [True, False]


def test_a_held_level_is_named_as_it_was_given(call, tmp_path):
    np.save(tmp_path / "v.npy", ball(8).values)
    text = '[[field]]\nname = "a"\nvolume = "v.npy"\nrange = [0.3, 0.9]\n'
    held = '[[field]]\nname = "b"\nvolume = "v.npy"\nisovalue = 0.2\n'
    (tmp_path / "s.toml").write_text(f"{text}{held}")
    said = call("run", "s.toml", "--grid", 4, "--paths", 1, "--bounces", 0, "--no-preview", "-o", "out")
    assert "voxels, held at isovalue 0.2\n" in said and "0.19999" not in said and "isovalues 0.3 to 0.9" in said
    told = call("info", "out")
    assert "held at          0.2, inside above" in told and "0.19999" not in told


def test_levels_that_cannot_be_held_are_refused(tmp_path):
    refused(lambda: Field("a", ball(8), isovalue=9.0), "9", "'a'", "misses")
    np.save(tmp_path / "v.npy", ball(8).values)
    text = '[[field]]\nname = "a"\nvolume = "v.npy"\nisovalue = 0.5\n'
    (tmp_path / "s.toml").write_text(text)
    assert ig.read_scene(tmp_path / "s.toml").fields[0].isovalue == 0.5
    (tmp_path / "s.toml").write_text(text + "range = [0.3, 0.9]\n")
    refused(lambda: ig.read_scene(tmp_path / "s.toml"), "range and isovalue")
    (tmp_path / "s.toml").write_text(text.replace("isovalue = 0.5", "transmission = 2"))
    refused(lambda: ig.read_scene(tmp_path / "s.toml"), "transmission is 2", "0 to 1")
