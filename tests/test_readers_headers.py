"""MetaImage and NRRD: what ITK and pynrrd write and read, and headers that would be somebody's tools."""

import os
import warnings
import zlib

import nrrd
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813

from illumgrid.errors import BadInput, IllumgridWarning
from illumgrid.field.volume import index_to_world
from illumgrid.io.readers import read_scene, read_volume
from volume_files import meta_head, nrrd_head, refused, values, write

# MetaImage


NAMED = ["%n 1 4 1", "%s 1 4 1", "%d%n 0 6 1", "%99999d 0 6 1", "a%n", "/dev/zero", "../a.raw", "C:\\a.raw", "", "%d"]


@pytest.mark.parametrize("named", NAMED)
def test_a_data_file_is_a_name_and_never_a_format(tmp_path, named):
    (tmp_path / "in").mkdir()
    (tmp_path / "a.raw").write_bytes(values().tobytes())
    (tmp_path / "in" / "a.mhd").write_bytes(meta_head(named))
    refused(tmp_path / "in" / "a.mhd")


@pytest.mark.parametrize("dims", ["-3", "0", "65535", "1000000", "three", "3 3", "99999999999999999999"])
def test_number_of_axes(tmp_path, dims):
    (tmp_path / "a.mha").write_bytes(meta_head("LOCAL").replace(b"NDims = 3", f"NDims = {dims}".encode()) + bytes(210))
    refused(tmp_path / "a.mha", "NDims")


@pytest.mark.parametrize("part", [b"Slope = 2", b"Offset = -1024"])
def test_an_intensity_function_that_is_not_applied_is_a_warning(tmp_path, part):
    head = meta_head("LOCAL").replace(b"ElementDataFile", b"ElementToIntensityFunction" + part + b"\nElementDataFile")
    (tmp_path / "a.mha").write_bytes(head + values().tobytes(order="F"))
    with pytest.warns(IllumgridWarning, match="ElementToIntensityFunction is not applied"):
        read_volume(tmp_path / "a.mha")


@pytest.mark.parametrize("name", ["a.mha", "a.mhd", "a.nrrd", "a.nhdr"])
def test_every_damage_to_packed_data_is_found(tmp_path, name):
    random = np.random.default_rng(2)
    write(tmp_path / name, random.integers(0, 200, (12, 13, 14)).astype("uint8"), compress=True)
    data = next(f for f in tmp_path.iterdir() if f.name != name) if name in ("a.mhd", "a.nhdr") else tmp_path / name
    whole = data.read_bytes()
    head = max(whole.find(b"LOCAL\n") + 6, whole.find(b"\n\n") + 2 if b"NRRD" in whole else 0, 10)
    for k in range(80):
        damaged = bytearray(whole)
        at = int(random.integers(head + 10, len(whole) - 8))
        if k % 2:
            damaged[at] ^= 1 << int(random.integers(8))
        else:
            damaged[at : at + 64] = bytes(len(damaged[at : at + 64]))
        if damaged == whole:
            continue
        data.write_bytes(damaged)
        refused(tmp_path / name)


def test_times_and_channels_of_a_meta_image(tmp_path):
    many = np.stack([values(), values() + 1, values() + 2], axis=-1)
    sitk.WriteImage(sitk.GetImageFromArray(many.T, isVector=False), str(tmp_path / "a.mha"))
    for time in range(3):
        assert np.array_equal(read_volume(tmp_path / "a.mha", time=time).values, many[..., time])
    sitk.WriteImage(sitk.GetImageFromArray(many[..., :1].T, isVector=False), str(tmp_path / "a.mha"))
    assert np.array_equal(read_volume(tmp_path / "a.mha").values, values())
    colours = np.ascontiguousarray(np.moveaxis(many.T, 0, -1))
    sitk.WriteImage(sitk.GetImageFromArray(colours, isVector=True), str(tmp_path / "a.mha"))
    assert np.array_equal(read_volume(tmp_path / "a.mha", channel=2).values, many[..., 2])


@pytest.mark.parametrize("name", ["größe.raw", "Ω µ.raw", "with space.raw", "below/a.raw"])
@pytest.mark.parametrize("ending", ["mhd", "nhdr", "MHD"])
def test_names_of_data_files(tmp_path, name, ending):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(values().T.tobytes())
    line = f"data file: {name}\n"
    head = nrrd_head("raw", line) if ending == "nhdr" else meta_head(name)
    (tmp_path / f"a.{ending}").write_bytes(head)
    assert np.array_equal(read_volume(tmp_path / f"a.{ending}").values, values())


