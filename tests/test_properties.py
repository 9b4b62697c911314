"""Properties of light on any field; hypothesis searches for a counterexample.

Properties that hold path by path are asserted exactly: with equal seeds, two scenes share their paths.
"""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from illumgrid.backends.numba_ import Numba
from illumgrid.field.rooms import box_around
from illumgrid.field.scene import Field, Material, Scene
from illumgrid.field.volume import Volume, index_to_world
from illumgrid.transport.samples import Queries
from transport import assert_standard_normal

laws = settings(max_examples=12, deadline=None, derandomize=True, database=None)

sizes = st.tuples(*[st.integers(2, 7)] * 3)
colors = st.tuples(*[st.floats(0.0, 1.0)] * 3).map(np.array)
spacings = st.tuples(*[st.floats(0.2, 5.0)] * 3)


@st.composite
def volumes(draw):
    """Noise of few or many gray values, or a smooth field, on voxels of any shape."""
    shape, seed = draw(sizes), draw(st.integers(0, 1000))
    random = np.random.default_rng(seed)
    grays = draw(st.sampled_from([2, 4, 256, 0]))
    if grays:
        values = random.integers(0, grays, shape).astype(np.float32)
    else:
        a, b, c = random.normal(size=(3, 3))
        x = np.stack(np.indices(shape), axis=-1)
        values = np.sin(x @ a) + np.sin(x @ b + 1) + np.sin(x @ c + 2)
    if np.ptp(values) == 0:
        values[0, 0, 0] += 1
    return Volume(values, spacing=draw(spacings))


def field(volume, albedo=(0.6, 0.6, 0.6), emission=(0, 0, 0), inside="above"):
    low, high = float(volume.values.min()), float(volume.values.max())
    span = np.float64(high) - low
    return Field("f", volume, Material(np.asarray(albedo), np.asarray(emission)), (low + 0.3 * span, high), inside)


def queries(scene, count=40):
    """At voxels of the range and at points between."""
    volume = scene.fields[0].volume
    top = np.array(volume.shape) - 1
    between = np.random.default_rng(1).random((count, 3)) * top
    return Queries.at(scene, index_to_world(volume, np.concatenate([between, np.round(between)])))


def light(scene, asked, paths=8, bounces=3, seed=0):
    return Numba(threads=1).solve(scene, asked, paths=range(paths), bounces=bounces, seed=seed)


@laws
@given(volumes(), colors, colors, st.booleans())
def test_more_albedo_never_means_less_light(volume, dark, more, closed):
    quads = box_around(volume)[:6] if closed else ()
    bright = dark + (1 - dark) * more
    one, other = (
        Scene((field(volume, albedo, (0.1, 0.2, 0.3)),), tuple(replace(q, material=Material(albedo)) for q in quads),
              np.ones(3))
        for albedo in (dark, bright)
    )  # fmt: skip
    asked = queries(one)
    a, b = light(one, asked), light(other, asked)
    assert (b.mean >= a.mean * (1 - 1e-6)).all()


@laws
@given(volumes(), st.floats(0, 0.95), st.floats(0, 2), colors)
def test_light_stays_below_the_brightest_that_can_be_seen(volume, albedo, emission, sky):
    """Radiance from a surface is at most emission / (1 - albedo), from outside the background."""
    scene = Scene((field(volume, [albedo] * 3, [emission] * 3),), background=sky)
    answer = light(scene, queries(scene), bounces=20)
    most = np.pi * np.maximum(sky, emission / (1 - albedo))
    assert (answer.mean <= most * (1 + 1e-6)).all() and (answer.mean >= 0).all()


@laws
@given(volumes(), st.floats(0, 0.9), st.floats(0.1, 2))
def test_a_room_of_lamps_stays_below_the_brightest(volume, albedo, emission):
    """Where lamps are sampled the bound holds for the mean, within its error."""
    around = Material(np.full(3, albedo), np.full(3, emission))
    quads = tuple(replace(q, material=around) for q in box_around(volume)[:6])
    scene = Scene((field(volume, [albedo] * 3),), quads)
    answer = light(scene, queries(scene), paths=64, bounces=20)
    lit = answer.paths > 0
    off = answer.mean[lit].astype(float) - np.pi * emission / (1 - albedo)
    bar = np.sqrt((answer.stderr[lit].astype(float) ** 2).sum())
    assert off.sum() <= 5 * bar + 1e-4 * off.size


