"""A folder that claims to hold a finished run is not trusted: reading raises BadInput or gives the right result."""

import json
import os
import random
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from illumgrid.errors import BadInput
from illumgrid.io import store
from test_store import assert_same, example


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A finished run."""
    store.write(tmp_path / "out", example(), None, False)
    return tmp_path / "out"


def reseal(folder: Path, **changes) -> None:
    """Forge the record so that its checksum matches the current content."""
    record = json.loads((folder / store.RUN).read_text("utf-8")) | changes
    record |= {"exr": store._digest(folder / store.EXR)}
    (folder / store.RUN).write_text(json.dumps(record | {"checksum": store._checksum(record, folder / store.EXR)}))


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
    reseal(out, format=5)
    with pytest.raises(BadInput, match=r"run\.json .* format is 5; illumgrid .* reads 1 to 4"):
        store.read(out)


def forge(folder: Path, *way: str | int, value: object = None, remove: bool = False) -> None:
    """Change one entry of the record and the checksum with it, so that only the entry itself can be detected."""
    record = json.loads((folder / store.RUN).read_text("utf-8"))
    at = record
    for key in way[:-1]:
        at = at[key]
    at[way[-1]] = value
    if remove:
        del at[way[-1]]
    if way != ("checksum",):
        record["checksum"] = store._checksum(record, folder / store.EXR)
    (folder / store.RUN).write_text(json.dumps(record))


WAYS = [
    ("recipe",),
    ("levels",),
    ("grids",),
    ("checksum",),
    ("exr",),
    ("scene",),
    ("scene", "fields"),
    ("scene", "background"),
]


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
    "type": [None, 4, "float64", "uint8", "int64", ["float32"], {}],
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
    text = (out / store.RUN).read_text("utf-8")
    (out / store.RUN).write_text(text.replace('"solve": 0.1', f'"solve": {token}'))
    with pytest.raises(BadInput, match=r"JSON compliant.*give a folder that"):
        store.read(out)


@pytest.mark.parametrize(
    "disguise",
    [
        {"compression": OpenEXR.PIZ_COMPRESSION},
        {"type": OpenEXR.tiledimage},
        {"name": "x"},
        {"dataWindow": ((1, 0), (5, 27))},
    ],
    ids=str,
)
def test_another_kind_of_exr_file_is_refused(out, disguise):
    """Its header could claim more than the bound of deflate, or have another meaning."""
    parts = OpenEXR.File(str(out / store.EXR)).parts
    for part in parts:
        part.header.pop("chunkCount", None)
        part.header |= {"tiles": OpenEXR.TileDescription()} if "type" in disguise else {}
    parts[1].header |= disguise
    names = parts[0].name(), disguise.get("name", parts[1].name())
    again = [OpenEXR.Part(p.header, p.channels, name) for p, name in zip(parts, names)]
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
    """The checksum normally keeps such damage from the EXR library: only BadInput or right shapes may result."""
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
