"""Return freed memory to the system."""

import sys
from typing import Any

LARGE = 1 << 23
"""Bytes from which on an array has pages of its own."""
_MMAP_THRESHOLD = -3  # of mallopt, in malloc.h


def return_what_is_freed() -> None:
    """Give each large array pages of its own, which are returned when it is freed.

    The allocator of glibc raises that bound by itself, up to 32 MB, and smaller arrays then leave holes in its heap: a
    run of 512³ voxels held 40 MB of them at its peak. Other systems need nothing.
    """
    if (set_option := _of_the_allocator("mallopt")) is not None:
        set_option(_MMAP_THRESHOLD, LARGE)


def return_holes() -> None:
    """Return whole pages that smaller arrays have left in the heap.

    The search for a range on 512³ voxels leaves 52 MB, which a run would hold to its end.
    """
    if (trim := _of_the_allocator("malloc_trim")) is not None:
        trim(0)


def _of_the_allocator(name: str) -> Any:
    """A function of glibc; None elsewhere."""
    if not sys.platform.startswith("linux"):
        return None
    import ctypes

    return getattr(ctypes.CDLL(None), name, None)  # musl has none
