"""The page without a browser: its source, its data, and its server."""

import base64
import gzip
import hashlib
import re
import socket
import threading
import time
import urllib.error
import urllib.request
from dataclasses import replace

import numpy as np
import pytest

from browser import bent, coloured, pair
from illumgrid.field.volume import Volume, box_corners, index_to_world
from illumgrid.grid import GREY
from illumgrid.show.trust import relative
from illumgrid.show.viewer import MODULES, SHADERS, compressed, packing, page, script, source
from illumgrid.show.viewer.arrays import field_steps, reduced, thinned
from illumgrid.show.viewer.packing import Stage, packed
from illumgrid.show.viewer.server import CONNECTIONS, serve
from shapes import MIRRORED, ball, lit, sampled, sky

LIGHT = coloured(pair())


# The source


def test_the_source_is_under_111_kb():  # 9 of them mix lights and turn a sky, 26 gather light at rest, 10 show looks
    text = page(LIGHT)
    carried = re.findall(
        r'<script type="(?:application/json" id="scene|text/plain" id="data)">(.*?)</script>', text, re.S
    )
    assert len(carried) == 2
    assert len(text.encode()) - sum(map(len, carried)) < 111_000


def test_modules_joined_into_one_keep_their_names_apart():
    for last in ("page", "widget"):
        text = script(last)
        named = re.findall(r"^(?:async )?(?:function|const|let|class) (\w+)", text, re.M)
        assert len(named) == len(set(named)) > 20
        assert not re.search(r"^import |^export (?!default)", text, re.M)


def test_a_module_imports_only_from_those_before_it():
    for number, name in enumerate(MODULES):
        taken = re.findall(r'from "\./(\w+)\.js"', source(f"{name}.js"))
        assert set(taken) <= set(MODULES[:number])


def test_the_page_names_no_other_place():
    text = page(LIGHT)
    assert not re.search(r"https?:|//\w+\.|@import|url\(", re.sub(r'id="data">.*?</script>', "", text, flags=re.S))
    assert text.count("<canvas") == 1 and re.search(r'type: "range"|type="range"', text)


def test_a_name_cannot_leave_its_place():
    scene = sky(ball(8), name="</script><b>&")
    text = page(coloured(scene))
    assert "</script><b>" not in text and "<title>&lt;/script&gt;&lt;b&gt;&amp;" in text


def test_shaders_never_discard_in_the_ray_loop():
    body = source("march.glsl")
    loop = body[body.index("float march(") : body.index("vec3 gradient(")]
    assert "break" in loop and "discard" not in body and len(SHADERS) == len(set(SHADERS)) == 16


# What it carries


def unpacked(scene, data, part):
    """Undo the packing of field values as the page does."""
    (nx, ny, nz), size, start = part["shape"], part["bytes"], part["offset"]
    count = nx * ny * nz
    raw = np.frombuffer(data, np.uint8, count * size, start)
    words = raw if size == 1 else raw[:count] + (raw[count:].astype(np.uint16) << 8)
    rows = words.reshape(nz, ny, nx)
    return np.cumsum(rows, axis=2, dtype=rows.dtype).transpose(2, 1, 0)


def halves(data, part):
    count, each = int(np.prod(part["shape"])), part["channels"] + 1
    raw = np.frombuffer(data, np.uint8, 2 * each * count, part["offset"]).reshape(each, 2, count)
    words = raw[:, 0] + (raw[:, 1].astype(np.uint16) << 8)
    words[1:-1] += words[0]
    return words.view(np.float16).reshape(each, *part["shape"][::-1]).transpose(3, 2, 1, 0)


@pytest.mark.plain
def test_fields_and_light_come_out_as_they_went_in():
    scene, data = packed(LIGHT)
    assert gzip.decompress(compressed(data)) == data and compressed(data) == compressed(data)
    for about, field, grid in zip(scene["fields"], LIGHT.scene.fields, LIGHT.grids):
        part = about["values"]
        back = part["base"] + part["step"] * unpacked(scene, data, part).astype(float)
        assert np.abs(back - field.upward * field.volume.values).max() <= 0.51 * part["step"] * (part["step"] != 1)
        texels = halves(data, about["light"])
        lit = grid.values * (LIGHT.exposure / np.pi)
        np.testing.assert_allclose(texels[..., :3], lit, rtol=5e-4)
        assert ((texels[..., 3] < 0) == (grid.support == 0)).all()
        known = grid.support > 0
        np.testing.assert_allclose(texels[known][:, 3], relative(grid, grid.bar)[known], rtol=2e-3, atol=1e-4)
    wall = scene["walls"][1]
    atlas = halves(data, scene["atlas"])[wall["offset"][0] :, : wall["texels"][1]]
    shown = LIGHT.walls[1].values.transpose(2, 1, 0, 3) * (LIGHT.exposure / np.pi)
    np.testing.assert_allclose(atlas[: wall["texels"][0], ..., :3], shown, rtol=5e-4)


