"""TIFF as ImageJ, OME and picture programs write it: places are those that tifffile was asked to write."""

import numpy as np
import pytest
import tifffile

from illumgrid.errors import IllumgridWarning
from illumgrid.io.readers import read_volume
from microscope_files import lsm_file, stk_file
from volume_files import refused, values

ZYX = values("uint16").T.copy()
TWO = np.stack([ZYX, ZYX + 7], axis=1)  # z, c, y, x


def spaced(file, spacing, unit):
    volume = read_volume(file)
    assert np.allclose(volume.spacing, spacing) and volume.unit == unit
    return volume


def test_imagej_calibration(tmp_path):
    file = tmp_path / "a.tif"
    for unit, shown in (("um", "µm"), ("\\u00B5m", "µm"), ("micron", "µm"), ("nm", "nm"), ("mm", "mm")):
        tifffile.imwrite(
            file, ZYX, imagej=True, resolution=(5, 4), metadata={"spacing": 0.5, "unit": unit, "axes": "ZYX"}
        )
        assert np.array_equal(spaced(file, (0.2, 0.25, 0.5), shown).values, values())


def test_ome_calibration(tmp_path):
    file = tmp_path / "a.ome.tif"
    about = {"axes": "ZYX", "PhysicalSizeX": 200, "PhysicalSizeY": 250, "PhysicalSizeZ": 0.5}
    units = {"PhysicalSizeXUnit": "nm", "PhysicalSizeYUnit": "nm", "PhysicalSizeZUnit": "µm"}
    tifffile.imwrite(file, ZYX, metadata=about | units, photometric="minisblack")
    assert np.array_equal(spaced(file, (0.2, 0.25, 0.5), "µm").values, values())
    tifffile.imwrite(
        file, ZYX, metadata={"axes": "ZYX", "PhysicalSizeX": 0.2, "PhysicalSizeY": 0.2}, photometric="minisblack"
    )
    with pytest.warns(IllumgridWarning, match=r"spacing: .* along z; 0\.2 was assumed"):
        spaced(file, (0.2, 0.2, 0.2), "µm")


def test_channels_and_times_are_chosen(tmp_path):
    file = tmp_path / "a.tif"
    tifffile.imwrite(file, TWO, imagej=True, metadata={"axes": "ZCYX", "spacing": 0.5, "unit": "um"}, resolution=(5, 5))
    refused(file, "holds 2 channels: 0, 1", "--channel N")
    for channel in (0, 1):
        assert np.array_equal(read_volume(file, channel=channel).values, TWO[:, channel].T)
    tifffile.imwrite(file, np.stack([ZYX, ZYX + 1, ZYX + 2]), imagej=True, metadata={"axes": "TZYX", "spacing": 1})
    refused(file, "holds 3 time steps: 0, 1, 2", "--time N")
    assert np.array_equal(read_volume(file, time="2").values, values() + 2)
    file = tmp_path / "b.ome.tif"
    about = {
        "axes": "CZYX",
        "Channel": {"Name": ["DAPI", "GFP"]},
        "PhysicalSizeX": 1,
        "PhysicalSizeY": 1,
        "PhysicalSizeZ": 2,
    }
    tifffile.imwrite(file, np.moveaxis(TWO, 1, 0), metadata=about, photometric="minisblack")
    refused(file, "0 DAPI, 1 GFP")
    assert np.array_equal(read_volume(file, channel="GFP").values, values() + 7)


