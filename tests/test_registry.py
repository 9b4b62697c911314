"""Stages by name: their origin, errors attributed to plugins, and names claimed twice."""

import sys
import warnings
from types import SimpleNamespace

import pytest

import illumgrid as ig
from illumgrid import registry
from illumgrid.registry.options import options, parse, short
from illumgrid.transport.stages import Capabilities, capabilities
from shapes import refused

SAMPLER = """
from dataclasses import dataclass
from typing import ClassVar, Literal
from illumgrid.stages import hookimpl, on_level_sets

@dataclass(frozen=True)
class Mine:
    '''Mine.

    Parameters
    ----------
    way : {"slow", "quick"}
        How. And more.
    at : tuple of float
        Where
        it is;
        in two lines.

    References
    ----------
    x : y
        Not an option.
    '''
    name: ClassVar[str] = "NAME"
    way: Literal["slow", "quick"] = "slow"
    at: tuple[float, float] = (0.0, 1.0)
    on: bool = False
    word: str = "a"
    many: tuple[int, ...] = (1,)
    def queries(self, scene, specs, seed):
        return on_level_sets(scene, [0.5], seed, specs=specs)

@hookimpl
def register_samplers():
    return [Mine]
"""


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """No plugins except those that a test installs."""
    others = {d.dist.name for d in registry.entry_points(group="illumgrid")}
    monkeypatch.setenv(registry.SWITCH, ",".join(sorted(others)))
    registry._reported.clear()
    registry._registry.cache_clear()
    yield
    registry._registry.cache_clear()


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Put a package on the path as pip would: a module and the folder with its entry points."""
    monkeypatch.syspath_prepend(tmp_path)

    def install(package, source, version="1.0"):
        module = package.replace("-", "_")
        (tmp_path / f"{module}.py").write_text(source)
        about = tmp_path / f"{module}-{version}.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
        (about / "entry_points.txt").write_text(f"[illumgrid]\nit = {module}\n")
        monkeypatch.delitem(sys.modules, module, raising=False)
        registry._registry.cache_clear()

    return install


def messages():
    """Warnings issued when the registry is read."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        registry.entries()
    return [str(w.message) for w in caught]


def test_the_packages_own_stages_come_by_hooks_and_are_named_once():
    assert messages() == []
    entries = registry.entries()
    assert {e.package for e in entries} == {"illumgrid"} and {e.version for e in entries} == {ig.__version__}
    assert {"direct", "uniform", "numba", "reference", "nearest"} <= {e.name for e in entries}
    assert len({(e.kind, e.name) for e in entries}) == len(entries) == len(registry.OWN)
    assert registry.backend("auto") == registry.backend(registry.auto_backend())


def test_a_strangers_stage_is_found_and_its_options_are_read(install):
    install("stranger", SAMPLER.replace("NAME", "mine"), "2.5")
    assert messages() == []
    entry = registry.entry("sampler", "mine")
    assert (entry.package, entry.version, entry.missing()) == ("stranger", "2.5", None)
    found = {o.name: o for o in options(entry.stage)}
    assert found["way"].meaning == "How" and found["at"].meaning == "Where it is; in two lines"
    assert list(found) == ["way", "at", "on", "word", "many"] and found["on"].meaning == ""
    assert [short(o.type) for o in found.values()] == ["slow|quick", "float,float", "bool", "str", "int,..."]
    told_so = {"way": "quick", "at": "2,3.5", "on": "true", "word": "b c", "many": "1, 2,3"}
    made = ig.sampler("mine", **told_so)
    assert (made.way, made.at, made.on, made.word, made.many) == ("quick", (2.0, 3.5), True, "b c", (1, 2, 3))
    assert made == ig.sampler("mine", way="quick", at=[2, 3.5], on=True, word="b c", many=(1, 2, 3))


@pytest.mark.parametrize(
    ("contract", "words"),
    [
        ("1", ""),
        ("2", ""),
        ("3", "written for contract 3; expected 1 to 2, which this version of illumgrid runs; upgrade illumgrid"),
        ("0", "written for contract 0; expected 1 to 2, which this version of illumgrid runs; upgrade the plugin"),
        ("'two'", "contract is 'two'; expected a version, such as 2"),
    ],
)
def test_a_stage_of_a_contract_that_is_not_run_is_refused_in_a_sentence(install, contract, words):
    source = SAMPLER.replace("NAME", "mine")
    install("stranger", source.replace("    way:", f"    contract: ClassVar = {contract}\n    way:"))
    found = messages()
    assert len(found) == bool(words) and all(words in text and "stranger 1.0" in text for text in found)
    if words:
        refused(lambda: ig.sampler("mine"), "no sampler is named 'mine'")
    else:
        assert registry.entry("sampler", "mine").contract == int(contract)


