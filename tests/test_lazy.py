"""Light that is computed while one looks: the same bits in any order, coarse first, then what is in sight; the page."""

import json
import re
import signal
import subprocess
import threading
import urllib.error
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

import illumgrid as ig
from browser import browser, until  # noqa: F401
from illumgrid.chain import run
from illumgrid.cli import lazily
from illumgrid.field.lattice import specs_over
from illumgrid.field.scene import level_table
from illumgrid.field.volume import interpolate
from illumgrid.grid import IlluminationGrid
from illumgrid.io.partial import Partial
from illumgrid.live import Attention, Live, Stopped
from illumgrid.show.viewer import page
from illumgrid.show.viewer.server import serve
from illumgrid.show.viewer.texture import Texture
from shapes import ball
from test_cli_process import COMMAND

GRID, HOW = 18, {"paths": 4, "bounces": 2, "isovalues": 6, "seed": 3}
CHANNELS = 3


@pytest.fixture(scope="module")
def scene():
    return ig.Scene.floor(ball(15), range=(0.3, 0.9))


@pytest.fixture(scope="module")
def truth(scene):
    return run(scene, grid=GRID, **HOW, judge=False)


def live_of(scene, folder, piece=None):
    """A live run in `folder`, whose pieces `piece` may watch."""
    keeper = Partial(folder, {"paths": 4}, "illumgrid run", lambda place: place.mkdir(parents=True))
    if keeper.place.is_dir():
        assert keeper.resume(None, False, False)
    live = Live(keeper, scene, specs_over(scene, GRID), level_table(scene, HOW["isovalues"]), {"input": "ball"})
    choose = live.next

    def next(unknown, most):
        number, rows = choose(unknown, [min(each, 40) for each in most])
        if piece:
            piece(live, number, rows)
        return number, rows

    live.next = next
    return live


def the_same(light, truth):
    grids = zip((*light.grids, *light.walls), (*truth.grids, *truth.walls))
    return all(np.array_equal(a.light, b.light) for a, b in grids)


def test_whatever_is_looked_at_the_light_is_the_same_in_the_end(scene, truth, tmp_path):
    random = np.random.default_rng(0)

    def wander(live, number, rows):
        live.attention = Attention(random.random(), random.normal(size=3), np.array([0.0, 1.0, 0.0]), 0.4)

    live = live_of(scene, tmp_path / "run", wander)
    assert the_same(run(scene, grid=GRID, **HOW, judge=False, keep=live), truth)
    assert live.share == 1 and live.ended


