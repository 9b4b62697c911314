"""OpenEXR files that are written some rows at a time hold, by the library, what was written."""

import numpy as np
import OpenEXR
import pytest

from illumgrid.io import exr, scanlines
from illumgrid.io.scanlines import Part, write


def image(height, width, seed=0):
    pixels = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    pixels[0, 0], pixels[-1, -1] = np.inf, np.nan
    return pixels


def pieces(*images, sizes=(1, 20, 3, 16, 1000)):
    first = 0
    for size in sizes:
        if first < len(images[0]):
            yield [one[first : first + size] for one in images]
            first += size


@pytest.mark.parametrize("height", [1, 16, 33])
def test_one_image_with_attributes(tmp_path, height):
    red, other = image(height, 7), image(height, 7, 1)
    about = {"layout": "as text, ü", "origin": np.array([1.5, -2, 3]), "direction": np.eye(3), "exposure": 0.25}
    write(tmp_path / "a.exr", [Part((7, height), dict.fromkeys("zR", "f4"), pieces(other, red), about)])
    (part,) = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).parts
    assert np.array_equal(part.channels["R"].pixels, red, equal_nan=True)
    assert np.array_equal(part.channels["z"].pixels, other, equal_nan=True)
    assert part.header["layout"] == about["layout"] and part.header["exposure"] == 0.25
    assert np.array_equal(part.header["origin"], about["origin"]) and np.array_equal(
        part.header["direction"], np.eye(3)
    )
    exr.check_end(tmp_path / "a.exr", height)


def test_parts_of_other_sizes_and_types_and_long_names(tmp_path):
    """Rows that repeat are packed, noise is not; a name of more than 31 letters needs a flag."""
    words = np.arange(40, dtype=np.uint32).reshape(20, 2).repeat(50, axis=1)
    name = "a light with quite a long name.Y.error"
    window = (100, 33)
    write(tmp_path / "a.exr", [
        Part((100, 20), {"bytes": "u4"}, pieces(words), {}, "field/a", window),
        Part((5, 33), {name: "f4"}, pieces(image(33, 5)), {}, "light/a", window),
    ])  # fmt: skip
    one, other = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).parts
    assert (one.name(), other.name()) == ("field/a", "light/a")
    assert one.channels["bytes"].pixels.dtype == np.uint32 and np.array_equal(one.channels["bytes"].pixels, words)
    assert np.array_equal(other.channels[name].pixels, image(33, 5), equal_nan=True)
    assert (tmp_path / "a.exr").stat().st_size < words.nbytes // 2


def test_rows_that_do_not_come_are_noticed(tmp_path):
    with pytest.raises(ValueError, match="5 rows of 6"):
        write(tmp_path / "a.exr", [Part((4, 6), {"Y": "f4"}, pieces(image(5, 4)), {})])


@pytest.mark.parametrize("kind, nz", [("uint8", 9), ("int16", 6), ("float32", 5)])
def test_arrays_are_turned_and_padded_a_few_rows_at_a_time(tmp_path, monkeypatch, kind, nz):
    monkeypatch.setattr(exr, "_AT_ONCE", 1)
    field = np.arange(7 * 5 * nz).reshape(7, 5, nz).astype(kind)
    light = np.random.default_rng(0).random((4, 6, 8, 2)).astype(np.float32)
    planned = exr.Planned((4, 6, 8), ("Y", "error"))
    parts = {
        "light/a": (planned, {name: exr.Turned(light[..., c]) for c, name in enumerate(planned.channels)}),
        "field/a": exr.of_field(field),
    }
    exr.write(tmp_path / "a.exr", parts)
    plan = {name: planned for name, (planned, _) in parts.items()}
    exr.check_whole(tmp_path / "a.exr", plan)
    found = exr.read(tmp_path / "a.exr", plan)
    assert np.array_equal(exr.array(found["light/a"], ("Y", "error"), (4, 6, 8)), light)
    assert np.array_equal(exr.field_values(found["field/a"], plan["field/a"]), field)
    assert scanlines.LINES == 16
