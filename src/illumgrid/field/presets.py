"""Scenes around one volume that need more than a sky: the light of a photographer's studio."""

import numpy as np

from illumgrid.field.lights import Distant, Light, Sky
from illumgrid.field.scene import Field, Scene
from illumgrid.field.upright import sky_axes
from illumgrid.field.volume import Floats

ALBEDO = (0.65, 0.65, 0.65)
"""A neutral grey, dark enough that light between folds does not wash out their shadows."""
GROUND = 0.4
"""Albedo of the floor: darker than the object, so that shadows remain visible."""
KEY, DOME = "key", "dome"
AZIMUTH, ELEVATION, ANGLE = -20.0, 40.0, 25.0
"""Of the key, in degrees: 50 to the left of the default view (itself 30 to the right of the front); half-angle."""
RATIO = 16.0
"""Irradiance by the key over that by the dome, on a surface that faces the key."""
WARM, COOL = (1.03, 1.0, 0.94), (0.92, 0.99, 1.09)


def studio_lights(scene: Scene) -> tuple[Light, ...]:
    """A soft warm key from the upper left front and a dim cool dome; together as bright as a sky of radiance 1."""
    back, up = sky_axes(scene)[1:]
    right = sky_axes(scene)[0]
    azimuth, elevation = np.radians((AZIMUTH, ELEVATION))
    towards: Floats = np.cos(elevation) * (np.sin(azimuth) * right - np.cos(azimuth) * back) + np.sin(elevation) * up
    share = RATIO / (1 + RATIO)
    return (
        Distant(KEY, towards, ANGLE, share * np.pi * np.array(WARM)),
        Sky(DOME, (1 - share) * np.array(COOL)),
    )


def studio(field: Field) -> Scene:
    """One field in the light of a studio: see `Scene.studio`."""
    return Scene((field,), lights=studio_lights(Scene((field,))))
