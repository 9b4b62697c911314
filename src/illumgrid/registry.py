"""Stages by name. Names exist only here and above; everything below is handed objects."""

import difflib
import importlib
from dataclasses import fields
from typing import Any, cast

from illumgrid.errors import BadInput
from illumgrid.stages import Backend, Interpolator, Sampler

_STAGES = {
    "sampler": {"direct": "samplers.direct:Direct", "uniform": "samplers.uniform:Uniform"},
    "backend": {
        "auto": "backends.numba_:Numba",
        "numba": "backends.numba_:Numba",
        "reference": "backends.reference:Reference",
    },
    "interpolator": {"nearest": "interpolators.nearest:Nearest"},
}


def stage_class(kind: str, name: str) -> type[Any]:
    """Class of the stage of this kind ("sampler", "backend", "interpolator") and name.

    Raises
    ------
    BadInput
        On an unknown name; the nearest known one is suggested.
    """
    known = _STAGES[kind]
    if name not in known:
        close = difflib.get_close_matches(name, known, 1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise BadInput(f"no {kind} is named {name!r}; expected one of {', '.join(known)}{hint}")
    module, attribute = known[name].split(":")
    return cast(type[Any], getattr(importlib.import_module(f"illumgrid.{module}"), attribute))


def option_names(kind: str, name: str) -> list[str]:
    """Options of the stage of this kind and name."""
    return [f.name for f in fields(stage_class(kind, name))]


def make(kind: str, name: str, options: dict[str, Any]) -> Any:
    """Stage of this kind and name; options may be texts, which are parsed by the type of the stage's field.

    Raises
    ------
    BadInput
        On an unknown name or option, or a value that its type does not take.
    """
    stage = stage_class(kind, name)
    types = {f.name: f.type for f in fields(stage)}
    values = {}
    for option, value in options.items():
        if option not in types:
            expected = ", ".join(types) or "none: it has no options"
            raise BadInput(f"the {kind} {name!r} has no option {option!r}; expected one of {expected}")
        values[option] = _parse(f"{kind}.{option}", value, types[option]) if isinstance(value, str) else value
    return stage(**values)


def _parse(option: str, text: str, kind: Any) -> Any:
    if kind is bool:
        if text.lower() in ("true", "false"):
            return text.lower() == "true"
        raise BadInput(f"{option} is {text!r}; expected true or false")
    try:
        return kind(text)
    except ValueError:
        raise BadInput(f"{option} is {text!r}; expected {'a whole number' if kind is int else 'a number'}") from None


def sampler(name: str, **options: Any) -> Sampler:
    """Sampler by name: ``sampler("uniform", count=64)``."""
    return cast(Sampler, make("sampler", name, options))


def backend(name: str, **options: Any) -> Backend:
    """Light-transport backend by name: ``backend("numba", threads=1)``."""
    return cast(Backend, make("backend", name, options))


def interpolator(name: str, **options: Any) -> Interpolator:
    """Interpolator by name: ``interpolator("nearest")``."""
    return cast(Interpolator, make("interpolator", name, options))
