"""The families of files that hold volumes: how each is recognised, which module reads it, and what users can choose."""

import re
from dataclasses import dataclass

from illumgrid.errors import BadInput
from illumgrid.io.readers.source import Source


@dataclass(frozen=True)
class Family:
    """A kind of file, read by `read(source, wanted)` of its module, which gives a `Stored`.

    A family of folders has `read_folder(files, wanted)` as well.
    """

    name: str
    module: str
    """Within `illumgrid.io.readers`; imported where it is needed."""
    endings: tuple[str, ...]
    starts: tuple[tuple[int, bytes], ...] = ()
    """Bytes at an offset, each of which identifies the family whatever the file's name."""
    chooses: tuple[str, ...] = ()
    """Options that choose one volume of several: channel, time, array."""
    medical: bool = False
    """World coordinates are LPS millimetres."""


FAMILIES = (
    # DICOM first: its preamble may look like a TIFF.
    Family("DICOM", "dicom", (".dcm", ".ima"), ((128, b"DICM"),), ("channel", "time", "array"), True),
    Family(
        *("TIFF", "tiff", (".tif", ".tiff", ".lsm", ".stk", ".btf")),
        starts=((0, b"II*\0"), (0, b"MM\0*"), (0, b"II+\0"), (0, b"MM\0+")),
        chooses=("channel", "time", "array"),
    ),
    Family("NRRD", "nrrd", (".nrrd", ".nhdr"), ((0, b"NRRD000"),), ("channel", "time"), True),
    Family(
        *("NIfTI", "nifti", (".nii", ".hdr", ".img")),
        starts=((344, b"n+1\0"), (344, b"ni1\0"), (4, b"n+2\0\r\n"), (4, b"ni2\0\r\n")),
        chooses=("channel", "time"),
        medical=True,
    ),
    Family("FreeSurfer", "mgh", (".mgh", ".mgz"), (), ("time",), True),
    Family(
        *("MetaImage", "meta", (".mha", ".mhd")),
        starts=((0, b"ObjectType"), (0, b"NDims")),
        chooses=("channel", "time"),
        medical=True,
    ),
    Family(
        *("MRC", "mrc", (".mrc", ".mrcs", ".rec", ".map", ".ccp4", ".st", ".ali")),
        starts=((208, b"MAP "), (208, b"MAP\0")),
        chooses=("array",),
    ),
    Family(
        *("NumPy", "arrays", (".npy", ".npz")),
        starts=((0, b"\x93NUMPY"), (0, b"PK\x03\x04")),
        chooses=("channel", "time", "array"),
    ),
    Family("legacy VTK", "vtk", (".vtk",), ((0, b"# vtk DataFile"),), ("channel", "array")),
    Family("VTK image", "vti", (".vti",), ((0, b"<VTKFile"), (0, b"<?xml")), ("channel", "array")),
    Family("Gaussian cube", "cube", (".cube", ".cub"), chooses=("array",)),
    Family("OpenDX", "dx", (".dx",)),
    Family(
        *("HDF5", "hdf5", (".h5", ".hdf5", ".hdf", ".nc")),
        starts=((0, b"\x89HDF\r\n\x1a\n"),),
        chooses=("channel", "time", "array"),
    ),
    Family("Zarr", "zarr", (".zarr",), chooses=("channel", "time", "array")),
    Family("ITK", "itk", (".gipl",)),
)
"""In the order in which they are tried."""

OTHERS = {
    b"\x89PNG": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"GIF8": "a GIF picture",
    b"%PDF": "a PDF document",
    b"BM": "a bitmap picture",
    b"\x76\x2f\x31\x01": "an OpenEXR picture",
    b"ply\n": "a PLY mesh",
    b"glTF": "a glTF mesh",
    b"BZh": "packed by bzip2",
    b"\xfd7zXZ\0": "packed by xz",
    b"\x28\xb5\x2f\xfd": "packed by zstd",
    b"MATLAB 5": "a MATLAB file",
    b"CDF\x01": "a NetCDF file",
    b"CDF\x02": "a NetCDF file",
    b"version https://git-lfs": "a pointer of Git LFS, in place of the data",
    b"<!DOCTYPE": "a web page",
    b"<html": "a web page",
}
"""First bytes of files of other kinds, and their kinds."""

EXPECTED = (
    "expected NRRD, NIfTI, MetaImage, TIFF, MRC, legacy VTK, .vti, .cube, .dx, .npy, .npz or HDF5, or a folder of "
    "Zarr, or of DICOM or TIFF slices"
)

SUFFIXES = {ending for family in FAMILIES for ending in family.endings}


_REPRESENTATIONS = {b"CS", b"UI", b"UL", b"OB", b"DA", b"TM", b"LO", b"SH"}
"""Types of values that the first element of a DICOM file may have."""


def bare_dicom(head: bytes) -> bool:
    """Whether a file begins like DICOM without its preamble of 128 bytes: by an element of group 2 or 8."""
    if len(head) < 256 or head[:2] not in (b"\x02\0", b"\x08\0") or head[3] != 0:
        return False
    # The type of the value follows, or, without one, a length of few bytes.
    return head[4:6] in _REPRESENTATIONS or (head[2] <= 0x18 and 0 < int.from_bytes(head[4:8], "little") <= 128)


def family_of(source: Source) -> Family:
    """The family of a file: by its first bytes, then by the ending of its name."""
    for family in FAMILIES:
        if any(source.head[at : at + len(mark)] == mark for at, mark in family.starts):
            return family
    for mark, what in OTHERS.items():
        if source.head.startswith(mark):
            raise BadInput(f"{what}; {EXPECTED}; save the volume as one of those")
    for family in FAMILIES:
        if source.ending in family.endings:
            return family
    if bare_dicom(source.head):
        return FAMILIES[0]
    ending = re.sub(r"[^\w.+-]", "?", source.ending) or "none"
    raise BadInput(f"neither its first bytes nor its ending ({ending}) are those of a volume; {EXPECTED}")
