"""A finished run on disk: read back bit by bit, complete or absent, and never trusted."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from illumgrid.errors import BadInput
from illumgrid.field.scene import Field, Levels, Material, Quad, Scene, level_table
from illumgrid.field.storing import NATIVE
from illumgrid.field.volume import Volume
from illumgrid.grid import GREY, RGB, Channels, GridSpec, IlluminationGrid, WallTexture
from illumgrid.io import store

CHANNELS = (3,), (), ()
MIRRORED = ((0, 0, -1), (1, 0, 0), (0, 1, 0))
ODD = np.array([0.0, -0.0, 1e-42, np.inf, 3.4e38, 1 / 3, np.nan], np.float32)


def grid(spec: GridSpec, rng: np.random.Generator) -> IlluminationGrid:
    values, error = (rng.random(shape, np.float32) for shape in ((*spec.shape, 3), spec.shape))
    values.flat[: len(ODD)] = error.flat[: len(ODD)] = ODD
    error[rng.random(spec.shape) < 0.3] = np.inf
    return IlluminationGrid(spec, values, error, np.isfinite(error).astype(np.float32))


def wall(quad: Quad, rows: int, rng: np.random.Generator) -> WallTexture:
    values = rng.random((rows, *quad.texels[::-1], 3), np.float32)
    values.flat[: len(ODD)] = ODD
    return WallTexture(values, (rng.random(values.shape[:3]) < 0.7).astype(np.float32))


def example(count: int = 1, seed: int = 0, direction=MIRRORED) -> store.Stored:
    """One field, or two that differ in every respect, between walls, on lattices without symmetry."""
    rng = np.random.default_rng(seed)
    first = Volume(rng.normal(size=(4, 7, 5)), (1 / 3, -1e5, 2e-7), (0.1, 1 / 7, 3), direction)
    second = Volume(rng.normal(size=(3, 2, 6)) * 1e20, (0.1, 0.2, 0.3), (1, 2, 3), direction)
    fields = (
        Field("protons", first, Material((0.1, 0.2, 1 / 3)), (-0.1, 0.7), "below"),
        Field("Dichte/ρ 名", second, Material((1, 0, 0.5), (0, 1e-300, 7e9)), (-1e19, 2e19), "above"),
    )[:count]
    quads = (
        Quad("wall/名", (1 / 3, -1e5, 2e-7), (0.1, 0, 1 / 7), (0, 1e-9, 3e-9), Material((1 / 3, 0, 1)), (3, 2)),
        Quad("lamp", (1, 2, 3), (0, 0, -1), (0, 7, 0), Material((0, 0, 0), (0, 1e-300, 7e9)), (1, 5)),
    )[: 2 * (count - 1)]
    scene = Scene(fields, quads, background=(0.1, 0, 1 / 3))
    grids = tuple(grid(GridSpec.over(f.volume, n), rng) for f, n in zip(fields, (9, 5)))
    recipe = {
        "seed": 2**70 + seed,
        "seconds": {"solve": 0.1},
        "stage": None,
        "path": "é\udcff",
        "list": [1.5, True, "x"],
    }
    walls = tuple(wall(q, 4, rng) for q in quads)
    return store.Stored(scene, Levels(scene.levels(np.linspace(0, 1, 4))), grids, walls, recipe)


def assert_same(one: store.Stored, other: store.Stored) -> None:
    """Compare bit by bit, including -0.0, NaN and infinities."""

    def bits(stored: store.Stored) -> list:
        rest: list = []
        for f in stored.scene.fields:
            v, m = f.volume, f.material
            rest += [f.name, f.inside, v.shape]
            rest += [a.tobytes() for a in (v.values, v.origin, v.spacing, v.direction, f.range, m.albedo, m.emission)]
        for g in stored.grids:
            rest += [g.spec.shape, *(a.tobytes() for a in (g.spec.origin, g.spec.spacing, g.spec.direction))]
            rest += [a.tobytes() for a in (g.values, g.error, g.support)]
        for q, w in zip(stored.scene.quads, stored.walls, strict=True):
            m = q.material
            rest += [q.name, q.texels, w.values.shape, w.support.shape, w.values.dtype, w.support.dtype]
            rest += [a.tobytes() for a in (q.corner, q.edge_u, q.edge_v, m.albedo, m.emission, w.values, w.support)]
        table = stored.levels.table
        return [*rest, stored.scene.background.tobytes(), table.shape, table.tobytes(), stored.recipe]

    assert bits(one) == bits(other)


def left_beside(folder: Path) -> set[str]:
    return {p.name for p in folder.parent.iterdir()} - {folder.name}


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A finished run."""
    store.write(tmp_path / "out", example(), None, False)
    return tmp_path / "out"