def test_a_coarse_lattice_comes_first_and_then_what_is_in_sight(scene, tmp_path):
    seen = []

    def note(live, number, rows):
        seen.append((live.coarse.is_set(), live._batches[number] + rows))

    live = live_of(scene, tmp_path / "run", note)
    eye = np.array([0.0, -3.0, 0.3])
    live.attention = Attention(0.25, eye, np.array([0.0, 1.0, 0.0]), 0.4)
    run(scene, grid=GRID, **HOW, judge=False, keep=live)
    places, blocks = live._places, live._blocks
    before, after = (np.concatenate([rows for now, rows in seen if now == when]) for when in (False, True))
    assert places.first[before].all() and not places.first[after].any()
    nodes = after[places.texture[after] == 0]
    block = blocks.block[nodes]
    away = np.maximum(blocks.low[block] - 0.25, 0.25 - blocks.high[block]).clip(0)
    third = len(nodes) // 3
    assert away[:third].max() < away[-third:].mean()
    front = blocks.middle[block][away == 0][:, 1]  # the eye looks along y
    assert front[: len(front) // 3].mean() < front[-(len(front) // 3) :].mean() - 0.1


def test_a_stop_keeps_what_is_lit_and_the_same_run_goes_on(scene, truth, tmp_path):
    def stop(live, number, rows):
        if live.share > 0.4:
            live.stop.set()

    live = live_of(scene, tmp_path / "run", stop)
    with pytest.raises(Stopped):
        run(scene, grid=GRID, **HOW, judge=False, keep=live)
    live.keeper.close()
    again = live_of(scene, tmp_path / "run")
    shares = []
    again.next = (lambda choose: lambda *about: shares.append(again.share) or choose(*about))(again.next)
    assert the_same(run(scene, grid=GRID, **HOW, judge=False, keep=again), truth)
    assert 0.4 < shares[0] < 0.5


def test_before_there_is_light_everywhere_only_coarse_nodes_are_looked_at(scene, tmp_path):
    """Where all the others lie, and a folder for what comes in, would keep the first picture waiting."""
    early = []

    def note(live, number, rows):
        early.append((live.coarse.is_set(), live._blocks is None, live.keeper.place.is_dir()))

    run(scene, grid=GRID, **HOW, judge=False, keep=live_of(scene, tmp_path / "run", note))
    assert early[0] == (False, True, False)
    assert all(unplaced and not kept for coarse, unplaced, kept in early if not coarse)
    assert early[-1] == (True, False, True)


def test_once_there_is_light_everywhere_the_page_is_made_before_more_is_lit(tmp_path, monkeypatch):
    """What works beside it would keep the page waiting; a stop meanwhile keeps the coarse light."""
    monkeypatch.chdir(tmp_path)
    np.save("ball.npy", ball(40).values)
    made, pieces, released = page, [], threading.Event()
    begun = Live.next

    def next(live, unknown, most):
        if live.coarse.is_set():
            released.set()
        else:
            pieces.append(live)
        return begun(live, unknown, most)

    def slowly(light, up, coming):
        assert not released.wait(0.5)
        made(light, up, coming=coming)
        raise KeyboardInterrupt

    monkeypatch.setattr(Live, "next", next)
    monkeypatch.setattr("illumgrid.show.viewer.page", slowly)
    with pytest.raises(KeyboardInterrupt):
        lazily.look_at("ball.npy", False, None)
    live = pieces[0]
    assert live.coarse.is_set() and 0 < live.share < 1
    assert live.keeper._stored == round(live.share * live._batches[-1])


def test_light_between_coarse_nodes_lies_on_straight_lines():
    texture = Texture.of((9, 6, 7), 3)
    nodes = np.stack(np.indices((9, 6, 7)), axis=-1).reshape(-1, 3)
    straight = (nodes @ np.array([[1.0, 0.0, 2.0], [3.0, 1.0, 0.0], [0.5, 4.0, 1.0]])).astype(np.float32)
    coarse = np.flatnonzero((nodes % 4 == 0).all(axis=1))
    texture.paint(coarse, straight[coarse], 1)
    texture.paint(np.array([17]), np.full((1, 3), 99.0, np.float32), 1)
    texture.fill(np.ones(3), 2)
    between = (nodes <= [8, 4, 4]).all(axis=1) & (np.arange(len(nodes)) != 17)
    light = texture.light.reshape(-1, 3)
    assert np.allclose(light[between], straight[between], rtol=1e-6)
    assert (light[17] == 99).all()
    edge = np.ravel_multi_index((8, 5, 6), (9, 6, 7))  # beyond the last coarse node as at it
    assert np.allclose(light[edge], straight[np.ravel_multi_index((8, 4, 4), (9, 6, 7))])


def test_a_texture_without_light_on_coarse_nodes_has_the_mean_of_what_is_lit():
    texture = Texture.of((6, 6, 6), 3)
    texture.paint(np.array([8, 9]), np.array([[1, 2, 3], [3, 4, 5]], np.float32), 1)
    texture.fill(np.ones(3), 2)
    assert (texture.light[5, 5, 5] == (2, 3, 4)).all() and (texture.light[0, 1, 2] == (1, 2, 3)).all()


def news(live, since=0):
    answer = live.news({"since": [str(since)], "sweep": ["0.5"]})
    length = int.from_bytes(answer[:4], "little")
    head, at = json.loads(answer[4 : 4 + length]), 4 + length
    for part in head["parts"]:
        shape = (*part["shape"][::-1], CHANNELS + 1)
        part["texels"] = np.frombuffer(answer, np.float16, int(np.prod(shape)), at).reshape(shape)
        at += part["texels"].nbytes
    assert at == len(answer)
    return head


def test_the_page_gets_all_light_once(scene, truth, tmp_path):
    heads, since = [], [0]

    def ask(live, number, rows):
        if live.coarse.is_set():
            if not heads:
                live.light()
            heads.append(news(live, since[0]))
            since[0] = heads[-1]["stamp"]

    live = live_of(scene, tmp_path / "run", ask)
    run(scene, grid=GRID, **HOW, judge=False, keep=live)
    live.done = True
    heads.append(news(live, since[0]))
    assert heads[-1]["done"] and not heads[0]["done"] and not news(live, heads[-1]["stamp"])["parts"]
    shape = truth.grids[0].spec.shape
    grid = np.full((*shape[::-1], CHANNELS + 1), np.nan)
    wall = np.full((*truth.walls[0].light.shape[:3], CHANNELS + 1), np.nan)
    for part in (part for head in heads for part in head["parts"]):
        x, y, z = part["from"]
        w, h, d = part["shape"]
        (grid, wall)[part["texture"]][z : z + d, y : y + h, x : x + w] = part["texels"]
    values = scene.fields[0].volume.values  # a rim node shows what it was asked, and not its nearest neighbour's light
    at = np.linspace(0, values.shape[0] - 1, GRID)
    at = np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1)
    level = interpolate(ig.Volume(values), at.reshape(-1, 3))
    lit = ((level >= 0.3) & (level <= 0.9)).reshape(shape).T
    expected = truth.grids[0].light[..., :CHANNELS].transpose(2, 1, 0, 3)[lit] * live._scale
    assert lit.sum() > 1000
    assert np.allclose(grid[lit][:, :CHANNELS], expected, rtol=1e-3)  # half floats have 11 bits
    assert (grid[..., CHANNELS] == -1).all()  # no errors are known yet
    assert np.isfinite(grid).all() and np.isfinite(wall).all()


