"""Complete files and folders or none: written in a hidden folder beside their place, synced to the disk, then renamed.

The order is that of a database's commit: the bytes of each file, the names in its folder, the rename, the names in the
folder above. A power cut at any moment leaves what was there before or what came new, both whole. The hidden folder is
locked while its process lives; one that nobody holds is removed by the next writer to the same place.
"""

import errno
import os
import re
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from illumgrid.errors import BadInput

ELSEWHERE = "choose another folder"
STOPS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

written: list[Path] = []
"""What this process has put in place, in order, for the message when it is stopped."""
begun: list[Path] = []
"""Hidden folders that are being written; a process that is ended by a thread removes them."""
kept: list[str] = []
"""What a stopped process has kept of its work, as a sentence; empty where there is nothing."""


@contextmanager
def sentences(trouble: str, remedy: str) -> Iterator[None]:
    """Turn any exception into one sentence: what happened and what to do."""
    try:
        yield
    except BadInput as reason:
        if str(reason).endswith((ELSEWHERE, remedy)):
            raise
        raise BadInput(f"{trouble}: {reason}; {remedy}") from reason
    except Exception as reason:  # the EXR library raises RuntimeError, ValueError, UnicodeDecodeError...
        what = reason.strerror if isinstance(reason, OSError) else f"{type(reason).__name__} {reason}"
        raise BadInput(f"{trouble} ({what}); {remedy}") from reason


