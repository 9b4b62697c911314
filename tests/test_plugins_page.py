"""The page for authors of plugins: its code works, and it documents every hook and argument."""

import importlib
import inspect
import re
import sys
import tomllib
import unittest
from pathlib import Path

import pytest

import illumgrid as ig
from illumgrid import registry, stages
from shapes import sky

PAGE = (Path(__file__).parents[1] / "docs" / "plugins.md").read_text("utf-8")
MODULES = {name: code for code, name in re.findall(r"```python\n(# (\w+)\.py\n.*?)```", PAGE, re.DOTALL)}


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The modules of the page on the path, with an entry point each."""
    monkeypatch.syspath_prepend(tmp_path)
    about = tmp_path / "page-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: page\nVersion: 1.0\n")
    plugins = [name for name in MODULES if not name.startswith("test_")]
    (about / "entry_points.txt").write_text("[illumgrid]\n" + "\n".join(f"{name} = {name}" for name in plugins))
    for name, code in MODULES.items():
        (tmp_path / f"{name}.py").write_text(code, "utf-8")
        monkeypatch.delitem(sys.modules, name, raising=False)
    registry._registry.cache_clear()
    yield
    registry._registry.cache_clear()


def test_the_stages_of_the_page_run_by_name(installed):
    assert len(MODULES) == 6
    stages = {"sampler": "chance", "backend": "hemisphere", "interpolator": "bins"}
    light = ig.run(sky(), **stages, grid=6, paths=2, bounces=0, isovalues=24, seed=1)
    assert light.recipe["sampler"] == {"name": "chance", "count": 24}
    assert light.recipe["backend"] == {"name": "hemisphere", "up": (0.0, 0.0, 1.0)}
    assert (light.grids[0].support > 0).any()


@pytest.mark.parametrize(("kind", "name"), [("sampler", "chance"), ("backend", "hemisphere"), ("interpolator", "bins")])
def test_the_modules_of_the_page_are_what_the_command_writes(call, tmp_path, kind, name):
    assert "next: pip install -e new" in call("plugins", "--new", name, kind, "new")
    for module in (f"illumgrid_{name}", f"test_{name}"):
        assert f"# {module}.py\n{(tmp_path / 'new' / f'{module}.py').read_text('utf-8')}" == MODULES[module]
    if kind == "sampler":
        assert f"```toml\n{(tmp_path / 'new' / 'pyproject.toml').read_text('utf-8')}```" in PAGE


@pytest.mark.parametrize("name", [name for name in MODULES if name.startswith("test_")])
def test_the_suites_of_the_page_pass(installed, name):
    module = importlib.import_module(name)
    (suite,) = [c for n, c in vars(module).items() if n.startswith("Test")]
    checks = [check for check in dir(suite) if check.startswith("test_")]
    assert len(checks) > 7
    for check in checks:
        try:
            getattr(suite(), check)()
        except unittest.SkipTest:
            assert check == "test_light_is_as_its_closed_forms_say"


def test_the_project_file_of_the_page_names_the_module_of_the_page():
    (text,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    project = tomllib.loads(text)
    assert set(project["project"]["entry-points"]["illumgrid"].values()) <= set(MODULES)


def test_the_present_contract_has_a_row_on_the_page():
    rows = re.findall(r"^\| (\d+) \|", PAGE, re.MULTILINE)
    assert list(map(int, rows)) == list(range(1, stages.CONTRACT + 1))
    assert f"This version of illumgrid is {stages.CONTRACT} " in PAGE


def test_every_hook_and_every_argument_is_on_the_page():
    hooks = [f for f in vars(stages).values() if getattr(f, "illumgrid_spec", None)]
    assert {f.__name__ for f in hooks} == {kind.hook for kind in registry.KINDS.values()}
    for hook in hooks:
        assert f"`{hook.__name__}({', '.join(inspect.signature(hook).parameters)})`" in PAGE
        assert inspect.getdoc(hook)
    methods = (stages.Sampler.queries, stages.Backend.solve, stages.Interpolator.fill)
    for method in methods:
        assert f"`{method.__name__}({str(_bare(method)).removeprefix('(self, ')}`" in PAGE
        for argument in list(inspect.signature(method).parameters)[1:]:
            assert f"`{argument}`" in PAGE, f"{method.__name__} takes {argument}, of which the page says nothing"


def _bare(method):
    """The signature without types."""
    signature = inspect.signature(method)
    bare = [p.replace(annotation=p.empty) for p in signature.parameters.values()]
    return signature.replace(parameters=bare, return_annotation=signature.empty)


def test_the_switch_is_on_the_page():
    assert f"`{registry.SWITCH}=1`" in PAGE