@pytest.mark.parametrize(
    "value, kind, words",
    [
        ("maybe", bool, "true or false"),
        ("1.5", int, "a whole number"),
        (1.5, int, "a whole number"),
        (True, int, "a whole number"),
        ("much", float, "a number"),
        ("nan", float, "a number"),
        (None, float, "a number"),
        ("1,2", tuple[float, float, float], "3 numbers joined by commas"),
        ("1,x", tuple[int, ...], "whole numbers joined by commas"),
        ("cubic", registry.options.Literal["a", "b"], "a or b"),
    ],
)
def test_a_value_that_its_type_does_not_take_is_refused(value, kind, words):
    refused(lambda: parse("sampler.x", value, kind), "sampler.x", repr(str(value)), words)


def test_values_are_read_exactly():
    assert parse("x", 0.1 + 0.2, float) == 0.1 + 0.2 and parse("x", " -3 ", int) == -3
    assert parse("x", "inf", float) == float("inf") and parse("x", "TRUE", bool) is True


def test_unknown_names_suggest_the_nearest():
    refused(lambda: ig.sampler("unifrom"), "no sampler", "'unifrom'", "did you mean 'uniform'?")
    refused(lambda: ig.backend("ato"), "auto", "numba", "did you mean 'auto'?")
    refused(lambda: ig.interpolator("zzz"), "expected one of", "nearest")
    refused(lambda: ig.sampler("uniform", cuont=3), "no option 'cuont'", "count, points", "did you mean 'count'?")
    refused(lambda: ig.sampler("direct", count=3), "'direct'", "it has no options")


