"""Every sampler with every interpolator, from the command line."""

import json

import pytest

QUICK = ["--range", "0.3", "0.9", "--grid", "8", "--paths", "2", "--bounces", "1", "--no-preview"]


@pytest.mark.parametrize("sampler", ["direct", "uniform", "adaptive"])
@pytest.mark.parametrize("interpolator", ["nearest", "bilateral", "splat", "rbf"])
def test_samplers_and_interpolators_go_together(call, tmp_path, sampler, interpolator):
    call("run", "v.npy", *QUICK, "--sampler", sampler, "--interpolator", interpolator, "--isovalues", "3", "-o", "out")
    made = json.loads((tmp_path / "out" / "run.json").read_text("utf-8"))["recipe"]
    assert made["sampler"]["name"] == sampler and made["interpolator"]["name"] == interpolator
    assert made["sampler"].get("count", 3) == 3


def test_the_options_of_the_stages_are_set_by_name(call, refuse, tmp_path):
    stages = ("run", "v.npy", *QUICK, "--sampler", "adaptive", "--interpolator", "splat")
    settings = ["sampler.count=4", "sampler.points=70", "interpolator.neighbours=8"]
    call(*stages, *(word for s in settings for word in ("--set", s)), "-o", "out")
    made = json.loads((tmp_path / "out" / "run.json").read_text("utf-8"))["recipe"]
    assert made["sampler"] == {"name": "adaptive", "count": 4, "points": 70}
    assert made["interpolator"] == {"name": "splat", "neighbours": 8}
    refuse(*stages, "--set", "interpolator.neighbours=0", words=["splat.neighbours is 0", "at least 1"])
