"""Connected components of flat cells, numbered plane by plane, compiled: imported on first use, no state."""

import numpy as np

from illumgrid.compiled import njit

jit = njit(_nrt=False)


@jit
def root(parent, number):
    """The first of the numbers that stand for the same component."""
    while parent[number] != number:
        parent[number] = parent[parent[number]]
        number = np.int64(parent[number])
    return number


@jit
def joined(parent, one, other):
    """Join the components of two numbers and return a number for both; -1 stands for none."""
    if one < 0 or one == other:
        return other
    if other < 0:
        return one
    one, other = root(parent, one), root(parent, other)
    parent[max(one, other)] = min(one, other)
    return min(one, other)


@jit
def number_cells(flat, plane, parent, size, first, before, count):
    """Number the marked cells of a slab; cells that share a face belong to one piece.

    Parameters
    ----------
    flat : (nx, ny, nz) bool
        Marked cells.
    plane : (ny, nz) int32
        Numbers of the cells ahead of the slab, -1 where not marked; in the end those of its last plane.
    parent, size, first : (m,) int32, int64, int64
        Of each number: another one of its piece, the cells of the piece, its first cell. The first `count` are known;
        m is `count` and one more for every two cells.
    before : int
        Flat number of the first cell of the slab.
    count : int
        How many numbers there are.

    Returns
    -------
    count : int
        How many numbers there are now. `parent` then leads to the first of a piece at once, whose records are true.
    """
    nx, ny, nz = flat.shape
    for number in range(count):
        parent[number] = number
    for i in range(nx):
        for j in range(ny):
            last = np.int64(-1)
            for k in range(nz):
                if not flat[i, j, k]:
                    plane[j, k] = -1
                    last = np.int64(-1)
                    continue
                mine = joined(parent, last, np.int64(plane[j, k]))
                if j:
                    mine = joined(parent, mine, np.int64(plane[j - 1, k]))
                if mine < 0:
                    mine = count
                    parent[mine], size[mine] = mine, 0
                    first[mine] = before + (i * ny + j) * nz + k
                    count += 1
                size[mine] += 1
                plane[j, k] = mine
                last = mine
    for number in range(count - 1, -1, -1):
        whole = root(parent, number)
        parent[number] = whole
        if whole != number:
            size[whole] += size[number]
            first[whole] = min(first[whole], first[number])
    for j in range(ny):
        for k in range(nz):
            if plane[j, k] >= 0:
                plane[j, k] = parent[plane[j, k]]
    return count
