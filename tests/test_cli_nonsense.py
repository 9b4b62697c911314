"""Invalid values for every option of every command are refused in one sentence and write nothing; valid ones work.

The options are read from the command line itself, so that a new option without invalid values fails here.
"""

import os
import re
import shutil

import numpy as np
import pytest
import typer

from illumgrid import chain, cli, registry
from illumgrid import show as preview
from illumgrid.registry.options import options
from shapes import ball

COMMANDS = typer.main.get_command(cli.app).commands
BASE = {
    "run": "v.npy --range 0.3 0.9 --grid 4 --paths 1 --bounces 1 --no-preview -o new",
    "preview": "out --engine software -o x.png",
    "view": "out --export x.html",
    "export": "out x.npz",
    "info": "v.npy",
    "bench": "v.npy --budget nan -o new",  # what is legal otherwise is refused for that, before minutes go by
    "density": "points.csv --spacing 1 --sigma 1 -o x.nrrd",
    "verify": "--backend nonsense",
    "plugins": "",
}
HUGE = "99999999999999999999"
WORDS = ["two", "", "nan", "inf", "1e400", "1.5", "1,5", "0x", "☃"]  # for a whole number
NUMBERS = ["two", "", "nan", "inf", "-inf", "1e400", "1,5"]  # for a real one
NAMES = ["nonsense", "", "nan", "-1", "☃", "a/b", "x" * 300]
FLAG = ["=maybe", "=", "=1"]
# where nothing can be read from, or written to: missing, a folder, a file as a folder, no name, too long a name
SOURCES = ["missing", "folder", "v.npy/v.npy", "", "x" * 300, "missing/v.npy", "dangling", "text.txt"]
RUNS = [*SOURCES, "v.npy", "half"]


def targets(ending):
    """File names that cannot be written to, for a file that ends so."""
    return [f"folder{ending}", f"v.npy/x{ending}", f"sealed/x{ending}", "x" * 300 + ending, "", "x.tiff", "x"]


