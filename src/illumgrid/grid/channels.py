"""Channels of light: since light is linear, grids and samples carry one per light, and mix them to RGB."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.errors import BadInput
from illumgrid.field.layers import Channel, Layer, colors_of, is_grey, layers_of
from illumgrid.field.scene import Scene


@dataclass(frozen=True)
class Channels:
    """Names of the channels, and the mix of them that is shown.

    Parameters
    ----------
    names : tuple of str
        C names, those of the channels in an EXR file.
    mix : tuple of (float, float, float)
        C rows: the contribution of each channel to red, green and blue.
    """

    names: tuple[str, ...]
    mix: tuple[tuple[float, float, float], ...]

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def own(self) -> int:
        """Number of the first channels that are shown unchanged: 1 for grey, 3 for RGB, 0 if the mix is another."""
        for few in (GREY_MIX, RGB_MIX):
            if self.mix[: len(few)] == few and not any(map(any, self.mix[len(few) :])):
                return len(few)
        return 0

    @property
    def mixable(self) -> bool:
        """Whether there are several lights whose weights can be changed, each with its own error.

        Basis functions are too many, and no weighted sum of their errors would say much.
        """
        return len(self) > max(self.own, 1) and not any(re.search(r"\.\d+\.[YRGB]$", name) for name in self.names)

    @property
    def grey(self) -> bool:
        """Whether the light that is shown is grey."""
        return self.own == 1

    def shown(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """The shown mix of light (..., C): grey (..., 1) or linear RGB (..., 3); a view if it is stored so."""
        if self.own:
            return light if self.own == len(self) else light[..., : self.own]
        # Layers and weights may be negative; only their sum is light.
        return np.maximum(light @ np.array(self.mix, dtype=np.float32), np.float32(0))

    def rgb(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """Linear RGB (..., 3) of light (..., C): a view where no arithmetic is needed."""
        shown = self.shown(light)
        return np.broadcast_to(shown, (*light.shape[:-1], 3)) if self.grey else shown


GREY_MIX = ((1.0, 1.0, 1.0),)
RGB_MIX = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
RGB = Channels(("R", "G", "B"), RGB_MIX)
GREY = Channels(("Y",), GREY_MIX)


def columns_of(scene: Scene) -> list[Channel]:
    """The columns for the channels of a scene: all light together, then each of several layers."""
    grey = all(map(is_grey, colors_of(scene)))
    layers = layers_of(scene)
    together = [Channel(None, color) for color in range(1 if grey else 3)]
    return together + [Channel(one, c) for one in layers for c in range(1 if one.grey else 3) if len(layers) > 1]


def channels_of(scene: Scene) -> Channels:
    """The light of the scene as it is, GREY where nothing has a colour, else RGB; then each of several layers.

    The light of the scene as it is is shown; the layers are for other mixes: see `mixed`.
    """
    columns = columns_of(scene)
    together = [column for column in columns if column.layer is None]
    names = GREY.names if len(together) == 1 else RGB.names
    mix = GREY_MIX if len(together) == 1 else RGB_MIX
    layered = columns[len(together) :]
    return Channels((*names, *(c.name for c in layered)), (*mix, *((0.0, 0.0, 0.0) for _ in layered)))


def mixed(channels: Channels, layers: Sequence[Layer], weights: Mapping[str, float]) -> Channels:
    """The same channels, showing these layers multiplied by weights, 1 where none is given.

    Parameters
    ----------
    channels : Channels
        As `channels_of` made them.
    layers : sequence of Layer
        Those of the scene; for a sky in spherical harmonics, possibly with the coefficients of another sky.
    weights : mapping
        From the name of a layer to a number.

    Raises
    ------
    BadInput
        If the channels hold only the sum of several layers, as those of a backend that computes RGB only.
    """
    known, rows = {layer.name: layer for layer in layers}, []
    if len(layers) > 1 and not any("." in name for name in channels.names):
        raise BadInput(
            f"this light has only the sum of {', '.join(known)}; expected channels for each to mix: run it with a "
            "backend and an interpolator that keep them, such as numba and nearest"
        )
    for name in channels.names:
        layer, _, color = name.rpartition(".")
        only = np.array(GREY_MIX[0] if color == "Y" else RGB_MIX["RGB".index(color)])
        if layer:
            rows.append(weights.get(layer, 1.0) * np.array(known[layer].color) * only)
        else:  # all light together is part of a mix only if there is one layer
            rows.append(only * (weights.get(layers[0].name, 1.0) if len(layers) == 1 else 0.0))
    return Channels(channels.names, tuple((float(r), float(g), float(b)) for r, g, b in rows))


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
        array = array[..., :1]  # grey light as RGB, passed on by dataclasses.replace
    channels = channels_for(array.shape[-1]) if channels is None else channels
    count = array.shape[-1]
    if len(channels) != count:
        raise BadInput(f"light of {count} channels came; expected {len(channels)}: {', '.join(channels.names)}")
    kept = np.ascontiguousarray(array).view()
    values = channels.rgb(kept).view()
    kept.flags.writeable = values.flags.writeable = False
    return {"light": kept, "channels": channels, "values": values}
