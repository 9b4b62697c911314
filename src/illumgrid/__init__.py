"""illumgrid: global illumination for every isosurface of a volume at once.

The light is computed once, for all isovalues, into a 3D illumination grid; from then on every isosurface is lit by a
texture lookup (Banks and Beason, "Fast global illumination for visualizing isosurfaces with a 3D illumination grid",
Computing in Science & Engineering, 2007).
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from illumgrid.errors import BadInput, IllumgridWarning
    from illumgrid.grid import GridSpec, IlluminationGrid, WallTexture
    from illumgrid.illumination import Illumination, load, run
    from illumgrid.levelset import isosurface
    from illumgrid.readers import read_scene, read_volume
    from illumgrid.registry import backend, interpolator, sampler
    from illumgrid.samples import Queries, Samples
    from illumgrid.scene import Field, Levels, Material, Quad, Scene, suggest_range
    from illumgrid.volume import Volume

__all__ = [
    "BadInput",
    "Field",
    "GridSpec",
    "IllumgridWarning",
    "Illumination",
    "IlluminationGrid",
    "Levels",
    "Material",
    "Quad",
    "Queries",
    "Samples",
    "Scene",
    "Volume",
    "WallTexture",
    "backend",
    "interpolator",
    "isosurface",
    "load",
    "read_scene",
    "read_volume",
    "run",
    "sampler",
    "suggest_range",
]

_HOMES = {
    "errors": ("BadInput", "IllumgridWarning"),
    "grid": ("GridSpec", "IlluminationGrid", "WallTexture"),
    "illumination": ("Illumination", "load", "run"),
    "levelset": ("isosurface",),
    "readers": ("read_scene", "read_volume"),
    "registry": ("backend", "interpolator", "sampler"),
    "samples": ("Queries", "Samples"),
    "scene": ("Field", "Levels", "Material", "Quad", "Scene", "suggest_range"),
    "volume": ("Volume",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name where it is first used, so that ``import illumgrid`` and ``--help`` are quick."""
    if name == "__version__":
        from importlib.metadata import version

        return version("illumgrid")
    if name not in _HOME:
        raise AttributeError(f"module 'illumgrid' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"illumgrid.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
