"""Scene files: correct ones are built as written; messages about wrong ones name file, table and key."""

import numpy as np
import pytest

import illumgrid as ig
from illumgrid.field.filters import smooth
from illumgrid.io.readers import scene_file
from shapes import OBLIQUE, ball, refused

WHOLE = """
[[field]]
name = "neutrons"
volume = "data/n.npy"
albedo = [0.9, 0.5, 1]
emission = [0, 0.25, 0]
range = [0.3, 0.9]
inside = "below"

[[field]]
name = "protons"
volume = "p.npy"

[[quad]]
name = "lamp"
corner = [0, 1, 2.5]
edge_u = [1, 0, 0]
edge_v = [0, 2, 0]
albedo = [0, 0, 0]
emission = [10, 11, 12]
texels = [3, 5]

[[quad]]
name = "wall"
corner = [-1, -1, -1]
edge_u = [1, 0, 0]
edge_v = [0, 0, 1]

[background]
radiance = [0.1, 0.2, 0.3]
"""
FIELD = '[[field]]\nname = "a"\nvolume = "p.npy"\n'
QUAD = '[[quad]]\nname = "lamp"\ncorner = [0, 0, 0]\nedge_u = [1, 0, 0]\nedge_v = [0, 1, 0]\n'


@pytest.fixture
def read(tmp_path):
    """The scene that a text describes, read from a folder with two volumes."""
    (tmp_path / "data").mkdir()
    np.save(tmp_path / "data" / "n.npy", ball(8).values)
    np.save(tmp_path / "p.npy", ball(9).values)

    def read(text, **more):
        file = tmp_path / "s.toml"
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        return ig.read_scene(file, **more)

    return read


def test_all_keys_are_taken(read):
    scene = read(WHOLE)
    neutrons, lamp = scene.fields[0], scene.quads[0]
    assert [f.name for f in scene.fields] == ["neutrons", "protons"] and neutrons.inside == "below"
    assert neutrons.volume.shape == (8, 8, 8) and neutrons.range.tolist() == [0.3, 0.9]
    assert neutrons.material.albedo.tolist() == [0.9, 0.5, 1] and neutrons.material.emission.tolist() == [0, 0.25, 0]
    assert lamp.name == "lamp" and lamp.texels == (3, 5) and lamp.corner.tolist() == [0, 1, 2.5]
    assert lamp.edge_u.tolist() == [1, 0, 0] and lamp.edge_v.tolist() == [0, 2, 0]
    assert lamp.material.albedo.tolist() == [0, 0, 0] and lamp.material.emission.tolist() == [10, 11, 12]
    assert scene.background.tolist() == [0.1, 0.2, 0.3]


def test_texels_that_are_left_out_fit_the_field(read):
    wide = QUAD.replace("[1, 0, 0]", "[66, 0, 0]").replace("[0, 1, 0]", "[0, 33, 0]")  # in voxels of the field
    assert read(FIELD + wide).quads[0].texels == (20, 10)  # one for about three voxels
    assert read(FIELD + wide + "albedo = [0, 0, 0]").quads[0].texels == (1, 1)  # nothing to be seen


def test_what_is_left_out_has_the_usual_value(read):
    scene = read(WHOLE)
    protons, wall = scene.fields[1], scene.quads[1]
    assert protons.inside == "above" and tuple(protons.range) == ig.suggest_range(protons.volume)[:2]
    assert wall.texels == (6, 6)  # the fewest beside a volume
    for part in (protons, wall):
        assert part.material.albedo.tolist() == [0.8] * 3 and part.material.emission.tolist() == [0] * 3
    for text in (FIELD, FIELD + "[background]"):
        scene = read(text)
        assert scene.quads == () and scene.background.tolist() == [0, 0, 0]


def test_volumes_lie_beside_the_file_wherever_one_stands(read, tmp_path, monkeypatch):
    read(WHOLE)
    monkeypatch.chdir(tmp_path / "data")
    assert ig.read_scene("../s.toml").fields[1].volume.shape == (9, 9, 9)
    assert len(read(FIELD.replace("p.npy", str(tmp_path / "data" / "n.npy"))).fields[0].volume.values) == 8


def test_one_file_of_two_fields_is_read_once(read):
    scene = read(FIELD + FIELD.replace('"a"', '"b"') + "range = [0.5, 0.6]")
    assert scene.fields[0].volume is scene.fields[1].volume


