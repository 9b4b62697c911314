"""``illumgrid plugins --new``: a package that pip takes and whose tests pass; names and folders that are refused."""

import os
import subprocess
import sys
import tomllib

import pytest

import illumgrid as ig
from illumgrid import registry


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """Puts the package in a folder on the path, as an installation would: module and metadata with its entry point."""
    monkeypatch.setenv(registry.SWITCH, ",".join(d.dist.name for d in registry.entry_points(group="illumgrid")))

    def plugin(folder):
        project = tomllib.loads((folder / "pyproject.toml").read_text("utf-8"))["project"]
        about = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: 0.1.0\n")
        points = project["entry-points"]["illumgrid"].items()
        (about / "entry_points.txt").write_text("[illumgrid]\n" + "".join(f"{k} = {v}\n" for k, v in points))
        monkeypatch.syspath_prepend(folder)
        registry._registry.cache_clear()

    yield plugin
    registry._registry.cache_clear()


def test_the_tests_of_a_new_package_pass_and_its_stage_runs_by_name(call, plugin, tmp_path):
    said = call("plugins", "--new", "my-levels_2", "sampler", "new")
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == [
        *("README.md", "illumgrid_my_levels_2.py", "pyproject.toml", "test_my_levels_2.py"),
    ]
    assert "new/pyproject.toml" in said
    path = os.pathsep.join(p for p in sys.path if p)
    tests = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-W", "ignore::DeprecationWarning", "new"]
    done = subprocess.run(tests, cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True)
    assert done.returncode == 0 and "passed" in done.stdout, done.stdout
    plugin(tmp_path / "new")
    listed = call("plugins")
    assert "my-levels_2  illumgrid-my-levels-2 0.1.0, contract 2\n" in listed
    assert ig.sampler("my-levels_2", count=3).count == 3


def test_a_stage_may_have_the_name_of_a_class_that_its_module_imports(call, plugin, tmp_path):
    call("plugins", "--new", "samples", "backend", "new")
    plugin(tmp_path / "new")
    assert type(ig.backend("samples")).__name__ == "SamplesStage"


def test_what_cannot_be_made_is_refused_and_nothing_is_written(refuse, tmp_path):
    refuse("plugins", "--new", "Big Words", "sampler", "new", words=["'Big Words'", "small letters"])
    refuse("plugins", "--new", "auto", "backend", "new", words=["'auto'"])
    refuse("plugins", "--new", "mine", "camera", "new", words=["'camera'", "sampler, backend or interpolator"])
    refuse("plugins", "--new", "direct", "sampler", "new", words=["'direct'", "illumgrid"])
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("")
    refuse("plugins", "--new", "mine", "sampler", "full", words=["full is there already"])
