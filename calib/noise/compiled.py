"""Options of compiled code."""

from typing import Any

import numba

# Sums may be reordered, but infinities and NaN keep their meaning.
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "nsz", "arcp", "reassoc"}, "nogil": True}


def compiled(function: Any) -> Any:
    """Return a function that is compiled at its first call with new types, or found in numba's cache."""
    try:
        return numba.njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # numba has no folder for its cache that can be written
        return numba.njit(**_OPTIONS)(function)
