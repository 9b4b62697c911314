"""Values of every type that files have give what their copy in single precision gives, bit for bit."""

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
import pytest

import illumgrid as ig
import illumgrid.show.engines
from illumgrid import show
from illumgrid.backends.reference import Reference
from illumgrid.field import bricks, levelset
from illumgrid.field.boundaries import suggest_magnitudes, suggest_range
from illumgrid.field.coarse import block_means
from illumgrid.field.diagnosis import critical_isovalues, diagnose, turning
from illumgrid.field.filters import smooth
from illumgrid.field.lattice import nodes_over
from illumgrid.field.levelset import isosurface, marchable
from illumgrid.field.plateaus import plateaus
from illumgrid.field.scene import Field, Scene
from illumgrid.field.storing import NATIVE
from illumgrid.field.volume import Volume, histogram, interpolate, outward_normals, project
from illumgrid.show.picture import render
from illumgrid.show.viewer.packing import packed
from illumgrid.transport.samples import Queries

SPAN = {"uint8": (0, 250), "int8": (-120, 120), "uint16": (1000, 60000), "int16": (-30000, 30000)}
PLACE = ((1, 2, 3), (1.0, 1.5, 0.5))


def pair(kind, shape=(13, 11, 17)):
    """A lumpy field with a plateau, in a type of files and as its copy in single precision."""
    x, y, z = np.meshgrid(*(np.linspace(-3, 3, n) for n in shape), indexing="ij")
    share = np.clip(0.5 + 0.3 * np.sin(x + y) * np.cos(z) + 0.25 * np.exp(-x * x - y * y - z * z), 0.45, 1)
    low, high = SPAN[kind]
    values = np.round(low + share * (high - low)).astype(kind)
    return Volume(values, *PLACE), Volume(values.astype(np.float32), *PLACE)


def at(kind, *shares):
    low, high = SPAN[kind]
    return tuple(low + share * (high - low) for share in shares)


@pytest.fixture(scope="module", params=SPAN)
def kind(request):
    return request.param


@pytest.fixture(scope="module", params=["above", "below"])
def lights(request):
    """Of bytes only: for each type the kernels are compiled anew."""
    scenes = [Scene.studio(volume, range=at("uint8", 0.5, 0.8), inside=request.param) for volume in pair("uint8")]
    return [ig.run(scene, grid=14, paths=4, bounces=2, isovalues=3) for scene in scenes]


def test_the_light_is_the_same(lights):
    native, single = lights
    assert native.scene.fields[0].volume.values.dtype in NATIVE[:4]
    for one, other in zip(native.grids, single.grids):
        assert (one.support > 0).sum() > 500 and one.light.std() > 0.1
        for name in ("light", "error", "support"):
            assert np.array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("inside", ["above", "below"])
def test_a_map_to_other_units_leaves_the_light_as_it_is(inside):
    """Powers of 2 round nothing: in units of a quarter the same isovalues have the same surfaces."""
    native, found = pair("uint8")[0], []
    for slope, intercept in ((1.0, 0.0), (0.25, -8.0)):
        volume = replace(native, slope=slope, intercept=intercept)
        assert volume.stored is native.stored or np.array_equal(volume.stored, native.stored)
        scene = Scene.studio(volume, range=[slope * c + intercept for c in at("uint8", 0.5, 0.8)], inside=inside)
        light = ig.run(scene, grid=14, paths=4, bounces=2, isovalues=3)
        level = slope * at("uint8", 0.6)[0] + intercept
        picture = render(light, isovalue=level, width=48, height=40, engine="software")
        found.append((light.grids[0].light, light.grids[0].error, picture, isosurface(volume, level, inside).vertices))
    assert all(np.array_equal(one, other) for one, other in zip(*found))


