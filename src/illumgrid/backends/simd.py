"""Eight numbers at once: a type for compiled kernels that lives in vector registers.

Numba has none, and its loop vectoriser does not find the lanes of a box or triangle test by itself; LLVM maps this one
to AVX, SSE or NEON. Each operation is a plain NumPy function which also says how it compiles: with NUMBA_DISABLE_JIT=1
a kernel runs on arrays of eight instead, bit for bit the same.

Memory is read and written at addresses: an array argument of a compiled function costs an atomic reference count at
every call, and each array inside a tuple another.
"""

import hashlib
import inspect
import operator
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import lower_builtin, models, register_model, type_callable

from illumgrid.compiled import njit

WIDE = 8


def cached(*sources: ModuleType, **options: Any) -> Callable[[Any], Any]:
    """Compile a function with a disk cache that notices edits in other modules, and another version of Numba.

    Parameters
    ----------
    *sources : module
        All modules whose functions end up in the compiled code, except the function's own and frozen ones.
    **options
        Further options of Numba.

    Returns
    -------
    callable
        A decorator.
    """
    # Numba takes compiled code from the disk if the file that contains the function is unchanged: by its contents
    # (0.68), by its time and size (0.61). It ignores what else went into the code, so an upgrade that changes only
    # another file would run the old code. And if two processes find the code of another version of Numba, one writes
    # its index anew before it has replaced the code, and the other loads what it cannot read. But the cache's files are
    # named after the function's qualified name: with a digest in it, files of others are not found. This holds
    # wherever the cache lies and whatever times an installer sets, and leaves NUMBA_CACHE_DIR and the caches of other
    # packages alone.
    made_of = [numba.__version__, *map(inspect.getsource, sources)]
    digest = hashlib.sha256("\n".join(made_of).encode()).hexdigest()[:16]

    def compiled(function: Any) -> Any:
        function.__qualname__ += f"_{digest}"
        return njit(**options)(function)

    return compiled


class Lanes(types.Type):
    """Eight numbers in a register: kind "f" single precision, "i" 32-bit integers, "b" true or false."""

    def __init__(self, kind: str) -> None:
        super().__init__(name=f"lanes_{kind}")
        self.kind = kind


ELEMENT = {"f": ir.FloatType(), "i": ir.IntType(32), "b": ir.IntType(1)}
VECTOR = {kind: ir.VectorType(element, WIDE) for kind, element in ELEMENT.items()}
FLOATS, INTS, TRUTHS = Lanes("f"), Lanes("i"), Lanes("b")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, lanes):
        super().__init__(manager, lanes, VECTOR[lanes.kind])  # type: ignore[no-untyped-call]


def compiles(function: Any, result: Any, *arguments: Any) -> Any:
    """Register how `function` compiles for arguments of these types: emit(builder, *values) -> value."""

    def fit(context: Any, *given: Any) -> Any:
        # Exactly these types, except that any integer type matches an integer.
        if all(
            g == a or (isinstance(a, types.Integer) and isinstance(g, types.Integer)) for g, a in zip(given, arguments)
        ):
            return result(*arguments)

    def register(emit: Any) -> Any:
        @type_callable(function)
        def typer(context: Any) -> Any:
            return (
                lambda: fit(context),
                lambda a: fit(context, a),
                lambda a, b: fit(context, a, b),
                lambda a, b, c: fit(context, a, b, c),
            )[len(arguments)]

        @lower_builtin(function, *arguments)
        def lower(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            value = emit(builder, *values)
            return context.get_dummy_value() if result is types.none else value

        return emit

    return register


def library(name: str, kind: Any) -> Any:
    """Emit a call of LLVM's own function."""

    def emit(builder: Any, *values: Any) -> Any:
        shape = ir.FunctionType(kind, [v.type for v in values])
        return builder.call(builder.module.declare_intrinsic(name, fnty=shape), values)

    return emit


def _method(name: str, *first: Any) -> Any:
    return lambda builder, *values: getattr(builder, name)(*first, *values)


_kind: Any
for _operator, _name in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    compiles(_operator, FLOATS, FLOATS, FLOATS)(_method(_name))
for _operator, _name in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    compiles(_operator, TRUTHS, FLOATS, FLOATS)(_method("fcmp_ordered", _name))
compiles(operator.eq, TRUTHS, INTS, INTS)(_method("icmp_signed", "=="))
for _kind in (INTS, TRUTHS):
    compiles(operator.and_, _kind, _kind, _kind)(_method("and_"))
    compiles(operator.or_, _kind, _kind, _kind)(_method("or_"))


def choose(condition: Any, a: Any, b: Any) -> Any:
    """Take a where the condition holds, else b: lanes, or one scalar, without a branch."""
    return np.where(condition, a, b)[()]


for _condition, _kind in (
    (TRUTHS, FLOATS),
    (TRUTHS, INTS),
    (types.boolean, types.float32),
    (types.boolean, types.float64),
    (types.boolean, types.intp),
):
    compiles(choose, _kind, _condition, _kind, _kind)(_method("select"))


def minimum(a: Any, b: Any) -> Any:
    """Smaller of a and b, lane by lane."""
    return np.minimum(a, b)


def maximum(a: Any, b: Any) -> Any:
    """Larger of a and b, lane by lane."""
    return np.maximum(a, b)


compiles(minimum, FLOATS, FLOATS, FLOATS)(lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))
compiles(maximum, FLOATS, FLOATS, FLOATS)(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))


def muladd(a: Any, b: Any, c: Any) -> Any:
    """Product a b plus c, rounded once or twice depending on the processor: for bounds only."""
    return a * b + c


compiles(muladd, FLOATS, FLOATS, FLOATS, FLOATS)(library("llvm.fmuladd.v8f32", VECTOR["f"]))


