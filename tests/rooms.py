"""Rooms of quads, queries on their walls, and a statistical test of a mean."""

import math
from dataclasses import replace

import numpy as np

from illumgrid.field.rooms import box_around
from illumgrid.field.scene import Field, Material, Quad, Scene
from illumgrid.field.volume import Volume
from illumgrid.transport.samples import Queries
from transport import ALBEDO, EMISSION, SKY, noise, rotation, sidak, waves

NOWHERE = 9.0
"""A level that no voxel of `empty` reaches."""


def empty(**placement):
    """A field without a surface at NOWHERE, 2 wide."""
    values = np.zeros((3, 3, 3))
    values[1, 1, 1] = 1
    return Field("empty", Volume(values, **placement), range=(0.5, 10.0))


def painted(quads, albedo, emission=0.0):
    """The same quads of one material."""
    return tuple(replace(q, material=Material(albedo * np.ones(3), emission * np.ones(3))) for q in quads)


def on_quads(scene, count, t=0.5, seed=0, back=False, only=None, first_id=1 << 50):
    """Queries at random places, uniform by area over the quads (or those in `only`), on one row of the sweep."""
    rng = np.random.default_rng(seed)
    quads = scene.quads if only is None else [scene.quads[k] for k in only]
    numbers = np.arange(len(scene.quads)) if only is None else np.array(only)
    area = np.array([q.area for q in quads])
    pick = rng.choice(len(quads), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    corner, along, across, normal = (
        np.array([getattr(q, name) for q in quads])[pick] for name in ("corner", "edge_u", "edge_v", "normal")
    )
    side = np.where(rng.random((count, 1)) < 0.5, -1.0, 1.0) if back == "both" else -1.0 if back else 1.0
    return Queries(
        id=np.arange(first_id, first_id + count, dtype=np.uint64),
        point=corner + u * along + v * across,
        normal=side * normal,
        level=np.tile(scene.levels(t), (count, 1)),
        target=(len(scene.fields) + numbers[pick]).astype(np.int32),
    )


def at_levels(queries, *levels):
    """The same queries with one row of isovalues."""
    return replace(queries, level=np.tile(np.array(levels, float), (len(queries), 1)))


def assert_mean(values, truth, tests=1, slack=0.0):
    """Independent numbers (n, ...) have the mean `truth` up to `slack`, tested with their own standard deviation."""
    values = np.asarray(values, float)
    off = np.abs(values.mean(axis=0) - truth)
    bar = values.std(axis=0, ddof=1) / math.sqrt(len(values))
    assert (bar > 0).all()
    assert (off <= slack + sidak(tests * max(1, off.size)) * bar).all(), f"off by {off}, bar {bar}, slack {slack}"


# Scenes in which paths meet all there is.


def lamp(name, corner, edge_u, edge_v, emission, albedo=0.0):
    return Quad(name, corner, edge_u, edge_v, Material(albedo * np.ones(3), emission), (2, 2))


def box(volume):
    """The preset, with a solid that shines and walls that differ in colour."""
    scene = Scene.box(volume, range=np.quantile(volume.values, [0.4, 0.8]))
    solid = replace(scene.fields[0], material=Material(ALBEDO, EMISSION))
    return replace(scene, fields=(solid,))


def floor(volume):
    """The preset under a coloured sky."""
    scene = Scene.floor(volume, albedo=ALBEDO, range=np.quantile(volume.values, [0.4, 0.8]))
    return replace(scene, background=SKY)


def lamps(volume):
    """Lamps of different power: a slanted one, one that reflects, one seen from behind, one within the solid."""
    scene = floor(volume)
    middle = scene.from_frame((np.array(volume.shape) - 1) * volume.spacing / 2)
    size = ((np.array(volume.shape) - 1) * volume.spacing).max()
    x, y, z = size * volume.direction.T
    return replace(
        scene,
        quads=(
            *scene.quads,
            lamp("slanted", middle + 1.2 * z - 0.3 * x, 0.5 * x + 0.1 * z, 0.2 * x - 0.4 * y, (5, 1, 0.2)),
            lamp("white", middle - 0.9 * x - 0.2 * y, 0.1 * y, 0.3 * z, (30, 40, 50), albedo=0.5),
            lamp("behind", middle + 0.9 * y, 0.3 * x, 0.3 * z, (2, 0, 7)),
            lamp("through", middle - 0.4 * z, 0.6 * x, 0.5 * y + 0.3 * z, (0, 3, 1), albedo=0.2),
        ),
        background=0.3 * SKY,
    )


def two_fields():
    """Two solids between walls; the lattices overlap."""
    left, right = noise(8, spacing=(0.9, 1.1, 0.8)), noise(9, (5, 7, 4), seed=5, origin=(3.3, -0.8, 2.1))
    fields = (
        Field("here", left, Material(ALBEDO, EMISSION), (3.0, 6.0)),
        Field("there", right, Material(ALBEDO[::-1], 0.3 * EMISSION), (3.0, 6.0), "below"),
    )
    return Scene(fields, box_around(left, margin=0.6))


def far(volume):
    """The same volume 1e5 of its extents from the world's origin."""
    extent = (np.array(volume.shape) - 1) * volume.spacing
    return replace(volume, origin=1e5 * extent.max() * np.array([1.0, -1.0, 1.0]))


MIRRORED = rotation() @ np.diag([1.0, -1.0, 1.0])
ROOMS = {
    "box": lambda: box(noise(8)),
    "box, mirrored": lambda: box(noise(256, (4, 6, 5), spacing=(1.0, 0.7, 1.9), direction=MIRRORED)),
    "box, far": lambda: box(far(waves(direction=rotation()))),
    "floor": lambda: floor(waves()),
    "lamps": lambda: lamps(noise(8, (5, 6, 4))),
    "lamps, mirrored": lambda: lamps(waves(spacing=(1.0, 0.7, 1.4), direction=MIRRORED)),
    "two fields": two_fields,
}
