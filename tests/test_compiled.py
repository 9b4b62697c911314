"""Compilation where the cache on the disk is of no use: it costs time, and the answer is the same."""

import importlib.util
import os
import subprocess
import sys

import pytest

from illumgrid import compiled
from illumgrid.errors import IllumgridWarning

CODE = "from illumgrid.compiled import njit\n\n@njit()\ndef f(x):\n    return 2.5 * x\n"

pytestmark = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled")


@pytest.fixture
def function(tmp_path, monkeypatch):
    """Imports a module with a compiled function anew at each call."""
    monkeypatch.setattr(compiled, "_said", set())
    (tmp_path / "made.py").write_text(CODE)

    def again():
        spec = importlib.util.spec_from_file_location("made", tmp_path / "made.py")
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "made", module)
        spec.loader.exec_module(module)
        return module.f

    return again


def kept(tmp_path, ending):
    return next((tmp_path / "__pycache__").glob(f"*.{ending}"))


def test_it_is_kept_and_found(function):
    assert function()(2.0) == 5
    again = function()
    assert again(2.0) == 5 and sum(again.entrance.stats.cache_hits.values()) == 1


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", ["empty", "cut", "noise", "bit"])
def test_a_damaged_cache_is_made_anew(tmp_path, function, ending, damage):
    function()(2.0)
    file = kept(tmp_path, ending)
    whole = bytearray(file.read_bytes())
    if damage == "bit":
        whole[-200 if ending == "nbc" else 3] ^= 1  # within machine code
    file.write_bytes({"empty": b"", "cut": whole[: len(whole) // 2], "noise": b"\xff" * 99, "bit": whole}[damage])
    if (ending, damage) == ("nbi", "bit"):
        function()(2.0)  # of another version, for all that Numba can see
    else:
        with pytest.warns(IllumgridWarning, match="compiler: compiled code on the disk cannot be read"):
            assert function()(2.0) == 5
    again = function()
    assert again(2.0) == 5 and sum(again.entrance.stats.cache_hits.values()) == 1


def test_python_may_call_what_compiled_code_calls(tmp_path, monkeypatch):
    code = CODE + "\n@njit()\ndef g(x):\n    return f(x) + 1\n"
    (tmp_path / "pair.py").write_text(code)
    for _ in range(2):  # compiled, and from the disk, where code without an entrance must not pass for code with one
        spec = importlib.util.spec_from_file_location("pair", tmp_path / "pair.py")
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "pair", module)
        spec.loader.exec_module(module)
        assert module.g(2.0) == 6 and module.f(2.0) == 5
    assert sum(module.f.entrance.stats.cache_hits.values()) == 1
    assert sum(module.g.entrance.stats.cache_hits.values()) == 1


def test_what_compiled_code_calls_becomes_machine_code_in_its_caller_only(tmp_path, monkeypatch):
    from numba.core.registry import cpu_target

    (tmp_path / "called.py").write_text(
        CODE + '\n@njit()\ndef g(x):\n    if x < 0:\n        raise ValueError("below zero")\n    return f(x) + 1\n'
    )
    (tmp_path / "calling.py").write_text(
        CODE.replace("def f(x)", "def h(x)").replace("2.5 * x", "2 * g(x)") + "\nfrom called import g\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    engine = cpu_target.target_context.codegen()._engine
    for whence in "compiled", "from the disk":
        for name in "called", "calling":
            monkeypatch.delitem(sys.modules, name, raising=False)
        if whence == "from the disk":
            next((tmp_path / "__pycache__").glob("calling.h*.nbi")).unlink()  # what it calls is kept
        calling = importlib.import_module("calling")
        assert calling.h(2.0) == 12
        with pytest.raises(ValueError, match="below zero"):
            calling.h(-1.0)
        (part,) = calling.g.overloads.values()
        assert sum(calling.g.stats.cache_hits.values()) == (whence == "from the disk")
        assert not engine.is_symbol_defined(part.fndesc.llvm_func_name)


def test_nowhere_to_write(tmp_path, function, monkeypatch):
    import numba

    monkeypatch.setattr(numba.config, "CACHE_LOCATOR_CLASSES", "UserProvidedCacheLocator")  # which nobody provided
    with pytest.warns(IllumgridWarning, match="compiler: compiled code cannot be kept .* no locator"):
        f = function()
    assert f(2.0) == 5
    assert function()(2.0) == 5  # and is said once


def test_a_full_disk(tmp_path, function, monkeypatch):
    from numba.core.caching import IndexDataCacheFile

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(IndexDataCacheFile, "_save_data", full)
    with pytest.warns(IllumgridWarning, match="cannot be kept .*No space left"):
        assert function()(2.0) == 5


@pytest.mark.parametrize("threads", ["0", "-3", "many", ""])
def test_a_number_of_threads_that_is_none(threads):
    code = "import illumgrid.compiled as c; print(c.njit()(lambda x: x + 1)(1))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, "NUMBA_NUM_THREADS": threads}
    )
    assert done.stdout == "2\n", done.stderr
