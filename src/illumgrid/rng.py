"""Random numbers as a pure function of (seed, query, path, dimension).

Nothing here has a state, so a result does not depend on the number of threads, the size of batches or the order of
work, and NumPy, Numba and plain loops walk the same paths. The functions take NumPy arrays of uint64 (they broadcast)
and are compiled unchanged by Numba. This file is frozen: another stream is another function.

Directions come in pairs of Owen-scrambled Sobol' points: within a pair each aligned run of 2^m paths is a (0, m, 2)-
net: every box of 2^-a by 2^-b with a + b = m, on its lattice, holds exactly one path. So the paths of a query spread
evenly over the hemisphere, however many there are. Pairs are scrambled and shuffled independently ("padding").

References
----------
.. [1] G. L. Steele, D. Lea, C. H. Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014
       (the 64-bit finalizer, with the constants of Stafford's variant 13).
.. [2] pbrt-v4, ``samplers.h``: a stream for each pixel, an offset for each sample and dimension.
.. [3] A. B. Owen, "Randomly permuted (t,m,s)-nets and (t,s)-sequences", Monte Carlo and Quasi-Monte Carlo Methods in
       Scientific Computing, Springer 1995.
.. [4] B. Burley, "Practical hash-based Owen scrambling", JCGT 9(4), 2020 (shuffling and padding).
.. [5] S. Laine, T. Karras, "Stratified sampling for stochastic transparency", EGSR 2011 (hashes whose bits depend on
       lower bits only); N. Vegdahl, "Building a better LK hash", 2021 (their shape here, widened to 64 bits).
.. [6] A. G. M. Ahmed, "An implementation algorithm of 2D Sobol sequence fast, elegant, and compact", EGSR 2024.
"""

import numpy as np

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_UNIT = 2.0**-53
_S1, _S2, _S4, _S8, _S11 = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(8), np.uint64(11)
_S16, _S27, _S30, _S31, _S32 = np.uint64(16), np.uint64(27), np.uint64(30), np.uint64(31), np.uint64(32)
_M1, _M2, _M4 = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333), np.uint64(0x0F0F0F0F0F0F0F0F)
_M8, _M16 = np.uint64(0x00FF00FF00FF00FF), np.uint64(0x0000FFFF0000FFFF)
_M32 = np.uint64(0x00000000FFFFFFFF)
_E1, _E2, _E3 = np.uint64(0x9FB21C651E98DF24), np.uint64(0xD6E8FEB86659FD92), np.uint64(0xA0761D6478BD642E)


def mix(x):  # type: ignore[no-untyped-def]
    """Scramble 64 bits so that each bit of the result depends on all of `x` (a bijection)."""
    x = (x ^ (x >> _S30)) * _FIRST
    x = (x ^ (x >> _S27)) * _SECOND
    return x ^ (x >> _S31)


def stream(seed, query):  # type: ignore[no-untyped-def]
    """Key of the random numbers of one query: both arguments uint64."""
    return mix(mix(seed + _GOLDEN) + query * _GOLDEN)


def draw(key, path, dimension):  # type: ignore[no-untyped-def]
    """Uniform number in [0, 1), independent of all others, for a query's key, a path and a dimension below 65536."""
    return np.float64(mix(key ^ mix((path << _S16) + dimension + _GOLDEN)) >> _S11) * _UNIT


def reverse(x):  # type: ignore[no-untyped-def]
    """The 64 bits of `x` in opposite order."""
    x = ((x >> _S1) & _M1) | ((x & _M1) << _S1)
    x = ((x >> _S2) & _M2) | ((x & _M2) << _S2)
    x = ((x >> _S4) & _M4) | ((x & _M4) << _S4)
    x = ((x >> _S8) & _M8) | ((x & _M8) << _S8)
    x = ((x >> _S16) & _M16) | ((x & _M16) << _S16)
    return (x >> _S32) | (x << _S32)


def pascal(x):  # type: ignore[no-untyped-def]
    """Bit k of the result is the sum over j of binomial(j, k) x_j mod 2: Sobol's second dimension, reversed [6]_."""
    x = x ^ ((x >> _S1) & _M1)
    x = x ^ ((x >> _S2) & _M2)
    x = x ^ ((x >> _S4) & _M4)
    x = x ^ ((x >> _S8) & _M8)
    x = x ^ ((x >> _S16) & _M16)
    return x ^ ((x >> _S32) & _M32)


def upward(x, seed):  # type: ignore[no-untyped-def]
    """Random bijection of 64 bits in which each bit is flipped or not as the lower ones say [5]_."""
    x = x ^ (x * _E1)
    x = (x + seed) * ((seed >> _S32) | _S1)
    x = x ^ (x * _E2)
    return x ^ (x * _E3)


def draw_pair(key, path, pair):  # type: ignore[no-untyped-def]
    """Two uniform numbers in [0, 1) for a query's key, a path and the number of a pair: all uint64, `pair` a scalar.

    Pair 0 takes the points in their order, so that `sharing` holds; the others in an order of their own.
    """
    seed = mix(key ^ mix(pair + _GOLDEN))
    index = path
    if pair != 0:
        index = reverse(upward(reverse(path), seed))
    u = reverse(upward(index, mix(seed + _FIRST)))
    v = reverse(upward(pascal(index), mix(seed + _SECOND)))
    return np.float64(u >> _S11) * _UNIT, np.float64(v >> _S11) * _UNIT


def net_size(first, count):  # type: ignore[no-untyped-def]
    """Size of the largest net, an aligned run of 2^m paths, at the front of `count` > 0 paths from `first` (int)."""
    size = 1
    while first % (2 * size) == 0 and 2 * size <= count:
        size *= 2
    return size


def sharing(along, across):  # type: ignore[no-untyped-def]
    """Mask d for which paths i and i ^ d share `along` bits of pair 0's first number and `across` of its second.

    Read as polynomials over GF(2), the two indices differ by d(x): they share a bits of the first number if x^a divides
    d, and b bits of the second, where `pascal` turns d(x) into d(x + 1), if (x + 1)^b does. So d = x^a (x + 1)^b, of
    degree a + b: in a net of 2^(a + b + 1) paths it leads to the only other path in a box of 2^-a by 2^-b. Scrambling
    keeps boxes.
    """
    mask = 1
    for _ in range(across):
        mask ^= mask << 1
    return mask << along


def shifted_seed(seed: int, shift: int) -> int:
    """Another seed, `shift` further on, within the 64 bits that a seed has."""
    return (seed + shift) % 2**64
