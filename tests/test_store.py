"""A finished run on the disk: bit by bit the same when it comes back, whole or not there, and never trusted."""

import json
import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from illumgrid import store
from illumgrid.errors import BadInput
from illumgrid.grid import GridSpec, IlluminationGrid
from illumgrid.scene import Field, Levels, Material, Scene
from illumgrid.volume import Volume

MIRRORED = ((0, 0, -1), (1, 0, 0), (0, 1, 0))
ODD = np.array([0.0, -0.0, 1e-42, np.inf, 3.4e38, 1 / 3, np.nan], np.float32)


def grid(spec: GridSpec, rng: np.random.Generator) -> IlluminationGrid:
    values, error = (rng.random(shape, np.float32) for shape in ((*spec.shape, 3), spec.shape))
    values.flat[: len(ODD)] = error.flat[: len(ODD)] = ODD
    error[rng.random(spec.shape) < 0.3] = np.inf
    return IlluminationGrid(spec, values, error, np.isfinite(error).astype(np.float32))


def example(count: int = 1, seed: int = 0, direction=MIRRORED) -> store.Stored:
    """One field, or two that differ in all that can differ, on lattices with no two sides alike."""
    rng = np.random.default_rng(seed)
    first = Volume(rng.normal(size=(4, 7, 5)), (1 / 3, -1e5, 2e-7), (0.1, 1 / 7, 3), direction)
    second = Volume(rng.normal(size=(3, 2, 6)) * 1e20, (0.1, 0.2, 0.3), (1, 2, 3), direction)
    fields = (
        Field("protons", first, Material((0.1, 0.2, 1 / 3)), (-0.1, 0.7), "below"),
        Field("Dichte/ρ 名", second, Material((1, 0, 0.5), (0, 1e-300, 7e9)), (-1e19, 2e19), "above"),
    )[:count]
    scene = Scene(fields, (0.1, 0, 1 / 3))
    grids = tuple(grid(GridSpec.over(f.volume, n), rng) for f, n in zip(fields, (9, 5)))
    recipe = {
        "seed": 2**70 + seed,
        "seconds": {"solve": 0.1},
        "stage": None,
        "path": "é\udcff",
        "list": [1.5, True, "x"],
    }
    return store.Stored(scene, Levels(scene.levels(np.linspace(0, 1, 4))), grids, recipe)


def assert_same(one: store.Stored, other: store.Stored) -> None:
    """Bit by bit, so that -0.0, NaN and infinities count too."""

    def bits(stored: store.Stored) -> list:
        fields = [
            (f.name, f.inside, *(a.tobytes() for a in (v.values, v.origin, v.spacing, v.direction, f.range)))
            + (v.shape, f.material.albedo.tobytes(), f.material.emission.tobytes())
            for f in stored.scene.fields
            for v in [f.volume]
        ]
        lights = [
            (g.spec.shape, *(a.tobytes() for a in (g.spec.origin, g.spec.spacing, g.spec.direction)))
            + tuple(a.tobytes() for a in (g.values, g.error, g.support))
            for g in stored.grids
        ]
        table = stored.levels.table
        return [fields, lights, stored.scene.background.tobytes(), table.shape, table.tobytes(), stored.recipe]

    assert bits(one) == bits(other)


def left_beside(folder: Path) -> set[str]:
    return {p.name for p in folder.parent.iterdir()} - {folder.name}


def reseal(folder: Path, **changes) -> None:
    """Forge the record so that its checksum agrees with what is there now."""
    record = json.loads((folder / store.RUN).read_text()) | changes
    (folder / store.RUN).write_text(json.dumps(record | {"checksum": store._checksum(record, folder / store.EXR)}))


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
        np.testing.assert_allclose(one.direction, other.direction, rtol=0, atol=5e-15)


