"""What the page needs of the lights to gather light by rays of its own, while nothing moves."""

from typing import Any

import numpy as np

from illumgrid.field.layers import SKY
from illumgrid.field.lights import Distant, Harmonics, Sky, projected
from illumgrid.field.upright import sky_axes
from illumgrid.light import Illumination

MOST_SURFACES = 16


def described(light: Illumination, names: list[str]) -> dict[str, Any] | None:
    """Lights as the exposure shows them, each with its number among the page's sliders `names`, -1 if it has none.

    None where the page would need more than it holds: under images of the sky, in which a ray finds what is small and
    bright too seldom, beside fields that shine, and with more surfaces than `MOST_SURFACES`.
    """
    scene = light.scene
    materials = [field.material for field in scene.fields]
    images = any(isinstance(one, Sky) and one.radiance.ndim == 3 for one in scene.lights)
    if images or any(m.emission.any() for m in materials) or len(scene.fields) + len(scene.quads) > MOST_SURFACES:
        return None

    def weighed(name: str) -> tuple[int, float]:
        known = name in names
        return (names.index(name) if known else -1), light.exposure * (1.0 if known else light.weights.get(name, 1.0))

    axes = sky_axes(scene)
    skies, discs, lamps = [], [], []
    for one in (Sky(SKY, scene.background), *scene.lights):
        number, share = weighed(one.name)
        if isinstance(one, Distant):
            cosine = float(np.cos(np.radians(one.angle)))
            color = (share * one.radiance).tolist()
            discs.append({"light": number, "axis": one.direction.tolist(), "cosine": cosine, "color": color})
        elif not isinstance(one, Harmonics):
            degree = 1 if one.radiance.ndim == 2 else 0
            skies.append({"light": number, "coefficients": (share * projected(one, degree, axes)).tolist()})
    for k, quad in enumerate(scene.quads):
        if quad.material.emission.any():
            number, share = weighed(quad.light or quad.name)
            lamps.append({"light": number, "wall": k, "color": (share * quad.material.emission).tolist()})
    return {"axes": axes.tolist(), "skies": skies, "discs": discs, "lamps": lamps}
