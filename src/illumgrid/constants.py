"""Numbers that several rooms must agree on; frozen."""

PATHS = 32
"""Paths per query by default."""

DENSITY, LONGEST = 1.2, 150
"""Nodes per voxel along an axis, and the largest number of nodes along the longest axis, by default.

At similar cost, more accurate than 1 node per voxel with 64 paths on three of four real volumes, though not on the
smoothest; half the error on one (``benchmarks/chart.py defaults``). Nodes on voxels are the worst place for noisy data.
"""

BASE, FINEST = 0.85, 300
"""Nodes per voxel along an axis, and nodes along the longest axis at most of the finest level, where a run refines."""

ON_A_VOXEL = 1e-7
"""Index coordinates this close to an integer are rounded to it: a node on a voxel remains there after a round trip
through world coordinates, even at origins 1e5 extents away (1e5 x 128 voxels x 2.2e-16 = 3e-9)."""

BRICK_SHIFT = 2
BRICK = 1 << BRICK_SHIFT
"""Cells along the side of a brick: see `illumgrid.field.bricks`."""

REACH = (1, 2, 3, 4, 6, 8, 16, 1 << 20)
"""Sides, in bricks, of the cubes that a ray may leap over; the last one goes to the border of the field."""

MISS, SURFACE, CAP, BURIED, QUAD = 0, 1, 2, 3, 4
"""What a ray meets: nothing, a level set, a cap, the inside of a solid, a quad."""

NOWHERE, LOST = -1, -2
"""In place of a face: the surface needs none; the query's mesh is out of reach."""

ON_A_WALL = 1e-10
"""A wall reaches this share of its size farther, so that walls joined at an edge leave no gap."""

UNSEEN = 0.2
"""Share of the usual light that features too small for the paths may add or take: measured, docs/light_transport.md."""

SAME_ROW = 1e-6
"""Share of the sweep within which the levels of all fields belong to one row of it."""

OFF_SWEEP = -1.0
"""In place of a row's place in the sweep: the levels belong to no row."""

MOST_FILMS = 64
"""Films that a ray goes straight through before it meets a surface that reflects it."""
