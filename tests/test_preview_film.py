"""Films and folders of a sweep, split pictures, and the options of ``illumgrid preview``."""

import importlib.util
import io
import weakref

import numpy as np
import pytest
from PIL import Image

import illumgrid as ig
from illumgrid.show import fit_camera, render, widest_row
from illumgrid.show.captions import labelled
from illumgrid.show.film import check_ending, film, frames
from shapes import lit, refused, sky
from test_tone_preview import three_balls

RUN = ["run", "v.npy", "--range", 0.3, 0.9, "--grid", 6, "--paths", 2, "--no-preview", "-o", "out"]


class Frame(np.ndarray):
    """A picture whose life is followed."""

    __hash__ = object.__hash__


@pytest.fixture
def out(call):
    call(*RUN)
    return ig.load("out")


def shown(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def test_a_split_picture_is_the_local_one_beside_the_global_one(call, out, tmp_path):
    for name, option in (("both", "--split"), ("left", "--local"), ("right", "--zoom=1")):
        call("preview", "out", option, "--engine", "software", "--isovalue", 0.5, "-o", f"{name}.png")
    both = shown("both.png")
    assert both.shape == (48, 128, 3)
    assert np.array_equal(both[:, :64], shown("left.png"))
    assert np.array_equal(both[:, 64:], shown("right.png"))
    assert np.array_equal(both[:, 64:], render(out, isovalue=0.5))


@pytest.mark.parametrize("ending", ["gif", "webp"])
def test_a_film_has_a_frame_for_each_isovalue_and_starts_again(call, out, ending):
    call("preview", "out", "--sweep", 5, f"film.{ending}", "--engine", "software", "--size", 150, 100)
    with Image.open(f"film.{ending}") as image:
        assert image.n_frames == 5 and image.size == (150, 100) and image.info["loop"] == 0
        found = []
        for number in range(5):
            image.seek(number)
            found.append(np.asarray(image.convert("RGB")).astype(int))
            assert image.info["duration"] == 500
    wide = [np.ptp(np.flatnonzero((f[:80].max(axis=2) > 90).any(axis=0))) for f in found]
    assert (np.diff(wide) < 0).all()  # one camera: the ball shrinks
    # The first and the last isovalue are the ends of the range; a ball of radius r is seen by this tangent.
    eye = fit_camera(out.scene, widest_row(out.scene), 1.5).eye - out.scene.from_frame(np.full(3, 4.5))
    radii = (np.ptp(ig.isosurface(out.scene.fields[0].volume, c).bounds[:, 0]) / 2 for c in (0.3, 0.9))
    first, last = (r / np.sqrt(eye @ eye - r * r) for r in radii)
    assert wide[-1] / wide[0] == pytest.approx(last / first, abs=0.03)
    bright = [f[:80][f[:80].max(axis=2) > 90].mean() for f in found]
    assert np.ptp(bright) < 0.1 * np.mean(bright)  # one exposure


def test_a_folder_of_png_holds_the_frames_exactly(call, out):
    call("preview", "out", "--sweep", 3, "new/frames", "--engine", "software", "--size", 80, 60, "--local")
    camera = fit_camera(out.scene, widest_row(out.scene), 80 / 60)
    for number, isovalue in enumerate((0.3, 0.6, 0.9)):
        plain = render(out, isovalue=isovalue, width=80, height=60, local=True, camera=camera)
        expected = labelled(plain, f"{isovalue:g}")
        assert np.array_equal(shown(f"new/frames/{number:04}.png"), expected)
        assert not np.array_equal(plain, expected) and np.array_equal(plain[:40], expected[:40])


def test_an_mp4_is_read_back(call, out):
    if not importlib.util.find_spec("imageio_ffmpeg"):
        pytest.skip("imageio-ffmpeg is not installed: pip install 'illumgrid[mp4]'")
    import imageio_ffmpeg as ffmpeg

    call("preview", "out", "--sweep", 4, "film.mp4", "--engine", "software", "--size", 91, 61, "--split")
    assert ffmpeg.count_frames_and_secs("film.mp4") == (4, pytest.approx(2.0, abs=0.1))
    reader = ffmpeg.read_frames("film.mp4")
    about, first = next(reader), np.frombuffer(next(reader), np.uint8)
    reader.close()
    assert about["size"] == (182, 62)  # even sides, as H.264 wants them
    picture = first.reshape(62, 182, 3).astype(int)
    wanted = render(out, isovalue=0.3, width=91, height=61)[25:35, 40:50].astype(int)
    assert np.abs(picture[25:35, 131:141] - wanted).mean() < 12


def test_mp4_without_its_extra_names_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    refused(lambda: check_ending("film.mp4", ".mp4"), "film.mp4", "pip install 'illumgrid[mp4]'")


@pytest.mark.parametrize("ground, tone", [(10, 225), (250, 40)])
def test_the_isovalue_stands_in_the_corner_and_can_be_read(ground, tone):
    picture = np.full((300, 400, 3), ground, np.uint8)
    found = labelled(picture, "0.1234")
    changed = np.argwhere((found != picture).any(axis=2))
    assert len(changed) > 50 and changed[:, 0].min() > 300 * 0.9 and changed[:, 1].max() < 400 * 0.25
    assert abs(int(found[changed[:, 0], changed[:, 1]].astype(int).mean()) - ground) > 60
    assert tone in found


def test_the_isovalues_of_several_fields_are_written_with_their_names():
    drawn = list(frames(lit(three_balls()), "top", 2, lambda isovalue: np.full((60, 200, 3), isovalue * 10, np.uint8)))
    assert [d[0, 0, 0] for d in drawn] == [9, 11]
    from illumgrid.show.captions import isovalues_of

    assert isovalues_of(three_balls(), np.array([0.9, 1.0, 1.123456])) == "x: 0.9,  front: 1,  top: 1.123"


def test_a_long_film_is_four_seconds_and_a_colour_survives_the_palette_of_a_gif():
    random = np.random.default_rng(0)
    smooth = np.linspace(0, 1, 64)[:, None, None] * np.linspace(50, 250, 48)[None, :, None]
    pictures = [np.clip(smooth * [1, 0.6, 0.3] + 3 * random.normal(size=(64, 48, 3)), 0, 255).astype(np.uint8)
                for _ in range(50)]  # fmt: skip
    film(pictures, 50, ".gif", out := io.BytesIO())
    with Image.open(out) as image:
        assert image.info["duration"] == 80 and image.n_frames == 50
        assert np.abs(np.asarray(image.convert("RGB")).astype(int) - pictures[0]).mean() < 5


@pytest.mark.parametrize("ending", [".gif", ".webp", ".mp4"])
def test_frames_are_let_go_when_they_are_encoded(ending):
    if ending == ".mp4":
        pytest.importorskip("imageio_ffmpeg")
    alive: weakref.WeakSet[Frame] = weakref.WeakSet()
    most = 0

    def drawn():
        nonlocal most
        for k in range(20):
            picture = np.full((40, 60, 3), 255, np.uint8).view(Frame)
            picture[5:20, 2 * k : 2 * k + 15] = (250, 120, 10)
            picture[30:, : 3 * (k // 2)] = (10, 20, 200)
            alive.add(picture)
            yield picture
            del picture
            most = max(most, len(alive))

    film(drawn(), 20, ending, out := io.BytesIO())
    assert most <= 2
    if ending != ".mp4":
        with Image.open(out) as image:
            assert image.n_frames == 20
            for k in range(20):
                image.seek(k)
                seen = np.asarray(image.convert("RGB")).astype(int)
                assert np.abs(seen[8:17, 2 * k + 3 : 2 * k + 12] - (250, 120, 10)).mean() < 12
                assert np.abs(seen[22:28] - 255).mean() < 12


def test_what_does_not_go_together_is_refused(call, refuse, tmp_path):
    call(*RUN)
    refuse("preview", "out", words=["--output", "--sweep", "neither"])
    refuse("preview", "out", "-o", "x.png", "--sweep", 3, "x.gif", words=["both"])
    refuse("preview", "out", "--sweep", 1, "x.gif", words=["1 isovalues", "2 to"])
    refuse("preview", "out", "--sweep", 3, "x.tiff", words=["x.tiff", ".webp", "folder"])
    refuse("preview", "out", "--sweep", 3, "x.gif", "--isovalue", 0.5, words=["--isovalue", "--sweep"])
    refuse("preview", "out", "--local", "--split", "-o", "x.png", words=["--local", "--split"])
    refuse("preview", "out", "--cut", "-o", "x.png", words=["--grid-volume"])
    for option in (["--local"], ["--split"], ["--isovalue", "1"]):
        refuse("preview", "out", "--grid-volume", *option, "-o", "x.png", words=[option[0], "--grid-volume"])
    soft = ["--engine", "software", "-o", "x.png"]
    refuse("preview", "out", "--view", "sideways", *soft, words=["sideways", "front", "azimuth,elevation"])
    refuse("preview", "out", "--zoom", "-1", *soft, words=["zoom", "-1"])
    refuse("preview", "out", "--size", 0, 10, *soft, words=["0 x 10", "pixels"])
    refuse("preview", "out", "--background", "plaid", *soft, words=["plaid", "white"])
    refuse("preview", "out", "--engine", "vulkan", "-o", "x.png", words=["vulkan", "software"])
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter").touch()
    refuse("preview", "out", "--sweep", 3, "full", "--engine", "software", words=["full", "new folder"])


def test_options_reach_the_picture(call, out):
    soft = ["--engine", "software"]
    call("preview", "out", "--view", "-40,12.5", "--zoom", "1.5", "--size", 70, 50, "--background", "navy", *soft,
         "-o", "x.png")  # fmt: skip
    expected = render(out, view=(-40, 12.5), zoom=1.5, width=70, height=50, background="navy")
    assert np.array_equal(shown("x.png"), expected)
    said = call("preview", "out", "--grid-volume", "--cut", "--view", "front", "--size", 40, 30, "-o", "g.png")
    assert "engine" not in said  # rays draw it, whatever the engine
    assert shown("g.png").shape == (30, 40, 3)
    assert "engine" not in call("preview", "out", *soft, "-o", "y.png")


def test_a_sweep_that_fails_leaves_nothing(call, out, monkeypatch, tmp_path):
    from illumgrid import show as preview

    def stop(*arguments, **options):
        raise KeyboardInterrupt

    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr(preview, "render", stop)
    stop.__kwdefaults__ = {"width": 64, "height": 48}
    call("preview", "out", "--sweep", 3, "frames", "--engine", "software", code=130)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_lit_sky_in_a_film_needs_no_run():
    assert len(list(frames(lit(sky()), None, 3, lambda isovalue: np.zeros((30, 40, 3), np.uint8)))) == 3
