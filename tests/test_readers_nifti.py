"""NIfTI as nibabel reads it, in LPS: qform and sform, shear, scaling, NIfTI-2, pairs, times and channels."""

import gzip

import nibabel
import numpy as np
import pytest

from illumgrid.errors import IllumgridWarning
from illumgrid.field.volume import index_to_world
from illumgrid.io.readers import read_volume
from volume_files import refused, values

CORNERS = np.array([(0, 0, 0), (4, 0, 0), (0, 5, 0), (0, 0, 6), (3, 2, 5)])
AFFINE = np.array([[0, -1.5, 0, 30], [1.2, 0, 0, -20], [0, 0, 2.5, 7], [0, 0, 0, 1.0]])


def saved(file, array=None, affine=AFFINE, kind=nibabel.Nifti1Image, **forms):
    image = kind(values("int16") if array is None else array, affine)
    for name, (matrix, code) in forms.items():
        getattr(image, f"set_{name}")(matrix, code)
    nibabel.save(image, file)
    return file


def lies_as_nibabel_says(file, volume, tolerance=1e-4):
    image = nibabel.load(file)
    there = nibabel.affines.apply_affine(image.affine, CORNERS) * [-1, -1, 1]  # RAS to LPS
    assert np.allclose(index_to_world(volume, CORNERS), there, atol=tolerance)
    assert np.allclose(volume.values, np.asarray(image.dataobj), rtol=1e-6)
    assert volume.unit == "mm"


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a.hdr", "a.img.gz", "A.NII"])
@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
def test_both_versions_and_pairs(tmp_path, name, kind):
    if name.startswith(("a.hdr", "a.img")):
        kind = {nibabel.Nifti1Image: nibabel.Nifti1Pair, nibabel.Nifti2Image: nibabel.Nifti2Pair}[kind]
    file = saved(tmp_path / name, kind=kind)
    lies_as_nibabel_says(file, read_volume(file))
    if name == "a.hdr":
        lies_as_nibabel_says(file, read_volume(tmp_path / "a.img"))
        (tmp_path / "a.img").unlink()
        refused(file, "a.img, is not there", "copy both")


def test_the_sform_counts_and_a_difference_is_reported(tmp_path):
    other = AFFINE.copy()
    other[0, 3] += 3
    file = saved(tmp_path / "a.nii", qform=(AFFINE, 1), sform=(other, 2))
    with pytest.warns(IllumgridWarning, match=r"placement: a\.nii: its qform and sform .* up to 2\.5 voxels"):
        lies_as_nibabel_says(file, read_volume(file))


@pytest.mark.parametrize("which", ["qform", "sform"])
def test_one_of_both(tmp_path, which):
    forms = {"qform": (None, 0), "sform": (None, 0), which: (AFFINE, 1)}
    file = saved(tmp_path / "a.nii", **forms)
    lies_as_nibabel_says(file, read_volume(file))


def test_neither_is_reported(tmp_path):
    file = saved(tmp_path / "a.nii", qform=(None, 0), sform=(None, 0))
    with pytest.warns(IllumgridWarning, match="placement: .*sets neither qform nor sform"):
        lies_as_nibabel_says(file, read_volume(file))