def test_other_programs_find_the_documented_layout(tmp_path):
    stored = example(2)
    store.write(tmp_path / "out", stored, None, False)
    parts = {p.name(): p for p in OpenEXR.File(str(tmp_path / "out" / store.EXR), separate_channels=True).parts}
    assert list(parts) == ["light/protons", "field/protons", "light/Dichte/ρ 名", "field/Dichte/ρ 名"]
    field, light = parts["field/protons"], parts["light/protons"]
    assert (field.width(), field.height(), set(field.channels)) == (4, 7 * 5, {"Y"})
    assert set(light.channels) == {"R", "G", "B", "error", "support"}
    assert field.header["layout"] == "array (nx, ny, nz) = (4, 7, 5); row = z*ny + y, column = x"
    assert field.compression() == OpenEXR.ZIP_COMPRESSION and field.type() == OpenEXR.scanlineimage
    x, y, z = 1, 6, 3
    assert field.channels["Y"].pixels[z * 7 + y, x] == stored.scene.fields[0].volume.values[x, y, z]
    own = stored.grids[0]
    row, column = z * own.spec.shape[1] + y, x
    found = [light.channels[c].pixels[row, column] for c in ("R", "G", "B", "error", "support")]
    assert found == [*own.values[x, y, z], own.error[x, y, z], own.support[x, y, z]]
    assert {c.pixels.dtype for p in parts.values() for c in p.channels.values()} == {np.dtype(np.float32)}


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
        store.Stored(two.scene, two.levels, one.grids, {})
    with pytest.raises(BadInput, match=r"shape \(4, 1\)"):
        store.Stored(two.scene, one.levels, two.grids, {})


@pytest.mark.parametrize("recipe", [{"x": float("nan")}, {"x": object()}])
def test_a_recipe_that_json_lacks_is_refused(tmp_path, recipe):
    stored = example()
    with pytest.raises((TypeError, ValueError), match="JSON"):
        store.write(tmp_path / "out", store.Stored(stored.scene, stored.levels, stored.grids, recipe), None, False)
    assert not list(tmp_path.iterdir())


def test_keys_that_are_numbers_become_text_and_do_not_break_the_checksum(tmp_path):
    stored = example()
    recipe = {10: "a", 9: ("b", "c")}
    store.write(tmp_path / "out", store.Stored(stored.scene, stored.levels, stored.grids, recipe), None, False)
    assert store.read(tmp_path / "out").recipe == {"10": "a", "9": ["b", "c"]}


# Where it may go


def test_a_finished_run_goes_only_with_overwrite(out):
    with pytest.raises(BadInput, match="holds a finished run; pass --overwrite or choose another folder with -o"):
        store.claim(out, False)
    with pytest.raises(BadInput, match="--overwrite"):
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
    assert (out / foreign).read_text() == "years of work" and not left_beside(out)


def test_what_arrives_at_the_last_moment_stays(out, monkeypatch):
    """Between the last look and the rename."""
    look = store.claim

    def look_too_early(folder, overwrite) -> None:
        look(folder, overwrite)
        if left_beside(out):  # the second look
            (out / "late.txt").write_text("late")

    monkeypatch.setattr(store, "claim", look_too_early)
    with pytest.raises(BadInput, match=r"late\.txt"):
        store.write(out, example(seed=1), None, True)
    assert (out / "late.txt").read_text() == "late" and not left_beside(out)
    (out / "late.txt").unlink()
    assert_same(store.read(out), example())


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
    elif kind == "mount":
        return Path("/proc")
    return place


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("kind", ["file", "link", "dangling", "below a file", "not writable", "mount"])
def test_places_that_cannot_be(tmp_path, kind, overwrite):
    place = make_bad(kind, tmp_path)
    before = sorted(tmp_path.iterdir())
    for refuse in (lambda: store.claim(place, overwrite), lambda: store.write(place, example(), None, overwrite)):
        with pytest.raises(BadInput, match=f"^{place} .*with -o$"):
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


# Whole or not there