# What comes back


@pytest.mark.parametrize("count", [1, 2])
def test_round_trip_is_exact(tmp_path, count):
    store.write(tmp_path / "new" / "deep" / "out", example(count), b"\x89PNG", False)
    folder = (tmp_path / "new" / "deep" / "out").rename(tmp_path / "moved")
    assert_same(store.read(folder), example(count))
    assert (folder / store.PREVIEW).read_bytes() == b"\x89PNG"


def test_oblique_axes_come_back_within_rounding(tmp_path):
    """`placement` makes them orthonormal anew, which moves the last bits."""
    c, s = np.cos(0.3), np.sin(0.3)
    stored = example(direction=((c, -s, 0), (s, c, 0), (0, 0, 1)))
    store.write(tmp_path / "out", stored, None, False)
    back = store.read(tmp_path / "out")
    for one, other in (
        (back.scene.fields[0].volume, stored.scene.fields[0].volume),
        (back.grids[0].spec, stored.grids[0].spec),
    ):
        np.testing.assert_allclose(one.direction, other.direction, rtol=0, atol=0)


def test_other_programs_find_the_documented_layout(tmp_path):
    stored = example(2)
    store.write(tmp_path / "out", stored, None, False)
    parts = {p.name(): p for p in OpenEXR.File(str(tmp_path / "out" / store.EXR), separate_channels=True).parts}
    assert list(parts) == [
        "light/protons",
        "field/protons",
        "light/Dichte/ρ 名",
        "field/Dichte/ρ 名",
        "wall/wall/名",
        "wall/lamp",
    ]
    field, light = parts["field/protons"], parts["light/protons"]
    assert (field.width(), field.height(), set(field.channels)) == (5, 4 * 7, {"Y"})
    assert set(light.channels) == {"R", "G", "B", "error", "support"}
    assert field.header["layout"] == "array (nx, ny, nz) = (4, 7, 5) of float32; row = x*ny + y, column = z"
    assert light.header["layout"].endswith("; row = z*ny + y, column = x")
    assert field.compression() == OpenEXR.ZIP_COMPRESSION and field.type() == OpenEXR.scanlineimage
    x, y, z = 1, 6, 3
    assert field.channels["Y"].pixels[x * 7 + y, z] == stored.scene.fields[0].volume.values[x, y, z]
    own = stored.grids[0]
    row, column = z * own.spec.shape[1] + y, x
    found = [light.channels[c].pixels[row, column] for c in ("R", "G", "B", "error", "support")]
    assert found == [*own.values[x, y, z], own.error[x, y, z], own.support[x, y, z]]
    texels = parts["wall/wall/名"]
    assert set(texels.channels) == {"R", "G", "B", "support"}
    assert texels.header["layout"] == "array (nx, ny, nz) = (3, 2, 4); row = z*ny + y, column = x"
    u, v, k = 2, 1, 3
    found = [texels.channels[c].pixels[k * 2 + v, u] for c in ("R", "G", "B", "support")]
    assert found == [*stored.walls[0].values[k, v, u], stored.walls[0].support[k, v, u]]
    assert {c.pixels.dtype for p in parts.values() for c in p.channels.values()} == {np.dtype(np.float32)}


