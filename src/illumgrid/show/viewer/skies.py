"""Light under any smooth sky, for the page: the answers to all basis functions, or principal components that fit.

P.-P. Sloan, J. Hall, J. Hart and J. Snyder, "Clustered principal components for precomputed radiance transfer",
SIGGRAPH 2003, with one cluster.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.layers import layers_of
from illumgrid.field.lights import Harmonics
from illumgrid.field.upright import sky_axes
from illumgrid.field.volume import Floats
from illumgrid.grid.channels import Channels, mixed
from illumgrid.grid.nodes import reachable
from illumgrid.light import Illumination
from illumgrid.show.viewer.arrays import Bytes, half_planes

MOST_BYTES = 18_000_000
"""Bytes of the answers in one page, before compression: a grey field of 128³ voxels and a grid of 96³ nodes then stay
under 25 MB, whatever they hold."""
FEWEST = 12
"""Number of components that must fit; otherwise the grid is thinned."""
FINE = 4
"""The first components are half floats, the others, which are weaker, integers of 8 bits."""


def sky_of(light: Illumination) -> Harmonics | None:
    """The sky of a run that stores the answers to its basis functions."""
    held = [*(grid.channels for grid in light.grids), *(wall.channels for wall in light.walls)]
    skies = [one for one in light.scene.lights if isinstance(one, Harmonics)]
    first = f"{skies[0].name}.0" if skies else ""
    return skies[0] if skies and all(any(n.startswith(f"{first}.") for n in c.names) for c in held) else None


def described(light: Illumination) -> dict[str, Any] | None:
    """The sky for the page: coefficients by basis function and colour, and the axes right, back and up."""
    sky = sky_of(light)
    if sky is None:
        return None
    weights = [light.weights.get(f"{sky.name}.{b}", 1.0) for b in range(len(sky.coefficients))]
    return {
        "coefficients": (sky.coefficients * np.array(weights)[:, None]).tolist(),
        "axes": sky_axes(light.scene).tolist(),
        "exposure": light.exposure,
    }


@dataclass(frozen=True, eq=False)
class Answers:
    """The contribution of each basis function of a sky to nodes.

    Parameters
    ----------
    light : (n, colors, B) float32
        One colour if no surface has any, else three.
    rest : (n, 3) float32
        Light of all sources other than the sky, in the shown mix.
    """

    light: NDArray[np.float32]
    rest: NDArray[np.float32]


def answers(light: Illumination, sky: Harmonics, stored: NDArray[np.float32], channels: Channels) -> Answers:
    """The answers from light (..., C) as a grid or a wall of a run stores it."""
    stored, count = stored.reshape(-1, len(channels)), len(sky.coefficients)
    colors = [c for c in "YRGB" if f"{sky.name}.0.{c}" in channels.names]
    each = [[channels.names.index(f"{sky.name}.{b}.{c}") for b in range(count)] for c in colors]
    mix = np.array(mixed(channels, layers_of(light.scene), light.weights).mix, np.float32)
    mix[np.ravel(each)] = 0.0
    return Answers(stored[:, each], stored @ mix)


def components(light: NDArray[np.float32], most: int) -> tuple[NDArray[np.float32], Floats, float]:
    """At most `most` components of the answers (n, colors, B): values (n, colors, K), basis (K, B), and the error.

    Values times basis are the answers, exactly if K = B. Otherwise the error is the relative root mean square of the
    rest, over nodes and over skies whose coefficients are independent and equally large.
    """
    count = light.shape[-1]
    if most >= count:
        return light, np.eye(count), 0.0
    flat = light.reshape(-1, count)
    squares, vectors = np.linalg.eigh(flat.T.astype(float) @ flat)
    kept = vectors[:, ::-1][:, :most]
    lost = float(np.sqrt(max(0.0, squares[:-most].sum()) / max(squares.sum(), 1e-300)))
    return light @ kept.astype(np.float32), kept.T, lost


def pack_sky(held: Answers, most: int, into: Bytes) -> tuple[list[dict[str, Any]], float]:
    """Planes of half floats, or of steps of 8 bits where they have a `scale`, and what each is, and what is lost.

    A plane has the colour that it adds to, -1 for all, and a `basis` (B,): its weight is the product with the
    coefficients of that colour, or 1 without a basis.
    """
    values, basis, lost = components(held.light, most)
    colors, planes = values.shape[1], []
    for k, row in enumerate(basis):
        for color in range(colors):
            plane, about = values[:, color, k], {"color": color if colors > 1 else -1, "basis": row.tolist()}
            if k < FINE:
                about["offset"] = into.add(half_planes(plane))
            else:
                about["scale"] = float(np.abs(plane).max(initial=1e-30)) / 127
                about["offset"] = into.add(np.round(plane / about["scale"]).astype(np.int8).tobytes())
            planes.append(about)
    if held.rest.any():
        planes += [
            {"color": color, "basis": None, "offset": into.add(half_planes(held.rest[:, color]))} for color in range(3)
        ]
    return planes, lost


def room(light: Illumination) -> float:
    """Bytes that a page has for each value of a component: per lit node or texel, and colour."""
    lit = sum(len(reachable(field, grid.spec)) for field, grid in zip(light.scene.fields, light.grids))
    texels = sum(wall.light[..., 0].size for wall in light.walls)
    colors = 1 if any(name.endswith(".Y") for name in light.grids[0].channels.names) else 3
    return MOST_BYTES / (colors * max(lit + texels, 1))


def fitting(bytes_: float, sky: Harmonics) -> int:
    """Number of components that fit into so many bytes per value."""
    return int(np.clip(bytes_ - FINE, FEWEST, len(sky.coefficients)))
