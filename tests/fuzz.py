"""Mutated files against every reader: the outcome must be BadInput or a correct result.

Where a checksum covers the data (gzip, zlib, zip, a finished run), every other case changes only what it covers; then
the result must be that of the whole file, or a refusal.

``python tests/fuzz.py --seconds 1800`` works for half an hour; `test_fuzz.py` for a moment, over the corpus first. What
is found is kept in `tests/corpus` and is from then on a test.
"""

import argparse
import gzip
import os
import random
import re
import resource
import signal
import struct
import sys
import tempfile
import time
import warnings
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import nibabel
import numcodecs
import numpy as np
import OpenEXR
import pydicom
import pydicom.data
import SimpleITK as sitk  # noqa: N813
import tifffile
import trimesh
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec, GzipCodec, ZstdCodec

from dicom_files import HOUNSFIELD, enhanced
from grid_files import cube_file, dx_file
from illumgrid.errors import BadInput
from illumgrid.field.volume import Volume
from illumgrid.io import store
from illumgrid.io.readers import read_scene, read_volume
from illumgrid.io.readers.mesh import read_mesh
from illumgrid.io.readers.points import read_points
from illumgrid.io.readers.sky import read_image
from illumgrid.light import Illumination
from test_readers_chunked import ome
from test_store import example
from test_store_trust import reseal
from volume_files import values, vtk_head, write, write_series

CORPUS = Path(__file__).with_name("corpus")
SECONDS = 10
"""Seconds of the processor: a case that takes more hangs."""
EXPLAINED = (
    "past end of allocation|more memory than its numbers explain|too much memory for decoding|needs .* GB.* memory"
)
"""What is refused before it is taken, and what HDF5 calls the end of a file."""
ROOM = 1 << 30
"""Bytes of memory that a case may take beyond what the process has: the files are a few kilobytes."""


@dataclass(frozen=True)
class Target:
    """A fuzzing target: a file of a few kilobytes among others in a folder, and the function that reads it."""

    name: str
    make: Callable[[Path], Path]
    read: Callable[[Path], object]
    sealed: Callable[[bytes], int] | None = None
    """Where in the file the bytes begin that a checksum covers, up to the end."""
    moment: int = 40
    """Cases in every session of the tests."""


def _volume(ending: str) -> Target:
    def make(folder: Path) -> Path:
        file = folder / f"a.{ending}"
        plain = ending.removesuffix(".gz")
        if plain == "npy":
            np.save(folder / "a.npy", values())
        elif plain == "npz":
            np.savez_compressed(file, values=values("float32"), spacing=np.ones(3))
        elif plain == "mgz":
            nibabel.MGHImage(values("float32"), np.eye(4)).to_filename(file)
            return file
        elif plain == "dcm":
            write_series(folder / "series", values("int16", (6, 5, 3)))
            return next(iter(sorted((folder / "series").iterdir())))
        else:
            write(folder / f"a.{plain}", values("uint8" if plain == "tif" else "float32"), compress=plain == "nrrd")
        if plain != ending:
            file.write_bytes(gzip.compress((folder / f"a.{plain}").read_bytes()))
        return file

    behind = {"nrrd": b"\n\n", "npz": b"", "nii.gz": b"", "npy.gz": b"", "mgz": b""}.get(ending)
    return Target(
        ending,
        make,
        lambda file: read_volume(file.parent if file.suffix == ".dcm" else file),
        None if behind is None else lambda clean: clean.index(behind) + len(behind),
        8 if ending == "h5" else 40,  # a process for each case
    )


def _part(whole: Target) -> Target:
    """The same file, of which a part is read."""
    crop = (1, 5, 0, 6, 2, 7)
    return Target(
        f"part of {whole.name}", whole.make, lambda file: read_volume(file, crop=crop, downsample=2), whole.sealed
    )


