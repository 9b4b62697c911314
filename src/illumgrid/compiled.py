"""Compilation by Numba with a cache on disk whose failures cost time, and never the run.

Numba alone refuses to compile where it may write nowhere, and raises whatever a damaged file of its cache makes of it;
it does not notice damage within machine code. And it optimises a function, with all that it calls, and makes machine
code of it, once for each function that calls it: here, only the code of an entrance, as a whole.
"""

import contextlib
import copy
import hashlib
import logging
import pickle
from collections.abc import Callable
from functools import partial
from typing import Any

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import Compiler
from numba.core.registry import CPUDispatcher
from numba.core.serialize import dumps

from illumgrid.errors import tell

log = logging.getLogger(__name__)
"""Logs the name of each function when its compilation begins."""

_said: set[str] = set()


def _say(what: str, problem: Exception) -> None:
    """Warn once per process that the cache cannot be used."""
    if what not in _said:
        _said.add(what)
        reason = " ".join(str(problem).split())[:160] or type(problem).__name__
        tell("compiler", f"{what}; it takes up to a minute at each start ({reason})", stacklevel=2)


class _Summed(CompileResultCacheImpl):
    """Compiled code with a checksum."""

    def reduce(self, compiled: Any) -> tuple[bytes, bytes]:
        """The data that are kept."""
        content = dumps(super().reduce(compiled))
        return content, hashlib.sha256(content).digest()

    def rebuild(self, context: Any, kept: tuple[bytes, bytes]) -> Any:
        """Restore from the data that were kept."""
        content, digest = kept
        if hashlib.sha256(content).digest() != digest:
            raise ValueError("its checksum is another")
        return super().rebuild(context, pickle.loads(content))

    def get_filename_base(self, name: str, flags: str) -> str:
        """A name that no file of Numba has."""
        return f"{super().get_filename_base(name, flags)}.summed"


class _Cache(FunctionCache):
    """A cache whose failures cause a warning and are then ignored."""

    _impl_class = _Summed

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Compiled code from the disk, or None."""
        try:
            if (kept := super().load_overload(signature, context)) is not None:
                return kept
        except Exception as problem:  # unpickling damaged bytes can raise anything
            _say("compiled code on the disk cannot be read and is made anew", problem)
            with contextlib.suppress(OSError):
                self.flush()
        log.info("%s", self._py_func.__qualname__)
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep compiled code, if that is possible."""
        try:
            super().save_overload(signature, compiled)
        except Exception as problem:  # the disk is full, or the folder is gone or not writable
            _say("compiled code cannot be kept on the disk", problem)


class _Part(JITCodeLibrary):
    """Code to be linked into that of an entrance: not optimised by itself, and without machine code."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """No address: what Numba returns for code without machine code."""
        return 0

    def serialize_using_object_code(self) -> Any:
        """The data that are kept on the disk."""
        return self.serialize_using_bitcode()


class _Parts(JITCPUCodegen):
    """Numba's own compiler, except that it makes parts."""

    _library_class = _Part

    def set_env(self, name: str, env: Any) -> None:
        """Do nothing: only code that calls Python needs an environment, and no part does."""


def _parts(codegen: Any) -> Any:
    made = copy.copy(codegen)
    made.__class__ = _Parts
    return made


class PartCompiler(Compiler):
    """For functions that only compiled code calls: option `pipeline_class` of Numba."""

    def _compile_bytecode(self) -> Any:
        library = _parts(self.state.targetctx.codegen()).create_library(self.state.func_id.func_qualname)
        library.enable_object_caching()  # as the lowering does with a library of its own
        self.state["library"] = library
        return super()._compile_bytecode()


class _PartSummed(_Summed):
    """Code without an entrance from Python, stored so that it is not taken for code with one."""

    def rebuild(self, context: Any, kept: tuple[bytes, bytes]) -> Any:
        """Restore as a part."""
        return super().rebuild(context.subtarget(_internal_codegen=_parts(context.codegen())), kept)

    def get_filename_base(self, name: str, flags: str) -> str:
        """A name of its own."""
        return f"{super().get_filename_base(name, flags)}.part"


class _PartCache(_Cache):
    _impl_class = _PartSummed


class _Kernel(CPUDispatcher):
    """A function that compiled code calls; `entrance` compiles it once more if Python calls it.

    An entrance holds a copy of the function, optimised together with what it calls.
    """

    entrance: Any

    @property
    def signatures(self) -> list[Any]:
        """Types of arguments for which Python may call it without compilation."""
        return list(self.entrance.signatures)

    def __call__(self, *arguments: Any) -> Any:
        return self.entrance(*arguments)


def _kept(dispatcher: Any, cache: type[_Cache]) -> Any:
    """The dispatcher with a cache on the disk, if that is possible."""
    try:
        dispatcher._cache = cache(dispatcher.py_func)  # as its method enable_caching does
    except (RuntimeError, OSError) as problem:
        _say("compiled code cannot be kept on the disk", problem)
    return dispatcher


def njit(**options: Any) -> Callable[[Any], Any]:
    """Compile a function, and keep the result on the disk if that is possible.

    No fastmath: what is computed must not depend on the processor, and infinity means something.
    """

    def made(function: Any) -> Any:
        compile_ = partial(numba.njit, nogil=True, error_model="numpy", no_cfunc_wrapper=True, **options)
        entrance = compile_()(function)
        if not hasattr(entrance, "py_func"):  # with NUMBA_DISABLE_JIT=1
            return entrance
        kernel = _kept(compile_(no_cpython_wrapper=True, pipeline_class=PartCompiler)(function), _PartCache)
        kernel.__class__ = _Kernel
        kernel.entrance = _kept(entrance, _Cache)
        return kernel

    return made