def test_a_sheared_sform_is_resampled_where_it_lies(tmp_path):
    sheared = AFFINE @ np.array([[1, 0, 0.5, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    file = saved(tmp_path / "a.nii", sform=(sheared, 1), qform=(None, 0))
    with pytest.warns(IllumgridWarning, match="placement: .* off right angles; it was resampled"):
        volume = read_volume(file)
    for index in CORNERS:
        there = (sheared @ [*index, 1])[:3] * [-1, -1, 1]
        at = (there - volume.origin) @ volume.direction / volume.spacing
        if np.allclose(at, np.round(at), atol=1e-4):  # every other slice moves by whole voxels
            here = volume.values[tuple(np.round(at).astype(int))]
            assert here == pytest.approx(values("int16")[tuple(index)], abs=1e-3)


def test_a_slope_of_0_means_none_and_others_scale(tmp_path):
    file = saved(tmp_path / "a.nii")
    for slope, intercept, expected in ((0, 5, values()), (0.5, 3, 0.5 * values() + 3), (-2, 0, -2.0 * values())):
        data = bytearray(file.read_bytes())
        data[112:120] = np.array([slope, intercept], "<f4").tobytes()
        file.write_bytes(data)
        assert np.array_equal(read_volume(file).values, expected.astype(np.float32))
        lies_as_nibabel_says(file, read_volume(file))


def test_scaled_values_are_those_of_nibabel_and_stay_as_small_as_in_the_file(tmp_path):
    import nibabel

    file = tmp_path / "a.nii"
    nibabel.save(nibabel.Nifti1Image(values("int16"), np.diag([2.0, 3, 4, 1])), file)
    data = bytearray(file.read_bytes())
    data[112:120] = np.array([0.013, -7.3], "<f4").tobytes()  # saving would leave them out
    file.write_bytes(data)
    assert nibabel.load(file).dataobj.slope == pytest.approx(0.013)
    volume = read_volume(file)
    assert volume.stored.dtype == np.int16
    assert np.allclose(volume.values, nibabel.load(file).get_fdata(), rtol=1e-14, atol=1e-12)
    low, high = volume.extremes
    assert low == volume.values.min() and high == volume.values.max()


def test_times_and_channels(tmp_path):
    many = values("int16", (5, 6, 7, 4))
    file = saved(tmp_path / "a.nii", many)
    refused(file, "holds 4 time steps: 0, 1, 2, 3", "--time N")
    assert np.array_equal(read_volume(file, time=2).values, many[..., 2])
    saved(file, many[:, :, :, None, :])
    assert np.array_equal(read_volume(file, channel=3).values, many[..., 3])
    saved(file, many[..., :1])
    assert np.array_equal(read_volume(file).values, many[..., 0])


def test_colours_and_complex_numbers(tmp_path):
    refused(saved(tmp_path / "a.nii", values("complex64")), "complex", "magnitude")
    colours = np.zeros((5, 6, 7), [("R", "u1"), ("G", "u1"), ("B", "u1")])
    refused(saved(tmp_path / "a.nii", colours), "expected one real number")


def test_damaged_gzip_is_refused(tmp_path):
    random = np.random.default_rng(1)
    file = saved(tmp_path / "a.nii.gz", random.integers(0, 999, (9, 9, 9)).astype("int16"))
    whole = file.read_bytes()
    for _ in range(60):
        data = bytearray(whole)
        data[random.integers(400, len(data))] ^= 1 << random.integers(8)
        file.write_bytes(data)
        refused(file)
    # Stored blocks: only the checksum tells.
    plain = gzip.decompress(whole)
    file.write_bytes(gzip.compress(plain, 0))
    data = bytearray(file.read_bytes())
    data[1000] ^= 1
    file.write_bytes(data)
    refused(file, "CRC")


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # nibabel leaves the file open
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("ending", ["mgh", "mgz"])
def test_freesurfer(tmp_path, ending):
    from nibabel.freesurfer.mghformat import MGHImage

    nibabel.save(MGHImage(values("int16"), AFFINE), tmp_path / f"a.{ending}")
    lies_as_nibabel_says(tmp_path / f"a.{ending}", read_volume(tmp_path / f"a.{ending}"))
    nibabel.save(MGHImage(values("float32", (5, 6, 7, 2)), AFFINE), tmp_path / f"a.{ending}")
    refused(tmp_path / f"a.{ending}", "holds 2 time steps")


def test_what_nibabel_mends_is_reported_and_stays_off_the_terminal(tmp_path, capfd):
    file = saved(tmp_path / "a.nii", sform=(AFFINE, 1), qform=(None, 0))
    data = bytearray(file.read_bytes())
    data[80:84] = np.array(-1.2, "<f4").tobytes()  # pixdim[1]
    file.write_bytes(data)
    with pytest.warns(IllumgridWarning, match=r"file: a\.nii: nibabel reports: pixdim\[1,2,3\] should be positive"):
        read_volume(file)
    assert capfd.readouterr().err == ""
