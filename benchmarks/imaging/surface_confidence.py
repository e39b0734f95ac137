"""Fit the probability that a depth is right: the coefficients and the misplacement of `recon.surface.confidence`.

For each set, depths are found in a larger range than that of the true ones. A sample counts with its features, and with
whether its depth is right; all sets count alike. Coefficients are the maximum of the likelihood, with a weak normal
prior. The last, of how much of the detail is explained, is fitted on scenes that mislead, given all others: elsewhere
there is little to learn about it. The misplacement is fitted on scenes from nodes close together.

Call `python -m benchmarks.imaging.surface_confidence SET=TRUTH … --misleading SET=TRUTH … --close SET=TRUTH …`, with a
folder of elemental.toml and one that holds true_depth_mm.tiff, of several scenes at several levels of light. Report
accuracy on other scenes.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tifffile
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize, minimize_scalar

from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.depth.search import default_bins, luminance
from faintfield.recon.surface.confidence import (
    COEFFICIENTS,
    MISPLACEMENT,
    RIGHT_WITHIN,
    SURE,
    features,
    found_probability,
    precise_probability,
)
from faintfield.recon.surface.estimate import equal_steps, first_depths, halves, next_depths
from faintfield.recon.surface.evidence import DepthEvidence
from faintfield.recon.surface.goodness import explained_share

# Rounds of depth and light; every so many samples along each axis are used; weight of the prior.
_ROUNDS, _STRIDE, _PRIOR = 4, 2, 1e-3

# No coefficients
_NOTHING = np.zeros(0)


class Samples(NamedTuple):
    """Depths of a set: features (sample, feature), whether they are right (sample,), and how precise they have to be.

    The `tolerance` (sample,) is the largest right movement of the views, as the root of the sum of their squares.
    """

    features: NDArray[np.float64]
    right: NDArray[np.bool_]
    tolerance: NDArray[np.float64]


def samples_of(folder: Path, truth: Path) -> Samples:
    """Return the depths of a set."""
    elemental_set = load_set(folder)
    bins = default_bins(elemental_set)
    views = luminance(elemental_set, bins)
    true_mm = tifffile.imread(truth / "true_depth_mm.tiff")[bins // 2 :: bins, bins // 2 :: bins]
    true_mm = true_mm[: views.grid.shape[0], : views.grid.shape[1]]
    depths = equal_steps(views, 1 / (1.2 * float(np.nanmax(true_mm))), 1 / (0.85 * float(np.nanmin(true_mm))))
    evidence = DepthEvidence(views, depths, halves(views.nodes))
    index = first_depths(evidence)
    for _ in range(_ROUNDS):
        index, costs = next_depths(evidence, evidence.explained(index))
    inverse_depth = np.interp(index, np.arange(len(depths)), depths)
    right = np.abs(1 / (inverse_depth * true_mm) - 1) < RIGHT_WITHIN
    tolerance = RIGHT_WITHIN * inverse_depth * float(np.linalg.norm(views.reach))
    thin = np.s_[..., ::_STRIDE, ::_STRIDE]
    measured = features(index, costs, depths, explained_share(evidence, index))[thin]
    return Samples(measured.reshape(len(measured), -1).T, right[thin].ravel(), tolerance[thin].ravel())


def fitted(
    sets: Sequence[tuple[NDArray[np.float64], NDArray[np.bool_]]], known: NDArray[np.float64] = _NOTHING
) -> NDArray[np.float64]:
    """Return the coefficients (feature,) after those known that make sets most likely, all sets counting alike."""
    x = np.concatenate([features for features, _ in sets])
    offset, x = x[:, : known.size] @ known, x[:, known.size :]
    sign = np.concatenate([2.0 * right - 1 for _, right in sets])
    weight = np.concatenate([np.full(len(right), 1 / (len(right) * len(sets))) for _, right in sets])
    free = np.arange(x.shape[1]) > (-1 if known.size else 0)  # the prior leaves the constant alone

    def loss(a: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        margin = (offset + x @ a) * sign
        slope = -(x.T @ (weight * sign / (1 + np.exp(margin))))
        value = float(weight @ np.logaddexp(0, -margin)) + _PRIOR * float(a[free] @ a[free])
        return value, slope + 2 * _PRIOR * a * free

    return np.asarray(minimize(loss, np.zeros(x.shape[1]), jac=True).x)


def fitted_misplacement(sets: Sequence[Samples], coefficients: NDArray[np.float64]) -> float:
    """Return the misplacement that makes sets most likely, all sets counting alike, given the coefficients."""

    def loss(misplacement: float) -> float:
        losses = []
        for samples in sets:
            p = np.clip(probability(samples, coefficients, misplacement), 1e-3, 1 - 1e-3)
            losses.append(-np.mean(np.log(np.where(samples.right, p, 1 - p))))
        return float(np.mean(losses))

    return float(minimize_scalar(loss, bounds=(0.01, 2.0), method="bounded").x)


def probability(samples: Samples, coefficients: ArrayLike, misplacement: float) -> NDArray[np.float64]:
    """Return the probability (sample,) that depths are right."""
    found = found_probability(samples.features.T, coefficients)
    return found * precise_probability(samples.tolerance, misplacement)


def main(argv: Sequence[str] | None = None) -> None:
    """Print the fitted numbers, and what they and the present ones say of each set."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imaging.surface_confidence", description=__doc__)
    parser.add_argument("sets", nargs="*", metavar="SET=TRUTH")
    parser.add_argument("--misleading", nargs="*", default=[], metavar="SET=TRUTH")
    parser.add_argument("--close", nargs="*", default=[], metavar="SET=TRUTH")
    arguments = parser.parse_args(argv)
    groups = (arguments.sets, arguments.misleading, arguments.close)
    sets = {name: samples_of(*map(Path, name.split("="))) for group in groups for name in group}
    plain, misleading, close = ([sets[name] for name in group] for group in groups)
    coefficients = np.array(COEFFICIENTS)
    if plain:
        coefficients[:-1] = fitted([(samples.features[:, :-1], samples.right) for samples in plain])
    if misleading:
        coefficients[-1:] = fitted([(samples.features, samples.right) for samples in misleading], coefficients[:-1])
    misplacement = fitted_misplacement(close, coefficients) if close else MISPLACEMENT
    print("fitted", ", ".join(f"{value:.3f}" for value in coefficients), f"misplacement {misplacement:.3f}")
    models: dict[str, tuple[ArrayLike, float]] = {
        "fitted": (coefficients, misplacement),
        "present": (COEFFICIENTS, MISPLACEMENT),
    }
    for name, samples in sets.items():
        for model, numbers in models.items():
            sure = probability(samples, *numbers) >= SURE
            share = samples.right[sure].mean() if sure.any() else float("nan")
            print(
                f"{name.partition('=')[0]:30} {model:8} {samples.right.mean():6.1%} right, {sure.mean():6.1%} sure, "
                f"{share:6.1%} of these right"
            )


if __name__ == "__main__":
    main()
