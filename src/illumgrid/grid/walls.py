"""The light of a wall: a texture over the quad and the sweep."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.grid.channels import Channels, stored


@dataclass(frozen=True, eq=False)
class WallTexture:
    """Light on the front of a quad, for every row of the level table.

    Parameters
    ----------
    values : (K, nv, nu, C) array_like
        Irradiance in C channels, at the middles of the texels: u along edge_u, v along edge_v. Kept as `light`; the
        attribute `values` is its linear RGB, (K, nv, nu, 3) float32, read-only.
    support : (K, nv, nu) float32
        1, or 0 for a texel inside a solid, which holds the value of the nearest one outside.
    channels : Channels, optional
        By default grey for one channel, RGB for three.
    """

    values: NDArray[np.float32]
    support: NDArray[np.float32]
    channels: Channels = None  # type: ignore[assignment]
    light: NDArray[np.float32] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name, value in stored(self.values, self.channels).items():
            object.__setattr__(self, name, value)

    def lookup(self, u: ArrayLike, v: ArrayLike, t: ArrayLike) -> NDArray[np.float32]:
        """Irradiance (n, 3) at shares u, v (n,) of the edges and t (n,) of the sweep, all 0 to 1; trilinear."""
        from scipy.ndimage import map_coordinates

        rows, nv, nu, count = self.light.shape
        place = np.broadcast_arrays(np.asarray(t) * (rows - 1), np.asarray(v) * nv - 0.5, np.asarray(u) * nu - 0.5)
        result = np.zeros((place[0].size, count), dtype=np.float32)
        for channel in range(count):
            light = self.light[..., channel]
            map_coordinates(light, [p.ravel() for p in place], output=result[:, channel], order=1, mode="nearest")
        return np.ascontiguousarray(self.channels.rgb(result))
