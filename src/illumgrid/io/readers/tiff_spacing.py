"""The spacing of a TIFF: by OME, LSM, ImageJ, MetaMorph, or its resolution tags."""

import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from illumgrid.field.volume import Floats
from illumgrid.io.readers.stored import Note

UNITS = {
    **dict.fromkeys(("um", "µm", "μm", "micron", "microns", "micrometer", "\\u00b5m", "\\u03bcm"), "µm"),
    **dict.fromkeys(("mm", "millimeter", "millimetre"), "mm"),
    **dict.fromkeys(("nm", "nanometer", "nanometre"), "nm"),
    **dict.fromkeys(("cm", "centimeter", "centimetre"), "cm"),
    **dict.fromkeys(("å", "angstrom", "a"), "Å"),
    **dict.fromkeys(("inch", "in", '"'), "inch"),
    **dict.fromkeys(("m", "meter", "metre"), "m"),
}

PRINTING = {72, 75, 90, 96, 100, 150, 200, 300, 400, 600, 1200}
"""Dots per inch for printing: programs that know nothing of the specimen write them."""

Found = tuple[Floats, str | None, tuple[Note, ...]]
"""Spacing (3,), its unit, and what was assumed."""


def calibrated(tiff: Any, series: int) -> Found:
    """Spacing of a series, its unit, and what was assumed."""
    pixels = _ome_pixels(tiff, series)
    if pixels:
        return _by_ome(pixels)
    if tiff.is_lsm and (about := tiff.lsm_metadata):
        return _checked([1e6 * float(about.get(f"VoxelSize{axis}", 0)) for axis in "XYZ"], "µm")
    if tiff.is_stk and (about := tiff.stk_metadata) and about.get("SpatialCalibration") and about.get("XCalibration"):
        depth = float(np.mean(about.get("ZDistance", 0)))
        unit = _unit(about.get("CalibrationUnits"))
        return _checked([float(about["XCalibration"]), float(about["YCalibration"]), depth], unit)
    x, y = (_size(tiff.pages.first, tag) for tag in ("XResolution", "YResolution"))
    if tiff.is_imagej and (about := tiff.imagej_metadata) is not None:
        unit = _unit(about.get("unit"))
        depth = float(about.get("spacing") or math.nan)
        if unit is None and "spacing" not in about:
            return _by_resolution(tiff, x, y)
        found, unit, notes = _checked([x or 1.0, y or 1.0, abs(depth)], unit)
        if not (x and y):
            text = "does not state the size of its pixels; 1 was assumed, as ImageJ does; give --spacing"
            notes = (*notes, ("spacing", text))
        return found, unit, notes
    return _by_resolution(tiff, x, y)


def channel_names(tiff: Any, series: int) -> Sequence[str]:
    """Names of the channels by OME or LSM; empty if there are none."""
    pixels = _ome_pixels(tiff, series)
    if pixels:
        found = pixels.get("Channel", [])
        return [str(one.get("Name", "")) for one in (found if isinstance(found, list) else [found])]
    if tiff.is_lsm and (about := tiff.lsm_metadata):
        return [str(name) for name in about.get("ChannelColors", {}).get("ColorNames", [])]
    return [str(label) for label in (tiff.imagej_metadata or {}).get("Labels", [])] if tiff.is_imagej else []


def _ome_pixels(tiff: Any, series: int) -> dict[str, Any]:
    """The element Pixels of an image in the OME description."""
    if not tiff.is_ome:
        return {}
    import tifffile

    about = tifffile.xml2dict(tiff.ome_metadata or "").get("OME", {})
    images = about.get("Image", [])
    images = images if isinstance(images, list) else [images]
    pixels = images[series].get("Pixels", {}) if series < len(images) else {}
    return pixels if isinstance(pixels, dict) else {}


def _by_ome(pixels: dict[str, Any]) -> Found:
    scale = {"m": 1e6, "cm": 1e4, "mm": 1e3, "µm": 1.0, "nm": 1e-3, "Å": 1e-4, "inch": 25400.0}
    sizes = []
    for axis in "XYZ":
        size = float(pixels.get(f"PhysicalSize{axis}") or math.nan)
        unit = _unit(pixels.get(f"PhysicalSize{axis}Unit", "µm"))
        sizes.append(size * scale.get(unit or "", math.nan))
    if not any(math.isfinite(size) for size in sizes):
        text = "its OME description does not state the distance between its voxels; 1, 1, 1 was assumed; give --spacing"
        return np.ones(3), None, (("spacing", text),)
    return _checked(sizes, "µm")


def _checked(sizes: Sequence[float], unit: str | None) -> Found:
    """Sizes where they are positive numbers; else that of x, with a word."""
    found = np.array(sizes, float)
    good = np.isfinite(found) & (found > 0)
    if good.all():
        return found, unit, ()
    known = found[good][0] if good.any() else 1.0
    lacking = " and ".join(axis for axis, fine in zip("xyz", good) if not fine)
    text = f"does not state the distance between its voxels along {lacking}; {known:g} was assumed; give --spacing"
    return np.where(good, found, known), unit, (("spacing", text),)


def _by_resolution(tiff: Any, x: float, y: float) -> Found:
    """Resolution tags say how large a picture is printed; slices they do not know."""
    inches = {2: 25.4, 3: 10.0}.get(int(tiff.pages.first.resolutionunit or 1), math.nan)
    width, height = x * inches, y * inches
    dpi = 25.4 / width if width else 0.0
    if not (math.isfinite(width) and width > 0 and height > 0) or (width == height and round(dpi) in PRINTING):
        said = f", only {dpi:.4g} dots per inch, as for printing" if dpi and math.isfinite(dpi) else ""
        text = f"does not state the distance between its voxels{said}; 1, 1, 1 was assumed; give --spacing"
        return np.ones(3), None, (("spacing", text),)
    depth = width if math.isclose(width, height, rel_tol=1e-6) else 1.0
    text = (
        f"its resolution says {width:.4g} x {height:.4g} mm for a pixel, but not the distance between slices; "
        f"{depth:.4g} mm was assumed; give --spacing"
    )
    return np.array([width, height, depth]), "mm", (("spacing", text),)


def _size(page: Any, tag: str) -> float:
    """Length of a pixel by a resolution tag, in its unit; 0 where there is none."""
    found = page.tags.get(tag)
    try:
        above, below = found.value
        return float(below) / float(above)
    except (AttributeError, TypeError, ValueError, ZeroDivisionError):
        return 0.0


def _unit(said: Any) -> str | None:
    text = re.sub(r"\s", "", str(said or "")).lower()
    return UNITS.get(text) or (
        str(said)[:20] if text and text not in ("pixel", "pixels", "null", "none", "1") else None
    )
