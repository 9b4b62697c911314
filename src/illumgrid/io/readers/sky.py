"""Images of a sky, in latitude and longitude: OpenEXR, and Radiance's .hdr."""

import os
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput, tell
from illumgrid.field.lights import MOST_PIXELS

NEGATIVE = 0.01
"""Largest ratio of negative to positive light of an image for which it becomes 0: lossy compression leaves some."""
EXPECTED = "expected an image of the sky, .exr or .hdr, twice as wide as high"


def read_image(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Linear RGB (H, W, 3) of an image, row 0 on top.

    Raises
    ------
    BadInput
        If it is not such an image.
    """
    file = Path(path)
    if not file.is_file():
        raise BadInput(f"there is no file {file}; {EXPECTED}; check the path")
    readers = {".exr": _exr, ".hdr": _hdr, ".pic": _hdr}
    if file.suffix.lower() not in readers:
        raise BadInput(f"{file.name} ends in {file.suffix or 'nothing'}; {EXPECTED}; convert it")
    try:
        image = readers[file.suffix.lower()](file)
    except BadInput:
        raise
    except Exception as reason:  # the EXR library raises RuntimeError, ValueError...
        raise BadInput(f"{file.name} cannot be read ({type(reason).__name__}: {reason}); {EXPECTED}") from None
    if not np.isfinite(image).all():
        raise BadInput(f"{file.name} has pixels that are not numbers; expected radiance from 0 up")
    return _without_negatives(file.name, image)


def _without_negatives(name: str, image: NDArray[np.float32]) -> NDArray[np.float32]:
    """The image with 0 in place of negative values."""
    where = (image < 0).any(axis=2)
    if not (count := int(where.sum())):
        return image
    rows = len(image)
    solid_angle = np.sin((np.arange(rows) + 0.5) * np.pi / rows)[:, None, None]
    positive, negative = (float((np.maximum(part, 0) * solid_angle).sum()) for part in (image, -image))
    they = f"{name} has {count} negative pixels of {where.size}"
    if negative > NEGATIVE * positive:
        share = f"{negative / positive:.2g} times" if positive else "more than"
        raise BadInput(
            f"{they}, whose light is {share} that of the others; expected at most {NEGATIVE}; save it without loss"
        )
    tell("file", f"{they} ({count / where.size:.2g} of them): they became 0, {negative / positive:.1g} of the light")
    return np.maximum(image, np.float32(0))


def _exr(file: Path) -> NDArray[np.float32]:
    import OpenEXR

    header = OpenEXR.File(os.fsencode(file), separate_channels=True, header_only=True)
    low, high = (np.asarray(corner) for corner in header.parts[0].header["dataWindow"])
    _check_size(file, *(high - low + 1)[::-1])
    channels = OpenEXR.File(os.fsencode(file), separate_channels=True).parts[0].channels
    names = "RGB" if {"R", "G", "B"} <= set(channels) else "YYY"
    if names[0] not in channels:
        raise BadInput(f"{file.name} has the channels {', '.join(channels)[:80]}; expected R, G and B, or Y")
    return np.stack([np.asarray(channels[name].pixels, np.float32) for name in names], axis=-1)


def _check_size(file: Path, rows: int, columns: int) -> None:
    if min(rows, columns) < 2 or rows * columns > MOST_PIXELS:
        raise BadInput(f"{file.name} has {columns} x {rows} pixels; expected 2 to {MOST_PIXELS} in all: reduce it")


def _hdr(file: Path) -> NDArray[np.float32]:
    """Radiance's RGBE, run lengths in the newer of its two ways, or none (G. Ward, "Real pixels", Graphics Gems II)."""
    content = file.read_bytes()
    head = re.search(rb"\n\n-Y (\d+) \+X (\d+)\n", content[:65536])
    if not content.startswith(b"#?") or head is None:
        raise BadInput(f"{file.name} is no Radiance picture with rows from the top (-Y H +X W); {EXPECTED}")
    rows, columns = int(head[1]), int(head[2])
    _check_size(file, rows, columns)
    data, at = np.frombuffer(content, np.uint8), head.end()
    pixels = np.zeros((rows, 4, columns), np.uint8)
    for row in pixels:
        if data[at] != 2 or data[at + 1] != 2 or data[at + 2] >= 128:  # no run lengths
            row[:] = data[at : at + 4 * columns].reshape(columns, 4).T
            at += 4 * columns
            continue
        at += 4
        for channel in row:
            filled = 0
            while filled < columns:
                count = int(data[at])
                run = count > 128
                count = count - 128 if run else count
                if count == 0 or filled + count > columns:
                    raise BadInput(f"{file.name} is damaged; {EXPECTED}")
                channel[filled : filled + count] = data[at + 1] if run else data[at + 1 : at + 1 + count]
                at += 2 if run else 1 + count
                filled += count
    mantissa, exponent = pixels[:, :3].swapaxes(1, 2).astype(np.float32), pixels[:, 3].astype(int)
    return np.asarray(np.where(exponent > 0, np.ldexp(1.0, exponent - 136), 0.0)[..., None] * mantissa, np.float32)