def test_what_an_address_says_wrongly_is_left_out():
    good = {"sweep": ["0.2"], "eye": ["1,2,3"], "forward": ["0,1,0"], "slope": ["0.4"]}
    assert Attention.of(good).sweep == 0.2
    for wrong in ({"eye": ["1,2"]}, {"eye": ["1,2,x"]}, {"sweep": ["nan"]}):
        assert Attention.of(good | wrong).eye is None
    assert Attention.of({}).sweep == 0.5


def test_a_page_becomes_what_it_would_be_if_all_light_had_been_there(browser, scene, tmp_path):  # noqa: F811
    gate = threading.Event()
    live = live_of(scene, tmp_path / "run", lambda live, *rest: live.coarse.is_set() and gate.wait(60))
    work = threading.Thread(
        target=lambda: (run(scene, grid=GRID, **HOW, judge=False, keep=live), setattr(live, "done", True))
    )
    work.start()
    assert live.coarse.wait(120)
    coarse, coming = live.light()
    with serve(page(coarse, coming=coming).encode(), live.news) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with pytest.raises(urllib.error.HTTPError):
            urllib.request.urlopen(server.address.rsplit("/", 2)[0] + "/light")
        browser.page.goto(f"{server.address}#rest=0")
        browser.shown = None
        first = browser.pixels()
        before = as_it_is(live, coarse)
        gate.set()
        subtitle = "document.querySelector('[data-part=subtitle]').textContent"
        until(browser.page, f"{subtitle}.startsWith('The light is complete')")
        last = browser.pixels()
        server.shutdown()
    work.join()
    for seen, light in ((first, before), (last, as_it_is(live, coarse))):
        (browser.folder / f"{scene.fields[0].name}.html").unlink(missing_ok=True)
        truth = browser.open(light) and browser.pixels()
        # A still page takes 4 to 16 samples a pixel, as its machine is fast: they differ where a pixel holds an edge.
        smooth = (maximum_filter(truth, (3, 3, 1)) - minimum_filter(truth, (3, 3, 1)) <= 8).all(axis=2)
        assert smooth.mean() > 0.5 and np.abs(seen - truth)[smooth].max() <= 2
    assert np.abs(first - truth)[smooth].max() > 10
    assert not browser.troubles


def as_it_is(live, first):
    """All that a live run holds, as light whose page comes whole, with the exposure of `first`."""
    grids = [
        IlluminationGrid(spec, t.light.copy(), np.full(spec.shape, np.inf), np.ones(spec.shape))
        for t, spec in zip(live._textures, live.specs)
    ]
    walls = [replace(wall, values=t.light.copy()) for wall, t in zip(first.walls, live._textures[len(grids) :])]
    whole = replace(first, grids=tuple(grids), walls=tuple(walls))
    whole.__dict__["exposure"] = first.exposure
    return whole


def test_view_lights_a_file_until_ctrl_c_and_run_goes_on(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("ball.npy", ball(40).values)

    def hear():
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    command = [*COMMAND, "view", "ball.npy", "--no-open"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=hear, cwd=tmp_path) as process:
        try:
            lines = []
            while not (found := re.search(r"http://127\.0\.0\.1:\d+/\S+", lines[-1] if lines else "")):
                lines.append(process.stderr.readline())
                assert lines[-1], lines
            with urllib.request.urlopen(found[0], timeout=60) as answer:
                assert b"connect-src 'self'" in answer.read()
            process.send_signal(signal.SIGINT)
            said = process.communicate(timeout=60)[1]
        finally:
            process.kill()
    assert process.returncode == 0
    if "all of it is lit" not in said:  # a fast machine may have ended
        assert re.search(r"\d+% of the light is kept in ball-light\.partial", said)
        assert "going on with ball-light.partial" in call("run", "ball.npy", "--no-preview")
    assert (tmp_path / "ball-light" / "run.json").is_file() and not (tmp_path / "ball-light.partial").exists()


def test_lazy_is_refused_with_what_is_not_lit_node_by_node(refuse, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("ball.npy", ball(9).values)
    refuse("run", "ball.npy", "--lazy", "--sampler", "uniform", words=["--lazy", "uniform", "direct"])
    refuse("run", "ball.npy", "--lazy", "--error", "0.1", words=["--lazy", "--error"])
    refuse("run", "ball.npy", "--lazy", "--lights", "sh", words=["--lazy", "sh"])