STAGE = SAMPLER.replace("NAME", "mine")
BROKEN = {
    "raises": ("raise RuntimeError('no\\n licence')", "could not be loaded (RuntimeError: no licence)"),
    "leaves": ("raise SystemExit(3)", "could not be loaded (SystemExit: 3)"),
    "needs": ("import not_there", "No module named 'not_there'"),
    "nothing": ("x = 1", "it has no hooks; expected a function marked @hookimpl"),
    "unmarked": (STAGE.replace("@hookimpl", ""), "it has no hooks"),
    "misspelt": (STAGE.replace("register_samplers", "register_sampler"), "did you mean 'register_samplers'?"),
    "argument": (STAGE.replace("register_samplers()", "register_samplers(cake)"), "cake"),
    "failing": (STAGE.replace("return [Mine]", "return [1 / 0]"), "its hook register_samplers failed (ZeroDivision"),
    "forgetful": (STAGE.replace("return [Mine]", "pass"), "its hook register_samplers failed (TypeError"),
    "object": (STAGE.replace("return [Mine]", "return [Mine()]"), "is not a class"),
    "thawed": (STAGE.replace("(frozen=True)", ""), "not a frozen dataclass"),
    "plain": (STAGE.replace("@dataclass(frozen=True)", ""), "not a frozen dataclass"),
    "unnamed": (STAGE.replace('name: ClassVar[str] = "mine"', ""), "name is None"),
    "spaced": (STAGE.replace('"mine"', '"my own"'), "name is 'my own'"),
    "reserved": (STAGE.replace('"mine"', '"auto"'), "other than auto"),
    "mute": (STAGE.replace("def queries", "def question"), "no method queries"),
    "deaf": (STAGE.replace("(self, scene, specs, seed)", "(self, scene)"), "takes (self, scene)"),
    "odd": (STAGE.replace("on: bool = False", "on: complex = 1j"), "the option on"),
    "bare": (STAGE.replace('way: Literal["slow", "quick"] = "slow"', "way: int"), "has no default"),
    "riddle": (STAGE.replace("on: bool = False", 'on: "Unknown" = 1'), "cannot be examined (NameError"),
    "wrong-kind": (STAGE.replace("register_samplers", "register_backends"), "no method solve"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_plugin_is_a_warning_that_names_it_and_why_and_all_others_run(install, name):
    source, why = BROKEN[name]
    install("before", SAMPLER.replace("NAME", "first"))
    install(f"bad-{name}", source, "0.3")
    install("later", SAMPLER.replace("NAME", "last"))
    (sentence,) = messages()
    assert f"bad-{name} 0.3" in sentence and why in sentence and "\n" not in sentence
    assert messages() == []  # once in a process
    assert ig.sampler("first").name == "first" and ig.sampler("last").name == "last" and ig.sampler("direct")
    refused(lambda: ig.sampler("mine"), "no sampler is named 'mine'")


def test_a_backend_says_what_it_traces(install):
    source = STAGE.replace("register_samplers", "register_backends")
    source = source.replace(
        "def queries(self, scene, specs, seed)", "def solve(self, scene, queries, *, paths, bounces, seed)"
    )
    install("vague", source)
    assert "geometry is None; expected 'mesh', 'levelset' or 'both'" in messages()[0]


@pytest.mark.parametrize(
    "geometry, options, surface, variants",
    [
        ("mesh", {}, "mesh", ()),
        ("levelset", {}, "levelset", ()),
        ("both", {}, "levelset", ()),
        ("both", {"surface": "auto"}, "levelset", ("levelset", "mesh")),
        ("both", {"surface": "mesh"}, "mesh", ("levelset", "mesh")),
    ],
)
def test_what_a_backend_can_do_is_read_from_its_class_and_its_option(geometry, options, surface, variants):
    assert capabilities(SimpleNamespace(geometry=geometry, **options)) == Capabilities(surface, True, variants)
    dark = SimpleNamespace(geometry=geometry, transport=False, **options)
    assert capabilities(dark) == Capabilities(surface, False, variants)


def test_every_backend_is_listed_once_per_surface():
    titles = [title for title, _, _ in registry.backends()]
    assert [title for title in titles if title != "embree"][:3] == ["numba:levelset", "numba:mesh", "reference"]
    assert all(can == capabilities(stage) for _, stage, can in registry.backends())


def test_of_two_hooks_in_a_package_one_may_be_broken(install):
    install("half", STAGE + "\n@hookimpl\ndef register_backends():\n    return [Mine]\n")
    (sentence,) = messages()
    assert "half 1.0" in sentence and "no method solve" in sentence
    assert ig.sampler("mine").name == "mine"


def test_a_name_that_two_packages_claim_is_an_error_for_its_users_and_a_warning_for_all_others(install):
    install("one", STAGE, "1.2")
    install("two", STAGE, "3.4")
    (sentence,) = messages()
    for words in ("'mine'", "one 1.2", "two 3.4"):
        assert words in sentence
    assert ig.sampler("direct").name == "direct"
    text = refused(lambda: ig.sampler("mine"), "'mine'", "one 1.2", "two 3.4", "uninstall", f"{registry.SWITCH}=one")
    assert "3.4 (two)" in text


def test_no_plugin_takes_a_name_of_the_packages_own(install):
    install("greedy", SAMPLER.replace("NAME", "direct"))
    assert "greedy 1.0" in messages()[0]
    refused(lambda: ig.sampler("direct"), "illumgrid", "greedy", f"{registry.SWITCH}=greedy")


def test_plugins_are_switched_off_all_or_by_name(install, monkeypatch):
    install("My.Own_plugin", "raise SystemError".replace("SystemError", "OSError"))
    install("good", STAGE)
    assert len(messages()) == 1
    monkeypatch.setenv(registry.SWITCH, f"{registry.os.environ[registry.SWITCH]}, my-own-plugin")
    registry._reported.clear()
    assert messages() == [] and ig.sampler("mine")
    monkeypatch.setenv(registry.SWITCH, "1")
    assert {e.package for e in registry.entries()} == {"illumgrid"}
    refused(lambda: ig.sampler("mine"), "no sampler")


def test_a_stage_that_cannot_run_here_says_what_would_help(install):
    method = "    @classmethod\n    def available(cls):\n        return ANSWER\n"
    for name, answer in (("lacking", "'pip install ray'"), ("ready", "None"), ("sick", "1 / 0")):
        source = SAMPLER.replace("NAME", name).replace(
            "    def queries", f"{method.replace('ANSWER', answer)}    def queries"
        )
        install(name, source)
    assert messages() == [] and ig.sampler("ready")
    refused(lambda: ig.sampler("lacking"), "'lacking' cannot run here", "pip install ray")
    refused(lambda: ig.sampler("sick"), "repair sick", "ZeroDivisionError")


def test_what_a_strangers_stage_refuses_is_bad_input(install):
    check = "    def __post_init__(self):\n        raise ValueError('too far')\n"
    install("strict", STAGE.replace("    def queries", f"{check}    def queries"))
    refused(lambda: ig.sampler("mine", at="1,2"), "'mine'", "too far")


def test_a_run_beside_a_broken_plugin_reports_it_and_ends_well(install, call, tmp_path):
    install("rotten", "raise OSError('mould')")
    quick = ("run", "v.npy", "--range", "0.3", "0.9", "--grid", "5", "--paths", "1", "--bounces", "0", "--no-preview")
    assert "the plugin rotten 1.0 (rotten) cannot be used in full" in call(*quick, "-o", "out")
    assert "mould" in str(ig.load(tmp_path / "out").recipe["warnings"][0])
    registry._reported.clear()
    assert "rotten" in call("plugins")


def test_the_list_of_plugins_shows_options_origins_and_what_is_missing(install, call):
    method = "    @classmethod\n    def available(cls):\n        return 'pip install ray'\n"
    install("stranger", STAGE.replace("    def queries", f"{method}    def queries"), "2.5")
    said = call("plugins")
    for words in (
        "mine         stranger 2.5, contract 1; not available here: pip install ray",
        "way   slow|quick   slow     How\n",
        "at    float,float  0.0,1.0  Where it is; in two lines\n",
        "uniform      illumgrid",
        "auto         stands for numba",
    ):
        assert words in said, said
    assert call("run", "v.npy", "--sampler", "mine", "-o", "out", code=2).count("pip install ray") == 1