def _points(ending: str) -> Target:
    def make(folder: Path) -> Path:
        file = folder / f"a.{ending}"
        some = np.random.default_rng(0).random((40, 3))
        if ending == "npy":
            np.save(file, some)
        elif ending == "csv":
            np.savetxt(file, some, "%.5f", ",", header="x,y,z", comments="")
        elif ending == "xyz":
            file.write_text("40\ncell\n" + "".join(f"C {x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in some))
        else:
            atom = "ATOM  {0:5d}  CA  ALA A{0:4d}    {1:8.3f}{2:8.3f}{3:8.3f}  1.00 20.00           C\n"
            file.write_text("".join(atom.format(k + 1, *p) for k, p in enumerate(some * 20)) + "END\n")
        return file

    return Target(f"points {ending}", make, read_points)


def _mesh(ending: str) -> Target:
    def make(folder: Path) -> Path:
        trimesh.creation.icosphere(1).export(folder / f"a.{ending}")
        return folder / f"a.{ending}"

    return Target(f"mesh {ending}", make, read_mesh)


def _tiff(name: str, **options: Any) -> Target:
    """A TIFF stack as other programs write it."""

    def make(folder: Path) -> Path:
        file = folder / f"a.{'ome.' if name == 'ome' else ''}tif"
        tifffile.imwrite(file, np.ascontiguousarray(values("uint16").T), **options)
        return file

    return Target(f"tif {name}", make, read_volume)


def _header(ending: str) -> Target:
    """A header whose data are in a file beside it."""

    def make(folder: Path) -> Path:
        write(folder / f"a.{ending}", values("float32"), compress=ending == "mhd")
        return folder / f"a.{ending}"

    return Target(ending, make, read_volume)


def _meta_packed(folder: Path) -> Path:
    write(folder / "a.mha", values("int16"), compress=True)
    return folder / "a.mha"


def _meta_beside(folder: Path) -> Path:
    write(folder / "a.mhd", values("float32"), compress=True)
    return folder / "a.zraw"


def _nifti_2(folder: Path) -> Path:
    nibabel.Nifti2Image(values("int16"), np.diag([2, 2, 3, 1])).to_filename(folder / "a.nii")
    return folder / "a.nii"


def _slices(folder: Path) -> Path:
    (folder / "slices").mkdir()
    for k in range(3):
        tifffile.imwrite(folder / "slices" / f"{k}.tif", values("uint16")[:, :, k].T.copy(), photometric="minisblack")
    return folder / "slices" / "1.tif"


def _deflated(folder: Path) -> Path:
    """Slices of DICOM whose whole data set is deflated."""
    write_series(folder / "series", values("int16", (6, 5, 3)))
    for file in (folder / "series").iterdir():
        whole = pydicom.dcmread(file)
        whole.file_meta.TransferSyntaxUID = pydicom.uid.DeflatedExplicitVRLittleEndian
        whole.save_as(file)
    return min((folder / "series").iterdir())


def _sky(folder: Path, ending: str) -> Path:
    pixels = np.random.default_rng(0).random((8, 16, 3), np.float32)
    file = folder / f"sky.{ending}"
    if ending == "exr":
        with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, {"RGB": pixels}) as out:
            out.write(str(file))
    else:
        mantissa = (pixels * 255).astype(np.uint8)
        bits = np.concatenate([mantissa, np.full((8, 16, 1), 128, np.uint8)], axis=2)
        rows = b"".join(b"\2\2\0\x10" + b"".join(b"\x10" + channel.tobytes() for channel in row.T) for row in bits)
        file.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 16\n" + rows)
    return file


def _packed(name: str) -> Target:
    """Slices packed by one of the codecs of pydicom's own test data."""

    def make(folder: Path) -> Path:
        whole = pydicom.dcmread(Path(pydicom.data.__file__).parent / "test_files" / name)
        (folder / "series").mkdir()
        for k in range(2):
            whole.ImagePositionPatient, whole.ImageOrientationPatient = [0, 0, k], [1, 0, 0, 0, 1, 0]
            whole.SOPInstanceUID, whole.SeriesInstanceUID = f"1.2.{k}", "1.2.3"
            whole.save_as(folder / "series" / f"{k}.dcm")
        return folder / "series" / "0.dcm"

    return Target(f"packed {name}", make, lambda file: read_volume(file.parent))


def _vti(packed: bool) -> Target:
    def make(folder: Path) -> Path:
        raw = values("float32").tobytes(order="F")
        body = struct.pack("<I", len(raw)) + raw
        if packed:
            parts = [zlib.compress(raw[k : k + 400]) for k in range(0, len(raw), 400)]
            sizes = [len(parts), 400, len(raw) % 400, *map(len, parts)]
            body = struct.pack(f"<{len(sizes)}I", *sizes) + b"".join(parts)
        head = '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt32"'
        head += ' compressor="vtkZLibDataCompressor"' * packed
        head += '><ImageData WholeExtent="0 4 0 5 0 6" Origin="0 0 0" Spacing="1 1 1"><Piece Extent="0 4 0 5 0 6">'
        head += '<PointData Scalars="f"><DataArray type="Float32" Name="f" format="appended" offset="0"/></PointData>'
        head += '</Piece></ImageData><AppendedData encoding="raw">_'
        (folder / "a.vti").write_bytes(head.encode() + body + b"</AppendedData></VTKFile>")
        return folder / "a.vti"

    return Target(
        "vti packed" if packed else "vti", make, read_volume, (lambda clean: clean.index(b"_") + 1) if packed else None
    )


def _legacy(folder: Path) -> Path:
    text = b" ".join(b"%d" % n for n in range(210))
    field = b"\nFIELD a 2\nb 1 210 float\n" + text + b"\nc 3 70 int\n" + text
    (folder / "a.vtk").write_bytes(vtk_head("ASCII") + text + field)
    return folder / "a.vtk"


def _zarr(name: str, part: str, sealed: bool = False, **options: Any) -> Target:
    """One file of a folder of Zarr: of its metadata, or a chunk."""

    def make(folder: Path) -> Path:
        array = zarr.create_array(
            folder / "a.zarr", shape=(5, 6, 7), **{"chunks": (3, 3, 4), "dtype": "float32", **options}
        )
        array[...] = values("float32")
        return folder / "a.zarr" / part

    apart = "blosc" in name  # a process for each case
    return Target(f"zarr {name}", make, _read_zarr, (lambda clean: 0) if sealed else None, 4 if apart else 40)


def _ome(version: str, part: str) -> Target:
    """One file of an image in two resolutions."""

    def make(folder: Path) -> Path:
        ome(folder / "a.zarr", values("uint8", (5, 6, 7)), version)
        return folder / "a.zarr" / part

    return Target(f"ome {version} {part.replace('/', ' ')}", make, lambda file: _read_zarr(file, channel=0))


def _read_zarr(file: Path, **options: Any) -> Volume:
    return read_volume(next(place for place in file.parents if place.name == "a.zarr"), **options)


def _hdf5(name: str, **options: Any) -> Target:
    def make(folder: Path) -> Path:
        with h5py.File(folder / "a.hdf5", "w", libver="latest" if name == "latest" else "earliest") as file:
            data = file.create_dataset("a/b", data=values("float32"), **options)
            data.attrs["element_size_um"] = (0.5, 1.0, 2.0)
            for dim, axis in zip(data.dims, "zyx"):
                dim.label = axis
            file["flat"] = np.zeros((3, 4))
        return folder / "a.hdf5"

    return Target(f"hdf5 {name}", make, read_volume, moment=4)  # a process for each case


SCENE = """[[field]]
name = "a"
volume = "a.npy"
albedo = [0.5, 0.5, 0.5]
range = [20.0, 150.0]
inside = "above"

[[quad]]
name = "lamp"
corner = [0, 0, 9]
edge_u = [1, 0, 0]
edge_v = [0, 1, 0]
albedo = [0, 0, 0]
emission = [10, 10, 10]

[background]
radiance = [0.1, 0.1, 0.1]
"""

LIGHTS = """
[[light]]
name = "key"
direction = [0, 0, 1]
angle = 5.0
irradiance = [1.0, 1.0, 1.0]

[[light]]
name = "dome"
image = "sky.exr"
"""


def _scene(folder: Path) -> Path:
    np.save(folder / "a.npy", values())
    (folder / "s.toml").write_text(SCENE)
    return folder / "s.toml"


def _scene_of_lights(folder: Path) -> Path:
    np.save(folder / "a.npy", values())
    _sky(folder, "exr")
    (folder / "s.toml").write_text(SCENE.partition("[background]")[0] + LIGHTS)
    return folder / "s.toml"


def _run(part: str, sealed: bool) -> Target:
    def make(folder: Path) -> Path:
        store.write(folder / "out", example(), None, False)
        return folder / "out" / part

    def read(file: Path) -> object:
        if sealed:  # as when forging a run
            try:
                reseal(file.parent)
            except (ValueError, TypeError, RecursionError, OSError):
                return None
            except KeyError:  # without a format there is no checksum to forge
                pass
        stored = store.read(file.parent)
        light = Illumination(stored.scene, stored.levels, stored.grids, stored.walls, stored.recipe)
        return light.grids[0].lookup(np.zeros((1, 3))).tobytes(), light.exposure, light.grids[0].values.tobytes()

    return Target(f"{'forged ' if sealed else ''}{part}", make, read, None if sealed else lambda clean: 0)


TARGETS = (
    *map(_volume, ("nrrd", "nii", "nii.gz", "mha", "mrc", "vtk", "gipl", "tif", "dcm", "npy", "npz", "npy.gz")),
    *map(_volume, ("mgz", "h5")),
    *map(_header, ("mhd", "nhdr", "hdr")),
    Target("mha packed", _meta_packed, read_volume, lambda clean: clean.index(b"LOCAL\n") + 6),
    Target("zraw", _meta_beside, lambda file: read_volume(file.with_suffix(".mhd")), lambda clean: 0),
    Target("nifti 2", _nifti_2, read_volume),
    Target("slices", _slices, lambda file: read_volume(file.parent)),
    Target("deflated", _deflated, lambda file: read_volume(file.parent)),
    Target("sky exr", lambda folder: _sky(folder, "exr"), read_image),
    Target("sky hdr", lambda folder: _sky(folder, "hdr"), read_image),
    Target("scene of lights", _scene_of_lights, read_scene),
    _tiff("imagej", imagej=True, metadata={"axes": "ZYX", "spacing": 0.5}, resolution=(5, 5)),
    _tiff("ome", metadata={"axes": "ZYX", "PhysicalSizeX": 0.5}, photometric="minisblack"),
    *(_tiff(codec, compression=codec, photometric="minisblack") for codec in ("lzw", "zstd", "jpeg2000", "packbits")),
    _tiff("tiles", compression="deflate", predictor=True, tile=(16, 16), photometric="minisblack"),
    Target("frames", lambda folder: enhanced(folder / "a.dcm", [3, 0, 2, 1], [HOUNSFIELD] * 4), read_volume),
    *map(
        _packed, ("MR_small_RLE.dcm", "MR_small_jpeg_ls_lossless.dcm", "MR_small_jp2klossless.dcm", "JPGExtended.dcm")
    ),
    *(_vti(packed) for packed in (False, True)),
    Target("vtk text", _legacy, read_volume),
    Target("cube", lambda folder: cube_file(folder / "a.cube"), read_volume),
    Target("dx", lambda folder: dx_file(folder / "a.dx"), read_volume),
    _zarr("3", "zarr.json"),
    _zarr("3 chunk", "c/0/1/1"),
    _zarr("3 sealed", "c/0/1/1", True, compressors=[ZstdCodec(), Crc32cCodec()]),
    _zarr("3 blosc", "c/0/1/1", compressors=[BloscCodec()]),
    _zarr("3 gzip", "c/0/1/1", compressors=[GzipCodec()]),
    _zarr("3 shards", "c/0/0/0", chunks=(3, 3, 4), shards=(6, 6, 8)),
    _zarr("2", ".zarray", zarr_format=2, order="F"),
    _zarr("2 chunk", "0.1.1", zarr_format=2),
    _zarr(
        "2 blosc", "0.1.1", zarr_format=2, compressors=[numcodecs.Blosc(cname="lz4")], filters=[numcodecs.Delta("f4")]
    ),
    *(_ome("0.5", part) for part in ("zarr.json", "0/zarr.json")),
    *(_ome("0.4", part) for part in (".zattrs", "0/.zarray")),
    _hdf5("plain"),
    _hdf5("chunks", chunks=(3, 3, 4), compression="gzip", shuffle=True),
    _hdf5("sealed", chunks=(3, 3, 4), compression="lzf", fletcher32=True),
    _hdf5("latest", chunks=(3, 3, 4), scaleoffset=3),
    Target("scene", _scene, read_scene),
    *(_run(part, sealed) for part in (store.RUN, store.EXR) for sealed in (False, True)),
)


TARGETS += tuple(
    _part(t) for t in TARGETS if t.name in ("nrrd", "nii.gz", "mha packed", "mrc", "mgz", "npy", "npz", "tif")
)
TARGETS += (*map(_points, ("npy", "csv", "xyz", "pdb")), *map(_mesh, ("ply", "stl", "obj", "glb")))


def mutate(data: bytes, chance: random.Random) -> bytes:
    """Flip, cut, repeat or insert bytes, or write a false number, mostly near the head, which holds the sizes."""
    result = bytearray(data)
    for _ in range(chance.choice((1, 1, 1, 2, 4, 16))):
        if not result:
            break
        reach = len(result) if chance.random() < 0.5 else min(len(result), 400)
        at = chance.randrange(reach)
        match chance.randrange(7):
            case 0:
                result[at] ^= 1 << chance.randrange(8)
            case 1:
                result[at] = chance.choice((0, 1, 0x7F, 0x80, 0xFF, ord("9"), ord("-"), ord(" "), ord("\n")))
            case 2:
                del result[at:]
            case 3:
                del result[at : at + chance.randrange(1, 40)]
            case 4:
                result[at:at] = result[at : at + chance.randrange(1, 40)] * chance.choice((1, 2, 50))
            case 5:
                lie = chance.choice((2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 0, 1, 65535, -1, 10**6))
                size = chance.choice((2, 4, 8))
                mask = (1 << 8 * size) - 1
                result[at : at + size] = (lie & mask).to_bytes(size, chance.choice(("little", "big")))
            case 6:
                text = chance.choice(
                    (b"99999999999", b"-1", b"0", b"1e308", b"nan", b"inf", b"../../a", b"\xff\xfe", b"]")
                )
                result[at : at + chance.choice((0, len(text)))] = text
    return bytes(result)


def mutated(target: Target, clean: bytes, case: int) -> tuple[bytes, bool]:
    """The file of a case, and whether only what a checksum covers was changed."""
    chance = random.Random(f"{target.name} {case}")
    if target.sealed is None or case % 2 == 0:
        return mutate(clean, chance), False
    at = target.sealed(clean)
    return clean[:at] + mutate(clean[at:], chance), True


def content(result: Any) -> object:
    """What was read, to be compared."""
    if isinstance(result, Volume):
        return result.stored.tobytes(order="F"), result.shape, result.intercept, result.slope
    return result


def judge(target: Target, file: Path, right: object = None) -> str:
    """Empty if the file was read (as `right`) or refused in one sentence, otherwise a description of the outcome."""
    try:
        found = content(target.read(file))
        if right is not None and found != right:
            return "damaged data were read as good"
    except BadInput as error:
        text = str(error)
        if "\n" in text or "Traceback" in text:
            return f"not one sentence: {text[:200]!r}"
        if re.search("memory|alloc", re.sub(EXPLAINED, "", text)):
            return f"more memory than the file explains: {text[:200]!r}"
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:200]}"
    return ""


