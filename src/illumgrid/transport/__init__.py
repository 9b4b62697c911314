"""Queries and samples: the input and output of light transport, and the protocols of the stages."""