@pytest.mark.plain
@pytest.mark.parametrize(
    "values, size, step",
    [
        ([0, 7, 255], 1, 1.0),
        ([-1024, 3071, 5], 2, 1.0),
        ([0, 65535, 1], 2, 1.0),
        ([0, 65536, 1], 2, 65536 / 65535),
        ([0.0, 0.5, 1.0], 2, 1 / 65535),
        ([2.0**25, 2.0**25 + 4, 2.0**25 + 8], 2, 8 / 65535),
    ],
)
def test_whole_numbers_stay_exact(values, size, step):
    values = np.resize(np.array(values, np.float32), (3, 2, 2))
    steps, base, step_, clamped = field_steps(Volume(values), (float(values.min()), float(values.max())))
    assert steps.dtype.itemsize == size and step_ == pytest.approx(step) and not clamped
    assert np.abs(base + step_ * steps.astype(float) - values).max() <= (0 if step == 1 else 0.5 * step_)


@pytest.mark.plain
def test_a_narrow_range_in_wide_data_keeps_its_steps():
    values = np.resize(np.array([0.0, 0.5, 0.51, 1e6 + 0.5], np.float32), (2, 2, 2))
    steps, base, step, clamped = field_steps(Volume(values), (0.4, 0.6))
    assert clamped and step * 1000 < 0.2
    assert np.abs(base + step * steps.astype(float) - values)[values < 1].max() <= 0.5 * step


@pytest.mark.plain
def test_the_stage_leads_to_the_indices_that_the_world_does():
    scene = bent()
    stage, volume = Stage.of(scene), scene.fields[0].volume
    index = np.random.default_rng(1).random((20, 3)) * 9
    world = index_to_world(volume, index)
    place = np.insert(stage.place(world), 3, 1.0, axis=1)
    np.testing.assert_allclose((place @ stage.to_index(volume).T)[:, :3], index, atol=1e-9)
    assert np.abs(place[:, :3]).max() <= 0.51


def test_what_is_too_large_is_reduced_and_reported(monkeypatch):
    volume = sampled(lambda x: x @ (1.0, 2.0, 3.0), (30, 30, 30), (5, 6, 7), (1, 2, 1), MIRRORED)
    small = reduced(volume, most=20**3)
    assert small.shape == (15, 15, 15) and reduced(volume, most=30**3) is volume
    where = index_to_world(small, np.array([[7.0, 3.0, 11.0]]))[0]  # the middle of a block lies between its voxels
    assert small.values[7, 3, 11] == pytest.approx(where @ (1.0, 2.0, 3.0), abs=1e-3)
    assert reduced(Volume(volume.values[:29]), most=20**3).shape == (15, 15, 15)
    monkeypatch.setattr(packing, "MOST_VOXELS", 12**3)
    monkeypatch.setattr(packing, "MOST_NODES", 6**3)
    light = coloured(sky(ball(20)))
    scene, _ = packed(light)
    assert scene["fields"][0]["values"]["shape"] == [10, 10, 10] and scene["fields"][0]["light"]["shape"] == [5, 5, 5]
    assert "20\u2009×\u200920\u2009×\u200920 to 10\u2009×\u200910\u2009×\u200910 voxels" in scene["notes"][0]
    assert "9\u2009×\u20099\u2009×\u20099 to 5\u2009×\u20095\u2009×\u20095 nodes" in scene["notes"][1]


def test_a_side_longer_than_a_texture_is_reduced():
    long = sampled(lambda x: x @ (1.0, 2.0, 3.0), (5000, 4, 3), (5, 6, 7), (1, 2, 1), MIRRORED)
    small = reduced(long, most=2**25)
    assert small.shape == (1667, 4, 3)
    where = index_to_world(small, np.array([[700.0, 2.0, 1.0]]))[0]
    assert small.values[700, 2, 1] == pytest.approx(where @ (1.0, 2.0, 3.0), rel=1e-5)
    grid = lit(sky(ball(20)), nodes=9).grids[0]
    spec = replace(grid.spec, shape=(3001, 2, 2))
    assert max(thinned(grid.onto(spec), most=2**22).spec.shape) <= 2048


