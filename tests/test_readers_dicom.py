"""DICOM, written by pydicom (and by ITK) as scanners do: places and values that went in, or the cause is named."""

import gzip
import shutil
import warnings
from pathlib import Path

import numpy as np
import pydicom
import pydicom.data
import pytest
from pydicom.uid import JPEG2000Lossless, RLELossless

from dicom_files import AXES, HOUNSFIELD, SHAPE, START, STEP, X, Y, Z, enhanced, image, item, place, series
from illumgrid.errors import BadInput, IllumgridWarning
from illumgrid.field.volume import index_to_world
from illumgrid.io.readers import read_volume
from volume_files import ORIGIN, SPACING, TURN, refused, refused_lightly, values, write, write_series, zipped

WHOLE = Path(pydicom.data.__file__).parent / "test_files"


def check(volume, field=HOUNSFIELD, at=place):
    """Every voxel lies where the standard's formula (C.7.6.2.1.1) puts it, and has its value."""
    assert volume.shape == field.shape
    corners = np.array([[0, 0, 0], [4, 0, 0], [0, 5, 0], [0, 0, field.shape[2] - 1], [3, 2, 1]])
    assert np.allclose(index_to_world(volume, corners), at(corners), atol=1e-4)
    assert np.allclose(volume.values, field, atol=1e-3)


