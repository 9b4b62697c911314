"""All engines draw the same picture, in position and tone; behaviour without an OpenGL library."""

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from illumgrid import show as preview
from illumgrid.errors import BadInput
from illumgrid.field.rooms import box_around
from illumgrid.field.scene import Field, Material, Scene
from illumgrid.show import choose_engine, grid_volume, render
from illumgrid.show.engines import gl
from illumgrid.show.shade import BACKGROUND
from illumgrid.tone import encode_srgb
from shapes import MIRRORED, OBLIQUE, ball, lit, refused, sampled, sky

GROUND = encode_srgb(np.full(3, BACKGROUND)).astype(int)
SIZE = {"width": 200, "height": 150}


def varied(light, seed=0):
    """The same illumination with light that varies over space, and over rows on the walls."""
    random = np.random.default_rng(seed)
    grids, walls = [], []
    for grid in light.grids:
        wave = np.sin(np.indices(grid.spec.shape).reshape(3, -1).T @ random.normal(size=(3, 3)) + [0, 1, 2])
        grids.append(replace(grid, values=(1.2 + wave).reshape(*grid.spec.shape, 3)))
    for wall in light.walls:
        walls.append(replace(wall, values=random.uniform(0.3, 2, wall.values.shape).astype(np.float32)))
    return replace(light, grids=tuple(grids), walls=tuple(walls))


def chiral(direction):
    """Three balls of different size and colour, whose sense of rotation a mirror would invert."""
    shape, spacing = np.array([30, 27, 33]), 2 / (np.array([30, 27, 33]) - 1)
    fields = []
    for number, (at, radius) in enumerate((((0.6, 0, 0), 0.3), ((0, -0.6, 0), 0.22), ((0, 0, 0.6), 0.38))):
        volume = sampled(
            lambda x, at=at, radius=radius: 1 + radius - np.linalg.norm((x - 5) @ direction - np.array(at), axis=1),
            tuple(shape), 5 - direction @ np.ones(3), spacing, direction,
        )  # fmt: skip
        fields.append(Field("abc"[number], volume, Material(np.roll([0.9, 0.5, 0.2], number)), (0.9, 1.1)))
    return Scene(tuple(fields), background=np.ones(3))


def room():
    """Two fields in a box, one of them hollow towards the viewer."""
    one = Field("one", ball(24, at=(-0.4, 0, 0)), Material(np.array([0.8, 0.5, 0.3])), (0.6, 0.9))
    hollow = sampled(lambda x: np.linalg.norm(x - [0.5, 0, 0], axis=1), (24, 24, 24), (-1, -1, -1), (2 / 23,) * 3)
    two = Field("two", hollow, Material(np.array([0.3, 0.5, 0.9])), (1.0, 1.2), "below")
    return Scene((one, two), box_around(one.volume))


def cut_open():
    """A ball whose front lies beyond the volume: a cap."""
    return sky(sampled(lambda x: 1.2 - np.linalg.norm(x, axis=1), (24, 14, 24), (-1, -0.4, -1), (2 / 23,) * 3))


def far_away():
    """A ball at 1e5 of its sizes from the origin, in units of a millionth."""
    place = {"origin": np.full(3, 0.1), "spacing": np.full(3, 1e-6 * 2 / 19)}
    middle = 0.1 + 1e-6
    return sky(sampled(lambda x: 1.2 - np.linalg.norm((x - middle) * 1e6, axis=1), (20, 20, 20), **place))


def pictures(engine):
    """All pictures by which engines are compared."""
    drawn = {}
    scenes = {"oblique": chiral(OBLIQUE), "mirrored": chiral(MIRRORED), "room": room(), "cap": cut_open(),
              "far": far_away()}  # fmt: skip
    for name, scene in scenes.items():
        light = varied(lit(scene, nodes=7))
        for local in (False, True):
            drawn[f"{name}, {'local' if local else 'global'}"] = render(light, local=local, engine=engine, **SIZE)
    light = varied(lit(sky(), nodes=7))
    drawn["seen from behind"] = render(light, view="back", zoom=1.5, background="white", engine=engine, **SIZE)
    drawn["nothing"] = render(light, isovalue=1.19, engine=engine, **SIZE)
    drawn["other size"] = render(light, engine=engine, width=61, height=77)
    return drawn