def sync(place: Path) -> None:
    """Sync a file, or a folder with the files in it, to the disk; raises OSError if that fails."""
    folder = place.is_dir()
    if folder:
        for file in sorted(place.iterdir()):
            _fsync(file, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    if not folder or os.name != "nt":  # Windows cannot open folders
        _fsync(place, os.O_RDWR if os.name == "nt" else os.O_RDONLY)


def _fsync(path: Path, flags: int) -> None:
    handle = os.open(path, flags)
    try:
        os.fsync(handle)
    except OSError as reason:
        if not (path.is_dir() and reason.errno in (errno.EINVAL, errno.ENOTSUP)):  # some network folders cannot
            raise
    finally:
        os.close(handle)


@contextmanager
def held() -> Iterator[None]:
    """Delay Ctrl-C, SIGTERM and SIGHUP to the end of the block: two renames must not be separated."""
    if threading.current_thread() is not threading.main_thread():  # Python interrupts only the main thread
        yield
        return
    came: list[int] = []
    before = {number: signal.getsignal(number) for number in STOPS}
    kept = {number: action for number, action in before.items() if action not in (signal.SIG_IGN, None)}
    try:
        for number in kept:
            signal.signal(number, lambda number, frame: came.append(number))
        yield
    finally:
        for number, action in kept.items():
            signal.signal(number, action)
    if came:
        signal.raise_signal(came[0])


def put(fresh: Path, place: Path, move: Callable[[Path, Path], Any] | None = None) -> None:
    """Sync `fresh` to the disk and rename it to `place`, by `move`; afterwards a power cut changes nothing."""
    sync(fresh)
    with held():
        (move or os.replace)(fresh, place)
        written.append(place)
        if os.name != "nt":
            _fsync(place.parent, os.O_RDONLY)


def make_parents(place: Path) -> None:
    """Make the folders above `place` that are missing."""
    missing = [folder for folder in place.parents if not folder.exists()]
    place.parent.mkdir(parents=True, exist_ok=True)
    for folder in missing if os.name != "nt" else ():
        _fsync(folder.parent, os.O_RDONLY)


@contextmanager
def beside(place: Path) -> Iterator[Path]:
    """Give an empty hidden folder beside `place`, which is gone afterwards; those of dead processes go first."""
    sweep(place)
    with temporary(f".{place.name[:50]}-", place.parent) as work:  # shortened, or the name would be too long
        yield work


@contextmanager
def temporary(prefix: str, above: Path) -> Iterator[Path]:
    """Give a new folder that is locked, and gone afterwards."""
    work, handle = None, None
    try:
        with held():  # a stop comes before it is made, or when it is known
            while work is None:
                work = Path(tempfile.mkdtemp(prefix=prefix, dir=above))
                try:
                    handle = lock(work)
                except FileNotFoundError:  # swept before it was locked
                    work = None
            begun.append(work)
        yield work
    finally:
        if work is not None:
            with held():  # a stop may come again
                shutil.rmtree(work, ignore_errors=True)
            begun.remove(work)
        if handle is not None:
            os.close(handle)


def lock(folder: Path) -> int | None:
    """Lock a folder until the process ends; None if locks are not supported. BlockingIOError if another holds it."""
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.stat(folder)
        return handle
    except (BlockingIOError, FileNotFoundError):
        os.close(handle)
        raise
    except OSError:  # a network folder without locks
        os.close(handle)
        return None


def sweep(place: Path) -> None:
    """Remove the hidden folders that killed writers of `place` left, and restore a run that one had moved aside."""
    if len(place.name) > 50:  # the names of several places begin like this
        return
    pattern = re.compile(re.escape(f".{place.name}-") + "[a-z0-9_]{8}")
    with suppress(OSError):
        for found in [p for p in place.parent.iterdir() if pattern.fullmatch(p.name)]:
            with suppress(OSError):  # another process works in it, or it is not ours
                if found.is_symlink() or not all(p.stem in ("new", "old") for p in found.iterdir()):
                    continue
                handle = lock(found)
                if handle is None:
                    continue
                try:
                    if (found / "old").is_dir() and not os.path.lexists(place):  # killed between two renames
                        (found / "old").rename(place)
                        _fsync(place.parent, os.O_RDONLY)
                    shutil.rmtree(found, ignore_errors=True)
                finally:
                    os.close(handle)


@contextmanager
def fresh_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path beside `path` for a file, and rename it at the end: complete, or absent.

    Raises
    ------
    BadInput
        If it cannot be written.
    """
    place = Path(os.path.abspath(path))
    with sentences(f"{path} could not be written", "choose another place"):
        if place.is_dir():
            raise BadInput(f"{path} is a folder; expected the name of a file")
        make_parents(place)
        with beside(place) as work:
            fresh = work / f"new{place.suffix}"  # libraries choose the format by the ending
            yield fresh
            put(fresh, place)


def write_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file as `fresh_file` does."""
    with fresh_file(path) as fresh:
        fresh.write_bytes(content)


def claim_new(path: str | os.PathLike[str]) -> None:
    """Raise BadInput if something other than an empty folder is at `path`, or if nothing can be written there."""
    place = Path(os.path.abspath(path))
    if place.exists() and not (place.is_dir() and not any(place.iterdir())):
        raise BadInput(f"{path} is there already; expected the name of a new folder: choose another")
    with sentences(f"{path} cannot be written to", ELSEWHERE):
        try_to_write(path)


def try_to_write(path: str | os.PathLike[str]) -> None:
    """Check permissions, quota and read-only disks by writing a byte to a hidden folder where `path` will be."""
    place = Path(os.path.abspath(path))
    above = next(p for p in place.parents if os.path.lexists(p))
    full = sentences(f"{path} could not be written; the disk may be full", ELSEWHERE)
    with beside(above / place.relative_to(above).parts[0]) as work, full:
        (work / "new").write_bytes(b"\n")


def write_folder(path: str | os.PathLike[str], files: Iterator[tuple[str, bytes]]) -> None:
    """Write named files into a new folder beside its place and rename it: complete, or absent.

    Raises
    ------
    BadInput
        If something is there already, before the first file is requested; or if it cannot be written.
    """
    claim_new(path)
    place = Path(os.path.abspath(path))
    with sentences(f"{path} could not be written", "choose another place"):
        make_parents(place)
        with beside(place) as work:
            fresh = work / "new"
            fresh.mkdir()  # with the umask's mode; `work` is closed to others
            for name, content in files:
                (fresh / name).write_bytes(content)
            with suppress(OSError):  # removes only an empty folder
                place.rmdir()
            put(fresh, place, os.rename)