@pytest.mark.plain
@pytest.mark.parametrize("nodes", [9, 10, 11, 12])
def test_thinned_light_reaches_from_the_first_node_to_the_last_and_is_what_the_grid_answers(nodes):
    grid = lit(sky(ball(20)), nodes=nodes).grids[0]
    index = np.indices(grid.spec.shape).transpose(1, 2, 3, 0)
    grid = replace(grid, values=1 + index / nodes, error=index[..., 0] / nodes)  # linear: fewer nodes answer the same
    few = thinned(grid, most=6**3)
    assert few is not grid and np.prod(few.spec.shape) <= 7**3
    np.testing.assert_allclose(box_corners(few.spec), box_corners(grid.spec), atol=1e-12)
    points = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    np.testing.assert_allclose(few.lookup(points), grid.lookup(points), atol=1e-5)
    np.testing.assert_allclose(few.lookup(box_corners(grid.spec)), grid.lookup(box_corners(grid.spec)), atol=1e-5)
    assert np.abs(few.error - np.linspace(0, 1 - 1 / nodes, len(few.error))[:, None, None]).max() <= 0.5 / nodes + 1e-6


@pytest.mark.plain
def test_grey_light_is_carried_in_one_channel():
    scene, _ = packed(LIGHT)
    assert [f["light"]["channels"] for f in scene["fields"]] == [3, 3] and scene["atlas"]["channels"] == 3
    light = lit(sky(), value=0.7, nodes=5)
    grid = light.grids[0]
    light = replace(light, grids=(replace(grid, values=grid.values[..., :1], channels=GREY),))
    grey, data = packed(light)
    part = grey["fields"][0]["light"]
    assert part["channels"] == 1
    texels = halves(data, part)
    assert texels.shape == (5, 5, 5, 2)
    np.testing.assert_allclose(texels[..., 0], 1.0, rtol=1e-3)  # albedo 0.8 under the automatic exposure


# The server


def test_the_server_answers_this_machine_only_and_only_with_the_page():
    with serve(b"<p>here</p>") as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        assert server.server_address[0] == "127.0.0.1" and server.server_address[1] > 0
        with urllib.request.urlopen(server.address, timeout=10) as answer:
            assert answer.read() == b"<p>here</p>" and answer.headers["Content-Type"].startswith("text/html")
            policy = answer.headers["Content-Security-Policy"]
            assert "frame-ancestors 'none'" in policy and "allow-popups" not in policy and "allow-forms" not in policy
        port = server.address.rpartition(":")[2].partition("/")[0]
        unknown = (server.address + "etc", f"http://127.0.0.1:{port}/", f"http://127.0.0.1:{port}/{'A' * 32}/")
        for address, host, code in ((server.address, "evil.example", 403), *((other, None, 404) for other in unknown)):
            asked = urllib.request.Request(address, headers={"Host": host} if host else {})
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(asked, timeout=10)
            assert refused.value.code == code
            refused.value.close()
        server.shutdown()


def test_every_start_of_the_server_has_an_address_of_its_own():
    with serve(b"") as one, serve(b"") as other:
        assert one.place != other.place and min(len(one.place), len(other.place)) > 30


def test_many_connections_at_once_are_hung_up_on_and_the_page_comes_again_later():
    with serve(b"<p>here</p>") as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        idle = [socket.create_connection(server.server_address) for _ in range(CONNECTIONS)]
        late = socket.create_connection(server.server_address)
        late.settimeout(10)
        assert late.recv(1) == b""  # hung up on
        for one in (*idle, late):
            one.close()
        until = time.monotonic() + 10
        while True:
            try:
                with urllib.request.urlopen(server.address, timeout=10) as answer:
                    assert answer.read() == b"<p>here</p>"
                break
            except OSError:
                assert time.monotonic() < until
        server.shutdown()


def test_the_page_may_run_its_own_script_and_no_text():
    text = page(lit(sky()))
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)
    assert "unsafe-eval" not in policy and "default-src 'none'" in policy and "form-action 'none'" in policy
    (run,) = re.findall(r'<script type="module">(.*?)</script>', text, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(run.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}';" in policy
