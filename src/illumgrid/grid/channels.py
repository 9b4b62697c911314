"""Channels of light: light is linear, so grids and samples carry as many as a scene needs, and mix them to RGB."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.scene import Scene


@dataclass(frozen=True)
class Channels:
    """Names of the channels, and the mix of them that is shown.

    Parameters
    ----------
    names : tuple of str
        C names.
    mix : tuple of (float, float, float)
        What each channel adds to red, green and blue, C rows.
    """

    names: tuple[str, ...]
    mix: tuple[tuple[float, float, float], ...]

    def __len__(self) -> int:
        return len(self.names)

    def rgb(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """Linear RGB (..., 3) of light (..., C); a read-only view where no arithmetic is needed."""
        if self == RGB:
            shown = light.view()
        elif self == GREY:
            shown = np.broadcast_to(light, (*light.shape[:-1], 3))
        else:
            shown = light @ np.array(self.mix, dtype=np.float32)
        shown.flags.writeable = False
        return shown


RGB = Channels(("red", "green", "blue"), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
GREY = Channels(("grey",), ((1.0, 1.0, 1.0),))


def channels_of(scene: Scene) -> Channels:
    """GREY where no material or light of a scene has a colour, else RGB."""
    materials = [f.material for f in scene.fields] + [q.material for q in scene.quads]
    colors = [scene.background, *(m.albedo for m in materials), *(m.emission for m in materials)]
    return GREY if all((color == color[0]).all() for color in colors) else RGB


def channels_for(count: int) -> Channels:
    """The channels that an array of so many has when nobody names them: 1 grey, 3 RGB."""
    if count not in (1, 3):
        raise BadInput(f"light of {count} channels came without their names; expected 1 (grey) or 3 (RGB)")
    return GREY if count == 1 else RGB
