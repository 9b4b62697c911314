"""Scenes and statistical tests shared by the tests of light transport."""

import math
from statistics import NormalDist

import numpy as np

from illumgrid.field.scene import Field, Material, Scene
from illumgrid.field.volume import Volume
from illumgrid.stages import on_level_sets
from illumgrid.transport.samples import Queries, join_queries

ALBEDO = np.array([0.8, 0.5, 0.2])
EMISSION = np.array([0.05, 0.3, 0.7])
SKY = np.array([1.0, 0.9, 0.6])


def noise(grays, shape=(6, 6, 6), seed=1, **placement):
    """Raw integer data: every level between 0 and `grays` - 1 passes through voxels."""
    return Volume(np.random.default_rng(seed).integers(0, grays, shape), **placement)


def waves(shape=(7, 6, 8), **placement):
    """A smooth field from -3 to 3, solids and gaps of a few voxels; it touches the border."""
    i, j, k = np.indices(shape)
    return Volume(np.sin(1.1 * i + 0.3) + np.sin(0.9 * j + 0.2 * k) + np.cos(0.8 * k - 0.5 * i), **placement)


def linear(slopes, shape=(6, 7, 5), **placement):
    return Volume(np.tensordot(slopes, np.indices(shape), axes=1), **placement)


def rotation(seed=8):
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def furnace(*volumes, inside="above", albedo=ALBEDO, share=(0.3, 0.7)):
    """Emission 1 - albedo under a white sky: a path that escapes contributes 1, any other 1 - albedo^(B + 1)."""
    albedo = np.asarray(albedo) * np.ones(3)
    fields = []
    for number, volume in enumerate(volumes):
        limits = volume.values.min() + np.array(share) * np.ptp(volume.values)
        side = inside if number == 0 else "below"
        fields.append(Field(f"field {number}", volume, Material(albedo, 1 - albedo), limits, side))
    return Scene(tuple(fields), background=np.ones(3))


def colored(scene, background=SKY):
    """The same solids with light that distinguishes paths."""
    materials = [Material(ALBEDO, EMISSION), Material(ALBEDO[::-1], 0.5 * EMISSION[::-1])]
    fields = (Field(f.name, f.volume, m, f.range, f.inside) for f, m in zip(scene.fields, materials))
    return Scene(tuple(fields), background=background)


def voxels(volume):
    """World positions of all voxel centres."""
    return volume.origin + (np.argwhere(np.ones(volume.shape)) * volume.spacing) @ volume.direction.T


def on_voxels(scene, field=0, first_id=0):
    """One query on each voxel, on the level set through it."""
    return Queries.at(scene, voxels(scene.fields[field].volume), field=field, first_id=first_id)


def on_sets(scene, count=3, points=40, seed=0):
    """Projected queries on some level sets of the common sweep, for every field."""
    rows = scene.levels(np.linspace(0.1, 0.9, count) + 0.003)
    return join_queries(list(on_level_sets(scene, rows, seed, points=points)))


def everywhere(scene):
    """Queries on all voxels of all fields, then projected ones."""
    nodes = [on_voxels(scene, f, first_id=f << 20) for f in range(len(scene.fields))]
    return join_queries([*nodes, on_sets(scene)])


def worth(backend, scene, queries, path, bounces, seed=0):
    """Contribution of one path at each query (n, 3), and which queries are not holes (n,)."""
    answer = backend.solve(scene, queries, paths=range(path, path + 1), bounces=bounces, seed=seed)
    return answer.mean.astype(float) / math.pi, answer.paths == 1


def sidak(tests, level=1e-4):
    """Largest |z| of `tests` independent standard normal numbers that is exceeded with probability `level`."""
    return NormalDist().inv_cdf(0.5 * (1 + (1 - level) ** (1 / tests)))


def assert_standard_normal(z):
    """No |z| is too large, and their mean and mean square are those of standard normal numbers."""
    z = np.asarray(z).ravel()
    worst = np.abs(z).max()
    assert worst < sidak(z.size), f"|z| = {worst:.2f} among {z.size}, at {np.abs(z).argmax()}"
    assert abs(z.mean()) * math.sqrt(z.size) < sidak(2), f"mean z = {z.mean():.3f} of {z.size}"
    excess = (np.mean(z**2) - 1) * math.sqrt(z.size / 2)
    assert excess < sidak(2), f"mean z² = {np.mean(z**2):.3f} of {z.size}"