@laws
@given(volumes(), st.integers(0, 2**63), st.integers(0, 79))
def test_a_batch_of_one_is_the_batch(volume, seed, k):
    scene = Scene((field(volume),), background=np.ones(3))
    asked = queries(scene)
    whole, alone = light(scene, asked, seed=seed), light(scene, asked[k : k + 1], seed=seed)
    for name in ("mean", "m2", "paths"):
        np.testing.assert_array_equal(getattr(whole, name)[k : k + 1], getattr(alone, name))


@laws
@given(volumes(), st.sampled_from([0.25, 2.0, 1024.0]), st.sampled_from([0.0, 1.0, -512.0]))
def test_the_unit_of_space_and_of_the_values_changes_no_bit(volume, scale, shift):
    here = Scene((field(volume),), background=np.ones(3))
    moved = Volume(scale * volume.values, np.full(3, shift), volume.spacing * scale)
    there = Scene((replace(here.fields[0], volume=moved, range=scale * here.fields[0].range),), background=np.ones(3))
    asked = queries(here)
    where = np.full(3, shift) + asked.point * scale
    other = Queries(asked.id, where, asked.normal, asked.level * scale, asked.target)
    a, b = light(here, asked), light(there, other)
    np.testing.assert_array_equal(a.paths, b.paths)
    # Away from the origin the last bits of positions go: a grazing path may flip.
    off = np.abs(a.mean - b.mean).max(axis=1)
    assert (off > (1e-6 if shift else 0.0)).mean() <= (0.05 if shift else 0.0)


@laws
@given(volumes(), st.integers(0, 47))
def test_turned_and_mirrored_arrays_hold_the_same_light(volume, which):
    """All 48 permutations and flips of the axes; directions differ, so means are compared within their errors."""
    axes = [p for p in np.ndindex(3, 3, 3) if len(set(p)) == 3][which // 8]
    flips = [k for k in range(3) if which >> k & 1]
    here = Scene((field(volume),), background=np.ones(3))
    values = np.flip(volume.values.transpose(axes), flips)
    turned = Volume(np.ascontiguousarray(values), spacing=volume.spacing[list(axes)])
    there = Scene((replace(here.fields[0], volume=turned),), background=np.ones(3))
    top = np.array(volume.shape) - 1
    index = np.random.default_rng(2).random((60, 3)) * top
    other = index[:, list(axes)]
    other = np.where(np.isin(np.arange(3), flips), top[list(axes)] - other, other)
    a = light(here, Queries.at(here, index_to_world(volume, index)), paths=256)
    b = light(there, Queries.at(there, index_to_world(turned, other)), paths=256, seed=1)
    np.testing.assert_array_equal(a.paths, b.paths)
    bar = np.hypot(a.stderr[:, 0], b.stderr[:, 0])
    sure = (a.paths > 0) & (bar > 0.01)
    if sure.sum() >= 20:
        assert_standard_normal((a.mean[:, 0] - b.mean[:, 0])[sure] / bar[sure])


@laws
@given(sizes, st.floats(0.05, 0.9), st.integers(0, 4))
def test_where_the_field_shows_nothing_the_walls_have_their_closed_form(shape, albedo, bounces):
    """A level beyond the data is an empty set: walls of albedo a and emission 1 - a receive π (1 - a^(B+1))."""
    values = np.zeros(shape, np.float32)
    values[0, 0, 0] = 1.0
    volume = Volume(values)
    quads = tuple(
        replace(q, material=Material(np.full(3, albedo), np.full(3, 1 - albedo))) for q in box_around(volume)[:6]
    )
    scene = Scene((Field("f", volume, range=(0.5, 3.0)),), quads)
    points = np.array([q.corner + 0.3 * q.edge_u + 0.6 * q.edge_v for q in quads])
    asked = Queries(
        np.arange(6, dtype=np.uint64), points, np.array([q.normal for q in quads]), np.full((6, 1), 2.0),
        np.arange(1, 7, dtype=np.int32),
    )  # fmt: skip
    answer = light(scene, asked, paths=256, bounces=bounces)
    z = (answer.mean - np.pi * (1 - albedo ** (bounces + 1))) / np.hypot(answer.stderr, 1e-3)
    assert np.abs(z).max() < 6
