"""Names of likelihoods and penalties, and callbacks before compiling: importing them loads neither numpy nor numba."""

from collections.abc import Callable
from typing import Literal

type LikelihoodName = Literal["poisson", "shifted-poisson", "poisson-gaussian", "least-squares"]
type PenaltyName = Literal["tv", "huber-tv", "quadratic", "none"]

# Called before the first kernel of a process is compiled, which takes seconds; not if numba's cache holds all of them.
on_compiling: list[Callable[[], object]] = []
