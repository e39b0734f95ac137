# mypy: disable-error-code="no-untyped-def"
"""Pointers for compiled functions that work on blocks of numbers.

An array is a counted reference: passing one to a function that works on 64 numbers costs more than the work itself. A
pointer is indexed like an array, `pointer[k]`, and costs nothing; whoever makes one must keep the array alive.
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

# Unsigned, because numba tests whether signed indices are negative, and loops with tests are not vectorised.
index = np.uintp


@intrinsic
def pointer(_context, array):
    """Return the pointer to the first number of a contiguous array."""

    def build(context, builder, signature, arguments):
        return context.make_array(signature.args[0])(context, builder, arguments[0]).data

    return types.CPointer(array.dtype)(array), build


@intrinsic
def advanced(_context, begin, count):
    """Return the pointer to the number `count` places after another."""

    def build(_, builder, __, arguments):
        return builder.gep(arguments[0], [arguments[1]])

    return begin(begin, count), build


@intrinsic
def prefetch(_context, begin, count):
    """Tell the processor to load the cache line that holds the number `count` places after a pointer."""

    def build(context, builder, _, arguments):
        place = builder.bitcast(builder.gep(arguments[0], [arguments[1]]), cgutils.voidptr_t)
        read, keep, data = (ir.Constant(ir.IntType(32), value) for value in (0, 3, 1))
        kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, read.type, keep.type, data.type])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [place, read, keep, data])
        return context.get_dummy_value()

    return types.void(begin, count), build