# What is refused; after the bar what is odd but legal.
READING = {
    "--spacing": [f"{n}|1|1" for n in (*NUMBERS, "-1", "0")],
    "--channel": [*NAMES, "1", HUGE],
    "--time": [*NAMES, "1", HUGE],
    "--array": [*NAMES, "0", HUGE],
    "--label": [*WORDS, "7"],
    "--crop": [*(f"{n}|8|0|8|0|8" for n in (*WORDS, "-1", "7", HUGE)), "0|1|0|8|0|8", "5|2|0|8|0|8"],
    "--downsample": [*WORDS, "-1", "0", HUGE],
    "--follow": FLAG,
}
LIGHT = {
    "--light": [*NAMES, "sky=", "sky=two", "sky=nan", "=1", "nonsense=1"],
    "--sky": ["missing", "folder", "v.npy", "text.txt", "", "x" * 300],
    "--turn": [*NUMBERS, "30"],
}
REFUSED = {
    ("run", "source"): SOURCES,
    ("run", "--output"): ["v.npy", "v.npy/x", "sealed/new", "x" * 300, "", ".", "/", "folder", "dangling", "out"],
    ("run", "--sampler"): NAMES,
    ("run", "--isovalues"): [*WORDS, "-1", "0", "1", HUGE],
    ("run", "--range"): [
        *(f"{n}|1" for n in NUMBERS),
        *(f"0.3|{n}" for n in NUMBERS),
        "0.9|0.3",
        "0.5|0.5",
        "7|9",
        "0|1e308",
    ],
    ("run", "--inside"): NAMES,
    ("run", "--backend"): NAMES,
    ("run", "--paths"): [*WORDS, "-1", "0", HUGE],
    ("run", "--bounces"): [*WORDS, "-1", HUGE],
    ("run", "--seed"): [*WORDS, "-1", HUGE],
    ("run", "--interpolator"): NAMES,
    ("run", "--grid"): [*WORDS, "-1", "0", "1", HUGE],
    ("run", "--scene"): NAMES,
    ("run", "--albedo"): [f"{n}|0.5|0.5" for n in (*NUMBERS, "-1", "1.5", HUGE)],
    **{(command, option): values for command in ("run", "info", "bench") for option, values in READING.items()},
    **{(command, option): values for command in ("preview", "view", "export") for option, values in LIGHT.items()},
    ("run", "--lights"): NAMES,
    ("run", "--degree"): [*WORDS, "-1", "2", HUGE],
    ("run", "--texels"): [*WORDS, "-1", "0", "8", HUGE],
    ("run", "--signed"): FLAG,
    ("run", "--set"): [*NAMES, "=", ".", ".=", "sampler.=1", "sampler.nonsense=1", "nonsense.count=1"],
    ("run", "--error"): [*NUMBERS, "-1", "0", "1", HUGE],
    ("run", "--seconds"): [*NUMBERS, "-1", "0"],
    ("run", "--smooth"): [*NUMBERS, "-1", "1e308", HUGE],
    ("run", "--threads"): [*WORDS, "-1", "0", HUGE],
    ("run", "--no-preview"): FLAG,
    ("run", "--overwrite"): FLAG,
    ("run", "--ignore"): NAMES,
    ("run", "--no-embed"): FLAG,
    ("run", "--resume"): FLAG,
    ("run", "--lazy"): FLAG,
    ("run", "--any-machine"): FLAG,
    ("run", "--workers"): [*WORDS, "-1", "0"],
    ("run", "--dask"): ["", "nonsense", "☃"],
    ("preview", "folder"): RUNS,
    ("preview", "--output"): targets(".png"),
    ("preview", "--sweep"): [
        *(f"{n}|new" for n in (*WORDS, "-1", "0", "1", HUGE)),
        *(f"2|{file}" for file in ("folder", "v.npy", "v.npy/x", "sealed/new", "x" * 300, "x.tiff", "folder.gif")),
    ],
    ("preview", "--field"): NAMES,
    ("preview", "--isovalue"): NUMBERS,
    ("preview", "--local"): FLAG,
    ("preview", "--trust"): FLAG,
    ("preview", "--split"): FLAG,
    ("preview", "--grid-volume"): FLAG,
    ("preview", "--cut"): [*FLAG, ""],
    ("preview", "--view"): [*NAMES, "30", "nan,0", "0,91", "1,2,3"],
    ("preview", "--zoom"): [*NUMBERS, "-1", "0", "1e-320", "1e308"],
    ("preview", "--size"): [f"{n}|8" for n in (*WORDS, "-1", "0", HUGE)] + [f"8|{n}" for n in ("0", "16385")],
    ("preview", "--background"): [*NAMES, "#12", "rgb(1,2)"],
    ("preview", "--engine"): NAMES,
    ("preview", "--isovalues"): [*NAMES, "1", "0.3,nan", "0.3,,0.5", ",".join(["0.5"] * 33)],
    ("preview", "--exposure"): [*NUMBERS, "21", "1e308"],
    ("preview", "--up"): [*NAMES, "w", "--x"],
    ("preview", "--roll"): NUMBERS,
    ("preview", "--camera"): ["missing", "folder", "v.npy", "text.txt", "", "x" * 300],
    ("preview", "--scale-bar"): FLAG,
    ("preview", "--exact"): [*NAMES, "0", "1.5", "full:", "full:0", "full:two"],
    ("preview", "--watch"): [*FLAG, ""],
    ("preview", "--clip"): [*NAMES, "x", "x=nan", "w=1", "x=-1e9"],
    ("preview", "--look"): [*NAMES, "roughness", "roughness=2", "translucent=nan", "other.roughness=0.5"],
    ("preview", "--color"): [*NAMES, "missing", "text.txt", "folder"],
    ("preview", "--cmap"): [*NAMES, "magma"],
    ("preview", "--color-range"): ["0|1", "1|0", "nan|1", "one|2"],
    ("view", "--look"): [*NAMES, "roughness", "roughness=2", "translucent=nan", "other.roughness=0.5"],
    ("view", "--color"): [*NAMES, "missing", "text.txt", "folder"],
    ("view", "--cmap"): [*NAMES, "magma"],
    ("view", "--color-range"): ["0|1", "1|0", "nan|1", "one|2"],
    ("view", "--up"): [*NAMES, "w"],
    ("view", "folder"): RUNS,
    ("view", "--export"): targets(".html"),
    ("view", "--no-open"): FLAG,
    ("view", "--desktop"): [*FLAG, ""],
    ("export", "folder"): RUNS,
    ("export", "file"): [*targets(".npz"), "out/illumination.exr"],
    ("export", "--field"): NAMES,
    ("export", "--isovalue"): [*NUMBERS, "0.5"],
    ("export", "--on"): NAMES,
    ("export", "--array"): NAMES,
    ("export", "--onto"): ["missing", "folder", "v.npy", "text.txt", "", "x" * 300],
    ("info", "source"): [*SOURCES, "half"],
    ("info", "--range"): [*(f"{n}|1" for n in NUMBERS), *(f"0.3|{n}" for n in NUMBERS), "0.9|0.3", "0.5|0.5"],
    ("info", "--inside"): NAMES,
    ("info", "--ignore"): NAMES,
    ("bench", "source"): SOURCES,
    ("bench", "--range"): [*(f"{n}|1" for n in NUMBERS), *(f"0.3|{n}" for n in NUMBERS), "0.9|0.3", "7|9"],
    ("bench", "--budget"): [*NUMBERS, "-1", "0", "1e308", HUGE],
    ("bench", "--output"): ["v.npy", "v.npy/x", "sealed/new", "x" * 300, "", ".", "/", "folder", "dangling", "out"],
    ("bench", "--smooth"): [*NUMBERS, "-1", "1e308", HUGE],
    ("bench", "--seed"): [*WORDS, "-1", HUGE],
    ("density", "points"): [*SOURCES, "v.npy"],
    ("density", "--output"): targets(".nrrd"),
    ("density", "--spacing"): [*NUMBERS, "-1", "0"],
    ("density", "--sigma"): [*NUMBERS, "-1"],
    ("density", "--weights"): ["nonsense", "", "☃", "x" * 300, "7"],
    ("density", "--columns"): ["a|b|c", "x|y|7", "||"],
    ("density", "--cell"): ["nonsense", "", "1,2", "0,1,1", "-1,1,1", "nan,1,1", "1,1,1,1", "file"],
    ("plugins", "--new"): [
        *(f"{name}|sampler|new" for name in ("", "-1", "a/b", "☃")),
        *(f"fine|{kind}|new" for kind in NAMES),
        *(f"fine|sampler|{place}" for place in ("v.npy", "v.npy/x", "sealed/new")),
    ],
    ("verify", "--backend"): NAMES,
    ("verify", "--paths"): [*WORDS, "-1", "0", HUGE],
    ("verify", "--seed"): [*WORDS, "-1", HUGE],
}
LEGAL = {
    ("run", "--output"): ["☃", "deep/er/new", "-1", "nan"],
    ("run", "--range"): ["-1e30|1e30", "0.3|1e38"],
    ("run", "--bounces"): ["0", "+1", " 1"],
    ("run", "--seed"): [str(2**64 - 1)],
    ("run", "--albedo"): ["0|0|0", "1|1|1", "1e-320|0|1"],
    ("run", "--seconds"): ["1e-320"],
    ("run", "--smooth"): ["0", "1e-320", "0.5"],
    ("run", "--threads"): ["1000"],
    ("preview", "--isovalue"): ["-1", "1e308", HUGE],
    ("preview", "--view"): ["1e6,-90"],
    ("preview", "--zoom"): ["1e-6", "1e6"],
    ("preview", "--size"): ["1|1", "1|300"],
    ("preview", "--isovalues"): ["0.3,0.9", "-1,1e30"],
    ("preview", "--exposure"): ["-20", "20", "0"],
    ("preview", "--up"): ["-z", "x"],
    ("preview", "--roll"): ["-1e9", "360"],
    ("info", "--range"): ["-1e30|1e30"],
}


