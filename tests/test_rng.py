"""Random numbers: nets, uniform, uncorrelated, and the same in NumPy, Numba and loops."""

import math

import numba
import numpy as np
import pytest
from scipy.stats import qmc

from illumgrid import rng
from illumgrid.backends import kernels  # compiles the functions of rng for Numba  # noqa: F401

U = np.uint64


@pytest.fixture(autouse=True)
def wrap():
    with np.errstate(over="ignore"):
        yield


def points(seed, query, paths, pair):
    return rng.draw_pair(rng.stream(U(seed), U(query)), np.asarray(paths, U), U(pair))


@pytest.mark.parametrize("pair", [0, 1, 2, 9])
@pytest.mark.parametrize("start", [0, 1, 5, 2**20 + 3])
def test_aligned_runs_are_nets(pair, start):
    for m in range(11):
        n = 2**m
        u, v = points(7, 1234 + m, np.arange(start * n, (start + 1) * n), pair)
        for a in range(m + 1):
            cell = np.floor(u * 2**a).astype(int) * 2 ** (m - a) + np.floor(v * 2 ** (m - a)).astype(int)
            assert (np.bincount(cell, minlength=n) == 1).all()


def test_without_scrambling_it_is_the_sequence_of_sobol():
    i = np.arange(256, dtype=U)
    ours = np.stack([rng.reverse(i), rng.reverse(rng.pascal(i))], 1) / 2.0**64
    theirs = qmc.Sobol(2, scramble=False).random_base2(8)  # in Gray code: the same set for every power of two
    for m in range(9):
        assert set(map(tuple, ours[: 2**m])) == set(map(tuple, theirs[: 2**m]))


def test_numpy_numba_and_loops_agree_to_the_bit():
    path = np.concatenate([np.arange(50), 2 ** np.arange(8, 62)]).astype(U)
    draw, draw_pair = rng.draw, rng.draw_pair

    @numba.njit
    def compiled(key, path, pair):
        out = np.empty((3, len(path)))
        for i in range(len(path)):
            out[0, i], out[1, i] = draw_pair(key, path[i], pair)
            out[2, i] = draw(key, path[i], pair)
        return out

    for pair in (0, 1, 3):
        key = rng.stream(U(2**63 + 5), U(3 << 40))
        array = np.stack([*draw_pair(key, path, U(pair)), draw(key, path, U(pair))])
        loop = np.array([(*draw_pair(key, p, U(pair)), draw(key, p, U(pair))) for p in path]).T
        assert (array == loop).all() and (array == compiled(key, path, U(pair))).all()
        assert array.min() >= 0 and array.max() < 1 and array.dtype == np.float64


def test_every_point_is_uniform_over_queries_down_to_small_scales():
    key = rng.stream(U(0), np.arange(100_000, dtype=U))
    for path in (0, 1, 3, 63, 2**33):
        for x in (*rng.draw_pair(key, U(path), U(0)), *rng.draw_pair(key, U(path), U(1)), rng.draw(key, U(path), U(0))):
            for scale in (1, 64, 2**20, 2**40):
                counts = np.bincount(((x * scale) % 1 * 64).astype(int), minlength=64)
                chi2 = ((counts - len(key) / 64) ** 2 / (len(key) / 64)).sum()
                assert chi2 < 63 + 6 * math.sqrt(126)  # 100 tests


def test_queries_seeds_and_pairs_are_uncorrelated():
    n, queries = 64, 4000
    key = rng.stream(U(0), np.arange(queries, dtype=U))[:, None]
    other = rng.stream(U(1), np.arange(queries, dtype=U))[:, None]
    path = np.arange(n, dtype=U)[None]
    columns = [*rng.draw_pair(key, path, U(0)), *rng.draw_pair(key, path, U(1)), *rng.draw_pair(other, path, U(0))]
    columns += [rng.draw(key, path, U(0)), np.roll(columns[0], 1, axis=0), np.roll(columns[2], 1, axis=0)]
    for i in range(len(columns)):
        for j in range(i):
            each = ((columns[i] - 0.5) * (columns[j] - 0.5)).mean(axis=1)  # one number a query
            assert abs(each.mean() / (each.std() / math.sqrt(queries))) < 4.9, (i, j)


def test_paths_share_the_bits_that_are_asked_for():
    for along, across in ((0, 0), (1, 0), (0, 1), (3, 2), (2, 3), (4, 4), (7, 5)):
        mask, n = rng.sharing(along, across), 2 ** (along + across + 1)
        assert n // 2 <= mask < n
        for start in (0, 3 * n):
            i = np.arange(n)
            (u, v), (u2, v2) = points(3, 5, start + i, 0), points(3, 5, start + (i ^ mask), 0)
            for one, other, bits in ((u, u2, along), (v, v2, across)):
                assert (np.floor(one * 2**bits) == np.floor(other * 2**bits)).all()
                assert (np.floor(one * 2 ** (bits + 1)) != np.floor(other * 2 ** (bits + 1))).all()
