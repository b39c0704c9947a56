"""Pieces of compiled kernels that the compiler does not make by itself."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils as untyped
from numba.extending import intrinsic

cgutils: Any = untyped


def _bring_near(typing_context: Any, array: Any, place: Any) -> Any:
    """Have an element of an array brought near, without waiting for it; it need not exist."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = cgutils.create_struct_proxy(signature.args[0])(context, builder, arguments[0]).data
        pointer, number = cgutils.voidptr_t, ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [pointer, number, number, number])
        prefetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        address = builder.bitcast(builder.gep(data, [arguments[1]]), pointer)
        to_read, keep_near, no_code = number(0), number(3), number(1)
        builder.call(prefetch, [address, to_read, keep_near, no_code])
        return context.get_dummy_value()

    return types.void(array, place), generate


bring_near: Any = intrinsic(_bring_near)


def _calibrate_eight(
    typing_context: Any, frames: Any, i: Any, scale: Any, offset: Any, j: Any, box: Any, o: Any
) -> Any:
    """box[o:o + 8] = frames[i:i + 8] * scale[j:j + 8] - offset[j:j + 8], in vector instructions.

    The compiler makes them by itself only for some lengths of a loop.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def vector(number: int, place: int, kind: Any) -> Any:
            data = cgutils.create_struct_proxy(signature.args[number])(context, builder, arguments[number]).data
            pointer = builder.gep(data, [arguments[place]])
            return builder.bitcast(pointer, ir.VectorType(kind, 8).as_pointer())

        def loaded(number: int, place: int) -> Any:
            dtype: Any = signature.args[number].dtype
            return builder.load(vector(number, place, context.get_data_type(dtype)), align=dtype.bitwidth // 8)

        single = ir.VectorType(ir.FloatType(), 8)
        raw, dtype = loaded(0, 1), signature.args[0].dtype
        if dtype in types.integer_domain:
            raw = builder.sitofp(raw, single) if dtype.signed else builder.uitofp(raw, single)
        flags = ("contract",)
        value = builder.fsub(builder.fmul(raw, loaded(2, 4), flags=flags), loaded(3, 4), flags=flags)
        builder.store(value, vector(5, 6, ir.FloatType()), align=4)
        return context.get_dummy_value()

    return types.void(frames, i, scale, offset, j, box, o), generate


_calibrate_8: Any = intrinsic(_calibrate_eight)


@njit(nogil=True, fastmath={"contract"})
def calibrate(frames: Any, i: Any, scale: Any, offset: Any, j: Any, box: Any, o: Any, length: Any) -> None:
    """box[o:o + length] = frames[i:i + length] * scale[j:j + length] - offset[j:j + length].

    Meant to be inlined, with a length that is constant there and places that are unsigned.
    """
    eight, none = np.uint64(8), np.uint64(0)
    if length < 8:
        for k in range(np.uint64(length)):
            box[o + k] = np.float32(frames[i + k]) * scale[j + k] - offset[j + k]
    else:
        for k in range(none, np.uint64(length - 7), eight):
            _calibrate_8(frames, i + k, scale, offset, j + k, box, o + k)
        if length % 8:
            last = np.uint64(length - 8)  # some of them twice
            _calibrate_8(frames, i + last, scale, offset, j + last, box, o + last)
