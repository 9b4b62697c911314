"""What a header may promise: how voxels lie on disk in each format, and how many bytes that takes.

ITK does not notice a cut file in every format (NIfTI, MRC, VTK, GIPL, TIFF), so the bytes are counted here.
"""

import os
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

from illumgrid.errors import BadInput

DEFLATE = 1032
"""No deflate stream unpacks to more than this many times its own size."""

CHUNK = 1 << 20
"""Bytes read at a time; also where a header must end."""

NIFTI_WIDTH = {2: 1, 4: 2, 8: 4, 16: 4, 64: 8, 256: 1, 512: 2, 768: 4, 1024: 8, 1280: 8}
"""Bytes per voxel on disk by NIfTI's number of the data type."""

AGAIN = "expected a whole file; fetch or write it again"


def check_axes(shape: Sequence[int]) -> None:
    """Refuse what is not three axes of at least 2 voxels."""
    size = "x".join(map(str, shape))
    if len(shape) != 3:
        todo = "choose one time step or channel" if len(shape) > 3 else "stack the slices"
        raise BadInput(f"has {len(shape)} axes ({size}); expected three, x, y and z; {todo} and save that")
    if min(shape) < 2:
        todo = "give the whole stack (of DICOM, its folder)"
        raise BadInput(f"has {size} voxels; expected at least 2 along each axis; {todo}")


def check_size(promised: int, held: int, memory: int) -> None:
    """Refuse a header that promises more bytes than the file can hold, or that needs more than the machine's memory."""
    if promised > held:
        raise BadInput(f"its header promises {promised} bytes but the file can hold {held}; {AGAIN}")
    if hasattr(os, "sysconf") and memory > os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"):
        raise MemoryError


@dataclass(frozen=True)
class OnDisk:
    """How the voxels of an image file are written, and where."""

    form: Literal["raw", "text", "packed"]
    width: int
    """Bytes per voxel, unpacked."""
    files: tuple[Path, ...]
    start: int = 0
    """Bytes before the data, where the format does not tell of a cut file by itself."""

    def promised(self, voxels: int) -> int:
        """Bytes that the files hold at least (packed: unpack to)."""
        return voxels if self.form == "text" else self.start + voxels * self.width

    def held(self, file: Path, most: int) -> int:
        """Bytes that the files hold at most (packed: unpack to, where `most` is the limit for the main `file`)."""
        size = sum(part.stat().st_size for part in self.files)
        if self.form == "packed":
            return min(size * DEFLATE, most) if file in self.files else size * DEFLATE
        return size


def on_disk(file: Path, reader: Any, width: int) -> OnDisk:
    """Tell from the header of `file`, which SimpleITK's `reader` has read, how its voxels are written."""
    with open(file, "rb") as stream:
        head = stream.read(CHUNK)
    ending = file.suffix.lower()
    if head.startswith(b"NRRD"):
        return _nrrd(file, head.decode("latin-1"), width)
    if ending in (".mha", ".mhd"):
        return _meta(file, head.decode("latin-1"), width)
    if head.startswith(b"# vtk"):
        text = b"ascii" in head.split(b"\n", 3)[2].lower()
        start = head.find(b"\n", head.find(b"LOOKUP_TABLE")) + 1
        return OnDisk("text" if text else "raw", width, (file,), start)
    if reader.HasMetaDataKey("vox_offset"):
        data = file.with_suffix(".img") if ending == ".hdr" else file
        width = NIFTI_WIDTH.get(int(reader.GetMetaData("datatype")), width)  # scaled voxels are wider in memory
        return OnDisk("raw", width, _present([data]), max(0, int(float(reader.GetMetaData("vox_offset")))))
    if reader.HasMetaDataKey("MRCHeader"):
        return OnDisk("raw", width, (file,), _mrc_start(head, reader.GetSize()[0]))
    return OnDisk("raw", width, (file,), 256) if ending == ".gipl" else OnDisk("packed", width, (file,))


def _mrc_start(head: bytes, columns: int) -> int:
    order = "<" if struct.unpack("<i", head[:4])[0] == columns else ">"
    axes = struct.unpack(order + "3i", head[64:76])
    if axes != (1, 2, 3) and sorted(axes) == [1, 2, 3]:  # ITK would take them for x, y, z
        raise BadInput(f"its axes are stored in the order {axes}; expected (1, 2, 3); save it in that order")
    return 1024 + max(0, int(struct.unpack(order + "i", head[92:96])[0]))


