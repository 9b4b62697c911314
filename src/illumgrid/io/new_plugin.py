"""A package with one stage, to start a plugin with: the examples of the documentation under another name."""

import os
import re
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from string import Template

from illumgrid import registry
from illumgrid.errors import BadInput
from illumgrid.io import disk

_USED = ("ClassVar", "Samples")
"""Classes that a template imports, so that a stage cannot have their names."""


def write_plugin(folder: str | os.PathLike[str], name: str, kind: str) -> list[str]:
    """Write a package with a stage and its tests into a new folder; returns the names of its files.

    Parameters
    ----------
    folder : str or path-like
        Must not be there, or be empty.
    name : str
        Of the stage: letters, digits, - and _, beginning with a letter.
    kind : {"sampler", "backend", "interpolator"}

    Raises
    ------
    BadInput
        On a name or kind that is none, or a folder that cannot be written.
    """
    if kind not in registry.KINDS:
        *most, last = registry.KINDS
        raise BadInput(f"the kind of stage is {kind!r}; expected {', '.join(most)} or {last}")
    if not re.fullmatch(r"[a-z][a-z0-9]*([-_][a-z0-9]+)*", name) or name == "auto":
        raise BadInput(f"the name is {name!r}; expected a word of small letters, digits, - and _, other than auto")
    for other in registry.entries():
        if (other.kind, other.name) == (kind, name):
            raise BadInput(f"the {kind} {name!r} is there already, in {other.package}; expected another name")
    written = list(_contents(name, kind))
    disk.write_folder(folder, iter(written))
    return [str(Path(folder) / file) for file, _ in written]


def _contents(name: str, kind: str) -> Iterator[tuple[str, bytes]]:
    package = f"illumgrid-{name.replace('_', '-')}"
    words = {
        "name": name,
        "kind": kind,
        "A": "An" if kind[0] in "aeiou" else "A",
        "package": package,
        "module": package.replace("-", "_"),
        "Stage": "".join(part.capitalize() for part in re.split("[-_]", name)),
    }
    if words["Stage"] in _USED:
        words["Stage"] += "Stage"
    templates = {
        "pyproject.toml": "pyproject",
        "README.md": "readme",
        f"{words['module']}.py": kind,
        f"test_{words['module'].removeprefix('illumgrid_')}.py": f"test_{kind}",
    }
    for file, template in templates.items():
        text = (files("illumgrid.io") / "templates" / f"{template}.txt").read_text("utf-8")
        yield file, Template(text).substitute(words).encode()
