"""HDF5, and Zarr with codecs that fuzzing makes crash, are read in a process of their own: a crash becomes a message.

The process has limits of memory and time for each request; it hands over raw bytes and JSON, and nothing is unpickled.
"""

import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput

AGAIN = "expected a whole file; copy or write it again"


class Isolated:
    """A file or folder that another process has opened."""

    def __init__(self, process: "subprocess.Popen[bytes]") -> None:
        self.process = process

    def ask(self, packed: bytes = b"", size: int = 0, **what: Any) -> Any:
        """The answer to a request with its limit in bytes of memory: a record, or an array."""
        to, of = self.process.stdin, self.process.stdout
        assert to is not None and of is not None
        try:
            to.write(json.dumps({"packed": len(packed), "bytes": size + len(packed), **what}).encode() + b"\n" + packed)
            to.flush()
            record = json.loads(of.readline())
            raw = bytearray(record.pop("size"))
            if of.readinto(raw) != len(raw):  # type: ignore[attr-defined]
                raise EOFError
        except (OSError, EOFError, json.JSONDecodeError):
            if self.process.wait() == -getattr(signal, "SIGPROF", 0):
                raise BadInput(f"keeps the library that reads it busy without end: it is damaged; {AGAIN}") from None
            raise BadInput(f"ended the library that reads it by a crash: it is damaged; {AGAIN}") from None
        if "memory" in record:
            raise BadInput(f"asks for more memory than its numbers explain: it is damaged; {AGAIN}")
        if "error" in record:
            raise ValueError(record["error"])
        return np.frombuffer(raw, record["dtype"]).reshape(record["shape"]) if raw else record


@contextmanager
def isolated(kind: Literal["hdf5", "zarr"], place: Path, packed: bytes = b"") -> Iterator[Isolated]:
    """Open a file or folder, or the bytes of an unpacked file, in a process of its own."""
    child = [sys.executable, "-P", str(Path(__file__).with_name("child.py")), kind, str(place)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        child, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
    ) as process:
        try:
            opened = Isolated(process)
            opened.ask(packed)
            yield opened
        finally:
            process.kill()


class Part:
    """An array in another process, for `read_box`."""

    def __init__(self, opened: Isolated, name: str, shape: Sequence[int], dtype: Any, chunks: Sequence[int]) -> None:
        self.opened, self.name, self.shape, self.dtype = opened, name, tuple(shape), np.dtype(dtype)
        self.chunks = tuple(chunks)

    def __getitem__(self, index: tuple[Any, ...]) -> NDArray[Any]:
        """A box of it."""
        shape = [min(i.stop, n) - i.start if isinstance(i, slice) else 1 for i, n in zip(index, self.shape)]
        size = (math.prod(shape) + math.prod(self.chunks)) * self.dtype.itemsize
        asked = [[i.start, i.stop] if isinstance(i, slice) else int(i) for i in index]
        return np.asarray(self.opened.ask(size=size, name=self.name, index=asked))
