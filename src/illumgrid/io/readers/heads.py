"""Headers on which ITK crashes, hangs or takes memory without end, as fuzzing found: refused before it sees them."""

import struct
from pathlib import Path

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.io.readers.sizes import AGAIN, CHUNK

NRRD_LINE = 1000  # characters; Teem writes its complaint about a longer line beyond the end of a buffer
EXTENDED = 1 << 26  # bytes of the longest extended header of MRC that is believed


def check_head(file: Path) -> None:
    """Refuse a NRRD, NIfTI or MRC header that ITK cannot be trusted with; other files pass."""
    with open(file, "rb") as stream:
        head = stream.read(CHUNK)
    if head.startswith(b"NRRD"):
        _check_nrrd(head)
    elif file.suffix.lower() in (".nii", ".hdr", ".img"):
        _check_nifti(head)
    elif file.suffix.lower() in (".mrc", ".rec", ".map"):
        _check_mrc(head)


def _check_nrrd(head: bytes) -> None:
    for line in head.replace(b"\r\n", b"\n").partition(b"\n\n")[0].split(b"\n"):
        if len(line) > NRRD_LINE and not line.startswith(b"#") and b":=" not in line:
            raise BadInput(f"a line of its header has {len(line)} characters; expected at most {NRRD_LINE}; {AGAIN}")


def _check_nifti(head: bytes) -> None:
    """Placements that are not finite send ITK's decomposition of matrices round for ever."""
    for order in "<>":
        if len(head) >= 348 and struct.unpack_from(f"{order}i", head)[0] == 348:
            placed = struct.unpack_from(f"{order}8f", head, 76) + struct.unpack_from(f"{order}18f", head, 256)
        elif len(head) >= 540 and struct.unpack_from(f"{order}i", head)[0] == 540:
            placed = struct.unpack_from(f"{order}8d", head, 104) + struct.unpack_from(f"{order}18d", head, 352)
        else:
            continue
        if not np.isfinite(placed).all():
            raise BadInput(f"its spacing or orientation is not finite; expected numbers; {AGAIN}")


def _check_mrc(head: bytes) -> None:
    """Check the extended header, which ITK makes room for before it looks whether it is there."""
    if len(head) < 1024:
        return
    columns = struct.unpack_from("<i", head)[0]
    order = "<" if 0 < columns < 1 << 16 else ">"
    extended = struct.unpack_from(f"{order}i", head, 92)[0]
    if not 0 <= extended <= EXTENDED:
        raise BadInput(f"its extended header has {extended} bytes; expected 0 to {EXTENDED}; {AGAIN}")
