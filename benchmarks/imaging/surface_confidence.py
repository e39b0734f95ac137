"""Fit the probability that a depth is right: the coefficients of `recon.surface.confidence`.

For each set, depths are found in a larger range than that of the true ones. A sample counts with its features, and with
whether its depth is right; all sets count alike. Coefficients are the maximum of the likelihood, with a weak normal
prior. That of how much of the detail is explained is fitted on scenes that mislead, given all others, and that of the
parallax on scenes from nodes close together, given these: elsewhere there is little to learn about them.

Call `python -m benchmarks.imaging.surface_confidence SET=TRUTH … --misleading SET=TRUTH … --close SET=TRUTH …`, with a
folder of elemental.toml and one that holds true_depth_mm.tiff, of several scenes at several levels of light. Report
accuracy on other scenes.
"""

import argparse
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy.optimize import minimize

from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.depth.search import default_bins, luminance
from faintfield.recon.surface.confidence import COEFFICIENTS, RIGHT_WITHIN, SURE, features
from faintfield.recon.surface.estimate import equal_steps, first_depths, halves, next_depths
from faintfield.recon.surface.evidence import DepthEvidence
from faintfield.recon.surface.goodness import explained_share

# Rounds of depth and light; every so many samples along each axis are used; weight of the prior.
_ROUNDS, _STRIDE, _PRIOR = 4, 2, 1e-3

# No coefficients
_NOTHING = np.zeros(0)


def samples_of(folder: Path, truth: Path) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the features (sample, feature) of a set's depths, and which are right (sample,)."""
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
    found_mm = 1 / np.interp(index, np.arange(len(depths)), depths)
    right = np.abs(found_mm / true_mm - 1) < RIGHT_WITHIN
    thin = np.s_[..., ::_STRIDE, ::_STRIDE]
    measured = features(index, costs, depths, explained_share(evidence, index), float(views.reach.max()))[thin]
    return measured.reshape(len(measured), -1).T, right[thin].ravel()


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


def main(argv: Sequence[str] | None = None) -> None:
    """Print the fitted coefficients, and what they and the present ones say of each set."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imaging.surface_confidence", description=__doc__)
    parser.add_argument("sets", nargs="*", metavar="SET=TRUTH")
    parser.add_argument("--misleading", nargs="*", default=[], metavar="SET=TRUTH")
    parser.add_argument("--close", nargs="*", default=[], metavar="SET=TRUTH")
    arguments = parser.parse_args(argv)
    groups = (arguments.sets, arguments.misleading, arguments.close)
    named = [[name.split("=") for name in group] for group in groups]
    measured = [[samples_of(Path(folder), Path(truth)) for folder, truth in group] for group in named]
    found = _NOTHING
    for known, group in zip((4, 5, 6), measured, strict=True):
        of_group = (
            fitted([(x[:, :known], right) for x, right in group], found) if group else COEFFICIENTS[len(found) : known]
        )
        found = np.append(found, of_group)
    print("fitted", ", ".join(f"{value:.3f}" for value in found))
    for (folder, _), (x, right) in zip(chain(*named), chain(*measured), strict=True):
        for name, coefficients in {"fitted": found, "present": np.array(COEFFICIENTS)}.items():
            sure = 1 / (1 + np.exp(-x @ coefficients)) >= SURE
            share = right[sure].mean() if sure.any() else float("nan")
            print(
                f"{folder:30} {name:8} {right.mean():6.1%} right, {sure.mean():6.1%} sure, {share:6.1%} of these right"
            )


if __name__ == "__main__":
    main()
