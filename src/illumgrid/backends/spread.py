"""The error of a mean over paths of a Sobol' net, in NumPy: the counterpart of `kernels.moments` for `reference`."""

import numpy as np

from illumgrid.constants import UNSEEN
from illumgrid.field.volume import Floats
from illumgrid.rng import net_size, sharing


def mixed_differences(worth: Floats, many: int) -> Floats:
    """Variance (n, C) of a path from mixed differences in a net (paths, n, C): see `kernels.mixed_differences`."""
    last = len(worth).bit_length() - 3
    i, squarest = np.arange(len(worth) // 4), (last + 1) // 2
    shapes = []
    for a in range(max(0, squarest - 1), min(last, squarest - 2 + many) + 1):
        first, second = sharing(a + 1, last - a), sharing(a, last - a + 1)
        off = worth[i] - worth[i ^ first] - worth[i ^ second] + worth[i ^ first ^ second]
        shapes.append((off**2).mean(axis=0) / 4)
    return np.asarray(np.mean(shapes, axis=0))


def net_variance(worth: Floats) -> Floats:
    """Variance (n, C) with which independent paths would have a net's error (paths, n, C): `kernels.net_variance`."""
    if len(worth) == 2:
        return np.asarray((worth[0] - worth[1]) ** 2 / 2)
    many = 2 if len(worth) > 64 and len(worth).bit_length() % 2 == 0 else 3
    fine = mixed_differences(worth, many)
    if len(worth) < 16:
        return fine
    coarse = np.mean([mixed_differences(part, many) for part in np.split(worth, 4)], axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(fine >= coarse, fine, np.maximum(0.5, fine / coarse) * fine)


def sum_variance(worth: Floats, first: int) -> Floats:
    """Variance (n, C) of the sum of paths (paths, n, C) number `first` on, from the nets in that range."""
    count, total, known, at = len(worth), np.zeros(worth.shape[1:]), 0, 0
    while at < count:
        size = net_size(first + at, count - at)
        if size > 1:
            total += size * net_variance(worth[at : at + size])
            known += size
        at += size
    if known == 0 and count == 2:
        total, known = (worth[0] - worth[1]) ** 2, 2
    return np.asarray(total * count / max(known, 1))


def spread(worth: Floats, first: int, sky: Floats, lamplight: Floats) -> Floats:
    """m2 (n, C) of the mean of paths (paths, n, C) number `first` on, given the light (C,): see `kernels.moments`."""
    count, usual = len(worth), np.maximum(worth.mean(axis=0), sky)
    unseen = (UNSEEN * usual) ** 2 + np.maximum(0.0, worth.max(axis=0) - usual) ** 2 + lamplight**2
    return np.asarray((sum_variance(worth, first) + unseen) * (count - 1) / count)
