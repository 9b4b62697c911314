"""Where to ask for light: one file a sampler."""