def test_the_light_is_the_same_in_the_large_bricks_of_large_fields(lights, monkeypatch):
    monkeypatch.setattr(bricks, "LARGE", 0)
    monkeypatch.setattr(levelset, "_LAID", WeakKeyDictionary())
    native = replace(lights[0])
    assert marchable(native.scene).shift.tolist() == [3] and marchable(native.scene).brick_shape.tolist() == [[2, 2, 2]]
    large = ig.run(native.scene, grid=14, paths=4, bounces=2, isovalues=3)
    assert np.array_equal(large.grids[0].light, native.grids[0].light)
    assert np.array_equal(*(render(light, width=48, height=40, engine="software") for light in (large, native)))


def test_pictures_and_pages_are_the_same(lights):
    one, other = (render(light, width=48, height=40, engine="software") for light in lights)
    assert np.array_equal(one, other) and len(np.unique(one)) > 20
    (about, data), (about_single, data_single) = map(packed, lights)
    assert about == about_single and data == data_single


@pytest.mark.parametrize("inside", ["above", "below"])
def test_the_reference_and_meshes_are_the_same(kind, inside):
    found = []
    for volume in pair(kind):
        scene = Scene.sky(volume, range=at(kind, 0.4, 0.8), inside=inside)
        queries = Queries.at(scene, isosurface(volume, at(kind, 0.6)[0], inside).vertices[::40], level=at(kind, 0.6)[0])
        answer = Reference().solve(scene, queries, paths=range(2), bounces=1, seed=0)
        mesh = isosurface(volume, at(kind, 0.6)[0], inside, capped=True)
        found.append((answer.light, queries.normal, mesh.vertices, mesh.faces))
    for one, other in zip(*found):
        assert np.array_equal(one, other) and len(one)


def test_what_is_read_between_voxels_is_the_same(kind):
    index = np.random.default_rng(0).uniform(0, 10, (99, 3))
    found = [
        (interpolate(v, index), outward_normals(v, index, "below"), project(v, index, np.full(99, at(kind, 0.6)[0]))[0],
         smooth(v, 1.3).values, histogram(v, 50)[0], block_means(v, (2, 3, 4)).values)
        for v in pair(kind)
    ]  # fmt: skip
    assert all(np.array_equal(one, other) for one, other in zip(*found))


@pytest.mark.parametrize("inside", ["above", "below"])
def test_suggestions_and_warnings_are_the_same(kind, inside):
    found = []
    for volume in pair(kind):
        field = Field("f", volume, range=at(kind, 0.4, 0.8), inside=inside)
        said = [one.sentence for one in diagnose(field, nodes_over(volume, 12))]
        limits = suggest_range(volume, inside), suggest_magnitudes(volume)
        flat = [(value, share, place.tolist()) for value, share, place in plateaus(volume)]
        turn = [turning(volume, *at(kind, 0.4, 0.8), blur) for blur in (0.0, 1.0)]
        found.append((said, limits, flat, turn, critical_isovalues(field), volume.extremes))
    assert found[0] == found[1] and found[0][2] and all(found[0][3])


def test_fields_of_several_types_are_promoted_to_one_that_holds_them_and_no_volume_is_held_twice():
    byte, wide = pair("uint8")[0], pair("uint16")[0]
    fields = [Field(str(k), v, range=v.extremes) for k, v in enumerate((byte, pair("int16")[0], byte, wide))]
    assert marchable(Scene(fields[:1])).values.dtype == np.uint8
    two = marchable(Scene(fields[:3]))
    assert two.values.dtype == np.int16 and two.values.size == 2 * byte.values.size and two.start[0] == two.start[2]
    every = marchable(Scene(fields))
    assert every.values.dtype == np.float32
    assert np.array_equal(every.values[every.start[3] :], wide.values.ravel())


def test_a_large_field_is_drawn_by_rays(call, monkeypatch):
    call("run", "v.npy", "--range", "0.3", "0.9", "--grid", "6", "--paths", "2", "--no-preview", "-o", "out")
    monkeypatch.setattr(show.engines, "choose_engine", lambda name: ("egl", "as a test says"))
    monkeypatch.setattr(show, "choose_engine", lambda name: ("egl", "as a test says"), raising=False)
    monkeypatch.setattr(show.engines, "_LARGE", 100)
    assert "drawn by the engine software: the field is large" in call("preview", "out", "--output", "a.png")
