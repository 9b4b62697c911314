"""Small fields with known surfaces, synthetic lights, and a helper for the tests of refusals."""

from dataclasses import replace

import numpy as np
import pytest

from illumgrid.errors import BadInput
from illumgrid.field.scene import Scene, level_table
from illumgrid.field.volume import Volume
from illumgrid.grid import GridSpec, IlluminationGrid, WallTexture
from illumgrid.light import Illumination


def rotation(axis, angle):
    """Turn by `angle` about `axis` (Rodrigues)."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


OBLIQUE = rotation((1, 2, 3), 0.7)
MIRRORED = OBLIQUE @ np.diag([1.0, -1.0, 1.0])
DIRECTIONS = {"straight": np.eye(3), "oblique": OBLIQUE, "mirrored": MIRRORED, "flipped": -np.eye(3)}


def sampled(function, shape, origin=(0, 0, 0), spacing=(1, 1, 1), direction=np.eye(3)):  # noqa: B008
    """Volume of the values of a function of world positions (n, 3)."""
    index = np.indices(shape).reshape(3, -1).T
    world = np.asarray(origin) + (index * np.asarray(spacing)) @ np.asarray(direction).T
    return Volume(function(world).reshape(shape), origin, spacing, direction)


def ball(n=20, at=(0, 0, 0), shape=None, **place):
    """1.2 minus the distance from `at`, on -1 to 1: level c is the sphere of radius 1.2 - c."""
    place = place or {"origin": (-1, -1, -1), "spacing": np.full(3, 2 / (n - 1))}
    return sampled(lambda x: 1.2 - np.linalg.norm(x - np.asarray(at), axis=1), shape or (n, n, n), **place)


def sky(volume=None, limits=(0.3, 0.9), **more):
    """One field under a white sky."""
    return Scene.sky(ball() if volume is None else volume, range=limits, **more)


def refused(call, *words):
    """The call raises BadInput with one sentence that contains `words`; returns the sentence."""
    with pytest.raises(BadInput) as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text and ". " not in text
    for word in words:
        assert word in text, text
    return text


def lit(scene, value=1.0, nodes=4):
    """Illumination of constant light, without a run."""
    grids = []
    for field in scene.fields:
        spec = GridSpec.over(field.volume, nodes)
        values = np.full((*spec.shape, 3), value, np.float32)
        grids.append(IlluminationGrid(spec, values, np.zeros(spec.shape), np.ones(spec.shape)))
    walls = [
        WallTexture(np.full((2, *q.texels[::-1], 3), value, np.float32), np.ones((2, *q.texels[::-1])))
        for q in scene.quads
    ]
    return Illumination(scene, level_table(scene, 2), tuple(grids), tuple(walls), {"seed": 0})


def relit(light, number=0, **parts):
    """The same illumination with other values, error or support in one of its grids."""
    grids = list(light.grids)
    grids[number] = replace(grids[number], **parts)
    return replace(light, grids=tuple(grids))