@pytest.mark.parametrize("ending", ["mhd", "nhdr"])
@pytest.mark.parametrize("named", ["../a.raw", "{folder}/a.raw", "link.raw", "pipe.raw", "missing.raw", "..\\a.raw"])
def test_only_files_beside_the_header_are_opened(tmp_path, ending, named):
    (tmp_path / "in").mkdir()
    (tmp_path / "a.raw").write_bytes(values().T.tobytes())
    (tmp_path / "in" / "link.raw").symlink_to(tmp_path / "a.raw")
    os.mkfifo(tmp_path / "in" / "pipe.raw")
    name = named.format(folder=tmp_path)
    head = nrrd_head("raw", f"data file: {name}\n") if ending == "nhdr" else meta_head(name)
    (tmp_path / "in" / f"a.{ending}").write_bytes(head)
    refused(tmp_path / "in" / f"a.{ending}")


@pytest.mark.parametrize("ending", ["mhd", "nhdr"])
def test_files_elsewhere_are_opened_where_that_is_allowed(tmp_path, call, ending):
    (tmp_path / "headers").mkdir()
    (tmp_path / "a.raw").write_bytes(values().T.tobytes())
    file = tmp_path / "headers" / f"a.{ending}"
    for named in ("../a.raw", str(tmp_path / "a.raw")):
        head = meta_head(named) if ending == "mhd" else nrrd_head("raw", f"data file: {named}\n")
        file.write_bytes(head)
        refused(file, "not in the folder of the header", "--follow")
        assert np.array_equal(read_volume(file, follow=True).values, values())
    assert "5 x 6 x 7 voxels" in call("info", str(file), "--follow")
    os.mkfifo(tmp_path / "pipe")
    file.write_bytes(head.replace(b"a.raw", b"pipe"))
    with pytest.raises(BadInput, match="pipe is neither a file nor a folder"):
        read_volume(file, follow=True)
    table = f'[[field]]\nname = "a"\nvolume = "headers/a.{ending}"\nrange = [20.0, 150.0]\n'
    file.write_bytes(head)
    (tmp_path / "s.toml").write_text(table + "follow = true\n")
    assert read_scene(tmp_path / "s.toml").fields[0].volume.shape == (5, 6, 7)
    (tmp_path / "s.toml").write_text(table)
    with pytest.raises(BadInput, match="--follow"):
        read_scene(tmp_path / "s.toml")


def test_header_size_and_byte_skip(tmp_path):
    (tmp_path / "a.raw").write_bytes(b"head" * 5 + values().T.tobytes())
    for skip in (20, -1):
        (tmp_path / "a.mhd").write_bytes(meta_head("a.raw", f"HeaderSize = {skip}\n"))
        (tmp_path / "a.nhdr").write_bytes(nrrd_head("raw", f"byte skip: {skip}\ndata file: a.raw\n"))
        for name in ("a.mhd", "a.nhdr"):
            assert np.array_equal(read_volume(tmp_path / name).values, values())


def test_data_after_the_end_are_reported(tmp_path):
    (tmp_path / "a.mha").write_bytes(meta_head("LOCAL") + values().T.tobytes() + b"more")
    with pytest.warns(IllumgridWarning, match="file: a.mha: 4 bytes follow its data"):
        assert np.array_equal(read_volume(tmp_path / "a.mha").values, values())


@pytest.mark.parametrize("encoding", ["text", "hex", "meta"])
def test_numbers_after_the_end_of_a_text_are_reported(tmp_path, encoding):
    numbers = values().ravel(order="F")
    text = numbers.tobytes().hex() if encoding == "hex" else " ".join(map(str, numbers))
    meta = encoding == "meta"
    file = tmp_path / ("a.mha" if meta else "a.nrrd")
    head = meta_head("LOCAL", "BinaryData = False\n") if meta else nrrd_head(encoding) + b"\n"
    for more, count in (("\n", 0), (" 7 8 \n", 4 if encoding == "hex" else 3)):
        file.write_bytes(head + text.encode() + more.replace("7 8", "0708" if encoding == "hex" else "7 8").encode())
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            assert np.array_equal(read_volume(file).values, values())
        said = [str(one.message) for one in caught]
        assert len(said) == bool(count) and all(f"{count} bytes follow its data" in one for one in said)
    with pytest.warns(IllumgridWarning, match="bytes follow its data"):  # and where they fill more than one piece
        file.write_bytes(head + text.encode() + b"\n" * (1 << 20) + b"07")
        read_volume(file)


def test_a_meta_image_with_a_checksum_that_is_wrong(tmp_path):
    packed = bytearray(zlib.compress(values().T.tobytes(), 0))
    packed[20] ^= 1
    (tmp_path / "a.mha").write_bytes(meta_head("LOCAL", "CompressedData = True\n") + packed)
    refused(tmp_path / "a.mha", "incorrect data check")


