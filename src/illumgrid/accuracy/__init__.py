"""How far off a grid is, and what it costs."""
