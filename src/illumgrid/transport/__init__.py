"""Queries and samples: what light transport is asked, and what it answers."""
