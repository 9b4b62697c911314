"""From scattered answers to a uniform grid: one file an interpolator."""