@pytest.mark.parametrize("kind", [kind.name for kind in NATIVE])
@pytest.mark.parametrize("nz", [5, 8])
def test_fields_come_back_in_their_type(tmp_path, kind, nz):
    values = np.random.default_rng(0).integers(-100, 100, (4, 3, nz)).astype("int8").view("u1").astype(kind)
    values[0, 0, :2] = np.iinfo(kind).min if kind != "float32" else -1e38, 77
    volume = Volume(values, slope=0.5, intercept=-3.0)
    scene = Scene.sky(volume, range=volume.extremes)
    grid = IlluminationGrid(
        GridSpec.over(volume, 3), *(np.ones((*GridSpec.over(volume, 3).shape, *c)) for c in CHANNELS)
    )
    store.write(tmp_path / "out", store.Stored(scene, level_table(scene, 2), (grid,), (), {}), None, False)
    back = store.read(tmp_path / "out").scene.fields[0].volume
    assert back.stored.dtype == kind and np.array_equal(back.stored, values) and back.extremes == volume.extremes
    part = {p.name(): p for p in OpenEXR.File(str(tmp_path / "out" / store.EXR), separate_channels=True).parts}[
        "field/field"
    ]
    ((name, channel),) = part.channels.items()
    assert name == ("Y" if kind == "float32" else "bytes")
    assert np.array_equal(channel.pixels.view(kind)[2 * 3 + 1][:nz], values[2, 1])


def test_a_run_is_described_without_its_pixels(tmp_path, monkeypatch):
    stored = example(2)
    store.write(tmp_path / "out", stored, None, False)
    monkeypatch.setattr(store, "_digest", None)
    monkeypatch.setattr(store.exr, "read", None)
    record = store.describe(tmp_path / "out")
    for about, field, grid in zip(record["scene"]["fields"], stored.scene.fields, stored.grids):
        assert tuple(about["extremes"]) == field.volume.extremes
        assert sum(about["histogram"]) == field.volume.values.size
        assert record["grids"][field.name]["lit"] == (grid.support > 0).mean()
    text = (tmp_path / "out" / store.RUN).read_text("utf-8")
    (tmp_path / "out" / store.RUN).write_text(text.replace('"lit": ', '"lit": 0'))
    with pytest.raises(BadInput, match=r"run\.json"):
        store.describe(tmp_path / "out")


def test_grey_light_takes_one_channel_of_the_file(tmp_path):
    stored = example(2)
    bare = [IlluminationGrid(g.spec, g.light[..., :1], g.error, g.support) for g in stored.grids]
    walls = tuple(WallTexture(w.light[..., :1], w.support) for w in stored.walls)
    grey = dataclasses.replace(stored, grids=tuple(bare), walls=walls)
    store.write(tmp_path / "out", grey, None, False)
    parts = {p.name(): set(p.channels) for p in OpenEXR.File(str(tmp_path / "out" / store.EXR)).parts}
    assert parts["light/protons"] == {"Y", "error", "support"} and parts["wall/lamp"] == {"Y", "support"}
    back = store.read(tmp_path / "out")
    assert_same(back, grey)
    assert [part.channels for part in (*back.grids, *back.walls)] == [GREY] * 4


def test_channels_of_any_name_and_mix_come_back(tmp_path):
    stored, rng = example(2), np.random.default_rng(1)
    key = Channels(("key.R", "key.G", "key.B", "Himmel ρ"), ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0.1, 1 / 3, -2)))
    grids = [IlluminationGrid(g.spec, rng.random((*g.spec.shape, 4)), g.error, g.support, key) for g in stored.grids]
    layered = dataclasses.replace(stored, grids=tuple(grids))
    store.write(tmp_path / "out", layered, None, False)
    back = store.read(tmp_path / "out")
    assert_same(back, layered)
    for one, other in zip(back.grids, grids):
        assert one.channels == key and np.array_equal(one.light, other.light)