def test_a_time_series_of_planes_is_taken_for_slices(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", ZYX, imagej=True, metadata={"axes": "TYX", "spacing": 2, "unit": "um"})
    with pytest.warns(IllumgridWarning, match="file: a.tif: its slices are called time steps"):
        assert np.array_equal(read_volume(tmp_path / "a.tif").values, values())


@pytest.mark.parametrize("dpi", [72, 96, 300])
def test_printing_resolutions_are_no_spacing(tmp_path, dpi):
    tifffile.imwrite(tmp_path / "a.tif", ZYX, resolution=(dpi, dpi), resolutionunit="inch", photometric="minisblack")
    with pytest.warns(IllumgridWarning, match=f"only {dpi} dots per inch, as for printing; 1, 1, 1 was assumed"):
        spaced(tmp_path / "a.tif", (1, 1, 1), None)
    assert np.allclose(read_volume(tmp_path / "a.tif", spacing=(1, 2, 3)).spacing, (1, 2, 3))


def test_a_resolution_of_a_microscope(tmp_path):
    tifffile.imwrite(
        tmp_path / "a.tif", ZYX, resolution=(20000, 20000), resolutionunit="centimeter", photometric="minisblack"
    )
    with pytest.warns(IllumgridWarning, match=r"0\.0005 x 0\.0005 mm for a pixel, .* 0\.0005 mm was assumed"):
        spaced(tmp_path / "a.tif", (5e-4, 5e-4, 5e-4), "mm")


def one_directory(file, cut=0):
    """As ImageJ writes stacks above 4 GB: one directory, all slices behind it."""
    about = "ImageJ=1.53t\nimages=7\nslices=7\nspacing=0.5\nunit=micron\n"
    tifffile.imwrite(file, ZYX[0], photometric="minisblack", description=about, metadata=None, byteorder=">")
    with tifffile.TiffFile(file) as tiff:
        start = tiff.pages[0].dataoffsets[0]
    data = file.read_bytes()[:start] + ZYX.astype(">u2").tobytes()
    file.write_bytes(data[: len(data) - cut])


def test_one_directory_for_all_slices(tmp_path):
    one_directory(tmp_path / "a.tif")
    assert np.array_equal(spaced(tmp_path / "a.tif", (1, 1, 0.5), "µm").values, values())
    one_directory(tmp_path / "a.tif", cut=1)
    refused(tmp_path / "a.tif", "promises 7 images")


def test_a_folder_of_slices(tmp_path):
    for k in range(7):
        tifffile.imwrite(
            tmp_path / f"s{k + 8}.tif", ZYX[k], photometric="minisblack", resolution=(5, 5), resolutionunit=3
        )
    with pytest.warns(IllumgridWarning, match="not the distance between slices"):
        assert np.array_equal(read_volume(tmp_path).values, values())  # 8, 9, 10, ...: by number, not by letter
    (tmp_path / "s11.tif").unlink()
    with pytest.warns(IllumgridWarning) as caught:
        assert read_volume(tmp_path).shape == (5, 6, 6)
    assert any("slices are missing between s10.tif and s12.tif" in str(one.message) for one in caught)
    tifffile.imwrite(tmp_path / "s11.tif", ZYX[0, :3], photometric="minisblack")
    refused(tmp_path, "its slice s11.tif differs in size")
    tifffile.imwrite(tmp_path / "s11.tif", ZYX, photometric="minisblack")
    refused(tmp_path, "s11.tif is no single grey slice")


def test_pixels_of_imagej_without_a_size_are_1_as_there_and_a_warning_says_so(tmp_path):
    about = {"axes": "ZYX", "spacing": 2, "unit": "um"}
    tifffile.imwrite(tmp_path / "a.tif", ZYX.astype("uint16"), imagej=True, resolution=(0, 0), metadata=about)
    with pytest.warns(IllumgridWarning, match="does not state the size of its pixels; 1 was assumed"):
        volume = read_volume(tmp_path / "a.tif")
    assert volume.spacing.tolist() == [1, 1, 2] and volume.unit == "µm"


@pytest.mark.filterwarnings("ignore:spacing")
def test_a_part_of_a_folder_of_slices(tmp_path):
    for k in range(7):
        tifffile.imwrite(tmp_path / f"s{k}.tif", ZYX[k], photometric="minisblack")
    (tmp_path / "s6.tif").write_bytes((tmp_path / "s6.tif").read_bytes()[:-40])  # is not opened
    crop = (1, 5, 0, 5, 2, 6)
    part = read_volume(tmp_path, crop=crop)
    assert np.array_equal(part.values, values()[1:5, :5, 2:6]) and part.origin.tolist() == [1, 0, 2]
    half = read_volume(tmp_path, crop=crop, downsample=2)
    blocks = values()[1:5, :4, 2:6].reshape(2, 2, 2, 2, 2, 2)
    assert np.allclose(half.values, blocks.mean(axis=(1, 3, 5)), rtol=1e-6) and half.origin.tolist() == [1.5, 0.5, 2.5]
    refused(tmp_path, "s6.tif")


CODECS = ["lzw", "deflate", "packbits", "zstd", "lzma"]


@pytest.mark.filterwarnings("ignore:spacing")
@pytest.mark.parametrize("codec", CODECS)
def test_packed_strips(tmp_path, codec):
    tifffile.imwrite(tmp_path / "a.tif", ZYX, compression=codec, photometric="minisblack", metadata=None)
    assert np.array_equal(read_volume(tmp_path / "a.tif").values, values())


@pytest.mark.filterwarnings("ignore:spacing")
def test_damage_to_deflated_strips_is_found(tmp_path):
    random = np.random.default_rng(3)
    array = random.integers(0, 999, (9, 10, 11)).astype("uint16")
    tifffile.imwrite(tmp_path / "a.tif", array, compression="deflate", photometric="minisblack", metadata=None)
    with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
        strips = [(p.dataoffsets[0], p.databytecounts[0]) for p in tiff.pages]
    whole = (tmp_path / "a.tif").read_bytes()
    for start, count in strips:
        damaged = bytearray(whole)
        damaged[start + int(random.integers(2, count))] ^= 1 << int(random.integers(8))
        (tmp_path / "a.tif").write_bytes(damaged)
        refused(tmp_path / "a.tif")


@pytest.mark.filterwarnings("ignore:spacing")
def test_colours_planes_and_whites(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.stack([ZYX.astype("u1")] * 3, -1), photometric="rgb")
    refused(tmp_path / "a.tif", "holds 3 channels: 0 red, 1 green, 2 blue")
    assert np.array_equal(read_volume(tmp_path / "a.tif", channel="green").values, values())
    tifffile.imwrite(tmp_path / "a.tif", ZYX[0], photometric="minisblack")
    refused(tmp_path / "a.tif", "2 axes (5x6)", "stack the slices")
    tifffile.imwrite(tmp_path / "a.tif", ZYX.astype("u1"), photometric="miniswhite")
    assert np.array_equal(read_volume(tmp_path / "a.tif").values, values())  # as stored
    tifffile.imwrite(tmp_path / "a.tif", values("complex64"), photometric="minisblack")
    refused(tmp_path / "a.tif", "complex64")


def test_planes_in_other_files_are_not_made_up(tmp_path):
    text = tifffile.OmeXml()
    text.addimage("uint16", (7, 6, 5), (7, 1, 1, 6, 5, 1), axes="ZYX")
    xml = text.tostring()
    tifffile.imwrite(tmp_path / "a.ome.tif", ZYX[0], description=xml, metadata=None, photometric="minisblack")
    refused(tmp_path / "a.ome.tif", "planes")


@pytest.mark.filterwarnings("ignore:spacing")
def test_several_series(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        for array in (ZYX, ZYX[:, :3], ZYX[0]):
            writer.write(array, photometric="minisblack")
    refused(tmp_path / "a.tif", "--array N")
    assert np.array_equal(read_volume(tmp_path / "a.tif", array=1).values, values()[:, :3])


def test_stacks_of_zeiss(tmp_path):
    three = np.stack([values("uint16") + 300 * channel for channel in range(3)])
    lsm_file(tmp_path / "a.lsm", three[:1], (2e-7, 2.5e-7, 1e-6))  # metres
    assert np.array_equal(spaced(tmp_path / "a.lsm", (0.2, 0.25, 1), "µm").values, values())
    lsm_file(tmp_path / "b.lsm", three, (2e-7, 2.5e-7, 1e-6))
    refused(tmp_path / "b.lsm", "holds 3 channels: 0, 1, 2", "--channel N")
    assert np.array_equal(read_volume(tmp_path / "b.lsm", channel=2).values, three[2])


def test_stacks_of_metamorph(tmp_path):
    file = stk_file(tmp_path / "a.stk", values(), 0.125, 0.5, "um")
    assert np.array_equal(spaced(file, (0.125, 0.125, 0.5), "µm").values, values())
    stk_file(tmp_path / "b.stk", values(), 1, 0.5, "pixel", calibrated=0)  # numbers that its own flag calls void
    with pytest.warns(IllumgridWarning, match="does not state the distance between its voxels"):
        spaced(tmp_path / "b.stk", (1, 1, 1), None)
