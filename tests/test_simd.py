"""Operations on eight numbers at once, compiled or with NUMBA_DISABLE_JIT=1 in NumPy."""

import importlib
import sys

import numba
import numpy as np
import pytest

from illumgrid.backends.simd import (
    address,
    bits,
    choose,
    lane,
    load,
    load_int,
    lowest,
    mask,
    maximum,
    minimum,
    muladd,
    peek,
    places,
    smallest,
    spread,
    spread_int,
    store,
)

pytestmark = pytest.mark.plain
A = np.array([0, 1, 2, 3.5, 1e-30, 7, 1e10, 0.1], np.float32)
B = np.array([5, 1, 0.3, -2, 4, -0.5, 1e-20, 0.1], np.float32)


@numba.njit(error_model="numpy")
def arithmetic(a, b, out):
    x, y, room = load(address(a), 0), load(address(b), 0), address(out)
    store(room, 0, bits(x + y))
    store(room, 8, bits(x - y))
    store(room, 16, bits(x * y))
    store(room, 24, bits(x / y))
    store(room, 32, bits(minimum(x, y)))
    store(room, 40, bits(maximum(x, y)))
    store(room, 48, bits(muladd(spread(2.0), x, spread(np.float32(1.0)))))
    store(room, 56, bits(choose(x < y, x, y)))


def test_arithmetic_is_that_of_numpy():
    out = np.zeros(64, np.int32)
    arithmetic(A, B, out)
    want = [A + B, A - B, A * B, A / B, np.minimum(A, B), np.maximum(A, B), 2 * A + 1, np.minimum(A, B)]
    np.testing.assert_array_equal(out.view(np.float32).reshape(8, 8), want)


@numba.njit(error_model="numpy")
def decisions(a, b, out):
    x, y, room = load(address(a), 0), load(address(b), 0), address(out)
    low = spread_int(np.int32(-8))
    store(room, 0, choose((x <= y) & (x >= y), places(), low))
    store(room, 8, (load_int(address(a), 0) & low) | places())
    store(room, 16, bits(np.float32(1.0)))
    one = mask(x < y), mask(x <= y), mask(x > y), mask((x >= y) | (x < y)), mask(places() == spread_int(np.int32(3)))
    return one, smallest(load_int(room, 0)), lane(x, 3), lowest(40), peek(room, 1), choose(one[0] > 9, 1.0, 2.0)


def test_comparisons_bits_and_choices():
    out = np.zeros(24, np.int32)
    masks, *rest = decisions(A, B, out)
    assert masks == (0b00010001, 0b10010011, 0b01101100, 255, 8)
    assert rest == [-8, 3.5, 3, 1, 1.0]
    assert out[:8].tolist() == [-8, 1, -8, -8, -8, -8, -8, 7]
    np.testing.assert_array_equal(out[8:16], (A.view(np.int32) & -8) | np.arange(8))
    assert out[16] == np.float32(1).view(np.int32)


OTHER = """
import numba

@numba.njit
def number():
    return {number}
"""
USER = """
import other
from illumgrid.backends.simd import cached

@cached(other)
def twice():
    return 2 * other.number()
"""


def test_an_edit_of_another_file_is_not_hidden_by_the_disk_cache(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "user.py").write_text(USER)
    hits = []
    for number in (1, 1, 1000):
        (tmp_path / "other.py").write_text(OTHER.format(number=number))
        for name in ("user", "other"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        twice = importlib.import_module("user").twice
        assert twice() == 2 * number
        if not numba.config.DISABLE_JIT:
            hits.append(sum(twice.entrance.stats.cache_hits.values()))
    assert hits in ([], [0, 1, 0])