def own_options(command):
    """Options (by their longest name) and arguments (by their name) of a command."""
    return [max(p.opts, key=len) for p in COMMANDS[command].params if p.name != "help"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with a volume, a finished run, and obstacles."""
    place = tmp_path_factory.mktemp("nonsense")
    np.save(place / "v.npy", ball(6).values)
    here = os.getcwd()
    os.chdir(place)
    try:
        args = BASE["run"].replace("new", "out").split()
        assert cli.guarded(lambda: cli.app(["run", *args], standalone_mode=False)) == 0
    finally:
        os.chdir(here)
    for name in ("folder", "folder.png", "folder.html", "folder.npz", "folder.nrrd", "folder.gif", "sealed", "half"):
        (place / name).mkdir()
    (place / "folder" / "letter").write_text("dear")
    (place / "text.txt").write_text("no volume")
    (place / "points.csv").write_text("x,y,z\n0,0,0\n1,2,3\n")
    (place / "dangling").symlink_to("nowhere")
    shutil.copy(place / "out" / "run.json", place / "half")
    return place


@pytest.fixture
def outcome(finished, capsys, monkeypatch):
    """Exit code, output and new files of a command; the new files are removed again."""
    small = {**preview.render.__kwdefaults__, "width": 24, "height": 18}
    monkeypatch.setattr(preview.render, "__kwdefaults__", small)
    monkeypatch.setattr(preview.strip, "__kwdefaults__", {**preview.strip.__kwdefaults__, "width": 24, "height": 18})
    monkeypatch.setattr(chain, "judged", lambda light, *about: light)
    monkeypatch.chdir(finished)

    def outcome(args):
        before = set(finished.rglob("*"))
        (finished / "sealed").chmod(0o500)
        try:
            code = cli.guarded(lambda: cli.app(args, standalone_mode=False))
        finally:
            (finished / "sealed").chmod(0o700)
        said = "".join(capsys.readouterr())
        fresh = sorted(set(finished.rglob("*")) - before)
        assert before <= set(finished.rglob("*"))
        for path in reversed(fresh):
            path.rmdir() if path.is_dir() else path.unlink()
        return code, said, fresh

    return outcome


def line(command, option, value):
    """The command with this value for the option or argument instead of its own."""
    args = BASE[command].split()
    values = value.split("|")
    if not option.startswith("--"):
        args[[name for name in own_options(command) if not name.startswith("--")].index(option)] = value
        return [command, *args]
    if value.startswith("=") and {"=maybe"} & set(REFUSED.get((command, option), ())):
        return [command, *args, option + value]
    if (command, option) == ("preview", "--sweep"):
        args = args[:3]
    if option in ("--cut", "--desktop") and not value:  # what does not go with the rest
        return [command, *args, option]
    return [command, *args, option, *values]


def one_sentence(said):
    """The last line, of the package or of typer's usage, is a sentence, and the package prints no other message."""
    *above, last = said.rstrip().split("\n")
    assert last.startswith(("illumgrid: ", "Error: ")), said
    if last.startswith("illumgrid: "):
        assert not re.search(r"\w\. ", last) and not any(earlier.startswith("illumgrid: ") for earlier in above), said
    else:
        assert not above or (above[0].startswith("Usage: ") and len(above) <= 3), said
    assert "Traceback" not in said


def test_no_option_is_forgotten():
    found = {(command, option) for command in COMMANDS for option in own_options(command)}
    assert found == set(REFUSED)
    assert set(LEGAL) <= found and set(BASE) == set(COMMANDS)


@pytest.mark.parametrize("command, option", REFUSED)
def test_nonsense_is_refused_in_a_sentence_and_leaves_nothing(outcome, command, option):
    for value in REFUSED[command, option]:
        if "sealed" in value and os.access("/", os.W_OK):
            continue  # nothing is sealed for root
        code, said, fresh = outcome(line(command, option, value))
        assert code == 2, (value, said)
        one_sentence(said)
        assert not fresh, (value, fresh)


@pytest.mark.parametrize("command, option", LEGAL)
def test_what_is_odd_but_legal_works(outcome, command, option):
    for value in LEGAL[command, option]:
        code, said, fresh = outcome(line(command, option, value))
        assert code == 0, (value, said)
        assert fresh or command == "info"


def test_an_isosurface_and_one_array_are_refused_their_nonsense(outcome):
    for file, option, values in (
        ("x.ply", "--isovalue", [*NUMBERS, "-1", "1e308"]),
        ("x.nrrd", "--array", NAMES),
        ("x.ply", "--on", ["grid", "field"]),
    ):
        for value in values:
            code, said, fresh = outcome(["export", "out", file, option, value])
            assert code == 2 and not fresh, (file, value, said)
            one_sentence(said)


def test_options_of_stages_are_refused_their_nonsense(outcome):
    seen = 0
    for entry in registry.entries():
        if entry.package != "illumgrid" or entry.missing():
            continue
        for option in options(entry.stage):
            for value in [*(NUMBERS if option.type is float else WORDS), "-1", HUGE]:
                setting = f"{entry.kind}.{option.name}={value}"
                args = ["run", *BASE["run"].split(), f"--{entry.kind}", entry.name, "--set", setting]
                code, said, fresh = outcome(args)
                assert code == 2 and not fresh, (setting, said)
                one_sentence(said)
                seen += 1
    assert seen > 50


@pytest.mark.parametrize("command", COMMANDS)
def test_an_unknown_option_and_one_argument_too_many_are_refused(outcome, command):
    for more in (["--nonsense"], ["--nonsense", "1"], ["one", "more", "still"]):
        code, said, fresh = outcome([command, *BASE[command].split(), *more])
        assert code == 2 and not fresh, said
        one_sentence(said)
