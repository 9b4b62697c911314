"""The lights for the page, with which it gathers light by its own rays at rest."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.layers import SKY, resampled
from illumgrid.field.lights import Distant, Harmonics, Sky, projected
from illumgrid.field.upright import sky_axes
from illumgrid.field.volume import Floats
from illumgrid.light import Illumination
from illumgrid.show.viewer.arrays import Bytes, half_planes

MOST_SURFACES = 16
FINEST = 256, 512
"""Rows and columns of an image of the sky in a page."""
_PEAK = 6e4  # largest half float


def described(light: Illumination, names: list[str], into: Bytes) -> dict[str, Any] | None:
    """Exposed lights, each with its number among the page's sliders `names`, -1 if it has none.

    None if the page cannot gather light: for fields that emit, and for more surfaces than `MOST_SURFACES`.
    """
    scene = light.scene
    materials = [field.material for field in scene.fields]
    if any(m.emission.any() for m in materials) or len(scene.fields) + len(scene.quads) > MOST_SURFACES:
        return None

    def weighed(name: str) -> tuple[int, float]:
        known = name in names
        return (names.index(name) if known else -1), light.exposure * (1.0 if known else light.weights.get(name, 1.0))

    axes = sky_axes(scene)
    skies, discs, lamps, images = [], [], [], []
    size = _size([one.radiance for one in scene.lights if isinstance(one, Sky) and one.radiance.ndim == 3])
    for one in (Sky(SKY, scene.background), *scene.lights):
        number, share = weighed(one.name)
        if isinstance(one, Distant):
            cosine = float(np.cos(np.radians(one.angle)))
            color = (share * one.radiance).tolist()
            discs.append({"light": number, "axis": one.direction.tolist(), "cosine": cosine, "color": color})
        elif isinstance(one, Sky) and one.radiance.ndim == 3:
            peak = max(float(one.radiance.max()) / _PEAK, 1e-30)
            offset = into.add(half_planes((smaller(one.radiance, *size) / peak).astype(np.float32)))
            images.append({"light": number, "exposure": share * peak, "offset": offset})
        elif not isinstance(one, Harmonics):
            degree = 1 if one.radiance.ndim == 2 else 0
            skies.append({"light": number, "coefficients": (share * projected(one, degree, axes)).tolist()})
    for k, quad in enumerate(scene.quads):
        if quad.material.emission.any():
            number, share = weighed(quad.light or quad.name)
            lamps.append({"light": number, "wall": k, "color": (share * quad.material.emission).tolist()})
    return {
        "axes": axes.tolist(), "skies": skies, "discs": discs, "lamps": lamps, "images": images, "size": size[::-1],
    }  # fmt: skip


def _size(images: list[Floats]) -> tuple[int, int]:
    """Rows and columns of the finest of some images, at most `FINEST`."""
    rows, columns = np.max([image.shape[:2] for image in images] or [(0, 0)], axis=0)
    return min(int(rows), FINEST[0]), min(int(columns), FINEST[1])


def smaller(image: Floats, rows: int, columns: int) -> NDArray[np.float64]:
    """An image of the sky (h, w, 3) with so many rows and columns: the mean light over each pixel."""
    h, w, _ = image.shape
    image = resampled(image, max(h, rows), max(w, columns))
    h, w, _ = image.shape
    down = _shares(-np.cos(np.linspace(0, np.pi, rows + 1)), -np.cos(np.linspace(0, np.pi, h + 1)))
    across = _shares(np.linspace(0, 1, columns + 1), np.linspace(0, 1, w + 1))
    return np.asarray(np.tensordot(across, np.tensordot(down, image, axes=1), axes=(1, 1)).transpose(1, 0, 2))


def _shares(few: Floats, many: Floats) -> Floats:
    """Share of each part of a line, between these ends, that each of some finer parts covers: one row for each."""
    common = np.minimum(few[1:, None], many[1:]) - np.maximum(few[:-1, None], many[:-1])
    return np.asarray(np.maximum(common, 0.0) / np.diff(few)[:, None])