def read(path, *words, **options):
    """Read with exactly the warnings that hold `words`."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        volume = read_volume(path, **options)
    said = [str(one.message) for one in caught]
    assert len(said) == len(words) and all(any(word in one for one in said) for word in words), said
    return volume


# One series of slices


def test_slices_of_itk(tmp_path):
    write_series(tmp_path / "scan", values("uint16"))
    write_series(tmp_path / "scan", values("uint16")[:, :, :1], uid="1.2.4")
    (tmp_path / "scan" / "notes.txt").write_text("a file of another kind")
    volume = read(tmp_path / "scan", "1 of 8 planes is left out")
    assert np.array_equal(volume.values, values())
    assert np.allclose(volume.origin, ORIGIN) and np.allclose(volume.spacing, SPACING)
    assert np.allclose(volume.direction, TURN * [1, 1, -1])


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"name": "{}"},
        {"PhotometricInterpretation": "MONOCHROME1"},  # values as stored, not inverted
        {"SpacingBetweenSlices": -2.5},
        {"dtype": "<i2", "intercept": 0},
        {"slope": lambda k: 0.5 + 0.5 * k, "intercept": lambda k: -1024},
        {"BitsStored": 12, "HighBit": 11},
    ],
)
def test_slices(tmp_path, more):
    field = HOUNSFIELD
    if "slope" in more:  # stored values are whole numbers
        scale = np.array([0.5 + 0.5 * k for k in range(7)])
        field = np.round((field + 1024) / scale) * scale - 1024
    check(read(series(tmp_path / "a", field, **more)), field)


def test_values_stay_as_small_as_the_pixels(tmp_path):
    whole = read(series(tmp_path / "a", HOUNSFIELD))
    assert whole.stored.dtype == np.int16 and whole.values is whole.stored
    field = np.round((HOUNSFIELD + 1024) / 0.3) * 0.3 - 1024
    scaled = read(series(tmp_path / "b", field, slope=0.3))
    assert scaled.stored.dtype == np.uint16 and np.allclose(scaled.values, field, rtol=0, atol=1e-10)


@pytest.mark.parametrize("slopes", [False, True])
@pytest.mark.parametrize("one_file", [False, True])
def test_a_part_is_read_as_a_part(tmp_path, one_file, slopes):
    scale = np.array([0.5 + 0.5 * k if slopes else 1.0 for k in range(7)])
    field = np.round((HOUNSFIELD + 1024) / scale) * scale - 1024
    if one_file:
        path = enhanced(tmp_path / "a.dcm", [3, 0, 5, 1, 6, 2, 4], [field] * 7, slope=lambda k: scale[k])
    else:
        path = series(tmp_path / "a", field, slope=lambda k: scale[k], intercept=lambda k: -1024)
        for k in (0, 1, 6):  # those outside are not unpacked
            file = path / f"{9 - k}.dcm"
            file.write_bytes(file.read_bytes()[:-9])
    crop = (1, 5, 0, 5, 2, 6)
    part = read(path, crop=crop)
    assert np.allclose(part.values, field[1:5, :5, 2:6]) and np.allclose(part.origin, place([1, 0, 2]))
    assert part.stored.itemsize == (4 if slopes else 2)
    half = read(path, crop=crop, downsample=2)
    assert np.allclose(half.values, field[1:5, :4, 2:6].reshape(2, 2, 2, 2, 2, 2).mean(axis=(1, 3, 5)), rtol=1e-6)
    assert np.allclose(half.origin, place([1.5, 0.5, 2.5])) and np.allclose(half.spacing, 2 * STEP)
    with pytest.raises(BadInput, match="--crop is 0 5 0 6 0 8; expected"):
        read_volume(path, crop=(0, 5, 0, 6, 0, 8))


def test_a_part_of_slices_between_which_one_is_missing(tmp_path):
    path = series(tmp_path / "a", ks=[0, 1, 2, 4, 5, 6])
    part = read(path, "slices are missing", crop=(0, 5, 1, 6, 4, 7))
    assert np.allclose(part.values, HOUNSFIELD[:, 1:, 4:]) and np.allclose(part.origin, place([0, 1, 4]))


def test_sub_folders_and_what_else_lies_there(tmp_path):
    series(tmp_path / "study" / "a", ks=range(3))
    series(tmp_path / "study" / "b", ks=range(3, 7))
    (tmp_path / "study" / "DICOMDIR").write_bytes(b"\0" * 128 + b"DICM" + b"\0" * 99)
    (tmp_path / "study" / ".DS_Store").write_bytes(b"x" * 99)
    (tmp_path / "study" / "report.txt").write_text("well")
    check(read(tmp_path))
    shutil.copy(tmp_path / "study" / "a" / "9.dcm", tmp_path / "copy.dcm")
    check(read(tmp_path, "copies"))


def test_a_folder_with_a_name_of_other_letters_and_gzipped_slices(tmp_path):
    folder = series(tmp_path / "Röntgen bilder")
    for file in folder.iterdir():
        file.with_name(f"{file.name}.gz").write_bytes(gzip.compress(file.read_bytes()))
        file.unlink()
    check(read(folder))


def test_a_preamble_like_that_of_a_tiff(tmp_path):
    for file in series(tmp_path / "a").iterdir():
        file.write_bytes(b"II*\0" + b"\x08\0\0\0" + bytes(120) + file.read_bytes()[128:])
    check(read(tmp_path / "a"))
    refused(tmp_path / "a" / "9.dcm", "5x6x1", "folder")


def test_no_preamble(tmp_path):
    for file in series(tmp_path / "a").iterdir():
        whole = pydicom.dcmread(file)
        whole.preamble = None
        del whole.file_meta
        whole.save_as(file, implicit_vr=True, little_endian=True, enforce_file_format=False)
    check(read(tmp_path / "a"))


@pytest.mark.parametrize("implicit", [True, False])
def test_no_preamble_and_no_ending(tmp_path, implicit):
    enhanced(tmp_path / "IM0001", [3, 0, 5, 1, 6, 2, 4], [HOUNSFIELD] * 7)
    whole = pydicom.dcmread(tmp_path / "IM0001")
    whole.preamble = None
    del whole.file_meta
    whole.save_as(tmp_path / "IM0001", implicit_vr=implicit, little_endian=True, enforce_file_format=False)
    check(read(tmp_path / "IM0001"))


@pytest.mark.parametrize("packing", [RLELossless, JPEG2000Lossless])
def test_packed_slices(tmp_path, packing):
    field = np.tile(HOUNSFIELD, (13, 11, 1))  # JPEG 2000 needs room for its resolutions
    for file in series(tmp_path / "a", field).iterdir():
        whole = pydicom.dcmread(file)
        whole.compress(packing)
        whole.save_as(file, enforce_file_format=True)
    check(read(tmp_path / "a"), field)


def test_a_packing_that_needs_a_package_names_it(tmp_path, monkeypatch):
    shutil.copytree(WHOLE / "dicomdirtests" / "98892001" / "CT5N", tmp_path / "a")
    from pydicom.pixels.decoders.base import Decoder

    monkeypatch.setattr(Decoder, "is_available", False)
    refused(tmp_path / "a", "Explicit VR", "pip install illumgrid[dicom]")


# What does not lie on one even lattice


def test_a_missing_slice_is_interpolated_and_said(tmp_path):
    linear = 10 * X + 20 * Y + 30 * Z - 900  # what linear interpolation gives back
    volume = read(series(tmp_path / "a", linear, ks=[0, 1, 2, 4, 5, 6]), "1 of its 7 slices is missing (between 85")
    check(volume, linear)
    check(read(enhanced(tmp_path / "b.dcm", [6, 0, 2, 3, 5], [linear] * 5), "2 of its 7 slices are missing"), linear)
    series(tmp_path / "c", np.concatenate([linear] * 3, axis=2), ks=[0, 1, 2, 18, 19, 20])
    refused(tmp_path / "c", "there is a gap", "on one side")


def test_uneven_slices_are_interpolated_onto_even_ones(tmp_path):
    z = np.array([0, 1, 2, 3, 4.5, 6, 7.5])
    ramp = (10 * X + 100 * z[Z] - 900).astype(int)

    def at(index):
        return START + (np.array([0, 0, z[index[2]]]) * STEP) @ AXES

    volume = read(series(tmp_path / "a", ramp, at=at), "unevenly spaced: 2.5 to 3.75 mm")
    index = np.array([[1, 1, k] for k in range(volume.shape[2])])
    along = (index_to_world(volume, index) - START) @ AXES[2] / STEP[2]
    assert np.allclose(volume.values[1, 1], 100 * along + 10 - 900, atol=0.51)


def test_a_tilted_gantry_is_sheared_back_and_said(tmp_path):
    tilted = AXES.copy()
    tilted[2] = AXES[2] + 0.36 * AXES[1]  # one row a slice

    def at(index):
        return START + (np.asarray(index) * STEP) @ tilted

    volume = read(series(tmp_path / "a", at=at), "tilt", "resampled")
    points = at(np.array([[1, 2, 3], [4, 5, 6], [0, 0, 0], [2, 3, 5]]))
    found = np.linalg.solve(volume.direction * volume.spacing, (points - volume.origin).T).T
    assert np.allclose(found, np.round(found), atol=1e-3)
    found = np.round(found).astype(int)
    assert np.allclose(volume.values[tuple(found.T)], HOUNSFIELD[[1, 4, 0, 2], [2, 5, 0, 3], [3, 6, 0, 5]], atol=1e-2)


def test_slices_that_shift_unevenly_are_refused(tmp_path):
    aside = np.array([0, 3, 0, 0, 3, 3, 0.0])
    series(tmp_path / "a", at=lambda index: place(index) + aside[index[2]] * AXES[0])
    refused(tmp_path / "a", "shifted")


def test_a_localizer_beside_the_slices(tmp_path):
    series(tmp_path / "a")
    scout = image(HOUNSFIELD[:, :, 0].T, at=place([1, 2, 3]))
    scout.ImageOrientationPatient = [0, 1, 0, 0, 0, -1]
    scout.save_as(tmp_path / "a" / "scout.dcm", enforce_file_format=True)
    check(read(tmp_path / "a", "1 of 8 planes is left out"))
    series(tmp_path / "b")
    series(tmp_path / "b", ks=range(3), name="s{}", uid="1.2.9", ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"])
    check(read(tmp_path / "b", "3 of 10 planes are left out (a localizer"))
    assert read(tmp_path / "b", array=1).shape == (5, 6, 3)


def test_two_series_are_a_choice(tmp_path):
    series(tmp_path / "a", SeriesDescription="thin", SeriesNumber=2)
    series(tmp_path / "a", HOUNSFIELD + 5, name="b{}", uid="1.2.4", SeriesDescription="thick", SeriesNumber=3)
    refused(tmp_path / "a", "2 arrays", "series 2: CT thin, 7 slices", "series 3: CT thick, 7 slices", "--array")
    check(read(tmp_path / "a", array="1"), HOUNSFIELD + 5)


@pytest.mark.parametrize(
    "mark",
    [
        {},
        {"TemporalPositionIdentifier": (1, 2)},
        {"EchoTime": (4.5, 9)},
        {"AcquisitionNumber": (4, 5)},
        {"ImageType": (["ORIGINAL", "PRIMARY", "M"], ["ORIGINAL", "PRIMARY", "P"])},
    ],
)
def test_two_phases_are_a_choice(tmp_path, mark):
    for k in (0, 1):
        # Numbers of all instances run on, as scanners count; times differ from slice to slice.
        own = {name: pair[k] for name, pair in mark.items()}
        series(tmp_path / "a", HOUNSFIELD + 200 * k, name=f"p{k}-{{}}", TriggerTime=lambda z, k=k: 7 * z + k, **own)
        for file in (tmp_path / "a").glob(f"p{k}-*"):
            whole = pydicom.dcmread(file)
            whole.InstanceNumber += 10 * k
            whole.save_as(file)
    refused(tmp_path / "a", "2 time steps", "--time", *mark)
    said = () if mark else ("its headers do not distinguish its 2 volumes",)
    for k in (0, 1):
        check(read(tmp_path / "a", *said, time=k), HOUNSFIELD + 200 * k)


def test_fields_of_view_beside_each_other_are_a_choice(tmp_path):
    series(tmp_path / "a")
    series(tmp_path / "a", HOUNSFIELD + 5, name="{}b.dcm", at=lambda index: place(index) + 200 * AXES[0])
    refused(tmp_path / "a", "first pixel in the plane at -100", "--time")
    check(read(tmp_path / "a", time=0))
    check(read(tmp_path / "a", time=1), HOUNSFIELD + 5, lambda index: place(index) + 200 * AXES[0])


def test_a_phase_that_lacks_a_slice(tmp_path):
    linear = 10 * X + 20 * Y + 30 * Z - 900
    series(tmp_path / "a", linear, TemporalPositionIdentifier=1)
    series(tmp_path / "a", linear + 200, ks=[0, 1, 2, 4, 5, 6], name="b{}", TemporalPositionIdentifier=2)
    check(read(tmp_path / "a", time=0), linear)
    check(read(tmp_path / "a", "1 of its 7 slices is missing", time=1), linear + 200)


def test_acquisitions_between_each_other(tmp_path):
    series(tmp_path / "a", AcquisitionNumber=1)
    series(tmp_path / "a", at=lambda i: place(i) + 0.9 * AXES[2], name="b{}", AcquisitionNumber=2)
    refused(tmp_path / "a", "AcquisitionNumber 1", "--time")
    check(read(tmp_path / "a", time=0))


# Files of many frames


def test_frames_of_itk(tmp_path):
    (tmp_path / "scan").mkdir()
    write(tmp_path / "scan" / "a.dcm", values("uint16"), np.eye(3))
    for path in (tmp_path / "scan", tmp_path / "scan" / "a.dcm", zipped(tmp_path / "scan" / "a.dcm")):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", IllumgridWarning)  # ITK writes no places, and the last is a copy
            assert np.array_equal(read_volume(path).values, values())


@pytest.mark.parametrize("order", [range(7), range(6, -1, -1), [3, 0, 5, 1, 6, 2, 4]])
def test_frames_are_sorted_by_their_places(tmp_path, order):
    enhanced(tmp_path / "a.dcm", order, [HOUNSFIELD] * 7)
    check(read(tmp_path / "a.dcm"))
    check(read(tmp_path))


def test_each_frame_has_its_own_slope(tmp_path):
    scale = np.array([0.5 + 0.25 * k for k in range(7)])
    field = np.round((HOUNSFIELD + 1024) / scale) * scale - 1024
    check(read(enhanced(tmp_path / "a.dcm", [3, 0, 5, 1, 6, 2, 4], [field] * 7, slope=lambda k: scale[k])), field)


def test_phases_of_frames_are_a_choice(tmp_path):
    order = [k for k in range(7) for _ in range(2)]
    fields = [HOUNSFIELD, HOUNSFIELD + 200] * 7
    enhanced(tmp_path / "a.dcm", order, fields, TemporalPositionIndex=[1, 2] * 7)
    refused(tmp_path / "a.dcm", "2 time steps", "TemporalPositionIndex 1", "--time")
    check(read(tmp_path / "a.dcm", time=1), HOUNSFIELD + 200)


def test_dose(tmp_path):
    with pydicom.dcmread(WHOLE / "rtdose.dcm") as whole:
        there = whole.pixel_array * float(whole.DoseGridScaling)
        offsets = np.array(whole.GridFrameOffsetVector, float)
        start = np.array(whole.ImagePositionPatient, float)
    for name in ("rtdose.dcm", "rtdose_expb.dcm", "rtdose_rle.dcm"):
        volume = read(WHOLE / name)
        assert np.allclose(volume.values, there.transpose(2, 1, 0), rtol=1e-6)
        assert np.allclose(index_to_world(volume, [[0, 0, 0], [0, 0, 14]])[:, :2], start[:2])
        assert np.allclose(index_to_world(volume, [[0, 0, 14]])[0, 2], start[2] + offsets[14])
    refused(WHOLE / "rtdose_1frame.dcm", "single DICOM plane")


def test_a_film_and_colours_are_named(tmp_path):
    refused(WHOLE / "examples_ybr_color.dcm", "film")
    refused(WHOLE / "SC_rgb_rle_2frame.dcm", "colours", "--channel")
    red = read(WHOLE / "SC_rgb_rle_2frame.dcm", "does not state the position", channel=0)
    there = pydicom.dcmread(WHOLE / "SC_rgb_rle_2frame.dcm").pixel_array
    assert np.array_equal(red.values, there[..., 0].T)


def test_a_segmentation_becomes_a_label_map(tmp_path):
    masks = np.zeros((4, 6, 5), np.uint8)
    masks[0, 1:3, 1:4], masks[1, 2:5, 2:4], masks[2, :2, :2], masks[3, 4, 4] = 1, 1, 1, 1
    where, segment = [0, 1, 1, 2], [1, 1, 2, 2]
    enhanced(tmp_path / "a.dcm", where, [np.zeros(SHAPE)] * 4)
    whole = pydicom.dcmread(tmp_path / "a.dcm")
    whole.Modality, whole.SegmentationType = "SEG", "BINARY"
    whole.BitsAllocated = whole.BitsStored = 1
    whole.HighBit = 0
    whole.PixelData = np.packbits(masks.ravel(), bitorder="little").tobytes()
    for frame, number in zip(whole.PerFrameFunctionalGroupsSequence, segment):
        frame.SegmentIdentificationSequence = [item(ReferencedSegmentNumber=number)]
    whole.save_as(tmp_path / "a.dcm")
    right = np.stack([masks[0], np.maximum(masks[1], 2 * masks[2]), 2 * masks[3]])
    assert np.array_equal(read(tmp_path / "a.dcm").values, right.transpose(2, 1, 0))


# What is broken


def test_a_cut_slice_is_refused(tmp_path):
    series(tmp_path / "a")
    last = tmp_path / "a" / "3.dcm"
    whole = last.read_bytes()
    for cut in (9, 59, 62, 400):
        last.write_bytes(whole[:-cut])
        refused(tmp_path / "a", "3.dcm")


def test_no_stack(tmp_path):
    write(tmp_path / "a.nrrd")
    refused(tmp_path, "none", "DICOM")
    write_series(tmp_path / "scan", values("uint16")[:, :, :1])
    refused(tmp_path / "scan", "1.2.3", "a single plane")
    refused(next((tmp_path / "scan").iterdir()), "5x6x1", "folder")


@pytest.mark.parametrize("lie", [{"Rows": 60000, "Columns": 60000}, {"NumberOfFrames": 2**31 - 1}, {"Rows": 65535}])
def test_a_header_that_lies_about_its_size(tmp_path, lie):
    enhanced(tmp_path / "a.dcm", range(7), [HOUNSFIELD] * 7)
    whole = pydicom.dcmread(tmp_path / "a.dcm")
    for name, value in lie.items():
        setattr(whole, name, value)
    whole.save_as(tmp_path / "a.dcm")
    refused_lightly(tmp_path / "a.dcm")


def test_what_the_header_lacks_is_assumed_and_said(tmp_path):
    image(np.moveaxis(HOUNSFIELD, 2, 0).transpose(0, 2, 1), NumberOfFrames=7).save_as(
        tmp_path / "a.dcm", enforce_file_format=True
    )
    volume = read(tmp_path / "a.dcm", "does not state the position of its slices")
    assert np.array_equal(volume.values, HOUNSFIELD) and np.allclose(volume.spacing, 1)


def test_a_gzipped_multi_frame_of_philips_lies_where_nibabel_says():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it calls itself experimental
        from nibabel.nicom import dicomwrappers
    path = Path(dicomwrappers.__file__).parent / "tests" / "data" / "philips_mprage.dcm.gz"
    if not path.exists():
        pytest.skip("this nibabel comes without its test data")
    with gzip.open(path) as stream, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        there = dicomwrappers.wrapper_from_data(pydicom.dcmread(stream))
        values, affine = there.get_data(), there.affine
    volume = read(path)
    index = np.random.default_rng(0).integers(0, values.shape, (200, 3))
    world = index @ affine[:3, :3].T + affine[:3, 3]
    found = np.linalg.solve(volume.direction * volume.spacing, (world - volume.origin).T).T
    assert np.abs(found - found.round()).max() < 0.01
    assert np.allclose(volume.values[tuple(found.round().astype(int).T)], values[tuple(index.T)])
