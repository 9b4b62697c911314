"""Writes stacks as the microscopes of Zeiss (LSM) and MetaMorph (STK) do, by their published layouts."""

import struct

import numpy as np
import tifffile

LSM_TAG = 34412  # CZ_LSMINFO
UIC1, UIC2 = 33628, 33629


def lsm_info(shape, channels, spacing_in_metres):
    """CZ_LSMINFO up to release 2.0 of the "LSM file format" of Zeiss; no block that it could point to is there."""
    x, y, z = shape
    head = struct.pack("<IiiiiiiiII", 0x00300494C, 176, x, y, z, channels, 1, 2, 128, 128)
    place = struct.pack("<6d", *spacing_in_metres, 0.0, 0.0, 0.0)
    kinds = struct.pack("<HHIIIII", 0, 0, 0, 0, 0, 0, 0)  # type 0 is a stack x-y-z
    rest = struct.pack("<d8I", 0.0, *[0] * 8)
    return (head + place + kinds + rest).ljust(176, b"\0")


def lsm_file(path, volumes, spacing_in_metres):
    """Volumes (channel, x, y, z): for each slice a page with all channels, and a thumbnail behind it."""
    info = lsm_info(volumes.shape[1:], len(volumes), spacing_in_metres)
    with tifffile.TiffWriter(path) as out:
        for k in range(volumes.shape[3]):
            page = np.ascontiguousarray(volumes[..., k].swapaxes(1, 2))
            tag = [(LSM_TAG, 1, len(info), info, True)] if k == 0 else []
            many = {"planarconfig": "separate"} if len(page) > 1 else {}
            out.write(page if many else page[0], photometric="minisblack", metadata=None, extratags=tag, **many)
            out.write(np.zeros((4, 4, 3), "u1"), photometric="rgb", subfiletype=1, metadata=None)
    return path


def stk_file(path, volume, pixel, depth, unit, calibrated=1):
    """One directory for all planes; tags UIC1 and UIC2 as in "MetaMorph Stack (STK) Image File Format"."""
    x, y, z = volume.shape
    tags, blocks = [], bytearray()
    entries = 10
    base = 8 + 2 + 12 * entries + 4

    def put(data):
        at = base + len(blocks)
        blocks.extend(data + b"\0" * (len(data) % 2))
        return at

    def ratio(value):
        return struct.pack("<II", round(value * 10_000), 10_000)

    text = unit.encode() + b"\0"
    values = {
        3: calibrated,
        4: put(ratio(pixel)),
        5: put(ratio(pixel)),
        6: put(struct.pack("<I", len(text)) + text),
    }
    uic1 = put(b"".join(struct.pack("<II", *pair) for pair in values.items()))
    uic2 = put(b"".join(ratio(depth) + struct.pack("<4I", 2_451_545, 1000 * k, 2_451_545, 1000 * k) for k in range(z)))
    pixels = put(np.ascontiguousarray(volume.T, "<u2").tobytes())
    for number, kind, count, value in (
        *((256, 4, 1, x), (257, 4, 1, y), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 1)),
        *((273, 4, 1, pixels), (278, 4, 1, y), (279, 4, 1, x * y * 2)),
        *((UIC1, 4, len(values), uic1), (UIC2, 5, z, uic2)),
    ):
        tags.append(struct.pack("<HHII", number, kind, count, value))
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, entries) + b"".join(tags) + bytes(4) + bytes(blocks))
    return path