@pytest.mark.parametrize(
    "trouble", [KeyboardInterrupt, RuntimeError, MemoryError, OSError(28, "No space left on device")]
)
@pytest.mark.parametrize("where", ["_write_exr", "_checksum", "_read_exr", "_refuse_foreign"])
def test_trouble_leaves_nothing_behind(tmp_path, monkeypatch, where, trouble):
    """Also on the way between the two renames, where an older run is put back."""
    out = tmp_path / "out"
    for old in (None, example()):
        if old:
            store.write(out, old, None, False)
        with monkeypatch.context() as patch:
            real = getattr(store, where)

            def fail(*args, real=real):
                if where == "_refuse_foreign" and args[0].name != "old":
                    return real(*args)
                raise trouble

            patch.setattr(store, where, fail)
            if old or where != "_refuse_foreign":  # without an older run nothing is between two renames
                with pytest.raises(trouble if trouble is KeyboardInterrupt else BadInput):
                    store.write(out, example(seed=1), b"picture", True)
        assert not left_beside(out)
        if old:
            assert_same(store.read(out), old)
        else:
            assert not out.exists()


def write_with_little_room(folder: str, room: int) -> None:
    """In a process of its own: files may not grow beyond `room` bytes."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
    try:
        store.write(folder, example(), None, False)
    except BadInput as reason:
        print(reason)  # noqa: T201
    else:
        print("written")  # noqa: T201


def in_another_process(call: str) -> str:
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import test_store as t; t.{call}"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True).stdout


def test_a_full_disk_is_noticed(out):
    """Also where but the last byte is missing, which the EXR library does not report."""
    size = (out / store.EXR).stat().st_size
    for room in (0, size // 2, size - 1):
        said = in_another_process(f"write_with_little_room({str(out.with_name('full'))!r}, {room})")
        assert "full could not be written; the disk may be full" in said
        assert not left_beside(out)
    assert in_another_process(f"write_with_little_room({str(out.with_name('full'))!r}, {size})") == "written\n"


def write_until_killed(folder: str, rounds: int) -> None:
    """In a process of its own that has not used the EXR library's threads: forked writers, killed at random moments."""
    pick = random.Random(0)
    for number in range(rounds):
        child = os.fork()
        if child == 0:
            for turn in range(10_000):
                store.write(Path(folder) / str(number), example(seed=turn % 2), b"picture", turn > 0)
            os._exit(0)
        time.sleep(pick.uniform(0.005, 0.06))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_a_kill_leaves_a_whole_run_or_none(tmp_path):
    in_another_process(f"write_until_killed({str(tmp_path)!r}, 24)")
    whole = [p for p in tmp_path.iterdir() if not p.name.startswith(".")]
    caught = [p for p in tmp_path.iterdir() if p.name.startswith(".")]  # what was under way
    assert len(whole) > 5 and len(caught) > 5
    for folder in whole:
        back = store.read(folder)
        assert_same(back, example(seed=back.recipe["seed"] - 2**70))


# Two at once


