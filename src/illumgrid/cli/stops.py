"""Ctrl-C, SIGTERM and SIGHUP end a command at once, also inside a library that does not check for signals.

Python raises KeyboardInterrupt only when the main thread is back in Python. A filter or a search tree on a large array
is one call that takes many seconds; in this case a thread removes the unfinished files and ends the process.
"""

import os
import select
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType

from illumgrid.io import disk

PATIENCE = 0.4
"""Seconds that the main thread has to raise KeyboardInterrupt."""
AGAIN = 1.0
"""Seconds after which KeyboardInterrupt comes again where nobody has answered it."""

unanswered = [0]
"""The signal that nobody has answered."""
_normal = [False]


def listen(numbers: Sequence[int]) -> None:
    """Raise KeyboardInterrupt on these signals, or else end the process."""
    (came, tell), (raised, note) = os.pipe(), os.pipe()
    seen, ending = [0], threading.RLock()

    def stop(number: int, frame: FrameType | None) -> None:
        seen[0] += 1
        unanswered[0] = number
        with suppress(OSError):
            os.read(came, 4096)
        with suppress(OSError):
            os.write(note, b"!")
        with ending:  # which a thread that ends the process keeps
            raise KeyboardInterrupt

    def watch() -> None:
        while True:
            select.select([came], [], [])
            before = seen[0]
            time.sleep(PATIENCE)
            if any(signal.getsignal(number) is not stop for number in numbers):  # between two renames, or at the end
                continue
            with ending, suppress(BlockingIOError):
                if seen[0] == before and set(os.read(came, 4096)) & set(numbers):
                    _end()

    def insist() -> None:
        while os.read(raised, 1):
            time.sleep(AGAIN)
            while any(signal.getsignal(number) is not stop for number in numbers):
                time.sleep(PATIENCE)
            if unanswered[0]:
                signal.raise_signal(unanswered[0])

    for number in numbers:
        signal.signal(number, stop)
    if os.name == "nt" or not numbers:  # Windows waits for no pipe
        return
    for end in (came, tell, note):
        os.set_blocking(end, False)
    signal.set_wakeup_fd(tell, warn_on_full_buffer=False)
    for work in (watch, insist):
        threading.Thread(target=work, daemon=True).start()


def answered() -> None:
    """Mark a stop as handled. Otherwise it is repeated, since libraries may drop exceptions that they do not expect."""
    unanswered[0] = 0


@contextmanager
def ends_normally() -> Iterator[None]:
    """Within this, a stop is the normal end of a command, such as a server: exit code 0 and no message."""
    _normal[0] = True
    try:
        with suppress(KeyboardInterrupt):
            yield
        answered()
    finally:
        _normal[0] = False


def _end() -> None:
    for place in list(disk.begun):
        shutil.rmtree(place, ignore_errors=True)
    if _normal[0]:
        os._exit(0)
    with suppress(OSError, ValueError):
        clear = "\r\x1b[2K\x1b[?25h" if sys.stderr.isatty() else ""  # a bar of progress, which hides the cursor
        os.write(sys.stderr.fileno(), f"{clear}{sentence()}\n".encode(errors="backslashreplace"))
    os._exit(130)


def sentence() -> str:
    """The message about what a stopped command leaves."""
    done = [f"{place} is written and complete" for place in disk.written if not place.name.endswith(".partial")]
    return f"illumgrid: stopped; {next(iter([*disk.kept, *done]), 'nothing was written')}"
