"""Writes DICOM as scanners do, by pydicom, for the tests of the readers."""

import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid

SHAPE = (5, 6, 7)
AXES = np.array([[1, 0, 0], [0, 0.8, 0.6], [0, -0.6, 0.8]])  # rows of this are x, y and the normal
STEP, START = np.array([0.7, 0.9, 2.5]), np.array([-100.0, -80.0, 40.0])
X, Y, Z = np.meshgrid(*map(np.arange, SHAPE), indexing="ij")
HOUNSFIELD = 10 * X + 20 * Y + 30 * Z + X * Y * Z - 900


def place(index):
    return START + (np.asarray(index) * STEP) @ AXES


def item(**attributes):
    made = Dataset()
    for name, value in attributes.items():
        setattr(made, name, value)
    return made


def image(pixels, uid="1.2.3", at=None, slope=1, intercept=-1024, dtype="<u2", **more):
    """One frame, or many without functional groups; pixels are (rows, columns) or (n, rows, columns)."""
    made = Dataset()
    made.file_meta = FileMetaDataset()
    made.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    made.file_meta.MediaStorageSOPClassUID = made.SOPClassUID = CTImageStorage
    made.file_meta.MediaStorageSOPInstanceUID = made.SOPInstanceUID = generate_uid()
    made.SeriesInstanceUID, made.Modality, made.SamplesPerPixel = uid, "CT", 1
    made.PhotometricInterpretation = "MONOCHROME2"
    made.Rows, made.Columns = pixels.shape[-2:]
    made.BitsAllocated = made.BitsStored = 8 * np.dtype(dtype).itemsize
    made.HighBit, made.PixelRepresentation = made.BitsStored - 1, int(np.dtype(dtype).kind == "i")
    if at is not None:
        made.ImagePositionPatient = [f"{x:.6f}" for x in at]
        made.ImageOrientationPatient = [f"{x:.6f}" for x in AXES[:2].ravel()]
        made.PixelSpacing, made.SliceThickness = [STEP[1], STEP[0]], STEP[2]
    made.RescaleSlope, made.RescaleIntercept = slope, intercept
    for name, value in more.items():
        setattr(made, name, value)
    made.PixelData = np.round((pixels - intercept) / slope).astype(dtype).tobytes()
    return made


def series(folder, field=HOUNSFIELD, ks=range(7), at=place, name="{}.dcm", **more):
    """Slices of a field in files whose numbers run against their places."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in ks:
        own = {key: value(k) if callable(value) else value for key, value in more.items()}
        made = image(field[:, :, k].T, at=at([0, 0, k]), InstanceNumber=9 - k, **own)
        made.save_as(folder / name.format(9 - k), enforce_file_format=True)
    return folder


def enhanced(path, order, fields, slope=lambda k: 1.0, **content):
    """One file whose frames are slices order[n] of fields[n]."""
    pixels = np.stack([np.round((f[:, :, k].T + 1024) / slope(k)) for k, f in zip(order, fields)])
    made = image(pixels - 1024)
    del made.RescaleSlope, made.RescaleIntercept
    made.NumberOfFrames = len(order)
    made.SharedFunctionalGroupsSequence = [
        item(
            PixelMeasuresSequence=[item(PixelSpacing=[STEP[1], STEP[0]], SliceThickness=2.5)],
            PlaneOrientationSequence=[item(ImageOrientationPatient=[f"{x:.6f}" for x in AXES[:2].ravel()])],
        )
    ]
    made.PerFrameFunctionalGroupsSequence = [
        item(
            PlanePositionSequence=[item(ImagePositionPatient=[f"{x:.6f}" for x in place([0, 0, k])])],
            FrameContentSequence=[item(**{key: value[n] for key, value in content.items()})],
            PixelValueTransformationSequence=[item(RescaleSlope=slope(k), RescaleIntercept=-1024, RescaleType="HU")],
        )
        for n, k in enumerate(order)
    ]
    made.save_as(path, enforce_file_format=True)
    return path
