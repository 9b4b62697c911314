"""An eight-wide bounding volume hierarchy over a triangle mesh, for the rays of `illumgrid.backends.mesh.traversal`."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid.backends import simd
from illumgrid.backends.simd import WIDE, cached

jit = cached(simd)  # no fastmath: an empty box is an infinite one

LINKS = 48  # a node: low x, high x, low y, ... of eight boxes, then eight links
NODE = 64  # elements of a node, with eight to spare: nodes begin on cache lines
IDS = 72  # a leaf: x, y, z of eight first corners, of the second, of the third, then eight numbers of triangles
LEAF = 80
FRAME = 16  # a level of the stack: eight keys and the place of the links
BINS = 16


class Tree(NamedTuple):
    """Bounding volume hierarchy over a mesh that is moved and scaled into [-1, 1]³.

    A link is the place of a node in memory, or minus the place of a leaf.
    """

    memory: NDArray[np.float32]  # nodes, the root first, then leaves
    centre: NDArray[np.float64]  # (3,) the point that becomes the origin
    scale: float  # a power of two
    depth: int  # nodes from the root to the deepest one


@jit
def half_area(box):
    """Half the surface of a box (6,)."""
    x, y, z = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    return x * y + y * z + z * x


@jit
def enclose(box, other):
    """Grow a box until it contains the other one."""
    for a in range(3):
        box[a] = min(box[a], other[a])
        box[3 + a] = max(box[3 + a], other[3 + a])


@jit
def nothing(boxes):
    """Make boxes (..., 6) empty."""
    boxes[..., :3], boxes[..., 3:] = np.inf, -np.inf


@jit
def split(bounds, order, start, stop):
    """Cut a range of triangles in two where the surface area heuristic is smallest, in bins along each axis.

    `order` is partitioned; the first place of the second part is returned. The cost of n triangles is that of the
    leaves of eight they will fill. Wald, "On fast construction of SAH-based bounding volume hierarchies", 2007.
    """
    middle = np.empty(6)
    nothing(middle)
    for m in range(start, stop):
        box = bounds[order[m]]
        for a in range(3):
            c = box[a] + box[3 + a]
            middle[a], middle[3 + a] = min(middle[a], c), max(middle[3 + a], c)
    boxes, count, factor = np.empty((3, BINS, 6)), np.zeros((3, BINS), np.int64), np.zeros(3)
    nothing(boxes)
    for a in range(3):
        if middle[3 + a] > middle[a]:
            factor[a] = BINS * (1.0 - 1e-6) / (middle[3 + a] - middle[a])
    for m in range(start, stop):
        box = bounds[order[m]]
        for a in range(3):
            k = int((box[a] + box[3 + a] - middle[a]) * factor[a])
            count[a, k] += 1
            enclose(boxes[a, k], box)
    best, axis, place = np.inf, -1, 0
    left, box = np.zeros(BINS), np.empty(6)
    for a in range(3):
        nothing(box)
        n = 0
        for k in range(BINS - 1):
            enclose(box, boxes[a, k])
            n += count[a, k]
            left[k + 1] = half_area(box) * ((n + WIDE - 1) // WIDE) if n > 0 else np.inf
        nothing(box)
        n = 0
        for k in range(BINS - 1, 0, -1):
            enclose(box, boxes[a, k])
            n += count[a, k]
            cost = left[k] + half_area(box) * ((n + WIDE - 1) // WIDE) if n > 0 else np.inf
            if cost < best:
                best, axis, place = cost, a, k
    if axis < 0:  # all centres coincide
        return (start + stop) // 2
    i, j = start, stop
    while i < j:
        box = bounds[order[i]]
        if int((box[axis] + box[3 + axis] - middle[axis]) * factor[axis]) < place:
            i += 1
        else:
            j -= 1
            order[i], order[j] = order[j], order[i]
    return i


@jit
def grow(bounds, order, halt):
    """Binary tree over triangles: (child (m, 2), span (m, 2) in order, box (m, 6)); a leaf has child -1.

    Set from another thread, `halt` (1,) ends it early.
    """
    most = 2 * order.shape[0]
    child, span, box = np.full((most, 2), -1, np.int64), np.zeros((most, 2), np.int64), np.empty((most, 6))
    nothing(box)
    span[0, 1] = order.shape[0]
    made, node = 1, 0
    while node < made and not halt[0]:
        start, stop = span[node]
        for m in range(start, stop):
            enclose(box[node], bounds[order[m]])
        if stop - start > WIDE:
            cut = split(bounds, order, start, stop)
            span[made, 0], span[made, 1], span[made + 1, 0], span[made + 1, 1] = start, cut, cut, stop
            child[node, 0], child[node, 1] = made, made + 1
            made += 2
        node += 1
    return child[:made], span[:made], box[:made]


@jit
def collapse(child, box, halt):
    """Make a binary tree eight-wide: the binary nodes (n, 8) that are children of each wide one, -1 for none.

    By dynamic programming over the surface area heuristic: Ylitie, Karras & Laine, "Efficient incoherent ray
    traversal on GPUs through compressed wide BVHs", HPG 2017. Greedy choice leaves a quarter more nodes.
    """
    count = child.shape[0]
    # cost[n, i]: of the subtree n under at most i roots; left[n, i]: how many of them lie in its first half.
    cost, left = np.full((count, WIDE + 1), np.inf), np.zeros((count, WIDE + 1), np.int64)
    for n in range(count - 1, -1, -1):
        if halt[0]:
            return np.full((1, WIDE), -1, np.int64), np.int64(1)
        first, second = child[n]
        if first < 0:
            cost[n, 1:] = half_area(box[n])
            continue
        for i in range(2, WIDE + 1):
            for k in range(1, i):
                if cost[first, k] + cost[second, i - k] < cost[n, i]:
                    cost[n, i], left[n, i] = cost[first, k] + cost[second, i - k], k
        cost[n, 1] = cost[n, WIDE] + half_area(box[n])
    wide, owner, depth = np.full((count, WIDE), -1, np.int64), np.zeros(count, np.int64), np.ones(count, np.int64)
    todo, share = np.zeros(2 * WIDE, np.int64), np.zeros(2 * WIDE, np.int64)
    made, node = 1, 0
    while node < made:
        todo[0], share[0], waiting, k = owner[node], WIDE, 1, 0
        while waiting > 0:
            waiting -= 1
            n, i = todo[waiting], share[waiting]
            if i > 1 and child[n, 0] >= 0:
                todo[waiting], share[waiting] = child[n, 0], left[n, i]
                todo[waiting + 1], share[waiting + 1] = child[n, 1], i - left[n, i]
                waiting += 2
                continue
            wide[node, k] = n
            k += 1
            if child[n, 0] >= 0:
                owner[made], depth[made] = n, depth[node] + 1
                made += 1
        node += 1
    return wide[:made], depth[:made].max()


@jit
def fill(memory, links, triangles, order, child, span, box, wide):
    """Lay out nodes and leaves; `links` is the same memory as integers."""
    inner, leaf = NODE, wide.shape[0] * NODE
    for node in range(wide.shape[0]):
        base = node * NODE
        for k in range(WIDE):
            n = wide[node, k]
            for a in range(3):
                memory[base + 16 * a + k] = box[n, a] if n >= 0 else np.inf
                memory[base + 16 * a + 8 + k] = box[n, 3 + a] if n >= 0 else -np.inf
            if n >= 0 and child[n, 0] >= 0:
                links[base + LINKS + k] = inner
                inner += NODE
            elif n >= 0:
                links[base + LINKS + k] = -leaf
                for m in range(WIDE):
                    # An empty box becomes a point, which no ray meets.
                    live = span[n, 0] + m < span[n, 1]
                    number = order[span[n, 0] + (m if live else 0)]
                    for j in range(3):
                        for a in range(3):
                            memory[leaf + 24 * j + 8 * a + m] = triangles[number, j if live else 0, a]
                    links[leaf + IDS + m] = number if live else -1
                leaf += LEAF


def aligned(elements: int, dtype: Any) -> NDArray[Any]:
    """Zeros that begin on a cache line, or on a huge page where there are many."""
    line = 64 if elements < 1 << 19 else 1 << 21
    raw = np.zeros(4 * elements + line, np.uint8)
    start = -raw.ctypes.data % line
    return raw[start : start + 4 * elements].view(dtype)


def unit_cube(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Centre (3,) and power of two that move and scale the corners (m, 3, 3) of triangles into [-1, 1]³."""
    if len(corners) == 0:
        return np.zeros(3), 1.0
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    centre = low + 0.5 * (high - low)
    extent = max(float((high - centre).max()), 1e-300)
    return centre, float(2.0 ** -np.ceil(np.log2(extent)))


