"""Interpolators, from scattered samples to a uniform grid: one file per interpolator."""
