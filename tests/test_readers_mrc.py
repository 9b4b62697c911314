"""MRC and CCP4 maps against mrcfile and the standard: places, angles, axis order, stacks, modes."""

import mrcfile
import numpy as np
import pytest

from illumgrid.errors import IllumgridWarning
from illumgrid.io.readers import read_volume
from volume_files import refused, values


def saved(file, array=None, cell=(10.0, 18.0, 35.0), **header):
    with mrcfile.new(file, overwrite=True) as mrc:
        mrc.set_data((values("float32") if array is None else array).T.copy())
        if "set" in header:
            header.pop("set")(mrc)
        mrc.header.cella = cell
        for name, value in header.items():
            mrc.header[name] = value
    return file


def test_spacing_and_start(tmp_path):
    volume = read_volume(saved(tmp_path / "a.mrc"))
    with mrcfile.open(tmp_path / "a.mrc") as mrc:
        assert np.array_equal(volume.values, mrc.data.T)
        assert np.allclose(volume.spacing, [mrc.voxel_size[a] for a in "xyz"])
    assert volume.unit == "Å" and not volume.origin.any()
    shifted = read_volume(saved(tmp_path / "a.map", nxstart=-2, nystart=3, nzstart=4))
    assert np.allclose(shifted.origin, np.array([-2, 3, 4]) * volume.spacing)
    wider = read_volume(tmp_path / "a.map", spacing=(1, 2, 3))  # starts are counted in voxels, whatever their size
    assert np.allclose(wider.origin, (-2, 6, 12)) and np.allclose(wider.spacing, (1, 2, 3))
    placed = read_volume(saved(tmp_path / "a.ccp4", origin=(1.5, -2, 8)))
    assert np.allclose(placed.origin, (1.5, -2, 8))
    with pytest.warns(IllumgridWarning, match="its origin and its starts differ"):
        assert np.allclose(read_volume(saved(tmp_path / "a.mrc", nxstart=9, origin=(1.5, -2, 8))).origin, (1.5, -2, 8))


def test_cell_angles(tmp_path):
    # CCP4: a along x, b in the plane of x and y; of a hexagonal cell b = (-1/2, √3/2, 0).
    file = saved(tmp_path / "a.map", cellb=(90, 90, 120))
    with pytest.warns(IllumgridWarning, match="30.0° off right angles; it was resampled"):
        volume = read_volume(file)
    a, b, c = np.array([10.0, 18, 35]) / (5, 6, 7)
    for i, j, k in np.ndindex(5, 6, 7):
        there = np.array([a * i - b * j / 2, b * j * 3**0.5 / 2, c * k])
        x, y, z = (there - volume.origin) / volume.spacing
        if abs(x - round(x)) < 1e-6:
            assert volume.values[round(x), round(y), round(z)] == pytest.approx(values()[i, j, k], abs=1e-3)
    assert np.allclose(volume.spacing, (a, b * 3**0.5 / 2, c)) and np.isnan(volume.values).any()
    refused(saved(tmp_path / "a.map", cellb=(90, 90, 179.99)), "expected three different directions")


@pytest.mark.parametrize("order", [(1, 2, 3), (3, 1, 2), (2, 1, 3)])
def test_axis_order(tmp_path, order):
    # The file's columns, rows and sections are the axes `order` of x, y, z.
    turned = values("float32").transpose([axis - 1 for axis in order])
    shape = values().shape
    names = ("mapc", "mapr", "maps", "nxstart", "nystart", "nzstart", "mx", "my", "mz")
    file = saved(tmp_path / "a.map", turned, **dict(zip(names, (*order, *order, *shape))))
    volume = read_volume(file)
    assert np.array_equal(volume.values, values())
    assert np.allclose(volume.spacing, np.array([10.0, 18, 35]) / shape)
    assert np.allclose(volume.origin, np.array([1, 2, 3]) * volume.spacing)


def test_axis_order_of_zeros(tmp_path):
    with pytest.warns(IllumgridWarning, match="columns, rows, sections were assumed"):
        assert np.array_equal(read_volume(saved(tmp_path / "a.map", mapc=0, mapr=0, maps=0)).values, values())
    refused(saved(tmp_path / "a.map", mapc=1, mapr=1, maps=3), "(1, 1, 3)")


def test_a_stack_of_volumes(tmp_path):
    many = values("float32", (5, 6, 14))
    file = saved(tmp_path / "a.mrc", many, ispg=401, mz=7)
    refused(file, "holds 2 arrays: 0 volume 0, 1 volume 1", "--array N")
    assert np.array_equal(read_volume(file, array=1).values, many[:, :, 7:])
    assert read_volume(file, array=1).spacing[2] == 5


@pytest.mark.parametrize("dtype", ["int8", "int16", "uint16", "float16", "float32"])
def test_modes(tmp_path, dtype):
    array = (values() // 2).astype(dtype)
    assert np.array_equal(read_volume(saved(tmp_path / "a.mrc", array)).values, array.astype(np.float32))


def test_modes_that_are_no_map(tmp_path):
    refused(saved(tmp_path / "a.mrc", values("complex64")), "Fourier")
    refused(saved(tmp_path / "a.mrc", mode=101), "its mode is 101")


def test_what_calls_itself_images(tmp_path):
    with pytest.warns(IllumgridWarning, match="calls itself a stack of images"):
        read_volume(saved(tmp_path / "a.mrcs", ispg=0, mz=1, cell=(10, 18, 5)))
