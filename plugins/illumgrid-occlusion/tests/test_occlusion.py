"""The backend keeps the promises of all backends, and its own."""

from dataclasses import replace

import numpy as np
import pytest
from illumgrid_occlusion import Occlusion

import illumgrid as ig
from illumgrid.testing import BackendTests


class TestOcclusion(BackendTests):
    stage = Occlusion(radius=4.0)


def slopes(angle):
    """A valley between two planes that rise by `angle` on both sides of x = 0; level c lies c above the bottom."""
    x, _, z = np.indices((33, 33, 33)) - np.array([16, 16, 8])[:, None, None, None]
    return ig.Scene.sky(ig.Volume((np.abs(x) * np.tan(angle) - z).astype(float)), range=(-3.0, 3.0))


def solve(scene, points):
    return Occlusion().solve(scene, ig.Queries.at(scene, points), paths=range(4096), bounces=0, seed=0)


def test_nothing_is_near_a_plane():
    answer = solve(slopes(0.0), [[16, 16, 8], [12, 13.3, 8.0]])
    assert np.allclose(answer.mean, np.pi)


@pytest.mark.parametrize("angle", [0.3, 0.7])
def test_a_valley_hides_what_its_other_side_covers(angle):
    # Half a voxel from the bottom. The other slope is a half plane seen under the angle 2a from the ground up: of the
    # cosine it hides (1 - cos 2a) / 2. It is sin(2a) / 2 away, so that the radius r leaves out what meets it with a
    # cosine below sin(2a) / 2r: a band whose share is at most 2 / pi times that.
    scene, radius = slopes(angle), 12.0
    asked = ig.Queries.at(scene, [[16 - 0.5 * np.cos(angle), 16, 8 + 0.5 * np.sin(angle)]])
    asked = replace(asked, normal=np.array([[np.sin(angle), 0, np.cos(angle)]]))  # not that of smoothed differences
    answer = Occlusion(radius, 0.05).solve(scene, asked, paths=range(4096), bounces=0, seed=0)
    expected, missed = np.pi * (1 + np.cos(2 * angle)) / 2, np.sin(2 * angle) / radius
    slack = 4 * answer.stderr[0, 0]
    assert expected - slack <= answer.mean[0, 0] <= expected + missed + slack


def test_a_quad_within_the_radius_hides_half_the_directions_of_a_point_at_its_foot():
    scene = slopes(0.0)
    wall = ig.Quad("wall", (16.001, -40, 8), (0, 100, 0), (0, 0, 100), ig.Material())
    scene = ig.Scene(scene.fields, (wall,), (1, 1, 1))
    answer = solve(scene, [[16, 16, 8]])
    assert abs(answer.mean[0, 0] - np.pi / 2) < 4 * answer.stderr[0, 0] + 1e-3


def test_the_radius_is_an_option_and_nonsense_is_refused():
    assert ig.backend("occlusion", radius="3.5") == Occlusion(radius=3.5)
    with pytest.raises(ig.BadInput, match="0 < step <= radius"):
        ig.backend("occlusion", radius=0)
