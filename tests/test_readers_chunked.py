"""Zarr, OME-Zarr and HDF5, read some chunks at a time; arrays larger than a quarter of the memory are paged."""

import importlib

import h5py
import numpy as np
import pytest
import zarr

import illumgrid as ig
from illumgrid.field.volume import index_to_world
from illumgrid.io.readers import chunked, limits, paged, read_volume
from volume_files import refused

RANDOM = np.random.default_rng(0).integers(0, 255, (11, 9, 13)).astype(np.uint8)
BOX = (2, 10, 1, 8, 0, 9)
NOTED = pytest.mark.filterwarnings("ignore::illumgrid.errors.IllumgridWarning")


def zarr_array(place, values, chunks=(4, 3, 5), version=3, **options):
    array = zarr.create_array(
        str(place), shape=values.shape, chunks=chunks, dtype=values.dtype, zarr_format=version, **options
    )
    array[...] = values
    return array


def ome(place, values, version="0.5", levels=2, unit="micrometer"):
    """An image t, c, z, y, x of two resolutions; the coarse one is moved by half a voxel, as means are."""
    group = zarr.create_group(str(place), zarr_format=3 if version == "0.5" else 2)
    datasets, scale = [], np.array([1, 1, 2.0, 0.5, 0.25])
    whole = np.stack([values.T, values.T // 2])[None]  # z, y, x
    for k in range(levels):
        step = 2**k
        part = whole[:, :, : 12 // step * step : step, ::step, ::step] if k else whole
        array = group.create_array(str(k), shape=part.shape, chunks=(1, 1, 5, 4, 3), dtype=part.dtype)
        array[...] = part
        factors = np.array([1, 1, step, step, step])
        change = [{"type": "scale", "scale": (scale * factors).tolist()}]
        change += [{"type": "translation", "translation": [0, 0, 10.0, 0, 0.125 * k]}]
        datasets.append({"path": str(k), "coordinateTransformations": change})
    axes = [{"name": "t", "type": "time"}, {"name": "c", "type": "channel"}]
    axes += [{"name": name, "type": "space", "unit": unit} for name in "zyx"]
    several = [{"axes": axes, "datasets": datasets, "version": version}]
    group.attrs.update({"ome": {"version": version, "multiscales": several}} if version == "0.5" else
                       {"multiscales": several})  # fmt: skip
    return group


def hdf5(place, values, **options):
    with h5py.File(place, "w") as file:
        data = file.create_dataset("a/b", data=values, chunks=(4, 3, 5), compression="gzip", **options)
        data.attrs["element_size_um"] = (0.5, 1.0, 2.0)
        file["flat"] = np.zeros((3, 4))
    return place


MADE = {
    "v3.zarr": lambda place: zarr_array(place, RANDOM),
    "v2.zarr": lambda place: zarr_array(place, RANDOM, version=2, order="F"),
    "shards.zarr": lambda place: zarr_array(place, RANDOM, chunks=(2, 3, 5), shards=(4, 6, 10)),
    "named.zarr": lambda place: zarr_array(place, RANDOM.T, (5, 3, 4), dimension_names=("z", "y", "x")),
    "a.h5": lambda place: hdf5(place, RANDOM),
}


@NOTED
@pytest.mark.parametrize("name", list(MADE))
def test_chunks_are_the_array_and_a_part_is_that_of_the_whole(tmp_path, monkeypatch, name):
    monkeypatch.setattr(chunked, "AT_ONCE", 100)  # else files so small are read at once
    MADE[name](tmp_path / name)
    whole = read_volume(tmp_path / name)
    assert whole.shape == RANDOM.shape and np.array_equal(whole.extremes, (RANDOM.min(), RANDOM.max()))
    assert np.array_equal(whole.values, RANDOM)
    a, b, c, d, e, f = BOX
    part = read_volume(tmp_path / name, crop=BOX)
    assert np.array_equal(part.values, RANDOM[a:b, c:d, e:f])
    assert np.allclose(index_to_world(part, (0, 0, 0)), index_to_world(whole, (a, c, e)))
    coarse = read_volume(tmp_path / name, crop=BOX, downsample=2)
    blocks = RANDOM[a:b, c : d - 1, e : f - 1].reshape(4, 2, 3, 2, 4, 2)
    assert np.allclose(coarse.values, blocks.mean(axis=(1, 3, 5)), rtol=1e-6)


@pytest.mark.parametrize("version", ["0.4", "0.5"])
def test_ome_zarr_says_where_it_lies(tmp_path, version):
    ome(tmp_path / "cell.ome.zarr", RANDOM, version)
    with pytest.warns(UserWarning, match="2 resolutions .*--array"):
        fine = read_volume(tmp_path / "cell.ome.zarr", channel=0)
    assert np.array_equal(fine.values, RANDOM) and fine.unit == "µm"
    assert fine.spacing.tolist() == [0.25, 0.5, 2] and fine.origin.tolist() == [0, 0, 10]
    coarse = read_volume(tmp_path / "cell.ome.zarr", channel=1, array=1)
    assert np.array_equal(coarse.values, RANDOM[::2, ::2, :12:2] // 2)
    assert coarse.spacing.tolist() == [0.5, 1, 4] and coarse.origin.tolist() == [0.125, 0, 10]
    refused(tmp_path / "cell.ome.zarr", "2 channels", "--channel")


def test_a_group_of_arrays_and_images_is_chosen_from(tmp_path):
    group = zarr.create_group(str(tmp_path / "many.zarr"))
    for name in ("one", "two"):
        group.create_array(name, shape=RANDOM.shape, dtype="u1", chunks=(4, 3, 5))[...] = RANDOM + (name == "two")
    group.create_array("line", shape=(5,), dtype="u1", chunks=(5,))
    ome(tmp_path / "many.zarr" / "cell", RANDOM // 2, levels=1)
    refused(tmp_path / "many.zarr", "3 arrays: 0 cell, 1 one, 2 two", "--array")
    with pytest.warns(UserWarning, match="distance"):
        assert np.array_equal(read_volume(tmp_path / "many.zarr", array="two").values, RANDOM + 1)
    assert np.array_equal(read_volume(tmp_path / "many.zarr", array=0, channel=0).values, RANDOM // 2)


def test_chunks_that_are_not_there_are_told(tmp_path):
    zarr_array(tmp_path / "a.zarr", RANDOM, (4, 9, 13), fill_value=7, dimension_names=("x", "y", "z"))
    (tmp_path / "a.zarr" / "c" / "1" / "0" / "0").unlink()
    with pytest.warns(UserWarning, match="1 of its 3 chunks are not there.* 7"):
        found = read_volume(tmp_path / "a.zarr", spacing=(1, 1, 1))
    assert (found.values[4:8] == 7).all() and np.array_equal(found.values[:4], RANDOM[:4])


def test_hdf5_has_steps_in_the_order_of_its_axes(tmp_path):
    found = read_volume(hdf5(tmp_path / "a.h5", RANDOM))
    assert found.spacing.tolist() == [0.5, 1, 2] and found.unit == "µm"
    with h5py.File(tmp_path / "a.h5", "a") as file:
        for dim, name in zip(file["a/b"].dims, "zyx"):
            dim.label = name
    found = read_volume(tmp_path / "a.h5")
    assert np.array_equal(found.values, RANDOM.T) and found.spacing.tolist() == [2, 1, 0.5]


@pytest.mark.parametrize("spoil, words", [
    (lambda place: zarr_array(place / "a.zarr", RANDOM.astype("c8")), ["complex64", "real numbers"]),
    (lambda place: zarr_array(place / "a.zarr", RANDOM[0], (4, 3)), ["2 axes"]),
    (lambda place: zarr.create_group(str(place / "a.zarr")), ["no array"]),
    (lambda place: (place / "a.zarr").mkdir() or (place / "a.zarr" / "zarr.json").write_text("{"), ["understood"]),
])  # fmt: skip
def test_zarr_that_cannot_be_a_volume_is_refused(tmp_path, spoil, words):
    spoil(tmp_path)
    refused(tmp_path / "a.zarr", *words)


def test_a_damaged_chunk_is_refused(tmp_path):
    zarr_array(tmp_path / "a.zarr", RANDOM, (4, 9, 13))
    chunk = tmp_path / "a.zarr" / "c" / "1" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:40])
    refused(tmp_path / "a.zarr")


def test_an_array_too_large_for_memory_and_disk_is_refused(tmp_path):
    zarr.create_array(str(tmp_path / "a.zarr"), shape=(1 << 20,) * 3, chunks=(64,) * 3, dtype="u1")
    refused(tmp_path / "a.zarr", "TMPDIR", "--downsample")


def test_hdf5_whose_numbers_lie_elsewhere_is_refused(tmp_path):
    hdf5(tmp_path / "b.h5", RANDOM)
    layout = h5py.VirtualLayout(RANDOM.shape, "u1")
    layout[...] = h5py.VirtualSource(str(tmp_path / "b.h5"), "a/b", RANDOM.shape)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_virtual_dataset("v", layout)
        file["elsewhere"] = h5py.ExternalLink("b.h5", "a/b")
    refused(tmp_path / "a.h5", "other files")


@pytest.fixture
def little(monkeypatch):
    """So little memory that each array is paged."""
    monkeypatch.setattr(limits, "free_memory", lambda: 10_000_000)
    monkeypatch.setattr(paged, "SHARE", 100_000)


def is_paged(values):
    while values is not None and not isinstance(values, np.memmap):
        values = values.base
    return values is not None


@pytest.mark.parametrize("kind, order", [("u1", "C"), ("<i2", "C"), (">i2", "C"), ("<f4", "F"), (">f4", "F")])
def test_a_raw_file_larger_than_a_quarter_of_memory_is_paged(tmp_path, little, monkeypatch, kind, order):
    """In the file itself where it lies as kernels want it; else turned a part at a time into another."""
    monkeypatch.setattr(paged, "TURNED", 300)
    np.save(tmp_path / "a.npy", np.asarray(RANDOM.astype(kind), order=order))
    found = read_volume(tmp_path / "a.npy").values
    assert np.array_equal(found, RANDOM) and found.flags.c_contiguous and found.dtype.isnative and is_paged(found)
    assert not found.flags.writeable


@NOTED
def test_a_paged_field_has_the_light_of_one_in_memory(tmp_path, monkeypatch):
    ball = np.indices((10, 10, 10)).reshape(3, -1).T - 4.5
    values = (200 - 40 * np.linalg.norm(ball, axis=1)).clip(0).reshape(10, 10, 10).astype(np.uint8)
    zarr_array(tmp_path / "a.zarr", values)
    options = {"grid": 6, "paths": 2, "bounces": 1, "judge": False}
    light = [ig.run(ig.Scene.sky(read_volume(tmp_path / "a.zarr"), range=(60, 150)), **options)]
    monkeypatch.setattr(limits, "free_memory", lambda: 10_000_000)
    monkeypatch.setattr(paged, "SHARE", 100_000)
    field = read_volume(tmp_path / "a.zarr")
    assert is_paged(field.values)
    light.append(ig.run(ig.Scene.sky(field, range=(60, 150)), **options))
    assert np.array_equal(*(one.grids[0].light for one in light))
    light[1].save(tmp_path / "out", preview=False)
    assert np.array_equal(ig.load(tmp_path / "out").scene.fields[0].volume.values, values)


@NOTED
def test_of_several_resolutions_the_finest_that_is_not_too_large_is_read(tmp_path, recwarn):
    ome(tmp_path / "cell.ome.zarr", RANDOM)
    sizes = {most: read_volume(tmp_path / "cell.ome.zarr", channel=0, most=most).shape for most in (None, 2000, 200, 1)}
    assert sizes == {None: (11, 9, 13), 2000: (11, 9, 13), 200: (6, 5, 6), 1: (6, 5, 6)}
    said = [str(one.message) for one in recwarn]
    assert all("0, the finest, was read" in one for one in said[:2])
    assert all("1, in whose means noise, plateaus and thin parts of 0 are lost, was read" in one for one in said[2:])
    assert read_volume(tmp_path / "cell.ome.zarr", channel=0, array=0, most=1).shape == (11, 9, 13)


def test_info_describes_a_large_image_from_its_coarser_resolution_and_says_so(call, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.import_module("illumgrid.cli.info"), "MOST", 200)  # `cli.info` is its command
    ome(tmp_path / "cell.ome.zarr", RANDOM)
    for options, shape in (([], "6 x 5 x 6"), (["--array", 0], "11 x 9 x 13"), (["--crop", *"084809"], "8 x 4 x 9")):
        said = call("info", tmp_path / "cell.ome.zarr", "--channel", 0, *options)
        assert f"{shape} voxels" in said
        assert ("1, in whose means noise" in said) == (options == [])
