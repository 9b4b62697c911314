"""illumgrid: global illumination for every isosurface of a volume at once.

The light is computed once, for all isovalues, into a 3D illumination grid; from then on every isosurface is lit by a
texture lookup (Banks and Beason, "Fast global illumination for visualizing isosurfaces with a 3D illumination grid",
Computing in Science & Engineering, 2007).
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from illumgrid.chain import load, run
    from illumgrid.errors import BadInput, IllumgridWarning
    from illumgrid.field.boundaries import suggest_range
    from illumgrid.field.levelset import isosurface
    from illumgrid.field.lights import Distant, Sky
    from illumgrid.field.scene import Field, Levels, Material, Quad, Scene
    from illumgrid.field.volume import Volume
    from illumgrid.grid import GridSpec, IlluminationGrid, WallTexture
    from illumgrid.io.points import density
    from illumgrid.io.readers import read_scene, read_volume
    from illumgrid.light import Illumination
    from illumgrid.registry import backend, interpolator, sampler
    from illumgrid.transport.samples import Queries, Samples

# Numba refuses to be imported if this is not a valid number of threads; nothing here uses its threads.
_threads = os.environ.get("NUMBA_NUM_THREADS", "1").strip()
if not _threads.isdecimal() or int(_threads) < 1:
    del os.environ["NUMBA_NUM_THREADS"]

__all__ = [
    "BadInput",
    "Distant",
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
    "Sky",
    "Volume",
    "WallTexture",
    "backend",
    "density",
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
    "chain": ("load", "run"),
    "errors": ("BadInput", "IllumgridWarning"),
    "field.levelset": ("isosurface",),
    "field.boundaries": ("suggest_range",),
    "field.lights": ("Distant", "Sky"),
    "field.scene": ("Field", "Levels", "Material", "Quad", "Scene"),
    "field.volume": ("Volume",),
    "grid": ("GridSpec", "IlluminationGrid", "WallTexture"),
    "io.points": ("density",),
    "io.readers": ("read_scene", "read_volume"),
    "light": ("Illumination",),
    "registry": ("backend", "interpolator", "sampler"),
    "transport.samples": ("Queries", "Samples"),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that ``import illumgrid`` and ``--help`` are quick."""
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