def test_smoothing_goes_before_everything_else(read, tmp_path):
    values = ball(9).values.copy()
    values[4, 4, 4] = 40
    values[0, 0, 0] = np.nan
    np.save(tmp_path / "p.npy", values)
    with pytest.warns(ig.IllumgridWarning, match="1 of 729 voxels"):
        field = read(FIELD, smoothing=1.0).fields[0]
    clean = ig.Volume(np.where(np.isnan(values), np.nanmin(values), values))
    assert np.array_equal(field.volume.values, smooth(clean, 1.0).values)
    assert tuple(field.range) == ig.suggest_range(field.volume)[:2]


def test_editors_may_mark_the_file_as_utf8_and_end_lines_as_windows_does(read):
    assert read(b"\xef\xbb\xbf" + FIELD.replace("\n", "\r\n").encode()).fields[0].name == "a"
    assert read(FIELD.replace('"a"', '"Kern ☢"')).fields[0].name == "Kern ☢"


# Refusals

EMPTY = '[[field]]\nname = "b"\nvolume = ""'
RADIANCE = "[background]\nradiance = "


@pytest.mark.parametrize(
    "text, words",
    [
        ("", ["no [[field]]", "at least one"]),
        (QUAD, ["no [[field]]"]),
        ("field = 3", ["field = 3", "[[field]]"]),
        ("field = [3]", ["field = [3]", "double brackets"]),
        ('[field]\nname = "a"', ["single table [field]", "double brackets"]),
        (FIELD + "[[background]]\nradiance = [1, 1, 1]", ["background", "one table [background]"]),
        (FIELD + "[[quads]]", ["no table 'quads'", "field, quad, background", "did you mean 'quad'?"]),
        (FIELD + "[sky]", ["no table 'sky'", "expected only field, quad, background"]),
        (FIELD + "colour = 1", ["[[field]] 1 'a'", "no key 'colour'", "albedo"]),
        (FIELD + "albdo = [1, 1, 1]", ["[[field]] 1 'a'", "'albdo'", "did you mean 'albedo'?"]),
        (FIELD + QUAD + "[[quad]]\nname = 'x'", ["[[quad]] 2 'x'", "corner is missing"]),
        (FIELD + "[[quad]]", ["[[quad]] 1: name is missing", "nothing"]),
        ('[[field]]\nname = "a"', ["[[field]] 1 'a'", "volume is missing"]),
        ("[[field]]\nvolume = 'p.npy'", ["[[field]] 1: name is missing", "there is volume"]),
        (FIELD + RADIANCE + "1", ["[background]: radiance is 1", "three numbers"]),
        (FIELD + RADIANCE + "[0, -1, 0]", ["[background]", "[0, -1, 0]", "from 0 up"]),
        (FIELD + "[background]\nradience = [0, 0, 0]", ["[background]", "did you mean 'radiance'?"]),
        (FIELD + FIELD, ["[[field]] 2 'a'", "name is that of [[field]] 1 'a'", "differ"]),
        (FIELD.replace('"a"', '"lamp"') + QUAD, ["[[quad]] 1 'lamp'", "[[field]] 1 'lamp'"]),
        (FIELD.replace('"a"', "7"), ["[[field]] 1: name is 7", "text in quotes"]),
        (FIELD.replace('"a"', '""'), ["[[field]] 1 ''", "name is ''"]),
        (FIELD.replace('"a"', r'"a\nb"'), [r"[[field]] 1 'a\nb'", "printable"]),
        (FIELD + EMPTY, ["[[field]] 2 'b'", "volume is ''"]),
        (FIELD.replace('"p.npy"', r'"a\u0000"'), ["volume is 'a\\x00'"]),
        (FIELD.replace('"p.npy"', '["p.npy"]'), ["volume is ['p.npy']", "text"]),
        (FIELD.replace("p.npy", "q.npy"), ["[[field]] 1 'a': volume: q.npy", "no such file"]),
        (FIELD.replace("p.npy", "s.toml"), ["[[field]] 1 'a': volume: s.toml"]),
        (FIELD.replace("p.npy", "data"), ["[[field]] 1 'a': volume: data"]),
        (FIELD.replace("p.npy", "x" * 300), ["[[field]] 1 'a': volume: xxx"]),
        (FIELD + "albedo = 0.8", ["albedo is 0.8", "three numbers"]),
        (FIELD + "albedo = [1, 1]", ["albedo is [1, 1]", "red, green, blue"]),
        (FIELD + "albedo = [1, 1, true]", ["albedo is [1, 1, True]"]),
        (FIELD + 'albedo = [1, 1, "1"]', ["albedo is [1, 1, '1']"]),
        (FIELD + "albedo = [1, 1, nan]", ["albedo is [1, 1, nan]"]),
        (FIELD + "albedo = [1, 1, 1.5]", ["[[field]] 1 'a'", "albedo is [1.0, 1.0, 1.5]", "0 to 1"]),
        (FIELD + "emission = [0, 0, inf]", ["emission is [0, 0, inf]"]),
        (FIELD + "emission = [-1, 0, 0]", ["[[field]] 1 'a'", "emission", "from 0 up"]),
        (FIELD + "emission = {r = 1}", ["emission is {'r': 1}"]),
        (FIELD + "range = [0.5]", ["[[field]] 1 'a'", "range is [0.5]", "lowest and highest"]),
        (FIELD + f"range = [0, {10**400}]", ["range is [0, 1000", "characters)", "none beyond 1.7e+308"]),
        (FIELD + "range = [0.9, 0.3]", ["[[field]] 1 'a'", "range", "[0.9, 0.3]"]),
        (FIELD + "range = [7, 9]", ["[[field]] 1 'a'", "misses its data"]),
        (FIELD + 'inside = "left"', ["[[field]] 1 'a'", "inside is 'left'", "'above' or 'below'"]),
        (FIELD + "inside = []", ["inside is []"]),
        (FIELD + QUAD + "texels = [4, 4.0]", ["[[quad]] 1 'lamp'", "texels is [4, 4.0]", "whole numbers"]),
        (FIELD + QUAD + "texels = [4, 0]", ["[[quad]] 1 'lamp'", "from 1 up"]),
        (FIELD + QUAD + "texels = [4, 99999]", ["texels is [4, 99999]", "4096"]),
        (FIELD + QUAD + "volume = 'a'", ["[[quad]] 1 'lamp'", "no key 'volume'"]),
        (FIELD + QUAD.replace("[0, 0, 0]", "[0, 0]"), ["[[quad]] 1 'lamp'", "corner is [0, 0]", "x, y, z"]),
        (FIELD + QUAD.replace("[1, 0, 0]", "[1e200, 0, 0]"), ["edge_u is [1e+200, 0, 0]", "1e+30"]),
        (FIELD + QUAD.replace("[1, 0, 0]", "[0, 1, 0]"), ["[[quad]] 1 'lamp'", "edges", "parallel"]),
        (FIELD + QUAD.replace("[1, 0, 0]", "1979-05-27"), ["edge_u is datetime.date(1979, 5, 27)"]),
        ("[[field]\n", ["not TOML", "line 1"]),
        (FIELD + 'name = "b"', ["not TOML"]),
        (FIELD + f"range = [0, {'9' * 1900}]", ["range is [0, 999"]),
        (b"name = '\xff\xfe'", ["byte 8 is not UTF-8"]),
        (b"\x93NUMPY\x01\x00", ["byte 0 is not UTF-8"]),
        ("[" * 1990, ["TOML"]),
        ("x = [" + "\n[" * 100_000, ["nested too deeply"]),
        ("a." * 30_000 + "a = 1", ["a line has more than 2000 characters"]),
        (FIELD + "albedo" + ".a" * 900 + " = 1", ["albedo is "]),
        ("#\n" * 600_000, ["more than 1048576 bytes", "voxels"]),
    ],
)
def test_a_scene_file_that_is_wrong_is_refused_in_one_sentence(read, text, words):
    assert refused(lambda: read(text), *words).startswith("s.toml: ")


def test_what_is_no_file_is_refused(tmp_path):
    refused(lambda: ig.read_scene(tmp_path), tmp_path.name, "a folder")
    refused(lambda: ig.read_scene(tmp_path / "t.toml"), "t.toml: there is no such file", "[[field]]")
    refused(lambda: ig.read_scene(str(tmp_path / "t.toml") + "x" * 400), "t.toml", "cannot be read")
    refused(lambda: ig.read_scene("/dev/zero"), "zero: neither a file nor a folder")


def test_axes_that_differ_are_refused(read, tmp_path):
    np.savez(tmp_path / "turned.npz", values=ball(5).values, direction=OBLIQUE)
    text = FIELD + FIELD.replace('"a"', '"b"').replace("p.npy", "turned.npz")
    refused(lambda: read(text), "s.toml: ", "axes of field 'b'", "'a'")


def test_nothing_is_read_when_a_table_is_wrong(read, monkeypatch):
    monkeypatch.setattr(scene_file, "_volume", lambda *given: pytest.fail("a volume was read"))
    refused(lambda: read(FIELD + QUAD + "texels = [0, 0]"), "texels")
    refused(lambda: read(FIELD + "albedo = [2, 2, 2]"), "albedo")
