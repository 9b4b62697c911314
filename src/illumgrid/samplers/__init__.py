"""Samplers, which choose the points of the queries: one file per sampler."""
