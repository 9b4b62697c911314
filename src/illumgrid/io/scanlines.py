"""OpenEXR files of scan lines, packed by ZIP, written some rows at a time: the library wants all pixels in memory.

References
----------
.. [1] https://openexr.com/en/latest/OpenEXRFileLayout.html
"""

import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

LINES = 16
"""Rows that ZIP packs together."""
_MAGIC, _VERSION, _LONG_NAMES, _MULTIPART = 20000630, 2, 1 << 10, 1 << 12
_KINDS = {"uint32": 0, "float32": 2}
_LEVEL = 4  # of zlib, as the library has it


@dataclass(frozen=True, eq=False)
class Part:
    """An image of a file.

    Parameters
    ----------
    size : (width, height)
    channels : mapping of str to dtype
        uint32 or float32.
    rows : iterable of sequences of arrays
        Rows from the top to the bottom, any number at a time: (m, width) for each channel, in their order.
    about : mapping
        Attributes of the header: text, float, (3,) or (3, 3) arrays.
    name : str, optional
        Of a part of several.
    window : (width, height), optional
        Of what is displayed.
    """

    size: tuple[int, int]
    channels: Mapping[str, Any]
    rows: Iterable[Sequence[NDArray[Any]]]
    about: Mapping[str, Any]
    name: str | None = None
    window: tuple[int, int] | None = None

    @property
    def chunks(self) -> int:
        """How many pieces are packed, each of `LINES` rows."""
        return -(-self.size[1] // LINES)


def write(path: Path, parts: Sequence[Part]) -> None:
    """Write images to a file: one without a name, or any number with names."""
    several = parts[0].name is not None
    names = [name for part in parts for name in (*part.channels, *part.about)]
    flags = (_MULTIPART if several else 0) | (_LONG_NAMES if max(map(len, map(_text, names))) > 32 else 0)
    with open(path, "wb") as file, ThreadPoolExecutor() as pool:  # zlib works without the interpreter's lock
        file.write(struct.pack("<2i", _MAGIC, _VERSION | flags))
        file.write(b"".join(map(_header, parts)) + (b"\0" if several else b""))
        tables = file.tell()
        file.write(bytes(8 * sum(part.chunks for part in parts)))
        offsets = []
        for number, part in enumerate(parts):
            for row, packed in _packed(part, pool):
                offsets.append(file.tell())
                file.write(struct.pack("<i", number) if several else b"")
                file.write(struct.pack("<2i", row, len(packed)) + packed)
        file.seek(tables)
        file.write(struct.pack(f"<{len(offsets)}Q", *offsets))


def _text(text: str) -> bytes:
    return text.encode() + b"\0"


def _header(part: Part) -> bytes:
    """Attributes, each with its type, in the order of their names."""

    def box(size: tuple[int, int]) -> bytes:
        return struct.pack("<4i", 0, 0, size[0] - 1, size[1] - 1)

    channels = b"".join(
        _text(name) + struct.pack("<iB3x2i", _KINDS[np.dtype(part.channels[name]).name], 0, 1, 1)
        for name in sorted(part.channels, key=str.encode)
    )
    entries: dict[str, tuple[str, bytes]] = {
        "channels": ("chlist", channels + b"\0"),
        "compression": ("compression", b"\3"),
        "dataWindow": ("box2i", box(part.size)),
        "displayWindow": ("box2i", box(part.window or part.size)),
        "lineOrder": ("lineOrder", b"\0"),
        "pixelAspectRatio": ("float", struct.pack("<f", 1.0)),
        "screenWindowCenter": ("v2f", bytes(8)),
        "screenWindowWidth": ("float", struct.pack("<f", 1.0)),
        "type": ("string", b"scanlineimage"),
    }
    if part.name is not None:
        entries |= {"name": ("string", part.name.encode()), "chunkCount": ("int", struct.pack("<i", part.chunks))}
    for name, value in part.about.items():
        if isinstance(value, str):
            entries[name] = "string", value.encode()
        elif np.ndim(value) == 0:
            entries[name] = "float", struct.pack("<f", value)
        else:
            entries[name] = "v3d" if np.ndim(value) == 1 else "m33d", np.asarray(value, "<f8").tobytes()
    found = [_text(n) + _text(kind) + struct.pack("<i", len(v)) + v for n, (kind, v) in sorted(entries.items())]
    return b"".join(found) + b"\0"


def _packed(part: Part, pool: ThreadPoolExecutor) -> Iterator[tuple[int, bytes]]:
    """The pieces of an image: number of the first row, and what it holds."""
    order = [number for _, number in sorted((name.encode(), k) for k, name in enumerate(part.channels))]
    kinds = [np.dtype(kind).newbyteorder("<") for kind in part.channels.values()]
    width, height, done = 4 * part.size[0] * len(order), part.size[1], 0
    rest = np.zeros((0, width), np.uint8)
    for rows in part.rows:
        lines = [np.ascontiguousarray(rows[k], kinds[k]).view(np.uint8) for k in order]  # of a row: one after the other
        rest = np.concatenate([rest, np.concatenate(lines, axis=1)])
        whole = len(rest) if done + len(rest) == height else len(rest) // LINES * LINES
        pieces = [rest[first : min(first + LINES, whole)] for first in range(0, whole, LINES)]
        for piece, packed in zip(pieces, pool.map(_pack, pieces)):
            yield done, packed
            done += len(piece)
        rest = rest[whole:]
    if done != height:
        raise ValueError(f"{done + len(rest)} rows of {height} came")


def _pack(rows: NDArray[np.uint8]) -> bytes:
    """Bytes of even places, then those of odd ones; their differences; zlib, where that makes them fewer."""
    raw = rows.reshape(-1)
    turned = np.concatenate([raw[0::2], raw[1::2]])
    turned[1:] = turned[1:] - turned[:-1] + np.uint8(128)
    packed = zlib.compress(turned.data, _LEVEL)
    return packed if len(packed) < len(raw) else raw.tobytes()
