"""What is lit: volumes, scenes, level sets."""
