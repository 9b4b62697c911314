"""The error of a grid, and its cost."""
