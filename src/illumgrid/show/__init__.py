"""Pictures of an `illumgrid.Illumination`: a still picture, a strip, a film, and the interactive page."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from illumgrid.field.upright import UPS
    from illumgrid.show.camera import VIEWS, Camera, fit_camera, widest_row
    from illumgrid.show.engines import ENGINES, choose_engine, too_large_for_meshes
    from illumgrid.show.picture import grid_volume, png, render, strip
    from illumgrid.show.shade import BACKGROUND, CAP_TONE

__all__ = [
    "BACKGROUND", "CAP_TONE", "ENGINES", "UPS", "VIEWS", "Camera", "choose_engine", "fit_camera", "grid_volume", "png",
    "render", "strip", "too_large_for_meshes", "widest_row",
]  # fmt: skip

_HOMES = {
    "show.camera": ("VIEWS", "Camera", "fit_camera", "widest_row"),
    "show.engines": ("ENGINES", "choose_engine", "too_large_for_meshes"),
    "show.picture": ("grid_volume", "png", "render", "strip"),
    "show.shade": ("BACKGROUND", "CAP_TONE"),
    "field.upright": ("UPS",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a name on first use: the engines and Pillow take long to import."""
    if name not in _HOME:
        raise AttributeError(f"module 'illumgrid.show' has no attribute {name!r}")
    return getattr(importlib.import_module(f"illumgrid.{_HOME[name]}"), name)
