"""Options of a stage: the fields of its dataclass, and values for them from texts."""

import inspect
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any, Literal, NoReturn, get_args, get_origin, get_type_hints

from illumgrid.errors import BadInput

_NUMBERS = {int: "a whole number of 32 bits", float: "a number"}


@dataclass(frozen=True)
class Option:
    """One option of a stage.

    Parameters
    ----------
    name : str
    type : type
        bool, int (of 32 bits), float, str, a Literal of words, or a tuple of numbers.
    default : object
    meaning : str
        Its description in the class's docstring, in one line.
    """

    name: str
    type: Any
    default: Any
    meaning: str


def options(stage: type[Any]) -> tuple[Option, ...]:
    """Options of a stage class, in order."""
    kinds, meanings = get_type_hints(stage), _meanings(stage)
    return tuple(Option(f.name, kinds[f.name], f.default, meanings.get(f.name, "")) for f in fields(stage) if f.init)


def _meanings(stage: type[Any]) -> dict[str, str]:
    """First sentence about each parameter in a numpydoc docstring."""
    _, _, section = inspect.cleandoc(stage.__doc__ or "").partition("Parameters\n----------\n")
    section = re.split(r"\n\S[^\n]*\n---+\n", section)[0]
    found = re.findall(r"^(\w+)\s*:[^\n]*\n((?:[ \t]+[^\n]*(?:\n|$)|\n)*)", section + "\n", re.MULTILINE)
    return {name: re.split(r"(?<=[.;]) (?=[A-Z])", " ".join(text.split()))[0].rstrip(".;") for name, text in found}


def expected(kind: Any) -> str | None:
    """Description of values of this type; None for a type that options cannot have."""
    if kind in _NUMBERS:
        return _NUMBERS[kind]
    if kind is bool:
        return "true or false"
    if kind is str:
        return "a text"
    parts = get_args(kind)
    if get_origin(kind) is Literal and all(isinstance(word, str) for word in parts):
        return " or ".join([", ".join(parts[:-1]), parts[-1]]) if len(parts) > 1 else str(parts[0])
    if get_origin(kind) is tuple and parts and all(p in _NUMBERS for p in parts if p is not ...):
        several = "numbers" if float in parts else "whole numbers"
        return f"{several} joined by commas" if ... in parts else f"{len(parts)} {several} joined by commas"
    return None


def short(kind: Any) -> str:
    """The type as a table shows it: ``int``, ``auto|mesh|levelset``, ``float,float,float``."""
    if get_origin(kind) is Literal:
        return "|".join(get_args(kind))
    if get_origin(kind) is tuple:
        return ",".join("..." if p is ... else p.__name__ for p in get_args(kind))
    return str(getattr(kind, "__name__", kind))


def parse(option: str, value: Any, kind: Any) -> Any:
    """Value of the type `kind` from a text, or from a number or sequence, which is converted to text first.

    Raises
    ------
    BadInput
        If it is not a value of this type.
    """
    text = ",".join(map(str, value)) if isinstance(value, Iterable) and not isinstance(value, str) else str(value)
    try:
        return _value(text, kind)
    except ValueError:
        raise BadInput(f"{option} is {text!r}; expected {expected(kind)}") from None


def _value(text: str, kind: Any) -> Any:
    if kind is str:
        return text
    text = text.strip()
    if kind is bool:
        return {"true": True, "false": False}[text.lower()] if text.lower() in ("true", "false") else _refuse()
    if kind is int:
        return int(text) if abs(int(text)) < 2**31 else _refuse()  # the limit of NumPy and the kernels for counts
    if kind is float:
        return float(text) if not math.isnan(float(text)) else _refuse()
    parts = get_args(kind)
    if get_origin(kind) is Literal:
        return text if text in parts else _refuse()
    texts = text.split(",")
    wanted = parts[:1] * len(texts) if ... in parts else parts
    return tuple(_value(t, k) for t, k in zip(texts, wanted, strict=True))


def _refuse() -> NoReturn:
    raise ValueError
