"""The lookup, compiled: trilinear values of a lattice at world points. Imported where it is first used."""

from illumgrid.compiled import njit

FAR = 1e300  # as far as a coordinate can be, for one that is infinite


@njit(_nrt=False)
def finite(x):
    """A coordinate that arithmetic keeps finite; 0 for NaN."""
    return min(max(x, -FAR), FAR) if x == x else 0.0


@njit(_nrt=False)
def read(values, origin, direction, spacing, snap, points, result):
    """Fill `result` (n, m) from `values` (nx, ny, nz, m), whose node 0 lies at `origin`, at world points (n, 3).

    Beyond the border the border is read. Within `snap` index units of a node the point is on it. In double precision,
    as one sum over the eight nodes about the point.
    """
    nx, ny, nz, channels = values.shape
    for i in range(points.shape[0]):
        x = finite(points[i, 0]) - origin[0]
        y = finite(points[i, 1]) - origin[1]
        z = finite(points[i, 2]) - origin[2]
        u = (x * direction[0, 0] + y * direction[1, 0] + z * direction[2, 0]) / spacing[0]
        v = (x * direction[0, 1] + y * direction[1, 1] + z * direction[2, 1]) / spacing[1]
        w = (x * direction[0, 2] + y * direction[1, 2] + z * direction[2, 2]) / spacing[2]
        u, v, w = min(max(u, 0.0), nx - 1.0), min(max(v, 0.0), ny - 1.0), min(max(w, 0.0), nz - 1.0)
        a, b, c = min(int(u), nx - 2), min(int(v), ny - 2), min(int(w), nz - 2)
        u, v, w = u - a, v - b, w - c
        u = 0.0 if u < snap else 1.0 if u > 1.0 - snap else u
        v = 0.0 if v < snap else 1.0 if v > 1.0 - snap else v
        w = 0.0 if w < snap else 1.0 if w > 1.0 - snap else w
        w00, w01, w10, w11 = (1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v
        t = 1.0 - w
        for k in range(channels):
            near = (
                w00 * values[a, b, c, k] + w01 * values[a, b + 1, c, k]
                + w10 * values[a + 1, b, c, k] + w11 * values[a + 1, b + 1, c, k]
            )  # fmt: skip
            far = (
                w00 * values[a, b, c + 1, k] + w01 * values[a, b + 1, c + 1, k]
                + w10 * values[a + 1, b, c + 1, k] + w11 * values[a + 1, b + 1, c + 1, k]
            )  # fmt: skip
            result[i, k] = t * near + w * far
