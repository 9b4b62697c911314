"""Noisy data in the studio are read by level and normal, unless a grid or another stage is asked for."""

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.field.diagnosis import noisy
from illumgrid.io import partial
from illumgrid.transport import walk
from shapes import ball

RANGE = (0.3, 0.7)


def rough(n=14, strength=0.25):
    smooth = ball(n)
    noise = np.random.default_rng(0).normal(0, strength, smooth.shape)
    return ig.Volume((smooth.values + noise).astype(np.float32), smooth.origin, smooth.spacing)


def lit(scene, **more):
    return ig.run(scene, bounces=1, isovalues=3, judge=False, **more)


def test_noisy_data_are_read_by_level_and_normal_and_every_light_keeps_its_bar():
    scene = ig.Scene.studio(rough(), range=RANGE)
    light = lit(scene)
    assert noisy(scene.fields[0]) and light.recipe["by_normal"] and light.recipe["paths"] == 16
    assert light.recipe["interpolator"] == {"name": "bilateral", "density": 1.0}
    asked = lit(scene, interpolator=ig.interpolator("bilateral", density=1.0), paths=16)
    np.testing.assert_array_equal(light.grids[0].light, asked.grids[0].light)
    known = light.grids[0].support > 0
    assert (
        np.isfinite(light.grids[0].errors[known]).all() and np.isfinite(light.mix(key=2.0).grids[0].error[known]).all()
    )


@pytest.mark.parametrize(
    "what",
    ["smooth", "grid", "sky alone", "in a box", "on a floor"],
)
def test_what_is_smooth_or_asked_for_or_has_walls_is_not(what):
    volume = ball(14) if what == "smooth" else rough()
    make = {"sky alone": ig.Scene.sky, "in a box": ig.Scene.box, "on a floor": ig.Scene.floor}.get(
        what, ig.Scene.studio
    )
    light = lit(make(volume, range=RANGE), paths=2, **({"grid": 17} if what == "grid" else {}))
    assert not light.recipe["by_normal"] and light.recipe["interpolator"]["name"] in ("nearest", "nested")


def test_a_run_of_noisy_data_that_was_stopped_goes_on_to_the_same_bits(call, monkeypatch, tmp_path):
    np.save(tmp_path / "v.npy", rough().values)
    monkeypatch.setattr(walk, "PIECE", 600)
    monkeypatch.setattr(partial, "EVERY", 0.0)
    command = ("run", "v.npy", "--range", "0.3", "0.7", "--isovalues", "3", "--bounces", "1", "--no-preview")
    assert "by level and normal (bilateral)" in call(*command, "-o", "whole")
    real, calls = walk.answer, iter(range(10**6))

    def dying(*work):
        if next(calls) == 3:
            raise KeyboardInterrupt
        return real(*work)

    monkeypatch.setattr("illumgrid.bake.accumulator.answer", dying)
    call(*command, "-o", "out", code=130)
    assert "going on with out.partial" in call(*command, "-o", "out")
    one, other = ig.load("whole"), ig.load("out")
    np.testing.assert_array_equal(one.grids[0].light, other.grids[0].light)
    assert other.recipe["by_normal"] and other.recipe["paths"] == 16
    assert "nothing is left to do" in call(*command, "-o", "out", "--resume")
    assert "16 paths" in call(*command, "--paths", "32", "-o", "out", "--resume")
    more, fresh = ig.load("out"), (call(*command, "--paths", "32", "-o", "fresh"), ig.load("fresh"))[1]
    np.testing.assert_allclose(more.grids[0].light, fresh.grids[0].light, rtol=1e-4, atol=1e-6)
