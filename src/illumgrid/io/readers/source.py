"""Bytes of files: opened safely, unpacked as a stream, with every byte counted and every checksum verified."""

import bz2
import gzip
import io
import math
import os
import stat
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from illumgrid.errors import BadInput
from illumgrid.io.readers.limits import CHUNK, DEFLATE, check_memory
from illumgrid.io.readers.paged import mapped, room

AGAIN = "expected a whole file; copy or write it again"

HEAD = 4096
"""Bytes from which a family is recognised."""

Packing = Literal["raw", "gzip", "zlib", "bzip2"]


@dataclass(frozen=True)
class Source:
    """A regular file, possibly gzipped as a whole."""

    file: Path
    size: int
    """Bytes on disk."""
    head: bytes
    """The first bytes, unpacked."""
    packed: bool
    """Gzipped as a whole: the readers see it unpacked."""

    @property
    def name(self) -> str:
        """File name without the ending .gz."""
        return self.file.stem if self.packed and self.file.suffix.lower() == ".gz" else self.file.name

    @property
    def ending(self) -> str:
        """In lower case, of the unpacked file: ".nii"."""
        return Path(self.name).suffix.lower()

    @property
    def most(self) -> int:
        """Bytes that the unpacked file can have at most."""
        return self.size * DEFLATE if self.packed else self.size

    def most_inside(self, packing: Packing) -> int:
        """Largest number of bytes to which a part can unpack; packing packed data gains nothing."""
        return self.most if packing == "raw" else self.size * (1 << 16 if packing == "bzip2" else DEFLATE)


def open_regular(file: Path) -> IO[bytes]:
    """Open a file for reading; anything but a regular file (a pipe, a device, a socket) is refused without waiting."""
    # Opening a pipe without a writer would block.
    number = os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise BadInput(f"{file.name} is neither a file nor a folder; expected a regular file; copy the data into one")
    return open(number, "rb")


def find_source(file: Path, whole: bool = True) -> Source:
    """Examine the beginning of a file; if it is gzipped as a `whole`, of the unpacked data."""
    with open_regular(file) as stream:
        size = os.fstat(stream.fileno()).st_size
        head = stream.read(HEAD)
    if not (whole and head.startswith(b"\x1f\x8b")):
        return Source(file, size, head, packed=False)
    source = Source(file, size, b"", packed=True)
    with opened(source) as stream:
        return Source(file, size, stream.read(HEAD), packed=True)


@contextmanager
def opened(source: Source) -> Iterator[IO[bytes]]:
    """The file, unpacked, from its beginning; it cannot seek where it is gzipped."""
    with open_regular(source.file) as stream:
        if not source.packed:
            yield stream
            return
        with gzip.open(stream) as unpacked:
            yield io.BufferedReader(unpacked, CHUNK)


@contextmanager
def seekable(source: Source) -> Iterator[IO[bytes]]:
    """The file, unpacked, for libraries that seek; a gzipped file is unpacked into memory."""
    if not source.packed:
        with open_regular(source.file) as stream:
            yield stream
        return
    whole = io.BytesIO()
    with opened(source) as stream:
        while chunk := stream.read(CHUNK):
            check_memory(2 * len(chunk) + whole.tell())  # so that no growing buffer is copied
            whole.write(chunk)
    whole.seek(0)
    yield whole


def beside(source: Source, named: str, follow: bool = False) -> Source:
    """A file that a header names, in the folder of the header or below it; elsewhere only with `follow`.

    It is taken as it is: whether it is packed the header says.
    """
    folder = source.file.parent
    if not named or "\0" in named:
        raise BadInput(f"its header names the data file {named!r}; expected a file beside it; correct the header")
    place = folder / named
    outside = Path(named).is_absolute() or ".." in Path(named).parts or "\\" in named or ":" in named[:2]
    if outside and not follow:
        raise BadInput(
            f"its header names the data file {named!r}, which is not in the folder of the header; expected a file "
            "beside it; copy the data there and write only its name into the header, or allow it with --follow"
        )
    try:
        if not place.exists():
            raise BadInput(f"its data should be in {named}, which is not there; expected both files; copy both")
        if not follow and not place.resolve().is_relative_to(folder.resolve()):
            raise BadInput(
                f"its data file {named} is a link to a place outside the folder of the header; expected a file beside "
                "it; copy the data there, or allow it with --follow"
            )
        return find_source(place, whole=False)
    except OSError as problem:
        raise BadInput(
            f"its data file {named} cannot be read ({problem.strerror}); check its name and rights"
        ) from None


