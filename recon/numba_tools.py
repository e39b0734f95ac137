# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""Common parts of compiled functions: options, pointers into arrays, and fast elementary functions.

An array is a counted reference: passing one to a function that works on 64 numbers costs more than the work itself. A
pointer is indexed like an array, `pointer[k]`, and costs nothing; whoever makes one must keep the array alive.

The library's logarithm and exponential take one number at a time, which would more than double the cost of a pass over
the data. In float32 the functions here replace them, with errors of one or two units in the last place; in float64
they are the library's.
"""

import math
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils, event
from numba.extending import intrinsic, overload

from faintfield.recon.names import on_compiling

# Options of all compiled code: sums may be reordered, but infinities and NaN keep their meaning, because callers test
# for them.
_OPTIONS = {"error_model": "numpy", "fastmath": {"contract", "nsz", "arcp", "reassoc"}}


def compiled(function: Any) -> Any:
    """Return a function that is compiled at its first call with new types, or found in numba's cache."""
    try:
        return numba.njit(nogil=True, cache=True, **_OPTIONS)(function)
    except RuntimeError:  # numba has no folder for its cache that can be written
        return numba.njit(nogil=True, **_OPTIONS)(function)


# For small functions called per pixel or block, where passing arrays would cost more than the work.
inlined = numba.njit(inline="always", **_OPTIONS)

# Unsigned, because numba tests whether signed indices are negative, and loops with tests are not vectorised.
index = np.uintp

_HALF_ROOT_BITS = np.int32(0x3F3504F3)  # √½ as float32
_LN2, _LN2_HIGH, _LN2_LOW = np.float32(0.6931472), np.float32(0.693359375), np.float32(-2.12194440e-4)
_LOG2_E = np.float32(1.442695)
# eˣ is a normal float32 between these.
_MIN_EXPONENT, _MAX_EXPONENT = np.float32(-87.0), np.float32(88.0)


class _First(event.Listener):  # type: ignore[misc]
    """Announces the first compilation of a process."""

    announced = False

    def on_start(self, _):
        if not self.announced:
            self.announced = True
            for announce in on_compiling:
                announce()

    def on_end(self, _):
        pass


event.register("numba:compile", _First())


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


def _bitcast(numba_type, llvm_type):
    """Return a function that takes the 32 bits of a number for one of another type."""

    @intrinsic
    def cast(_context, number):
        return numba_type(number), lambda _, builder, __, arguments: builder.bitcast(arguments[0], llvm_type)

    return cast


_bits, _float_from_bits = _bitcast(types.int32, ir.IntType(32)), _bitcast(types.float32, ir.FloatType())


def logarithm(x):
    """Return ln x for positive, normal x, and a meaningless number for any other."""
    return math.log(x)


def exponential(x):
    """Return eˣ, with x clipped to the range −87 to 88."""
    return math.exp(min(max(x, -87.0), 88.0))


@overload(logarithm, inline="always")
def _logarithm(x):
    if x == types.float32:
        return _logarithm_single
    return lambda x: math.log(x) if x > 0 else 0.0


@overload(exponential, inline="always")
def _exponential(x):
    return _exponential_single if x == types.float32 else exponential


def _logarithm_single(x):
    """Return ln x from x = 2ᵉ m with m near one, and six terms of the series of ln m = 2 artanh((m − 1)/(m + 1))."""
    bits = _bits(x)
    exponent = np.int32(bits - _HALF_ROOT_BITS) >> np.int32(23)
    mantissa = _float_from_bits(np.int32(bits - np.int32(exponent << np.int32(23))))
    s = (mantissa - np.float32(1)) / (mantissa + np.float32(1))
    t = s * s
    series = np.float32(2 / 9) + t * np.float32(2 / 11)
    series = np.float32(2 / 5) + t * (np.float32(2 / 7) + t * series)
    series = np.float32(2) + t * (np.float32(2 / 3) + t * series)
    return np.float32(exponent) * _LN2 + s * series


def _exponential_single(x):
    """Return eˣ = 2ⁿ eʳ, with x = n ln 2 + r and |r| ≤ ½ ln 2."""
    x = min(max(x, _MIN_EXPONENT), _MAX_EXPONENT)
    n = np.floor(x * _LOG2_E + np.float32(0.5))
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    series = np.float32(1 / 24) + r * (np.float32(1 / 120) + r * (np.float32(1 / 720) + r * np.float32(1 / 5040)))
    series = np.float32(1) + r * (np.float32(1) + r * (np.float32(1 / 2) + r * (np.float32(1 / 6) + r * series)))
    return series * _float_from_bits(np.int32((np.int32(n) + np.int32(127)) << np.int32(23)))
