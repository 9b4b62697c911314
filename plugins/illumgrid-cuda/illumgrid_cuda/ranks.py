"""Ranks of bricks compared eight at a time within a 64-bit integer, in place of the vector registers of a processor.

The bytes of a brick begin at a multiple of 64: see `illumgrid.field.bricks`.
"""

import numpy as np

HIGH, ONES = np.uint64(0x8080808080808080), np.uint64(0x0101010101010101)
LOW = np.uint64(0x7F7F7F7F7F7F7F7F)
GATHER = np.uint64(0x0102040810204080)
SEVEN, EIGHT, TOP = np.uint64(7), np.uint64(8), np.uint64(56)


def not_below(word, rank):
    """The highest bit of each byte of a word that is not below `rank`, which all bytes of `rank` hold."""
    without_top = (word | HIGH) - (rank & LOW)
    return ((word & ~rank) | (~(word ^ rank) & without_top)) & HIGH


def at_least(base, i, rank):
    """Number whose bit k says that byte i + k, of 64 bytes from byte i on, is not below `rank`."""
    spread, found = np.uint64(rank) * ONES, np.uint64(0)
    for k in range(8):
        high = not_below(word_at(base, i + 8 * k), spread)
        found |= (((high >> SEVEN) * GATHER) >> TOP) << (EIGHT * np.uint64(k))
    return found


def count_below(base, i, rank):
    """How many of the eight bytes from byte i on are below `rank`."""
    high = not_below(word_at(base, i), np.uint64(rank) * ONES)
    return 8 - int(((high >> SEVEN) * ONES) >> TOP)


class Memory:
    """An address in plain Python: an array of bytes, and a place in it."""

    def __init__(self, array, place=0):
        self.array, self.place = array, place

    def __add__(self, step):
        return Memory(self.array, self.place + int(step))


def address(array):
    """Where an array of bytes begins."""
    return Memory(array)


def word_at(base, i):
    """The eight bytes from byte i on, the first of which is the lowest."""
    first = base.place + int(i)
    return np.ascontiguousarray(base.array[first : first + 8]).view("<u8")[0]
