"""The light of a wall: a texture over the quad and the sweep."""

from dataclasses import dataclass, field
from itertools import product

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


_NEAR = 2, 1, 1  # rows of the sweep, and texels on either side, that are averaged
_ALIKE = 1.0  # excess over the noise of a squared difference, in units of that noise, at which a weight falls to 1/e


def calmed(
    light: NDArray[np.float32], seen: NDArray[np.float32], error: NDArray[np.float32], support: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Light of a wall with its noise averaged out; shadows stay sharp.

    Each texel becomes the mean of those near it, on the wall and in the sweep, that differ from it by no more than
    their noise; the edge of a shadow differs by more. Means over 3 x 3 texels are compared (A. Buades, B. Coll and
    J.-M. Morel, "A non-local algorithm for image denoising", CVPR 2005), their noise subtracted from the difference.

    Parameters
    ----------
    light : (K, nv, nu, C) float32
        In any channels, all of which get the same weights: a mix of means is the mean of the mix.
    seen : (K, nv, nu, 3) float32
        The same as it was baked, in RGB, which is compared.
    error : (K, nv, nu) float32
        Standard error of `seen`; where it is not finite, light stays as it is.
    support : (K, nv, nu) float32
        0 for a texel without light, which neither gives nor takes.
    """
    from scipy.ndimage import uniform_filter

    if not np.isfinite(error[support > 0]).all():
        return light
    known = (support > 0).astype(np.float32)
    share = np.maximum(uniform_filter(known, (1, 3, 3), mode="constant"), 1e-6)
    noise = uniform_filter(np.where(known > 0, np.square(error), 0), (1, 3, 3), mode="constant") / (9 * share**2)
    mean = uniform_filter(seen * known[..., None], (1, 3, 3, 1), mode="constant") / share[..., None]
    around = tuple((n, n) for n in _NEAR)
    lit, means = (np.pad(a, (*around, (0, 0))) for a in (light, mean))
    noises, knowns = np.pad(noise, around), np.pad(known, around)
    total, weights = np.zeros(light.shape), np.zeros(known.shape)
    for offset in product(*(range(2 * n + 1) for n in _NEAR)):
        at = tuple(slice(o, o + n) for o, n in zip(offset, known.shape))
        both = noise + noises[at]
        excess = np.square(mean - means[at]).mean(axis=-1) / np.maximum(both, 1e-30) - 1
        weight = np.exp(-np.maximum(excess, 0) / _ALIKE) * knowns[at]
        total += weight[..., None] * lit[at]
        weights += weight
    return np.where(known[..., None] > 0, total / np.maximum(weights, 1e-30)[..., None], light).astype(np.float32)
