# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""Logarithm and exponential that vectorise inside compiled loops; in float64 they are the library's own.

The library's functions are called one number at a time, which would cost a pass over the data more than all the rest of
it. In float32 these stand in, with errors of one or two units in the last place.
"""

import math

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic, overload

# Options of everything compiled here: sums may be reordered, but infinities and NaN keep their meaning, for callers
# test for them.
_OPTIONS = {"error_model": "numpy", "fastmath": {"contract", "nsz", "arcp", "reassoc"}}
compiled = numba.njit(nogil=True, cache=True, **_OPTIONS)

# For what is small and called per pixel or block: handing over arrays costs more than it does.
inlined = numba.njit(inline="always", **_OPTIONS)

_HALF_ROOT_BITS = np.int32(0x3F3504F3)  # √½ as float32
_LN2, _LN2_HIGH, _LN2_LOW = np.float32(0.6931472), np.float32(0.693359375), np.float32(-2.12194440e-4)
_LOG2_E = np.float32(1.442695)
_LEAST, _MOST = np.float32(-87.0), np.float32(88.0)


@intrinsic
def _bits(_context, number):
    """Return the 32 bits of a float32 as an int32."""

    def build(_, builder, __, arguments):
        from llvmlite import ir

        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.int32(number), build


@intrinsic
def _of_bits(_context, bits):
    """Return the float32 that an int32's bits are."""

    def build(_, builder, __, arguments):
        from llvmlite import ir

        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(bits), build


def logarithm(x):
    """Return ln x for positive, normal x; what it returns else is a number without meaning."""
    return math.log(x)


def exponential(x):
    """Return eˣ, with x kept within −87 and 88."""
    return math.exp(min(max(x, -87.0), 88.0))


@overload(logarithm, inline="always")
def _logarithm(x):
    if x == types.float32:
        return _logarithm_single
    return lambda x: math.log(x) if x > 0 else 0.0


@overload(exponential, inline="always")
def _exponential(x):
    if x == types.float32:
        return _exponential_single
    return lambda x: math.exp(min(max(x, -87.0), 88.0))


def _logarithm_single(x):
    """X = 2ᵉ m with m near one, and ln m = 2 artanh((m − 1)/(m + 1)), six terms of whose series are exact enough."""
    bits = _bits(x)
    exponent = np.int32(bits - _HALF_ROOT_BITS) >> np.int32(23)
    mantissa = _of_bits(np.int32(bits - np.int32(exponent << np.int32(23))))
    s = (mantissa - np.float32(1)) / (mantissa + np.float32(1))
    t = s * s
    series = np.float32(2 / 9) + t * np.float32(2 / 11)
    series = np.float32(2 / 5) + t * (np.float32(2 / 7) + t * series)
    series = np.float32(2) + t * (np.float32(2 / 3) + t * series)
    return np.float32(exponent) * _LN2 + s * series


def _exponential_single(x):
    """X = n ln 2 + r with |r| ≤ ½ ln 2, and eˣ = 2ⁿ eʳ."""
    x = min(max(x, _LEAST), _MOST)
    n = np.floor(x * _LOG2_E + np.float32(0.5))
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    series = np.float32(1 / 24) + r * (np.float32(1 / 120) + r * (np.float32(1 / 720) + r * np.float32(1 / 5040)))
    series = np.float32(1) + r * (np.float32(1) + r * (np.float32(1 / 2) + r * (np.float32(1 / 6) + r * series)))
    return series * _of_bits(np.int32((np.int32(n) + np.int32(127)) << np.int32(23)))
