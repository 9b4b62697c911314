"""The speed-accuracy chart."""