def build(vertices: ArrayLike, faces: ArrayLike) -> Tree:
    """Build the tree of a mesh.

    Parameters
    ----------
    vertices : array_like (n, 3)
        Finite. Rounded to single precision after the mesh is centred, so far origins and tiny scales do no harm.
    faces : array_like (m, 3) of int

    Returns
    -------
    Tree
    """
    corners = np.asarray(vertices, np.float64).reshape(-1, 3)[np.asarray(faces, np.int64).reshape(-1, 3)]
    centre, scale = unit_cube(corners)
    if len(corners) == 0:
        memory = aligned(NODE, np.float32)
        memory[:LINKS] = np.repeat([np.inf, -np.inf] * 3, WIDE)
        return Tree(memory, centre, scale, 1)
    triangles = ((corners - centre) * scale).astype(np.float32)
    bounds = np.concatenate([triangles.min(axis=1), triangles.max(axis=1)], axis=1)
    order = np.arange(len(triangles))
    halt = np.zeros(1, np.uint8)

    def work() -> tuple[Any, ...]:
        child, span, box = grow(bounds, order, halt)
        return child, span, box, *collapse(child, box, halt)

    with ThreadPoolExecutor(1) as other:  # this thread waits for Ctrl-C
        try:
            child, span, box, wide, depth = other.submit(work).result()
        except BaseException:
            halt[0] = 1
            raise
    leaves = int(np.count_nonzero(child[:, 0] < 0))
    memory = aligned(len(wide) * NODE + leaves * LEAF, np.float32)
    fill(memory, memory.view(np.int32), triangles, order, child, span, box, wide)
    return Tree(memory, centre, scale, int(depth))


def stack_for(*trees: Tree) -> NDArray[np.int32]:
    """Scratch memory for the traversal of any of these trees: one for each thread, for any number of rays."""
    return aligned((max((tree.depth for tree in trees), default=0) + 1) * FRAME, np.int32)
