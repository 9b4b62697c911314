"""Level sets as meshes: built and kept, with a tree over them, and rays against them."""