@contextmanager
def inflated(stream: IO[bytes], packing: Packing) -> Iterator[IO[bytes]]:
    """What a packed part of a file unpacks to, as a stream that verifies its checksum where it ends."""
    if packing == "raw":
        yield stream
    elif packing == "gzip":
        with gzip.open(stream) as unpacked:
            yield io.BufferedReader(unpacked, CHUNK)
    elif packing == "bzip2":
        with bz2.open(stream) as plain:
            yield plain
    else:
        yield io.BufferedReader(_Zlib(stream), CHUNK)


class _Zlib(io.RawIOBase):
    """A zlib stream within a file; zlib compares the checksum at its end."""

    def __init__(self, stream: IO[bytes]) -> None:
        self.stream, self.unpack, self.rest = stream, zlib.decompressobj(), b""

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        while not self.unpack.eof:
            packed = self.rest or self.stream.read(CHUNK)
            out = self.unpack.decompress(packed, len(buffer))
            self.rest = self.unpack.unconsumed_tail
            if out:
                buffer[: len(out)] = out
                return len(out)
            if not packed:
                raise EOFError("its packed data end too early")
        return 0


def read_array(
    stream: IO[bytes], dtype: DTypeLike, shape: Sequence[int], order: Literal["C", "F"] = "F"
) -> NDArray[Any]:
    """The next prod(shape) numbers of a stream, or a refusal if it ends before; call `check_size` first.

    What is larger than a quarter of the free memory is paged: see `illumgrid.io.readers.paged`.
    """
    if (whole := mapped(stream, dtype, math.prod(shape))) is not None:
        return whole.reshape(tuple(shape), order=order)
    flat = room([math.prod(shape)], dtype)
    raw = memoryview(flat.view(np.uint8))  # type: ignore[arg-type]
    done = 0
    while done < len(raw):
        got = stream.readinto(raw[done : done + CHUNK])  # type: ignore[attr-defined]
        if not got:
            raise BadInput(f"ends after {done} of {len(raw)} bytes of data; {AGAIN}")
        done += got
    return flat.reshape(tuple(shape), order=order)


def skip(stream: IO[bytes], count: int) -> None:
    """Skip bytes: in a file by seeking, otherwise by reading, which unpacks and verifies them."""
    if isinstance(stream, io.BufferedReader) and isinstance(stream.raw, io.FileIO):
        stream.seek(max(count, 0), os.SEEK_CUR)
        return
    while count > 0 and (chunk := stream.read(min(count, CHUNK))):
        count -= len(chunk)


def read_text(stream: IO[bytes], count: int) -> tuple[NDArray[np.float64], bytes]:
    """The next `count` numbers written as text, separated by white space or commas, and what was read behind them."""
    flat = np.zeros(count)
    done, rest, behind = 0, b"", b""
    while done < count:
        chunk = stream.read(CHUNK)
        text = rest + chunk.replace(b",", b" ")
        cut = len(text) if not chunk else max(text.rfind(b" "), text.rfind(b"\n"), text.rfind(b"\t")) + 1
        text, rest = text[:cut], text[cut:]
        found = text.split(maxsplit=count - done)
        if len(found) > count - done:
            behind = found.pop()
        try:
            words = np.array(found, dtype=float)
        except ValueError as problem:
            raise BadInput(
                f"holds something that is not a number ({str(problem)[-60:]}); expected {count} numbers; correct it"
            ) from None
        flat[done : done + len(words)] = words
        done += len(words)
        if not chunk and done < count:
            raise BadInput(f"ends after {done} of {count} values; {AGAIN}")
    return flat, behind + rest


def finish(stream: IO[bytes], spare: int = CHUNK, behind: bytes | None = None) -> int:
    """Read what follows the data, so that the checksum at the end is verified; returns its bytes (padding: 0).

    More than `spare` bytes are refused, since the header does not describe them. For text, `behind` was already read.
    """
    more = stream.read(spare + 1)
    if len(more) > spare:
        raise BadInput(f"has more data than its header promises; {AGAIN}")
    if behind is None:
        return len(more) if more.strip(b"\0") else 0
    return len((behind + more).strip(b"\0 \t\r\n"))
