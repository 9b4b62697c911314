"""A backend for illumgrid: light transport by Mitsuba 3, with any of its materials."""

import importlib.util
import json
from dataclasses import dataclass
from typing import ClassVar

from illumgrid.stages import hookimpl

OLDEST_LLVM = 16
"""With LLVM 15 the code of Mitsuba 3.9 ends the process: `fmaximum` cannot be selected."""


@dataclass(frozen=True)
class Mitsuba:
    """Paths by Mitsuba 3 over the meshes of the level sets, with materials of its own where they are described.

    Parameters
    ----------
    bsdf : str
        Material of the surface in Mitsuba's own terms, a word or JSON: dielectric, or {"type": "roughplastic"}; by
        default the field is Lambertian, of its albedo.
    medium : str
        Participating medium in the solid, as JSON, lengths in world units: {"type": "homogeneous", "sigma_t": 2.0}.
    field : str
        Name of the field that `bsdf` and `medium` are of; by default the first.
    """

    name: ClassVar[str] = "mitsuba"
    contract: ClassVar[int] = 2
    geometry: ClassVar[str] = "mesh"
    bsdf: str = ""
    medium: str = ""
    field: str = ""

    def __post_init__(self):
        for option in ("bsdf", "medium"):
            described(option, getattr(self, option))

    @classmethod
    def available(cls):
        """None, or what would make it so."""
        if importlib.util.find_spec("mitsuba") is None:
            return "pip install mitsuba"
        import drjit

        there = drjit.has_backend(drjit.JitBackend.LLVM)
        found = drjit.detail.llvm_version()[0] if there else 0
        if found < OLDEST_LLVM:
            came = f"version {found} was found" if there else "none was found"
            return f"install LLVM {OLDEST_LLVM} or newer, such as libllvm19 of Debian ({came})"
        return None

    def prepare(self, scene):
        """Describe what all level sets share; their meshes are built on request."""
        from illumgrid_mitsuba.tracer import MitsubaTracer

        return MitsubaTracer(self, scene)

    def solve(self, scene, queries, *, paths, bounces, seed):
        """Trace paths from every query: see `illumgrid.stages.Backend`."""
        return self.prepare(scene).solve(queries, paths=paths, bounces=bounces, seed=seed)


def described(option, text):
    """The dictionary that a description stands for; None if there is none."""
    if not text:
        return None
    try:
        found = json.loads(text) if text.lstrip().startswith("{") else {"type": text.strip()}
    except ValueError as problem:
        raise ValueError(f"{option} is {text!r}, which is no JSON ({problem})") from None
    if not isinstance(found, dict) or not isinstance(found.get("type"), str):
        raise ValueError(f"{option} is {text!r}; expected a word, or JSON with a type")
    return found


@hookimpl
def register_backends():
    """Name the backend to illumgrid."""
    return [Mitsuba]
