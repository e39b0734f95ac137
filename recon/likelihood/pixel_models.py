# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""The statistical models of a pixel, compiled: each model's ratio and negative log-likelihood.

For a pixel that reads g where λ = (H f) + b is expected, a model gives the *ratio* r, such that the derivative of its
negative log-likelihood with respect to (H f) is 1 − r, and that negative log-likelihood itself, up to a constant.
`Poisson(λ) + N(0, σ²)` is the truth; the models approximate it:

- shifted Poisson: `y = (g + σ²)₊` is taken for Poisson of mean `m = λ + σ²`. r = y/m, value `m − y + y ln(y/m)`.
  With σ = 0 it is Poisson.
- Poisson–Gaussian: exact. r = E[N | g, λ]/λ, value −ln p(g | λ).
- least squares: r = 1 + (g − λ)/v, value `(g − λ)²/(2v)`, with v the variance of the pixel at a given level of light.
"""

import numpy as np

from faintfield.recon.numba_tools import advanced, compiled, exponential, index, inlined, logarithm

SHIFTED_POISSON, POISSON_GAUSSIAN, LEAST_SQUARES = 0, 1, 2

# Rows of scratch that `form_ratio_of_block` needs, each of a block's length.
WORK_ROWS = 8

# Smallest variance of the read noise (0.03 electrons): less makes no difference, and would overflow.
_MIN_VARIANCE_E2 = 1e-3

# Smallest expected count, so that its logarithm is finite.
_MIN_MEAN_E = 1e-30

# Standard deviations, and counts beyond them, that the sum includes on either side of the mode.
# What it omits is below 1e-7.
_SPREADS, _EXTRA = 6.5, 4

# Newton steps to the mode.
_NEWTON_STEPS = 6


@compiled
def form_ratio_of_block(model, count, expected, observed, background, variance, response, level, work, with_value):
    """Replace H f of some pixels by the ratio; return their negative log-likelihood.

    Parameters
    ----------
    model, count : int
        One of the constants above; number of pixels.
    expected : pointer
        H f on entry, the ratio on return.
    observed, background, variance, response : pointer
        g, b, σ² and the response of each pixel; one of response zero does not count, and its ratio is meaningless.
    level : number
        Expected light of a pixel of response one, for the variance of least squares.
    work : pointer
        Scratch, `WORK_ROWS` rows of `count` numbers.
    with_value : bool
        False if the value is not needed; it is then left out where that saves time.
    """
    if model == POISSON_GAUSSIAN:
        return _poisson_gaussian(count, expected, observed, background, variance, response, work)
    if model == LEAST_SQUARES:
        return _least_squares(count, expected, observed, background, variance, response, level)
    if with_value:
        return _shifted_poisson(count, expected, observed, background, variance, response)
    return _shifted_poisson_ratio(count, expected, observed, background, variance)


@compiled
def _shifted_poisson_ratio(count, expected, observed, background, variance):
    zero = type(expected[0])(0)
    for k in range(count):
        shifted = max(observed[k] + variance[k], zero)
        mean = expected[k] + background[k] + variance[k]
        expected[k] = shifted / mean if mean > zero else zero
    return 0.0


@compiled
def _shifted_poisson(count, expected, observed, background, variance, response):
    number = type(expected[0])
    zero, tiny, infinite = number(0), number(1e-37), number(np.inf)
    total = zero
    for k in range(count):
        shifted = max(observed[k] + variance[k], zero)
        mean = expected[k] + background[k] + variance[k]
        ratio = shifted / mean if mean > zero else zero
        value = mean - shifted + shifted * logarithm(max(ratio, tiny))
        value = infinite if (mean <= zero) & (shifted > zero) else value
        total += value if response[k] != zero else zero
        expected[k] = ratio
    return np.float64(total)


@compiled
def _least_squares(count, expected, observed, background, variance, response, level):
    number = type(expected[0])
    zero, one, half, level = number(0), number(1), number(0.5), number(level)
    total = zero
    for k in range(count):
        miss = observed[k] - expected[k] - background[k]
        scaled = miss / (level * response[k] + background[k] + variance[k])
        total += half * scaled * miss if response[k] != zero else zero
        expected[k] = one + scaled
    return np.float64(total)


@compiled
def _poisson_gaussian(count, expected, observed, background, variance, response, work):
    """Sum over the count N outwards from its mode; each term follows from its neighbour by one multiplication."""
    number = type(expected[0])
    zero, one, half, limit = number(0), number(1), number(0.5), number(80)
    mode, mean = work, advanced(work, count)
    sigma2, step = advanced(mean, count), advanced(mean, index(2) * count)
    term, shrink = advanced(step, count), advanced(step, index(2) * count)
    mass, moment = advanced(shrink, count), advanced(shrink, index(2) * count)
    for k in range(count):
        mean[k] = max(expected[k] + background[k], number(_MIN_MEAN_E))
        sigma2[k] = max(variance[k], number(_MIN_VARIANCE_E2))
        shrink[k] = exponential(-one / sigma2[k])
        mass[k], moment[k] = one, zero
    widest = _modes(count, mode, observed, mean, sigma2, response, step)
    reach = int(_SPREADS * np.sqrt(widest)) + _EXTRA
    for k in range(count):
        term[k] = one
        step[k] = exponential(min((observed[k] - mode[k] - half) / sigma2[k] + logarithm(mean[k]), limit))
    _add_counts(True, count, reach, mode, step, shrink, term, mass, moment)
    for k in range(count):
        term[k] = one
        step[k] = exponential(min((mode[k] - observed[k] - half) / sigma2[k] - logarithm(mean[k]), limit))
    _add_counts(False, count, reach, mode, step, shrink, term, mass, moment)
    total = zero
    for k in range(count):
        miss = observed[k] - mode[k]
        value = half * miss * miss / sigma2[k] - logarithm(mass[k])
        value += mean[k] + _log_factorial_over_power(mode[k], mean[k])
        total += value if response[k] != zero else zero
        expected[k] = (mode[k] + moment[k] / mass[k]) / mean[k]
    return np.float64(total)


@inlined
def _add_counts(above, count, reach, mode, step, shrink, term, mass, moment):
    """Add the terms of the counts above the mode, or below it, to `mass`, and those times the distance to `moment`.

    Terms are zero from a count of −1 on.
    """
    number = type(step[0])
    for away in range(1, reach + 1):
        distance = number(away)
        for k in range(count):
            term[k] *= step[k] / (mode[k] + distance) if above else step[k] * (mode[k] - distance + number(1))
            mass[k] += term[k]
            moment[k] += distance * term[k] if above else -distance * term[k]
            step[k] *= shrink[k]


@compiled
def _modes(count, mode, observed, mean, sigma2, response, target):
    """Set `mode` to the N that maximises λᴺ/N! exp(−(g − N)²/2σ²); return the largest variance of N given g.

    The mode is the integer part of the root of n + σ² ln n = g + σ² ln λ + ½, and zero where that root is below one.
    Newton steps on a concave increasing function stay to the left of its root if they start there.
    """
    number = type(mode[0])
    zero, one = number(0), number(1)
    for k in range(count):
        target[k] = observed[k] + sigma2[k] * logarithm(mean[k]) + number(0.5)
        mode[k] = max(target[k] - sigma2[k] * logarithm(max(target[k], one)), one)
    for _ in range(_NEWTON_STEPS):
        for k in range(count):
            n, v = mode[k], sigma2[k]
            mode[k] = max(n - (n + v * logarithm(n) - target[k]) / (one + v / n), one)
    widest = zero
    for k in range(count):
        n = np.floor(mode[k]) if target[k] >= one else zero
        n = n if response[k] != zero else zero
        mode[k] = n
        widest = max(widest, (n + one) * sigma2[k] / (n + one + sigma2[k]))
    return widest


@compiled
def _log_factorial_over_power(n, mean):
    """Return ln(n!) − n ln λ by Stirling's series, arranged so that large terms cancel before they are added."""
    number = type(n)
    one = number(1)
    at_least_one = max(n, one)
    inverse = one / at_least_one
    square = inverse * inverse
    series = inverse * (
        number(1 / 12) - square * (number(1 / 360) - square * (number(1 / 1260) - square / number(1680)))
    )
    series = number(0.08106146679532726) if n == one else series
    root = number(0.5) * logarithm(number(2 * np.pi) * at_least_one)
    return n * logarithm(at_least_one / mean) - n + root + series if n > number(0) else number(0)