NAMES = ["oblique", "mirrored", "room", "cap", "far"]
ALL = [f"{n}, {light}" for n in NAMES for light in ("global", "local")] + [
    "seen from behind", "nothing", "other size"]  # fmt: skip


def child(script, folder, **environment):
    """Run Python in its own process, since a process can have only one OpenGL."""
    here = os.path.dirname(__file__)
    return subprocess.run(
        [sys.executable, "-c", script], cwd=folder, capture_output=True, text=True, timeout=300,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([here, *sys.path]), **environment},
    )  # fmt: skip


DRAW = """
import sys, numpy as np
from illumgrid.show.engines import gl
reason = gl.unavailable("{platform}")
if reason:
    sys.exit("missing: " + reason)
from test_preview_engines import pictures
np.savez("drawn.npz", **pictures("{platform}"))
"""


@cache
def drawn_by(platform, folder):
    if platform == "software":
        return pictures("software")
    done = child(DRAW.format(platform=platform), folder)
    if "missing: " in done.stderr:
        return done.stderr.strip()
    assert done.returncode == 0, done.stderr
    with np.load(folder / "drawn.npz") as file:
        return dict(file)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return {platform: tmp_path_factory.mktemp(platform) for platform in ("egl", "osmesa", "software")}


def covered(picture, ground):
    return (np.abs(picture.astype(int) - ground).max(axis=2) > 3).reshape(picture.shape[:2])


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("platform", ["egl", "osmesa"])
def test_opengl_draws_what_the_software_engine_draws(platform, name, folders):
    found = drawn_by(platform, folders[platform])
    if isinstance(found, str):
        pytest.skip(f"{found}; apt-get install {gl.PACKAGES[platform]}")
    one, two = found[name], drawn_by("software", folders["software"])[name]
    assert one.shape == two.shape and one.dtype == two.dtype == np.uint8
    if name == "nothing":
        assert (one == GROUND).all() and (two == GROUND).all()
        return
    ground = np.array([255, 255, 255]) if name == "seen from behind" else GROUND
    seen, as_software = covered(one, ground), covered(two, ground)
    either = seen | as_software
    assert either.mean() > 0.05
    differ = np.abs(one.astype(int) - two).max(axis=2)[either]
    assert np.median(differ) <= 2
    assert np.median(np.abs(one[:, ::-1].astype(int) - two).max(axis=2)[either]) > 5 or name == "far, local"
    # The same outline: half of the pixels on it, as of any line, are a toss-up.
    outline = as_software & ~(np.roll(as_software, 1, 0) & np.roll(as_software, -1, 0)
                              & np.roll(as_software, 1, 1) & np.roll(as_software, -1, 1))  # fmt: skip
    assert (seen ^ as_software).sum() <= outline.sum() / 2


HIDE = """
import ctypes
load = ctypes.CDLL.__init__
def hidden(self, name, *more, **options):
    if name and any(part in name for part in {hidden}):
        raise OSError(f"{{name}}: cannot open shared object file")
    return load(self, name, *more, **options)
ctypes.CDLL.__init__ = hidden
"""

CHOOSE = """
from illumgrid.show import choose_engine, render
from test_preview_engines import lit, sky
engine, why = choose_engine("auto")
picture = render(lit(sky()), engine=engine, width=40, height=30)
print(engine, "|", why, "|", picture[15, 20].tolist())
"""


def test_auto_takes_what_is_there_and_says_why(tmp_path):
    done = child(HIDE.format(hidden=["EGL", "OSMesa"]) + CHOOSE, tmp_path)
    assert done.returncode == 0, done.stderr
    engine, why, colour = done.stdout.split(" | ")
    assert engine == "software" and "EGL" in why and "OSMESA" in why and "libegl1 libgl1 libosmesa6" in why
    assert min(eval(colour)) > 200
    assert not done.stderr