def test_no_spacing_is_reported(tmp_path):
    (tmp_path / "a.mha").write_bytes(
        meta_head("LOCAL").replace(b"ElementSpacing = 1 1 1\n", b"") + values().T.tobytes()
    )
    (tmp_path / "a.nrrd").write_bytes(
        nrrd_head("raw").replace(b"spacings: 1 1 1\n", b"") + b"\n" + values().T.tobytes()
    )
    for name in ("a.mha", "a.nrrd"):
        with pytest.warns(IllumgridWarning, match=f"spacing: {name}: does not state the distance"):
            read_volume(tmp_path / name)
        read_volume(tmp_path / name, spacing=(1, 1, 2))


# NRRD


@pytest.mark.parametrize("encoding", ["raw", "gzip", "bzip2", "ascii"])
@pytest.mark.parametrize("dtype", ["uint8", "int16", ">f4", "float64"])
def test_what_pynrrd_writes(tmp_path, encoding, dtype):
    header = {"encoding": encoding, "space": "left-posterior-superior", "space origin": [1, 2, 3.5],
              "space directions": np.array([[0, 2, 0], [-1.5, 0, 0], [0, 0, 3]])}  # fmt: skip
    nrrd.write(str(tmp_path / "a.nrrd"), values(dtype), header)
    volume = read_volume(tmp_path / "a.nrrd")
    array, read = nrrd.read(str(tmp_path / "a.nrrd"))
    assert np.array_equal(volume.values, array)
    assert np.allclose(volume.direction * volume.spacing, read["space directions"].T)
    assert np.array_equal(volume.origin, read["space origin"]) and volume.unit == "mm"


@pytest.mark.parametrize(("space", "signs"), [("right-anterior-superior", (-1, -1, 1)), ("LAS", (1, -1, 1))])
def test_spaces_become_lps(tmp_path, space, signs):
    header = {"space": space, "space origin": [1, 2, 3], "space directions": np.diag([1.0, 2, 3])}
    nrrd.write(str(tmp_path / "a.nrrd"), values(), header)
    volume = read_volume(tmp_path / "a.nrrd")
    itk = sitk.ReadImage(str(tmp_path / "a.nrrd"))
    index = [(0, 0, 0), (4, 0, 0), (1, 2, 3)]
    there = (np.array([1, 2, 3]) + np.array(index) * [1, 2, 3]) * signs
    assert np.allclose(index_to_world(volume, index), there)
    if space != "LAS":  # ITK 5.4 takes the abbreviation for RAS
        assert np.allclose(there, [itk.TransformIndexToPhysicalPoint(i) for i in index])


def test_lists_of_a_nrrd(tmp_path):
    many = np.stack([values(), values() + 1])
    header = {"kinds": ["list", "domain", "domain", "domain"], "space dimension": 3, "space origin": [0, 0, 0],
              "space directions": np.array([[np.nan] * 3, [1, 0, 0], [0, 1, 0], [0, 0, 1]])}  # fmt: skip
    nrrd.write(str(tmp_path / "a.nrrd"), many, header)
    refused(tmp_path / "a.nrrd", "holds 2 channels: 0, 1", "--channel N")
    assert np.array_equal(read_volume(tmp_path / "a.nrrd", channel=1).values, many[1])
    nrrd.write(str(tmp_path / "a.nrrd"), many[:1], header)
    assert np.array_equal(read_volume(tmp_path / "a.nrrd").values, values())
    refused_with = {"kinds": ["domain", "domain", "domain", "time"], "spacings": [1, 1, 1, np.nan]}
    nrrd.write(str(tmp_path / "a.nrrd"), np.moveaxis(many, 0, -1), refused_with)
    refused(tmp_path / "a.nrrd", "holds 2 time steps")
    assert np.array_equal(read_volume(tmp_path / "a.nrrd", time="0").values, values())


@pytest.mark.parametrize(("center", "spacing", "origin"), [("node", 2.0, 1.0), ("cell", 8 / 5, 1.8)])
def test_axis_mins_and_maxs(tmp_path, center, spacing, origin):
    # Node: samples at both ends. Cell: samples at the middle of five cells from 1 to 9.
    header = {"axis mins": [1, 0, 0], "axis maxs": [9, 5, 6], "centerings": [center, "node", "node"]}
    nrrd.write(str(tmp_path / "a.nrrd"), values(), header)
    volume = read_volume(tmp_path / "a.nrrd")
    assert np.allclose(volume.spacing, (spacing, 1, 1)) and np.allclose(volume.origin, (origin, 0, 0))


@pytest.mark.parametrize("encoding", ["text", "hex"])
def test_lines_and_bytes_before_text_are_skipped(tmp_path, encoding):
    data = values().tobytes(order="F").hex() if encoding == "hex" else " ".join(map(str, values().ravel(order="F")))
    (tmp_path / "a.txt").write_text("12 34\n12" + data)
    head = nrrd_head(encoding, "line skip: 1\nbyte skip: 2\ndata file: a.txt\n")
    (tmp_path / "a.nhdr").write_bytes(head)
    assert (read_volume(tmp_path / "a.nhdr").values == values()).all()
