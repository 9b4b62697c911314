"""What a command has freed goes back to the system."""

import platform
from pathlib import Path

import numpy as np
import pytest

from illumgrid.cli.heap import return_holes

PART = 1 << 16


def resident():
    return int(Path("/proc/self/statm").read_text("ascii").split()[1]) * 4096


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the allocator of glibc")
def test_holes_in_the_heap_are_returned():
    parts = [np.ones(PART, np.uint8) for _ in range(1000)]  # below the size from which an array has pages of its own
    kept = parts[::10]
    full = resident()
    del parts
    return_holes()
    assert full - resident() > 0.7 * 900 * PART and sum(map(len, kept)) == 100 * PART