def test_of_two_writers_one_wins(tmp_path):
    for turn in range(10):
        folder, lost, start = tmp_path / str(turn), [], threading.Barrier(2)

        def go(seed: int, folder=folder, lost=lost, start=start) -> None:
            start.wait()
            try:
                store.write(folder, example(seed=seed), None, False)
            except BadInput:
                lost.append(seed)

        threads = [threading.Thread(target=go, args=(seed,)) for seed in (0, 1)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(lost) == 1
        assert_same(store.read(folder), example(seed=1 - lost[0]))


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_run_that_arrives_between_look_and_rename_wins(tmp_path, monkeypatch, overwrite):
    out, move = tmp_path / "out", store._move

    def late(fresh, place, old, replace) -> None:
        monkeypatch.setattr(store, "_move", move)
        store.write(place, example(seed=1), None, False)
        move(fresh, place, old, replace)

    monkeypatch.setattr(store, "_move", late)
    if overwrite:
        store.write(out, example(), None, True)
    else:
        with pytest.raises(BadInput, match="taken by another run meanwhile"):
            store.write(out, example(), None, False)
    assert_same(store.read(out), example(seed=0 if overwrite else 1))
    assert not left_beside(out)


# What is not trusted


def test_what_is_missing_is_named(out):
    with pytest.raises(BadInput, match=r"nowhere/illumination\.exr is missing; give a folder"):
        store.read(out.with_name("nowhere"))
    (out / store.RUN).rename(out / "aside")
    with pytest.raises(BadInput, match=r"run\.json is missing"):
        store.read(out)
    os.mkfifo(out / store.RUN)  # opening it would wait for ever
    with pytest.raises(BadInput, match=r"run\.json is missing"):
        store.read(out)


@pytest.mark.parametrize(
    "text", [b"", b"{", b"[]", b"7", b"\xff\xfe", b'{"format": 1}', b"[" * 100_000, b'{"format": ' + b"9" * 5000 + b"}"]
)
def test_a_record_that_is_none(out, text):
    (out / store.RUN).write_bytes(text)
    with pytest.raises(BadInput, match=r"run\.json is not the record of a run"):
        store.read(out)


def test_a_format_of_the_future(out):
    reseal(out, format=2)
    with pytest.raises(BadInput, match=r"run\.json .* format is 2; illumgrid .* reads format 1"):
        store.read(out)


def forge(folder: Path, *way: str | int, value: object = None, remove: bool = False) -> None:
    """Change one entry of the record, and the checksum with it, so that only the entry itself can be found out."""
    record = json.loads((folder / store.RUN).read_text())
    at = record
    for key in way[:-1]:
        at = at[key]
    at[way[-1]] = value
    if remove:
        del at[way[-1]]
    if way != ("checksum",):
        record["checksum"] = store._checksum(record, folder / store.EXR)
    (folder / store.RUN).write_text(json.dumps(record))


WAYS = [("recipe",), ("levels",), ("grids",), ("checksum",), ("scene",), ("scene", "fields"), ("scene", "background")]


@pytest.mark.parametrize("way", WAYS, ids=".".join)
@pytest.mark.parametrize("value", [None, 7, "text", [], [[1, 2], [3]], [[1, 2]], "remove"], ids=str)
def test_wrong_types_in_the_record(out, way, value):
    forge(out, *way, value=value, remove=value == "remove")
    with pytest.raises(BadInput, match=r"(run\.json|illumination\.exr) .*; give a folder that"):
        store.read(out)


BAD_ENTRIES = {
    "name": [None, 7, "", "a\nb", "other", ["protons"], {}],
    "shape": [
        None,
        [4, 7],
        [4, 7, 5, 1],
        [4, 7, 5.0],
        ["4", 7, 5],
        [4, 7, 1],
        [4, 7, -5],
        [5, 7, 4],
        [35, 4, 1],
        [10**9] * 3,
    ],
    "origin": [None, "here", [1, 2], [[1, 2, 3]], [1, 2, "x"], [1, 2, {}], [1, [2], 3]],
    "spacing": [None, [0, 1, 1], [1, -1, 1], [1, 2], {}],
    "direction": [None, [1, 0, 0], [[1, 0, 0], [0, 1, 0], [0, 0, 2]], [[1, 0], [0, 1]], "xyz"],
    "albedo": [None, 0.5, [0.5, 0.5], [0, 0, 1.1], [-0.1, 0, 0], "white"],
    "emission": [None, 1, [-1, 0, 0], [1, 2], {}],
    "range": [[2, 1], [1], [1, 1], 7, [1e6, 2e6], "wide", [None, 1]],
    "inside": [None, 1, "both", ["above"], {}],
}


@pytest.mark.parametrize("key", BAD_ENTRIES)
def test_wrong_entries_of_a_field(out, key):
    for value in BAD_ENTRIES[key]:
        forge(out, "scene", "fields", 0, key, value=value)
        with pytest.raises(BadInput, match=r"(run\.json|illumination\.exr) .*; give a folder that"):
            store.read(out)
    forge(out, "scene", "fields", 0, key, remove=True)
    with pytest.raises(BadInput, match=r"run\.json is not the record"):
        store.read(out)


@pytest.mark.parametrize("key", ["shape", "origin", "spacing", "direction"])
def test_wrong_entries_of_a_grid(out, key):
    for value in BAD_ENTRIES[key]:
        forge(out, "grids", "protons", key, value=value)
        with pytest.raises(BadInput, match=r"(run\.json|illumination\.exr) .*; give a folder that"):
            store.read(out)


@pytest.mark.parametrize("token", ["NaN", "Infinity", "1e999"])
def test_numbers_that_json_does_not_have(out, token):
    text = (out / store.RUN).read_text()
    (out / store.RUN).write_text(text.replace('"solve": 0.1', f'"solve": {token}'))
    with pytest.raises(BadInput, match="give a folder that"):
        store.read(out)


@pytest.mark.parametrize(
    "disguise",
    [
        {"compression": OpenEXR.PIZ_COMPRESSION},
        {"type": OpenEXR.tiledimage},
        {"name": "x"},
        {"dataWindow": ((1, 0), (4, 34))},
    ],
    ids=str,
)
def test_another_kind_of_exr_file_is_refused(out, disguise):
    """Whose header could claim more than the bound of deflate, or mean something else."""
    parts = OpenEXR.File(str(out / store.EXR)).parts
    for part in parts:
        part.header.pop("chunkCount", None)
        part.header |= {"tiles": OpenEXR.TileDescription()} if "type" in disguise else {}
    parts[1].header |= disguise
    again = [OpenEXR.Part(p.header, p.channels, disguise.get("name", p.name())) for p in parts]
    OpenEXR.File(again).write(str(out / store.EXR))
    reseal(out)
    with pytest.raises(BadInput, match=r"illumination\.exr cannot be used"):
        store.read(out)


def test_halves_are_refused(out):
    parts = OpenEXR.File(str(out / store.EXR)).parts
    channels = {"Y": parts[1].channels["Y"].pixels.astype(np.float16)}
    OpenEXR.File([parts[0], OpenEXR.Part(parts[1].header, channels, "field/protons")]).write(str(out / store.EXR))
    reseal(out)
    with pytest.raises(BadInput, match=r"illumination\.exr cannot be used: its pixels"):
        store.read(out)


def test_a_claim_beyond_the_file_is_refused_before_memory_is_asked_for(out, monkeypatch):
    forge(out, "scene", "fields", 0, "shape", value=[4096, 4096, 4096])
    monkeypatch.setattr(OpenEXR, "File", None)
    with pytest.raises(BadInput, match=r"its \d+ bytes cannot hold the arrays"):
        store.read(out)


def mutations(content: bytes, count: int, seed: int):
    pick = random.Random(seed)
    for _ in range(count):
        damaged = bytearray(content)
        if pick.random() < 0.25:
            damaged = damaged[: pick.randrange(len(damaged))]
        else:
            within = min(len(damaged), pick.choice([900, len(damaged)]))  # the headers, or all
            for _ in range(pick.choice([1, 1, 2, 5])):
                damaged[pick.randrange(within)] = pick.choice([0, 32, 57, 255, pick.randrange(256)])
        yield bytes(damaged)


@pytest.mark.parametrize("name", [store.EXR, store.RUN])
def test_damage_is_found_or_does_no_harm(out, name):
    refused = 0
    for damaged in mutations((out / name).read_bytes(), 300, seed=1):
        (out / name).write_bytes(damaged)
        try:
            assert_same(store.read(out), example())
        except BadInput as reason:
            assert str(out) in str(reason)
            refused += 1
    assert refused > 200


def test_damage_under_a_forged_checksum_is_no_crash(out, capfd):
    """What the checksum keeps from the EXR library in practice: nothing but BadInput or arrays of the right shapes."""
    refused = 0
    for damaged in mutations((out / store.EXR).read_bytes(), 300, seed=2):
        (out / store.EXR).write_bytes(damaged)
        reseal(out)
        try:
            back = store.read(out)
        except BadInput as reason:
            assert str(out) in str(reason)
            refused += 1
        else:
            assert back.grids[0].spec.shape == example().grids[0].spec.shape
    assert refused > 150