def test_a_volume_in_place_of_a_run_is_named_as_what_it_is(tmp_path):
    np.save(tmp_path / "v.npy", np.eye(3))
    for ask in (store.read, store.describe):
        with pytest.raises(
            BadInput, match=r"v\.npy is a file; expected the folder of a run; light it by 'illumgrid run "
        ):
            ask(tmp_path / "v.npy")


def test_a_run_of_format_1_still_loads():
    """Written by the version before channels had names, of a small ball on a wall."""
    folder = Path(__file__).with_name("format_1")
    back = store.read(folder)
    parts = {p.name(): p for p in OpenEXR.File(str(folder / store.EXR), separate_channels=True).parts}
    grid, wall = back.grids[0], back.walls[0]
    assert grid.channels == wall.channels == RGB and grid.values.shape == (3, 4, 3, 3)
    for c, name in enumerate("RGB"):
        image = grid.values[..., c].transpose(2, 1, 0).reshape(12, 3)
        assert np.array_equal(image, parts["light/ball"].channels[name].pixels)
        assert np.array_equal(wall.values[..., c].reshape(4, 3), parts["wall/wall"].channels[name].pixels)
    assert grid.values.sum(dtype=float) == pytest.approx(287.47772097587585, rel=1e-12)
    assert np.isfinite(grid.lookup([[1.5, 4.0, 0.5]])).all()


def test_a_run_of_format_2_still_loads():
    """Written by the version before fields kept their types, of a ball of whole numbers in the light of a studio."""
    folder = Path(__file__).with_name("format_2")
    back, record = store.read(folder), store.describe(folder)
    parts = {p.name(): p for p in OpenEXR.File(str(folder / store.EXR), separate_channels=True).parts}
    field = back.scene.fields[0].volume
    assert np.array_equal(field.stored, parts["field/ball"].channels["Y"].pixels.reshape(7, 6, 5).transpose(2, 1, 0))
    assert field.stored.dtype == np.float32 and field.intercept == 3 and back.grids[0].spec.shape == (3, 4, 4)
    assert field.extremes == tuple(record["scene"]["fields"][0]["extremes"])
    assert np.array_equal(field.values, field.values.round()) and field.values.sum() == 8964 + 3 * 210
    assert back.grids[0].channels.names == ("R", "G", "B", "key.Y", "dome.Y")
    assert back.grids[0].light.sum(dtype=float) == pytest.approx(304.85302293286077, rel=1e-12)


def test_without_a_picture_there_is_none_and_others_may_read(tmp_path):
    before = os.umask(0o022)
    try:
        store.write(tmp_path / "out", example(), None, False)
    finally:
        os.umask(before)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {store.EXR, store.RUN}
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o755
    assert {p.stat().st_mode & 0o777 for p in (tmp_path / "out").iterdir()} == {0o644}


def test_what_does_not_belong_together_is_refused():
    one, two = example(1), example(2)
    with pytest.raises(BadInput, match="1 grids came for 2 fields"):
        store.Stored(two.scene, two.levels, one.grids, two.walls, {})
    with pytest.raises(BadInput, match=r"shape \(4, 1\)"):
        store.Stored(two.scene, one.levels, two.grids, two.walls, {})
    with pytest.raises(BadInput, match="0 wall textures came for 2 quads"):
        store.Stored(two.scene, two.levels, two.grids, (), {})


@pytest.mark.parametrize("recipe", [{"x": float("nan")}, {"x": object()}])
def test_a_recipe_that_json_lacks_is_refused(tmp_path, recipe):
    stored = example()
    with pytest.raises((TypeError, ValueError), match="JSON"):
        store.write(tmp_path / "out", store.Stored(stored.scene, stored.levels, stored.grids, (), recipe), None, False)
    assert not list(tmp_path.iterdir())


def test_keys_that_are_numbers_become_text_and_do_not_break_the_checksum(tmp_path):
    stored = example()
    recipe = {10: "a", 9: ("b", "c")}
    store.write(tmp_path / "out", store.Stored(stored.scene, stored.levels, stored.grids, (), recipe), None, False)
    assert store.read(tmp_path / "out").recipe == {"10": "a", "9": ["b", "c"]}


