"""FreeSurfer volumes (.mgh, .mgz): header and placement by nibabel."""

import math

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.io.readers.limits import CHUNK, check_axes, check_size
from illumgrid.io.readers.nifti import in_lps
from illumgrid.io.readers.source import AGAIN, Source, opened
from illumgrid.io.readers.stored import Stored, Wanted, pick
from illumgrid.io.readers.windows import need, read_part, single

HEADER = 284
"""Bytes before the data."""


def read(source: Source, wanted: Wanted) -> Stored:
    """Read one volume of a FreeSurfer file; time steps (frames) are chosen by the user."""
    from nibabel.freesurfer.mghformat import MGHHeader

    with opened(source) as stream:
        block = stream.read(HEADER)
        if len(block) < HEADER:
            raise BadInput(f"ends within its header; {AGAIN}")
        # nibabel's header is the beginning of the file's header and a footer of 20 bytes without placement.
        header = MGHHeader(block[: MGHHeader.template_dtype.itemsize - 20] + bytes(20), check=False)
        sizes = [int(n) for n in header["dims"]]
        if int(header["version"]) != 1 or int(header["type"]) not in (0, 1, 3, 4) or min(sizes) < 1:
            raise BadInput(f"its header is not that of a FreeSurfer volume; {AGAIN}")
        dtype = header.get_data_dtype().newbyteorder(">")
        time = pick(wanted.time, "time", [""] * sizes[3])
        check_axes(sizes[:3])
        size = math.prod(sizes) * dtype.itemsize
        spans = [*wanted.spans(sizes[:3]), single(time)]
        check_size(HEADER + size, source.most, need(dtype, sizes, spans))
        values = read_part(stream, dtype, sizes, spans)[..., 0]
        while stream.read(CHUNK):  # what follows are notes of FreeSurfer; the checksum is at the end
            pass
    if not int(header["goodRASFlag"]):
        header["delta"], header["Mdc"], header["Pxyz_c"] = 1, np.array([[-1, 0, 0], [0, 0, -1], [0, 1, 0]]), 0
    origin, steps = in_lps(header.get_affine())
    return Stored(values, origin, steps, unit="mm", whole=tuple(sizes[:3]))
