"""Names of likelihoods and penalties, apart from the code that computes them: options are made of these."""

from typing import Literal

type LikelihoodName = Literal["poisson", "shifted-poisson", "poisson-gaussian", "least-squares"]
type PenaltyName = Literal["tv", "huber-tv", "quadratic", "none"]