# Where it may go


def test_a_finished_run_goes_only_with_overwrite(out):
    with pytest.raises(BadInput, match=r"holds a finished run; pass overwrite=True or choose another folder$"):
        store.claim(out, False)
    with pytest.raises(BadInput, match="overwrite=True"):
        store.write(out, example(seed=1), None, False)
    assert_same(store.read(out), example())
    store.claim(out, True)
    assert_same(store.read(out), example())
    store.write(out, example(2, seed=1), b"picture", True)
    assert_same(store.read(out), example(2, seed=1))
    store.write(out, example(), None, True)
    assert not (out / store.PREVIEW).exists() and not left_beside(out)


def test_an_empty_folder_is_fine(tmp_path):
    (tmp_path / "out").mkdir()
    store.claim(tmp_path / "out", False)
    store.write(tmp_path / "out", example(), None, False)
    assert_same(store.read(tmp_path / "out"), example())


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("foreign", ["thesis.tex", ".hidden", "folder/data", store.PREVIEW])
def test_what_is_not_ours_stays(tmp_path, foreign, overwrite):
    out = tmp_path / "out"
    if foreign != store.PREVIEW:  # that one is foreign where no run is
        store.write(out, example(), None, False)
    (out / foreign).parent.mkdir(exist_ok=True, parents=True)
    (out / foreign).write_text("years of work")
    for refuse in (lambda: store.claim(out, overwrite), lambda: store.write(out, example(), None, overwrite)):
        with pytest.raises(BadInput, match=f"holds '{foreign.split('/')[0]}', which is not of a finished run"):
            refuse()
    assert (out / foreign).read_text("utf-8") == "years of work" and not left_beside(out)


def test_a_link_among_our_names_is_not_ours(out):
    (out / store.RUN).rename(out.with_name("kept.json"))
    (out / store.RUN).symlink_to("../kept.json")
    with pytest.raises(BadInput, match=r"holds 'run\.json', which is not of a finished run"):
        store.claim(out, True)


def test_a_mount_point_cannot_be_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) == tmp_path)
    with pytest.raises(BadInput, match="is a mount point"):
        store.claim(tmp_path, True)


def make_bad(kind: str, tmp_path: Path) -> Path:
    place = tmp_path / "place"
    if kind == "file":
        place.write_text("x")
    elif kind == "link":
        (tmp_path / "elsewhere").mkdir()
        place.symlink_to("elsewhere")
    elif kind == "dangling":
        place.symlink_to("nowhere")
    elif kind == "below a file":
        place.write_text("x")
        return place / "deep" / "out"
    elif kind == "not writable":
        return Path("/proc/self/out")  # also to root
    return place


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("kind", ["file", "link", "dangling", "below a file", "not writable"])
def test_places_that_cannot_be(tmp_path, kind, overwrite):
    if kind == "not writable" and not Path("/proc/self").exists():
        pytest.skip("needs /proc")
    place = make_bad(kind, tmp_path)
    before = sorted(tmp_path.iterdir())
    for refuse in (lambda: store.claim(place, overwrite), lambda: store.write(place, example(), None, overwrite)):
        with pytest.raises(BadInput, match=f"^{place} .*choose another folder$"):
            refuse()
    assert sorted(tmp_path.iterdir()) == before


def test_names_may_be_long_but_not_too_long(tmp_path):
    store.write(tmp_path / ("é" * 127), example(), None, False)
    assert_same(store.read(tmp_path / ("é" * 127)), example())
    with pytest.raises(BadInput, match="File name too long"):
        store.claim(tmp_path / ("x" * 256), False)


def test_the_folder_one_stands_in_is_not_replaced(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadInput, match="folder you are in"):
        store.claim(".", False)
    store.write("out", example(), None, False)
    assert_same(store.read("out"), example())
