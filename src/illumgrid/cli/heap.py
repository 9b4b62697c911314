"""Memory that arrays have left goes back to the system."""

import sys

LARGE = 1 << 23
"""Bytes from which on an array has pages of its own."""
_MMAP_THRESHOLD = -3  # of mallopt, in malloc.h


def return_what_is_freed() -> None:
    """Let each large array have pages of its own, which go with it.

    The allocator of glibc raises that bound by itself, up to 32 MB, and smaller arrays then leave holes in its heap: a
    run of 512³ voxels held 40 MB of them at its peak. Other systems need nothing.
    """
    if not sys.platform.startswith("linux"):
        return
    import ctypes

    set_option = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
    if set_option is not None:
        set_option(_MMAP_THRESHOLD, LARGE)
