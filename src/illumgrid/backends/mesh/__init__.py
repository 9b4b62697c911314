"""Level sets as meshes: built and kept, a tree over them, and rays that are cast at them."""
