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
    if named.split()[0] == "LIST":
        first = next(k for k, line in enumerate(lines) if line.split()[-1:] == ["LIST"] or " LIST " in line)
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
    """Refuse a TIFF that is cut (ITK would read fewer pages) or that ITK would reduce to 8 bits; other files pass."""
    with open(file, "rb") as stream:
        start = stream.read(16)
        if start[:4] not in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
            return
        order = "<" if start[:2] == b"II" else ">"
        big = b"+" in start[:4]
        at = struct.unpack(order + ("Q" if big else "I"), start[8:16] if big else start[4:8])[0]
        seen: set[int] = set()
        while at:
            if at in seen:
                raise BadInput(f"the pages of this TIFF run in a circle; {AGAIN}")
            seen.add(at)
            at = _tiff_page(stream, at, order, big, file.stat().st_size)


def _tiff_page(stream: IO[bytes], at: int, order: str, big: bool, size: int) -> int:
    """Check the page at byte `at`; where the next one is, or 0."""
    count, entry, pointer = ("Q", "HHQHxxxxxx", "Q") if big else ("H", "HHIHxx", "I")
    left = size - at - struct.calcsize(order + count + pointer)
    length = 0
    if left >= 0:
        stream.seek(at)
        length = struct.unpack(order + count, stream.read(struct.calcsize(count)))[0] * struct.calcsize(order + entry)
    if length > left:
        raise BadInput(f"the TIFF ends before its last page; {AGAIN}")
    entries = struct.iter_unpack(order + entry, stream.read(length))
    tags = {tag: value for tag, _, number, value in entries if number == 1}
    bits, samples, form = tags.get(258, 8), tags.get(277, 1), tags.get(339, 1)
    if 322 in tags or (samples == 1 and bits not in (8, 16, 32)) or (form == 3 and bits != 32):  # 322: tile width
        raise BadInput("a TIFF in tiles or of unusual bits; expected strips of 8, 16 or 32 bits; save it so or as .nrrd")
    return int(struct.unpack(order + pointer, stream.read(struct.calcsize(pointer)))[0])
