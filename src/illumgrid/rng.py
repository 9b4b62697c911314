"""Random numbers as a pure function of (seed, query, path, dimension).

Nothing here has a state, so a result does not depend on the number of threads, the size of batches or the order of
work, and NumPy, Numba and plain loops walk the same paths. The functions take NumPy arrays of uint64 (they broadcast)
and are compiled unchanged by Numba. This file is frozen: another stream is another function.

References
----------
.. [1] G. L. Steele, D. Lea, C. H. Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014
       (the 64-bit finalizer, with the constants of Stafford's variant 13).
.. [2] pbrt-v4, ``samplers.h``: a stream for each pixel, an offset for each sample and dimension.
"""

import numpy as np

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_S16, _S27, _S30, _S31, _S11 = np.uint64(16), np.uint64(27), np.uint64(30), np.uint64(31), np.uint64(11)
_UNIT = 2.0**-53


def mix(x):  # type: ignore[no-untyped-def]
    """Scramble 64 bits so that each bit of the result depends on all of `x` (a bijection)."""
    x = (x ^ (x >> _S30)) * _FIRST
    x = (x ^ (x >> _S27)) * _SECOND
    return x ^ (x >> _S31)


def stream(seed, query):  # type: ignore[no-untyped-def]
    """Key of the random numbers of one query: both arguments uint64."""
    return mix(mix(seed + _GOLDEN) + query * _GOLDEN)


def draw(key, path, dimension):  # type: ignore[no-untyped-def]
    """Uniform number in [0, 1) for a query's key, a path and a dimension below 65536: all uint64."""
    return np.float64(mix(key ^ mix((path << _S16) + dimension + _GOLDEN)) >> _S11) * _UNIT