def spread(x: Any) -> Any:
    """Eight times the float x."""
    return np.full(WIDE, x, dtype=np.float32)


def spread_int(x: Any) -> Any:
    """Eight times the integer x."""
    return np.full(WIDE, x, dtype=np.int32)


@compiles(spread, FLOATS, types.float32)
@compiles(spread, FLOATS, types.float64)
@compiles(spread_int, INTS, types.int32)
def _(builder: Any, x: Any) -> Any:
    if x.type == ir.DoubleType():
        x = builder.fptrunc(x, ELEMENT["f"])
    first = ir.Constant(ir.IntType(32), 0)
    one = builder.insert_element(ir.Constant(ir.VectorType(x.type, WIDE), ir.Undefined), x, first)
    return builder.shuffle_vector(one, one, ir.Constant(VECTOR["i"], [0] * WIDE))


def places() -> Any:
    """0, 1, ... 7."""
    return np.arange(WIDE, dtype=np.int32)


compiles(places, INTS)(lambda builder: ir.Constant(VECTOR["i"], list(range(WIDE))))


def lane(a: Any, k: Any) -> Any:
    """Lane k of a."""
    return a[k]


compiles(lane, types.float32, FLOATS, types.intp)(_method("extract_element"))


def bits(a: Any) -> Any:
    """The same bits as integers: among floats from 0 on they have the same order."""
    return a.view(np.int32)


compiles(bits, INTS, FLOATS)(lambda builder, a: builder.bitcast(a, VECTOR["i"]))
compiles(bits, types.int32, types.float32)(lambda builder, a: builder.bitcast(a, ELEMENT["i"]))


def smallest(a: Any) -> Any:
    """Smallest of eight integers."""
    return a.min()


compiles(smallest, types.int32, INTS)(library("llvm.vector.reduce.smin.v8i32", ELEMENT["i"]))


def mask(a: Any) -> Any:
    """Integer whose bit k is lane k."""
    return int(np.packbits(a, bitorder="little")[0])


compiles(mask, types.intp, TRUTHS)(
    lambda builder, a: builder.zext(builder.bitcast(a, ir.IntType(WIDE)), ir.IntType(64))
)


def lowest(m: Any) -> Any:
    """Place of the lowest bit that is set."""
    return (m & -m).bit_length() - 1


compiles(lowest, types.intp, types.intp)(lambda builder, m: builder.cttz(m, ir.Constant(ir.IntType(1), 1)))


def address(array: Any) -> Any:
    """Where an array begins, for load and store; the caller keeps the array alive."""
    return array


@type_callable(address)
def _(context: Any) -> Any:
    return lambda array: types.intp if isinstance(array, types.Array) else None


@lower_builtin(address, types.Array)
def _(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, value=values[0])
    return builder.ptrtoint(array.data, ir.IntType(64))


def load(base: Any, i: Any) -> Any:
    """Eight floats from element i on."""
    return base[i : i + WIDE]


def load_int(base: Any, i: Any) -> Any:
    """Eight integers from element i on."""
    return base[i : i + WIDE].view(np.int32)


def peek(base: Any, i: Any) -> Any:
    """Integer at element i."""
    return int(base[i : i + 1].view(np.int32)[0])


def store(base: Any, i: Any, values: Any) -> None:
    """Put lanes, or one integer, at element i."""
    base[i : i + np.size(values)] = values


def _place(builder: Any, base: Any, i: Any, kind: Any) -> Any:
    byte = builder.add(base, builder.shl(i, ir.Constant(ir.IntType(64), 2)))
    return builder.inttoptr(byte, kind.as_pointer())


for _function, _kind, _shape in ((load, FLOATS, VECTOR["f"]), (load_int, INTS, VECTOR["i"])):
    compiles(_function, _kind, types.intp, types.intp)(
        lambda builder, base, i, shape=_shape: builder.load(_place(builder, base, i, shape), align=4)
    )
compiles(peek, types.intp, types.intp, types.intp)(
    lambda builder, base, i: builder.sext(builder.load(_place(builder, base, i, ELEMENT["i"]), align=4), ir.IntType(64))
)


@compiles(store, types.none, types.intp, types.intp, INTS)
@compiles(store, types.none, types.intp, types.intp, types.int32)
def _(builder: Any, base: Any, i: Any, values: Any) -> None:
    builder.store(values, _place(builder, base, i, values.type), align=4)


def at_least(base: Any, i: Any, rank: Any) -> Any:
    """Number whose bit k is set if byte i + k, of 64 bytes from byte i on, is not below `rank`."""
    return np.packbits(base[i : i + 64] >= rank, bitorder="little").view(np.uint64)[0]


def count_below(base: Any, i: Any, rank: Any) -> Any:
    """Number of the eight bytes from byte i on that are below `rank`."""
    return int((base[i : i + 8] < rank).sum())


def _compare(builder: Any, base: Any, i: Any, rank: Any, count: int, relation: str) -> Any:
    byte, whole = ir.IntType(8), ir.IntType(32)
    kind = ir.VectorType(byte, count)
    found = builder.load(builder.inttoptr(builder.add(base, i), kind.as_pointer()), align=1)
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), builder.trunc(rank, byte), ir.Constant(whole, 0))
    against = builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(whole, count), [0] * count))
    return builder.bitcast(builder.icmp_unsigned(relation, found, against), ir.IntType(count))


compiles(at_least, types.uint64, types.intp, types.intp, types.intp)(
    lambda builder, base, i, rank: _compare(builder, base, i, rank, 64, ">=")
)
compiles(count_below, types.intp, types.intp, types.intp, types.intp)(
    lambda builder, base, i, rank: builder.zext(builder.ctpop(_compare(builder, base, i, rank, 8, "<")), ir.IntType(64))
)
