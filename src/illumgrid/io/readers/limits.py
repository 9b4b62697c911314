"""Limits for the claims of a header: no more than its file can contain and than fits into the free memory."""

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path

from illumgrid.errors import BadInput

DEFLATE = 1032
"""No deflate stream unpacks to more than this many times its own size."""

CHUNK = 1 << 20
"""Bytes read at a time."""

AS_FLOAT = 4
"""Bytes per voxel in memory."""


def check_axes(shape: Sequence[int]) -> None:
    """Refuse shapes other than three axes of at least 2 voxels."""
    size = "x".join(map(str, shape))
    if len(shape) != 3:
        todo = "choose one time step or channel" if len(shape) > 3 else "stack the slices"
        raise BadInput(f"has {len(shape)} axes ({size}); expected three, x, y and z; {todo} and save that")
    if min(shape) < 2:
        todo = "give the whole stack (of single slices, their folder)"
        raise BadInput(f"has {size} voxels; expected at least 2 along each axis; {todo}")


def check_size(promised: int, held: int, memory: int) -> None:
    """Refuse a header that promises more bytes than the file can contain, or that needs more memory than is free."""
    if promised > held:
        raise BadInput(
            f"ends too early: its header promises {promised} bytes of data, the file can hold {held}; expected a whole "
            "file; copy or write it again"
        )
    check_memory(memory)


def check_memory(need: int) -> None:
    """Refuse data that need more bytes of memory than are free."""
    if need > (free := free_memory()):
        raise BadInput(
            f"needs {gigabytes(need)} of memory, {gigabytes(free)} are free; expected less; read a part with --crop or "
            "means over voxels with --downsample"
        )


def gigabytes(count: int) -> str:
    """A number of bytes as text."""
    return f"{count / 1e9:.2g} GB" if count < 1e11 else f"{count / 1e9:.0f} GB"


def free_memory() -> int:
    """Bytes that this process may still take: of the machine, of its control groups, of its address space."""
    free = [_available(), *_left_in_groups()]
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            free.append(limit - int(Path("/proc/self/statm").read_text("ascii").split()[0]) * resource.getpagesize())
    except (ImportError, OSError):  # not on Windows; no /proc on macOS
        pass
    return max(0, min(free))


def _available() -> int:
    try:
        for line in Path("/proc/meminfo").read_text("ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 1 << 62


def _left_in_groups() -> list[int]:
    """Free memory for this process in each control group above it that has a limit (containers, batch systems)."""
    left = []
    try:
        groups = [line.split(":", 2) for line in Path("/proc/self/cgroup").read_text("utf-8").splitlines()]
    except OSError:
        return []
    for _, controllers, place in groups:
        if controllers not in ("", "memory"):
            continue
        root = Path("/sys/fs/cgroup") if controllers == "" else Path("/sys/fs/cgroup/memory")
        most, used = ("max", "current") if controllers == "" else ("limit_in_bytes", "usage_in_bytes")
        inner = root / place.lstrip("/")
        for group in (inner, *inner.parents):
            with contextlib.suppress(OSError, ValueError):
                left += _left_in(group, most, used)
            if group == root:
                break
    return left


def _left_in(group: Path, most: str, used: str) -> list[int]:
    """Free memory of a control group with a limit; pages of files, as of a paged field, count as free."""
    limit = (group / f"memory.{most}").read_text("ascii").strip()
    if limit == "max":
        return []
    lines = (line.split() for line in (group / "memory.stat").read_text("ascii").splitlines())
    held = {name: int(count) for name, count in lines}
    cached = sum(held.get(f"total_{kind}", held.get(kind, 0)) for kind in ("inactive_file", "active_file"))
    return [int(limit) - int((group / f"memory.{used}").read_text("ascii")) + cached]
