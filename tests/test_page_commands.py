"""``illumgrid view``: a file, a server, a window."""

import os
import re
import signal
import subprocess
import sys
import time
import urllib.request

import numpy as np
import pytest

from browser import coloured, pair
from illumgrid.show import render
from illumgrid.tone import encode_srgb
from shapes import lit, sky
from test_cli_process import COMMAND


@pytest.fixture
def folder(tmp_path):
    lit(sky()).save(tmp_path / "run", preview=False)
    return tmp_path / "run"


def test_view_writes_a_page(call, folder, tmp_path):
    said = call("view", folder, "--export", "made/page.html")
    text = (tmp_path / "made" / "page.html").read_text(encoding="utf-8")
    assert text.startswith("<!doctype html>") and text.rstrip().endswith("</html>") and "page.html" in said


@pytest.mark.parametrize(
    "args, words",
    [
        (("nowhere",), ["nowhere"]),
        (("run", "--export", "page.pdf"), ["page.pdf", ".html"]),
        (("run", "--desktop", "--no-open"), ["--desktop"]),
        (("run", "--up", "w"), ["'w'", "-z"]),
    ],
)
def test_view_refuses(refuse, folder, args, words):
    refuse("view", *args, words=words)


def test_view_serves_the_page_until_ctrl_c(folder):
    def hear():
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    command = [*COMMAND, "view", str(folder), "--no-open"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=hear
    ) as process:
        try:
            address = re.search(r"http://127\.0\.0\.1:\d+/\S+", process.stderr.readline())[0]
            with urllib.request.urlopen(address, timeout=20) as answer:
                assert b"<canvas" in answer.read()
            process.send_signal(signal.SIGINT)
            said = process.communicate(timeout=20)[1]
        finally:
            process.kill()
    assert process.returncode == 0 and not said


def test_a_browser_that_runs_until_it_is_closed_gets_its_page(folder, tmp_path):
    browser, got = tmp_path / "browser.py", tmp_path / "got.html"
    browser.write_text(
        "import os, sys, urllib.request as u\n"
        f"open('new', 'wb').write(u.urlopen(sys.argv[1], timeout=20).read())\nos.replace('new', {str(got)!r})"
    )
    environment = {**os.environ, "BROWSER": f"{sys.executable} {browser} %s"}
    command = [*COMMAND, "view", str(folder)]
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE) as process:
        try:
            until = time.monotonic() + 20
            while not got.exists() and process.poll() is None and time.monotonic() < until:
                time.sleep(0.02)
        finally:
            process.kill()
    assert b"<canvas" in got.read_bytes()


WINDOW = """
import sys
import numpy as np
from browser import coloured, pair
from illumgrid.show.viewer.desktop import Window
window = Window(coloured(pair()), off_screen=True)
window.plotter.window_size = [330, 240]
pictures = []
for isovalue in (2550.0, 2850.0):
    window.sweep(isovalue)
    for widget in getattr(window.plotter, "widgets", window.plotter).slider_widgets:
        widget.Off()
    pictures.append(window.plotter.screenshot(None, return_img=True))
np.save(sys.argv[1], np.array(pictures))
"""


def test_the_window_shows_what_the_still_picture_shows(tmp_path, request):
    pytest.importorskip("pyvista", reason="pyvista is not installed (pip install illumgrid[desktop])")
    # VTK without any GL library ends the process: let that be a child.
    done = subprocess.run(
        [sys.executable, "-c", WINDOW, tmp_path / "seen.npy"], cwd=request.path.parent, capture_output=True, text=True
    )
    if done.returncode < 0:
        pytest.skip(f"VTK ended by signal {-done.returncode}: no OpenGL on this machine")
    assert done.returncode == 0, done.stderr
    light = coloured(pair())
    seen = np.load(tmp_path / "seen.npy").astype(int)
    wanted = render(light, isovalue=2550.0, width=330, height=240).astype(int)
    covered = (wanted != encode_srgb(np.full(3, 0.045))).any(axis=2)
    off = np.abs(seen[0] - wanted).max(axis=2)
    assert np.median(off[covered]) <= 3
    assert np.mean(np.abs(seen[1] - seen[0]).max(axis=2) > 10) > 0.02