def _nrrd(file: Path, head: str, width: int) -> OnDisk:
    lines = re.split(r"\r?\n\r?\n", head, maxsplit=1)[0].splitlines()
    fields = {key.lower().replace(" ", ""): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    encoding = fields.get("encoding", "").lower()
    form: Literal["raw", "text", "packed"] = "raw" if encoding == "raw" else "packed"
    if encoding in ("ascii", "text", "txt", "hex"):
        form = "text"
    named = fields.get("datafile")
    return OnDisk(form, width, _data_files(file, named, lines) if named else (file,))


def _meta(file: Path, head: str, width: int) -> OnDisk:
    lines = head.splitlines()
    fields: dict[str, str] = {}
    for line in lines:
        key, _, value = line.partition("=")
        fields[key.strip()] = value.strip()
        if key.strip() == "ElementDataFile":
            break
    named = fields.get("ElementDataFile", "LOCAL")
    files = (file,) if named.upper() == "LOCAL" else _data_files(file, named, lines)
    packed = fields.get("CompressedData", "").lower().startswith(("t", "1"))
    disk = OnDisk("packed" if packed else "raw", width, files)
    if packed:  # a buffer of this size is allocated, too
        check_size(int(fields.get("CompressedDataSize", 0)), sum(part.stat().st_size for part in files), 0)
    binary = fields.get("BinaryData", "true").lower().startswith(("t", "1"))
    return disk if packed or binary else OnDisk("text", width, files)


def _data_files(file: Path, named: str, lines: Sequence[str]) -> tuple[Path, ...]:
    """List the files that a detached header names, which lie relative to it."""
    if named.split()[:1] == ["LIST"]:
        first = [line.rstrip().endswith(named) for line in lines].index(True)
        return _present([file.parent / line.strip() for line in lines[first + 1 :] if line.strip()])
    if "%" in named:  # a pattern and its numbers: whatever it means, it names files in that folder
        folder = (file.parent / named.split()[0]).parent
        return tuple(entry for entry in folder.iterdir() if entry.is_file())
    return _present([file.parent / named])


def _present(files: Sequence[Path]) -> tuple[Path, ...]:
    for file in files:
        if not file.is_file():
            raise BadInput(f"its data should be in {file.name}, which is not there; expected both files; copy both")
    return tuple(files)


def check_words(file: Path, start: int, least: int) -> None:
    """Refuse a text file with fewer than `least` numbers after byte `start`; ITK would repeat the last one."""
    count, within = 0, False
    with open(file, "rb") as stream:
        stream.seek(start)
        while chunk := stream.read(CHUNK):
            count += len(chunk.split()) - (within and not chunk[:1].isspace())
            within = not chunk[-1:].isspace()
    if count < least:
        raise BadInput(f"ends after {count} of {least} values; {AGAIN}")


def check_tiff(file: Path) -> None:
    """Refuse a TIFF that is cut, whose pages differ (ITK would overrun its buffer) or that ITK would reduce to 8 bits.

    Files of other formats pass.
    """
    with open(file, "rb") as stream:
        start = stream.read(16)
        if start[:4] not in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
            return
        big = b"+" in start[:4]
        order: Literal["little", "big"] = "little" if start[:2] == b"II" else "big"
        at = int.from_bytes(start[8:16] if big else start[4:8], order)
        pages: dict[int, dict[int, int]] = {}
        while at:
            if at in pages:
                raise BadInput(f"the pages of this TIFF run in a circle; {AGAIN}")
            following, tags = _tiff_page(stream, at, order, big, file.stat().st_size)
            pages[at] = {tag: value for tag, value in tags.items() if tag in TIFF_FORM}
            at = following
    form = next(iter(pages.values()), {})
    if any(page != form for page in pages.values()) or form.get(254) not in (None, 0, 2) or 255 in form:
        raise BadInput("the pages of this TIFF differ in size or form; expected equal slices; save it as .nrrd")
    usual = form.get(277, 1) > 1 or form.get(258) in ((32,) if form.get(339) == 3 else (8, 16, 32))
    if not form.get(256) or not form.get(257) or 322 in form or not usual:
        raise BadInput("a TIFF in tiles or of unusual bits; expected strips of 8, 16 or 32 bits; save it as .nrrd")


TIFF_FORM = {254, 255, 256, 257, 258, 259, 262, 266, 274, 277, 278, 284, 317, 322, 323, 338, 339}
"""Tags that must agree: kind of page, width (256), height, bits, packing, samples (277), tiles (322), numbers (339)."""


TIFF_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
"""Bytes of one number, by its type."""


def _tiff_page(
    stream: IO[bytes], at: int, order: Literal["little", "big"], big: bool, size: int
) -> tuple[int, dict[int, int]]:
    """Where the page after that at byte `at` is, or 0; and the tags that hold one whole number."""
    counter, entry, pointer = (8, 20, 8) if big else (2, 12, 4)
    left = size - at - counter - pointer
    length = 0
    if left >= 0:
        stream.seek(at)
        length = int.from_bytes(stream.read(counter), order) * entry
    if length > left:
        raise BadInput(f"the TIFF ends before its last page; {AGAIN}")
    table = stream.read(length)
    tags: dict[int, int] = {}
    for k in range(0, length, entry):
        tag, kind = (int.from_bytes(table[k + j : k + j + 2], order) for j in (0, 2))
        value = k + entry - pointer
        number = int.from_bytes(table[k + 4 : value], order)
        extent = number * TIFF_BYTES.get(kind, 0)
        if extent > pointer and int.from_bytes(table[value : value + pointer], order) + extent > size:
            raise BadInput(f"a tag of the TIFF leaves the file; {AGAIN}")
        if number == 1 and kind in (1, 3, 4, 16) and extent <= pointer:  # byte, short, long, long long
            tags.setdefault(tag, int.from_bytes(table[value : value + extent], order))  # of two, the first counts
    return int.from_bytes(stream.read(pointer), order), tags
