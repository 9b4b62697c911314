"""The light of a wall: a texture over the quad and the sweep."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class WallTexture:
    """Light on the front of a quad, for every row of the level table.

    Parameters
    ----------
    values : (K, nv, nu, 3) float32
        Irradiance, linear RGB, at the middles of the texels: u along edge_u, v along edge_v.
    support : (K, nv, nu) float32
        1, or 0 for a texel inside a solid, which holds the value of the nearest one outside.
    """

    values: NDArray[np.float32]
    support: NDArray[np.float32]

    def lookup(self, u: ArrayLike, v: ArrayLike, t: ArrayLike) -> NDArray[np.float32]:
        """Irradiance (n, 3) at shares u, v (n,) of the edges and t (n,) of the sweep, all 0 to 1; trilinear."""
        from scipy.ndimage import map_coordinates

        rows, nv, nu, _ = self.values.shape
        place = np.broadcast_arrays(np.asarray(t) * (rows - 1), np.asarray(v) * nv - 0.5, np.asarray(u) * nu - 0.5)
        result = np.zeros((place[0].size, 3), dtype=np.float32)
        for channel in range(3):
            light = self.values[..., channel]
            map_coordinates(light, [p.ravel() for p in place], output=result[:, channel], order=1, mode="nearest")
        return result