@pytest.mark.parametrize("way", ["the library is missing", "the driver is missing"])
def test_after_egl_failed_osmesa_draws_in_the_same_process(tmp_path, way):
    if child(DRAW.format(platform="osmesa").split("from test")[0], tmp_path).returncode:
        pytest.skip("OSMesa is missing; apt-get install libosmesa6")
    if way == "the library is missing":
        done = child(HIDE.format(hidden=["EGL"]) + CHOOSE, tmp_path)
    else:
        done = child(CHOOSE, tmp_path, LIBGL_DRIVERS_PATH="/nonexistent")
    assert done.returncode == 0, done.stderr
    engine, _, colour = done.stdout.split(" | ")
    assert engine == "osmesa" and min(eval(colour)) > 200


ASK = """
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from illumgrid import cli
sys.argv = ["illumgrid", "preview", "anywhere", "-o", "x.png", "--engine", "{platform}"]
cli.main()
"""


@pytest.mark.parametrize("platform", ["egl", "osmesa"])
def test_an_engine_that_is_missing_is_bad_input_with_the_package_to_install(platform, tmp_path):
    done = child(HIDE.format(hidden=["EGL", "OSMesa"]) + ASK.format(platform=platform), tmp_path)
    assert done.returncode == 2, done.stderr
    assert gl.PACKAGES[platform] in done.stderr and "software" in done.stderr
    assert done.stderr.count("\n") == 1 and not list(tmp_path.iterdir())


def test_another_opengl_in_the_process_is_left_alone(monkeypatch):
    monkeypatch.setattr(gl, "_opened", {})
    monkeypatch.setattr(gl, "_missing", {})
    monkeypatch.setitem(sys.modules, "OpenGL", sys.modules["os"])
    assert "another library" in gl.unavailable("egl")
    assert sys.modules["OpenGL"] is sys.modules["os"]
    assert choose_engine("auto")[0] == "software"
    monkeypatch.setattr(gl, "_missing", {})
    monkeypatch.setattr(gl, "_opened", {"egl": None})
    assert "one OpenGL" in gl.unavailable("osmesa")
    assert choose_engine("auto") == ("egl", "OpenGL is available through EGL")


def test_another_thread_and_a_fork_draw_by_the_software_engine(monkeypatch):
    monkeypatch.setattr(gl, "_opened", {"egl": None})
    monkeypatch.setattr(gl, "_home", [(os.getpid(), threading.get_ident())])
    assert choose_engine("auto")[0] == "egl"
    with ThreadPoolExecutor() as pool:
        assert pool.submit(choose_engine, "auto").result() == ("software", "OpenGL was opened in another thread")
    monkeypatch.setattr(gl, "_home", [(os.getpid() + 1, threading.get_ident())])
    with pytest.raises(BadInput, match=r"opened in another process, .* draw there or choose"):
        choose_engine("egl")


def test_software_is_asked_for_without_a_look_at_opengl(monkeypatch):
    monkeypatch.setattr(gl, "unavailable", lambda platform: pytest.fail("looked"))
    assert choose_engine("software")[0] == "software"
    refused(lambda: choose_engine("vulkan"), "vulkan", "egl", "software")


def test_only_one_file_imports_pyrender_and_only_when_it_draws():
    done = subprocess.run(
        [sys.executable, "-c", "import sys, illumgrid.show, illumgrid.cli; print('pyrender' in sys.modules)"],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.stdout.strip() == "False"
    source = os.path.dirname(os.path.dirname(preview.__file__))
    found = []
    for folder, _, names in os.walk(source):
        for name in (n for n in names if n.endswith(".py")):
            with open(os.path.join(folder, name), encoding="utf-8") as file:
                if "import pyrender" in file.read():
                    found.append(name)
    assert found == ["gl.py"]


def test_what_no_picture_can_be_is_refused():
    light = lit(sky())
    refused(lambda: render(light, width=0), "0 x", "pixels")
    refused(lambda: render(light, height=10**6), "1000000", "pixels")
    refused(lambda: render(light, background="plaid"), "plaid", "CSS")
    refused(lambda: render(light, zoom=0.0), "zoom", "positive")
    refused(lambda: render(light, zoom=float("nan")), "zoom")
    refused(lambda: render(light, view="above"), "above", "front", "azimuth,elevation")
    refused(lambda: grid_volume(light, "w"), "'w'")
    with pytest.raises(BadInput):
        render(light, view=(0, 91))