def _confine() -> None:
    """Limit the memory of this process, and silence the libraries; coverage cannot count it, and would only slow it."""
    sys.settrace(None)
    if sys.platform == "linux":
        used = int(Path("/proc/self/statm").read_text("utf-8").split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, used + ROOM))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(1)
    warnings.simplefilter("ignore")
    null = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(null, stream)
    signal.signal(signal.SIGABRT, signal.SIG_DFL)


def _child(work: Callable[[int], None]) -> tuple[list[str], int]:
    """Run `work` in its own process, which writes lines to a given descriptor; returns the lines and exit status."""
    read, write_ = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other threads only wait here
        child = os.fork()
    if not child:
        try:
            os.close(read)
            _confine()
            work(write_)
            os.write(write_, b"end\n")
        finally:
            os._exit(0)
    os.close(write_)
    with os.fdopen(read) as said:
        lines = said.read().splitlines()
    return lines, os.waitpid(child, 0)[1]


def _ended(status: int) -> str:
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGPROF:
        return f"hung: {SECONDS} s of work"
    return f"the process ended with status {status}"


def alone(target: Target, file: Path) -> str:
    """`judge` in its own process."""

    def work(tell: int) -> None:
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        os.write(tell, f"{judge(target, file)}\n".encode())

    lines, status = _child(work)
    return lines[0] if lines[-1:] == ["end"] else _ended(status)


