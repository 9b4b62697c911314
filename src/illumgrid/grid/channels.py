"""Channels of light: light is linear, so grids and samples carry as many as a scene needs, and mix them to RGB."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.errors import BadInput
from illumgrid.field.scene import Scene


@dataclass(frozen=True)
class Channels:
    """Names of the channels, and the mix of them that is shown.

    Parameters
    ----------
    names : tuple of str
        C names, those of the channels in an EXR file.
    mix : tuple of (float, float, float)
        What each channel adds to red, green and blue, C rows.
    """

    names: tuple[str, ...]
    mix: tuple[tuple[float, float, float], ...]

    def __len__(self) -> int:
        return len(self.names)

    def rgb(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """Linear RGB (..., 3) of light (..., C): a view where no arithmetic is needed."""
        if self == RGB:
            return light
        if self == GREY:
            return np.broadcast_to(light, (*light.shape[:-1], 3))
        return light @ np.array(self.mix, dtype=np.float32)


RGB = Channels(("R", "G", "B"), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
GREY = Channels(("Y",), ((1.0, 1.0, 1.0),))


def channels_of(scene: Scene) -> Channels:
    """GREY where no material or light of a scene has a colour, else RGB."""
    materials = [f.material for f in scene.fields] + [q.material for q in scene.quads]
    colors = [scene.background, *(m.albedo for m in materials), *(m.emission for m in materials)]
    return GREY if all((color == color[0]).all() for color in colors) else RGB


def channels_for(count: int) -> Channels:
    """The channels of an array that has so many and names none: 1 is grey, 3 is RGB."""
    if count not in (1, 3):
        raise BadInput(f"light of {count} channels came without their names; expected 1 (grey) or 3 (RGB)")
    return GREY if count == 1 else RGB


def stored(light: ArrayLike, channels: Channels | None = None) -> dict[str, Any]:
    """Attributes of a holder of light (..., C): `light`, its `channels` (by default by their count), `values` in RGB.

    Raises
    ------
    BadInput
        If the last axis is not as long as there are channels.
    """
    array = np.asarray(light, dtype=np.float32)
    if channels == GREY and array.shape[-1] == 3 and array.strides[-1] == 0:
        array = array[..., :1]  # the RGB view of grey light, as dataclasses.replace hands it on
    channels = channels_for(array.shape[-1]) if channels is None else channels
    count = array.shape[-1]
    if len(channels) != count:
        raise BadInput(f"light of {count} channels came; expected {len(channels)}: {', '.join(channels.names)}")
    kept = np.ascontiguousarray(array).view()
    values = channels.rgb(kept).view()
    kept.flags.writeable = values.flags.writeable = False
    return {"light": kept, "channels": channels, "values": values}
