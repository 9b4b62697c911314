"""The identity of a run, everything that determines its light, with digests of large data; differences of runs."""

import hashlib
import json
import pickle
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, is_dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from illumgrid.field.scene import Scene

Record = dict[str, Any]

MACHINE = ("versions", "processor")
"""Entries that may differ with --any-machine: the light may then differ in its last digits."""


def digest(thing: Any) -> str:
    """Digest of dataclasses, arrays, and types of JSON, by content."""
    found = hashlib.sha256()
    take_in(thing, found.update)
    return found.hexdigest()


def take_in(thing: Any, update: Callable[[Any], None]) -> None:
    """Pass the content of a thing to `update`, that of a hash."""
    if is_dataclass(thing) and not isinstance(thing, type):
        update(type(thing).__name__.encode())
        for f in fields(thing):
            update(f.name.encode())
            take_in(getattr(thing, f.name), update)
    elif isinstance(thing, np.ndarray):
        axes = np.argsort([-abs(step) for step in thing.strides], kind="stable")  # as it lies in memory, or in its file
        update(f"{thing.dtype.str}{thing.shape}{axes}".encode())
        for slab in thing.transpose(axes) if thing.ndim > 1 else (thing,):
            update(np.ascontiguousarray(slab).view(np.uint8).data)
    elif isinstance(thing, list | tuple):
        update(f"{len(thing)}[".encode())
        for each in thing:
            take_in(each, update)
    elif thing is None or isinstance(thing, str | int | float | np.generic):
        update(f"{type(thing).__name__} {thing!r}".encode())
    else:
        update(pickle.dumps(thing))


def identity(scene: Scene, stages: Mapping[str, Any], **asked: float | None) -> Record:
    """Everything that determines a run's light, with digests of large data.

    Parameters
    ----------
    scene : Scene
    stages : mapping
        Sampler, backend and interpolator.
    **asked
        Numbers that the user gave.
    """
    given: Record = dict(asked)
    for kind, stage in stages.items():
        options = {name: value for name, value in asdict(stage).items() if name != "threads"}  # no effect on the light
        given |= {kind: {"name": stage.name, **options}}
    given |= machine()
    about = {f"field {field.name!r}": digest(field) for field in scene.fields}
    surroundings = {f.name: digest(getattr(scene, f.name)) for f in fields(scene) if f.name != "fields"}
    return dict(json.loads(json.dumps({**about, **surroundings, **given})))


def machine() -> Record:
    """The part of an identity that describes this machine: `MACHINE`."""
    from llvmlite.binding import get_host_cpu_name

    versions = {name: version(name) for name in ("illumgrid", "numba", "numpy", "scipy")}
    return {"versions": versions, "processor": get_host_cpu_name()}


def differences(one: Record, other: Record) -> list[str]:
    """The differences between two runs, in words."""
    found = []
    for key in sorted(one.keys() | other.keys()):
        a, b = one.get(key), other.get(key)
        if a != b:
            short = all(isinstance(x, str | int | float | None) and len(str(x)) < 20 for x in (a, b))
            found.append(f"{key} ({a}, not {b})" if short else key)
    return found
