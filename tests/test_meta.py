"""The package as a whole: every module imports alone, every public name exists and has a docstring."""

import inspect
import pkgutil
import subprocess
import sys

import pytest

import illumgrid

MODULES = sorted(
    m.name for m in pkgutil.walk_packages(illumgrid.__path__, "illumgrid.") if not m.name.endswith("__main__")
)

ALONE = """
import importlib, sys
for name in {names}:
    before = set(sys.modules)
    importlib.import_module(name)
    for new in set(sys.modules) - before:
        if new.startswith("illumgrid"):
            del sys.modules[new]
"""


@pytest.mark.parametrize("part", range(2))
def test_every_module_imports_alone_and_without_a_warning(part):
    names = MODULES[part::2]
    assert len(names) > 8
    command = [sys.executable, "-W", "error", "-c", ALONE.format(names=names)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr, done.stderr


def test_every_public_name_is_there_and_explained():
    for name in illumgrid.__all__:
        thing = getattr(illumgrid, name)
        assert thing.__name__ == name
        assert inspect.getdoc(thing) and thing.__doc__.strip()[0].isupper()
        assert thing.__module__.startswith("illumgrid.")
    assert len(set(illumgrid.__all__)) == len(illumgrid.__all__)
    assert set(illumgrid.__all__) <= set(dir(illumgrid))
    assert set(illumgrid._HOME) == set(illumgrid.__all__)


def test_no_module_has_the_name_of_a_public_thing():
    shadowed = {m.split(".")[1] for m in MODULES} & set(illumgrid.__all__)
    assert not shadowed


def test_every_function_of_a_public_class_is_explained():
    for name in illumgrid.__all__:
        thing = getattr(illumgrid, name)
        if inspect.isclass(thing):
            for what, value in vars(thing).items():
                if callable(getattr(value, "__func__", value)) and not what.startswith("_"):
                    assert inspect.getdoc(getattr(thing, what)), f"{name}.{what}"


def test_an_unknown_name_is_an_attribute_error_and_the_version_is_that_of_the_package():
    from importlib.metadata import version

    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = illumgrid.nonsense
    assert illumgrid.__version__ == version("illumgrid")


def test_the_package_is_typed():
    from importlib.resources import files

    assert (files("illumgrid") / "py.typed").is_file()
