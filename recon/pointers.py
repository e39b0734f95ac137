# mypy: disable-error-code="no-untyped-def"
"""Pointers for compiled functions that work on blocks of numbers.

An array is a counted reference: handing one to a function that works on 64 numbers costs more than its sums. A pointer
is indexed like an array, `pointer[k]`, and costs nothing; whoever makes one keeps the array alive.
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

# Unsigned: numba would test signed indices for being negative, which keeps loops from becoming vectors
index = np.uintp


@intrinsic
def pointer(_context, array):
    """Return where a contiguous array begins."""

    def build(context, builder, signature, arguments):
        return context.make_array(signature.args[0])(context, builder, arguments[0]).data

    return types.CPointer(array.dtype)(array), build


@intrinsic
def advanced(_context, begin, count):
    """Return the pointer that is `count` numbers behind another."""

    def build(_, builder, __, arguments):
        return builder.gep(arguments[0], [arguments[1]])

    return begin(begin, count), build


@intrinsic
def wanted_soon(_context, begin, count):
    """Ask for the numbers of a cache line, `count` numbers behind a pointer, to be read from memory meanwhile."""

    def build(context, builder, _, arguments):
        place = builder.bitcast(builder.gep(arguments[0], [arguments[1]]), cgutils.voidptr_t)
        read, nearest, data = (ir.Constant(ir.IntType(32), value) for value in (0, 3, 1))
        kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, read.type, nearest.type, data.type])
        prefetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(prefetch, [place, read, nearest, data])
        return context.get_dummy_value()

    return types.void(begin, count), build
