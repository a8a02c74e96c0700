"""What the intrinsics of this room share: LLVM's vectors, loads and stores that need no alignment, one fused operation.

Each function here adds instructions to the code that an intrinsic generates; none of them runs in a kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.registry import cpu_target

BYTE, I16, I32, I64 = ir.IntType(8), ir.IntType(16), ir.IntType(32), ir.IntType(64)
F32, F64 = ir.FloatType(), ir.DoubleType()
_SUFFIXES = {F32: "f32", F64: "f64", BYTE: "i8", I32: "i32"}


def processor_features() -> list[str]:
    """LLVM's names, with a sign before, of the processor that numba compiles for."""
    features: list[str] = cpu_target.target_context.codegen().magic_tuple()[2].split(",")
    return features


def int64(value: int) -> Any:
    """The constant."""
    return ir.Constant(I64, value)


def constant(kind: Any, value: float) -> Any:
    """A vector of type ``kind`` with the same number in all lanes."""
    return ir.Constant(kind, [value] * kind.count)


def data(context: Any, builder: Any, signature: Any, args: Any, n: int) -> Any:
    """Pointer to the first element of argument n of an intrinsic, which is an array or a pointer."""
    kind = signature.args[n]
    return args[n] if isinstance(kind, types.CPointer) else context.make_array(kind)(context, builder, args[n]).data


def load(builder: Any, pointer: Any, kind: Any, align: int) -> Any:
    """What lies at a pointer of any type, as a value of type ``kind``; ``align``: bytes that its address divides by."""
    value = builder.load(builder.bitcast(pointer, kind.as_pointer()))
    value.align = align
    return value


def store(builder: Any, value: Any, pointer: Any, align: int) -> None:
    """Write a value to a pointer of any type."""
    builder.store(value, builder.bitcast(pointer, value.type.as_pointer())).align = align


def splat(builder: Any, scalar: Any, kind: Any) -> Any:
    """A scalar in all lanes of a vector of type ``kind``."""
    empty = ir.Constant(kind, ir.Undefined)
    one = builder.insert_element(empty, scalar, ir.Constant(I32, 0))
    return builder.shuffle_vector(one, empty, ir.Constant(ir.VectorType(I32, kind.count), [0] * kind.count))


def fma(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """``a * b + c`` of three vectors of one type, rounded once."""
    return intrinsic(builder, "fma", a.type, [a, b, c])


def intrinsic(builder: Any, name: str, kind: Any, args: list[Any]) -> Any:
    """A call of LLVM's own function of a name for vectors of type ``kind``, which all its arguments have."""
    full = f"llvm.{name}.v{kind.count}{_SUFFIXES[kind.element]}"
    declared = ir.FunctionType(kind, [kind] * len(args))
    return builder.call(cgutils.get_or_insert_function(builder.module, declared, full), args)


def loading(kind: Any, align: int) -> Callable[..., Any]:
    """Code of an intrinsic (base, index) that loads a vector of a kind from there on."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return load(builder, builder.gep(args[0], [args[1]]), kind, align)

    return codegen


def storing(align: int) -> Callable[..., Any]:
    """Code of an intrinsic (base, index, vector) that stores it from there on."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        store(builder, args[2], builder.gep(args[0], [args[1]]), align)
        return context.get_dummy_value()

    return codegen


def splatting(kind: Any) -> Callable[..., Any]:
    """Code of an intrinsic (scalar) that makes all lanes of a vector of a kind."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return splat(builder, args[0], kind)

    return codegen
