"""The path loop of `illumgrid.backends`, compiled anew for another device.

Its functions are plain Python beneath Numba's decorator: here they get other globals, in which each function stands for
its counterpart on the device, vector registers are replaced by `ranks`, and NumPy by what the device has of it. So a
card walks the paths that a processor walks, and a change of the loop reaches both.
"""

import math
from functools import cache
from types import FunctionType, ModuleType, SimpleNamespace

import numba
import numpy as np
from numba import cuda

from illumgrid import rng
from illumgrid.backends import cubics, gathering, kernels, lights, march, normals
from illumgrid.field.levelset import Marchable
from illumgrid_cuda import ranks

MODULES = (rng, ranks, cubics, march, normals, lights, gathering, kernels)
"""In the order in which one uses another."""


@cache
def functions(device):
    """Functions of the path loop for "card" or "processor", by name; a processor has them already."""
    if device == "processor":
        return SimpleNamespace(**vars(kernels), compiled=numba.njit(nogil=True, error_model="numpy", _nrt=False))
    compiled, numpy, memory = _tools()
    made, spaces = {}, []
    for module in MODULES:
        space = {**vars(module), "np": numpy}
        for name, value in list(space.items()):
            plain = _plain(value)
            if plain is None or plain.__module__ != module.__name__:
                continue
            if module is ranks and name in memory:
                space[name] = memory[name]
            else:
                space[name] = compiled(FunctionType(plain.__code__, space, name, plain.__defaults__))
            made[plain] = space[name]
        spaces.append(space)
    stands_for = {"at_least": spaces[1]["at_least"], "count_below": spaces[1]["count_below"]}
    stands_for["address"] = spaces[1]["address"]
    for space in spaces:
        for name, value in list(space.items()):
            if name in stands_for:
                space[name] = stands_for[name]
            elif (plain := _plain(value)) in made:
                space[name] = made[plain]
    return SimpleNamespace(**{name: value for space in spaces for name, value in space.items()}, compiled=compiled)


def _plain(value):
    """The Python function beneath a compiled one, or beneath a question to a surface that is marched; else None."""
    if hasattr(value, "dispatch") and hasattr(value, "registry"):
        value = value.dispatch(Marchable)
    value = getattr(value, "py_func", value)
    return value if isinstance(value, FunctionType) else None


def _tools():
    """How functions are compiled for a card, its NumPy, and its access to memory."""
    if numba.config.ENABLE_CUDASIM:  # Python runs them as they are
        return lambda function: function, np, {"address": ranks.address, "word_at": ranks.word_at}
    from numba.cuda import types
    from numba.cuda.extending import intrinsic

    compiled = cuda.jit(device=True)
    return compiled, _numpy(compiled), _memory(intrinsic, types)


def _memory(intrinsic, types):
    """Addresses, and words at them."""
    from llvmlite import ir

    @intrinsic
    def address(context, array):
        def emit(target, builder, signature, arguments):
            data = target.make_array(signature.args[0])(target, builder, arguments[0]).data
            return builder.ptrtoint(data, ir.IntType(64))

        return types.int64(array), emit

    @intrinsic
    def word_at(context, base, i):
        def emit(target, builder, signature, arguments):
            place = builder.inttoptr(builder.add(*arguments), ir.IntType(64).as_pointer())
            return builder.load(place, align=8)

        return types.uint64(types.int64, types.int64), emit

    return {"address": address, "word_at": word_at}


def _numpy(compiled):
    """What the path loop calls of NumPy, from the mathematics of a card."""
    numpy = ModuleType("numpy")
    for name in ("uint64", "int64", "float64", "float32", "inf", "pi"):
        setattr(numpy, name, getattr(np, name))
    for name in ("sqrt", "sin", "cos", "copysign", "floor"):
        setattr(numpy, name, getattr(math, name))
    numpy.arccos, numpy.arctan2 = math.acos, math.atan2

    def nearest(x):
        return 1.0 * math.floor(x + 0.5)

    def searchsorted(values, x, side="right"):
        low, high = 0, values.shape[0]
        while low < high:
            middle = (low + high) >> 1
            if values[middle] <= x:
                low = middle + 1
            else:
                high = middle
        return low

    numpy.round, numpy.searchsorted = compiled(nearest), compiled(searchsorted)
    return numpy