def batch(target: Target, seed: int, cases: int) -> Iterator[tuple[int, str]]:
    """Failures among `cases` cases from `seed` on, run in their own process, with the outcomes."""

    def work(tell: int) -> None:
        # The number of each case goes down the pipe before it is tried, and what was wrong after.
        with tempfile.TemporaryDirectory() as place:
            file = target.make(Path(place))
            clean = file.read_bytes()
            right = content(target.read(file)) if target.sealed else None
            for case in range(seed, seed + cases):
                os.write(tell, f"{case}\n".encode())
                changed, sealed = mutated(target, clean, case)
                file.write_bytes(changed)
                signal.setitimer(signal.ITIMER_PROF, SECONDS)
                if what := judge(target, file, right if sealed else None):
                    os.write(tell, f"! {what}\n".encode())
                signal.setitimer(signal.ITIMER_PROF, 0)

    lines, status = _child(work)
    at = seed
    for line in lines:
        if line.startswith("! "):
            yield at, line[2:]
        elif line != "end":
            at = int(line)
    if lines[-1:] != ["end"]:
        yield at, _ended(status)
        if at + 1 < seed + cases:
            yield from batch(target, at + 1, seed + cases - at - 1)


def keep(target: Target, case: int) -> Path:
    """Write a case into the corpus."""
    with tempfile.TemporaryDirectory() as place:
        file = target.make(Path(place))
        CORPUS.mkdir(exist_ok=True)
        kept = CORPUS / f"{target.name.replace(' ', '-')}@{case}"
        kept.write_bytes(mutated(target, file.read_bytes(), case)[0])
    return kept


def main() -> None:
    """Fuzz every target in turn until the time is up."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="a pattern for names of targets")
    asked = parser.parse_args()
    end, seed, wrong = time.monotonic() + asked.seconds, asked.seed, 0
    targets = [t for t in TARGETS if re.search(asked.only or "", t.name)]
    count = dict.fromkeys((t.name for t in targets), 0)
    while time.monotonic() < end:
        for target in targets:
            for case, what in batch(target, seed, 200):
                wrong += 1
                print(f"{target.name} case {case}: {what}; kept as {keep(target, case)}", flush=True)  # noqa: T201
            count[target.name] += 200
            if time.monotonic() > end:
                break
        seed += 200
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    took = f"{time.monotonic() - end + asked.seconds:.0f} s, {used.ru_utime + used.ru_stime:.0f} s of a processor"
    print(f"{wrong} wrong of {sum(count.values())} in {took}, from seed {asked.seed}: {count}")  # noqa: T201
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
