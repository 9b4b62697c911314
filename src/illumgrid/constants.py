"""Numbers that several rooms must agree on; frozen."""

PATHS = 32
"""Paths from every query when nothing else is asked for."""

DENSITY, LONGEST = 1.2, 150
"""Nodes per voxel along an axis, and nodes along the longest axis at most, when nothing else is asked for.

At similar cost, more accurate than 1 node per voxel with 64 paths on three of four real volumes, though not on the
smoothest; half the error on one (``benchmarks/chart.py defaults``). Nodes on voxels are the worst place for noisy data.
"""
