"""Accuracy of a surface against the truth: `python -m benchmarks.imaging.surface_accuracy RESULT TRUTH [--scale-e X]`.

RESULT holds picture.tiff, depth_mm.tiff and depth_confidence.tiff, TRUTH true_depth_mm.tiff and true_picture.tiff, all
on the same samples. The picture is compared in electrons: `--scale-e` is the `scale_e` in the provenance.json of a set
that `faintfield darken` has made. Depths that a result does not know are NaN and count as wrong.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

# Neighbouring samples whose depths differ by more than this share are at an edge; no edge is farther than the cap.
_EDGE_STEP = 0.05
_MAX_EDGE_DISTANCE_PX = 20.0

# From this confidence on a depth counts as sure.
_SURE = 0.9
_CONFIDENCE_BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)

type Map = NDArray[np.floating]


@dataclass(frozen=True)
class ReliabilityBin:
    """Samples whose confidence lies from `low` to `high`: their share, mean confidence, and share within 2 %."""

    low: float
    high: float
    share: float
    confidence: float
    right: float


@dataclass(frozen=True)
class DepthAccuracy:
    """Errors of a depth map; the shares are of all samples with a true depth.

    Attributes
    ----------
    within_2, within_1 : float
        Share within 2 % and within 1 % of the true depth.
    median : float
        Median relative error of the known depths; NaN if none is known.
    sure, sure_within_2 : float
        Share with a confidence of at least 0.9, and the share of these within 2 %.
    """

    within_2: float
    within_1: float
    median: float
    sure: float
    sure_within_2: float


def picture_psnr_db(picture: Map, truth: Map, *, affine: bool = False) -> float:
    """Return the PSNR in dB, whose peak is the maximum of the truth; NaN in the picture counts as black.

    Parameters
    ----------
    picture, truth : array (row, column[, colour])
        In the same unit.
    affine : bool
        Fit the straight line from picture to truth first, where the unit or the offset of the picture is not known.
    """
    found, true = np.nan_to_num(picture.astype(np.float64).ravel()), truth.astype(np.float64).ravel()
    if affine:
        slope, offset = np.polyfit(found, true, 1)
        found = slope * found + offset
    error = float(np.mean(np.square(found - true)))
    return float(10 * np.log10(true.max() ** 2 / error)) if error > 0 else float("inf")


def relative_errors(depth_mm: Map, true_depth_mm: Map) -> Map:
    """Return |depth / true depth - 1| of the samples (sample,) with a true depth, inf where the depth is not known."""
    known = np.isfinite(true_depth_mm)
    errors = np.abs(depth_mm[known].astype(np.float64) / true_depth_mm[known] - 1)
    return np.asarray(np.where(np.isnan(errors), np.inf, errors))


def depth_accuracy(depth_mm: Map, confidence: Map, true_depth_mm: Map) -> DepthAccuracy:
    """Return the errors of a depth map (row, column); a confidence of NaN is 0."""
    errors = relative_errors(depth_mm, true_depth_mm)
    sure = confidence[np.isfinite(true_depth_mm)] >= _SURE
    known = np.isfinite(errors)
    return DepthAccuracy(
        within_2=float(np.mean(errors <= 0.02)),
        within_1=float(np.mean(errors <= 0.01)),
        median=float(np.median(errors[known])) if known.any() else float("nan"),
        sure=float(np.mean(sure)),
        sure_within_2=_mean(errors[sure] <= 0.02),
    )


def reliability(depth_mm: Map, confidence: Map, true_depth_mm: Map) -> list[ReliabilityBin]:
    """Return how often depths of each confidence are within 2 %; a confidence of NaN is 0, empty bins are left out."""
    right = relative_errors(depth_mm, true_depth_mm) <= 0.02
    stated = np.nan_to_num(confidence[np.isfinite(true_depth_mm)].astype(np.float64))
    bins = []
    for low, high in pairwise(_CONFIDENCE_BINS):
        inside = (stated >= low) & ((stated < high) | (high == _CONFIDENCE_BINS[-1]))
        if inside.any():
            means = (float(inside.mean()), float(stated[inside].mean()), float(right[inside].mean()))
            bins.append(ReliabilityBin(low, high, *means))
    return bins


def depth_edges(depth_mm: Map) -> NDArray[np.bool_]:
    """Return the samples (row, column) that are nearer than a neighbour beside, above or below by more than 5 %.

    Only the nearer sample of a pair counts, so that an edge moved by a pixel is a pixel away. A depth that is not known
    differs from nothing.
    """
    edges = np.zeros(depth_mm.shape, bool)
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        edges[one] |= depth_mm[other] > (1 + _EDGE_STEP) * depth_mm[one]
        edges[other] |= depth_mm[one] > (1 + _EDGE_STEP) * depth_mm[other]
    return edges


def median_edge_distance_px(edges: NDArray[np.bool_], targets: NDArray[np.bool_]) -> float:
    """Return the median distance from each of the edges to the nearest target, at most 20; NaN without edges."""
    if not edges.any():
        return float("nan")
    if not targets.any():
        return _MAX_EDGE_DISTANCE_PX
    distances = distance_transform_edt(~targets)[edges]
    return float(np.median(np.minimum(distances, _MAX_EDGE_DISTANCE_PX)))


def _mean(values: NDArray[np.bool_]) -> float:
    """Return the mean, NaN of nothing."""
    return float(values.mean()) if values.size else float("nan")


def report_lines(
    picture: Map, depth_mm: Map, confidence: Map, true_picture: Map, true_depth_mm: Map, *, affine: bool = False
) -> list[str]:
    """Return the lines of the table; the true picture is in the unit of the picture."""
    depth = depth_accuracy(depth_mm, confidence, true_depth_mm)
    found, true = depth_edges(depth_mm), depth_edges(true_depth_mm)
    figures = {
        "picture, PSNR (dB)": f"{picture_psnr_db(picture, true_picture, affine=affine):.2f}",
        "depth within 2 % (%)": f"{100 * depth.within_2:.1f}",
        "depth within 1 % (%)": f"{100 * depth.within_1:.1f}",
        "median error (%)": f"{100 * depth.median:.2f}",
        "sure (%)": f"{100 * depth.sure:.1f}",
        "sure, within 2 % (%)": f"{100 * depth.sure_within_2:.1f}",
        "true edges to found (px)": f"{median_edge_distance_px(true, found):.1f}",
        "found edges to true (px)": f"{median_edge_distance_px(found, true):.1f}",
    }
    lines = [f"{name:26} {value:>8}" for name, value in figures.items()]
    lines += ["", f"{'confidence':>14} {'share %':>8} {'mean %':>8} {'right %':>8}"]
    for interval in reliability(depth_mm, confidence, true_depth_mm):
        numbers = " ".join(f"{100 * value:8.1f}" for value in (interval.share, interval.confidence, interval.right))
        lines.append(f"{interval.low:6.2f} … {interval.high:5.2f} {numbers}")
    return lines


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imaging.surface_accuracy", description=__doc__)
    parser.add_argument("result", type=Path, help="folder of the surface")
    parser.add_argument("truth", type=Path, help="folder of the true depth and picture")
    parser.add_argument("--scale-e", type=float, default=1.0, help="electrons per unit of the true picture")
    parser.add_argument("--affine", action="store_true", help="fit a straight line to the picture first")
    arguments = parser.parse_args(argv)
    picture, depth_mm, confidence = (
        tifffile.imread(arguments.result / name) for name in ("picture.tiff", "depth_mm.tiff", "depth_confidence.tiff")
    )
    true_picture = tifffile.imread(arguments.truth / "true_picture.tiff") * arguments.scale_e
    true_depth_mm = tifffile.imread(arguments.truth / "true_depth_mm.tiff")
    shapes = {"depth_mm": depth_mm.shape, "depth_confidence": confidence.shape, "true_depth_mm": true_depth_mm.shape}
    if len({*shapes.values(), picture.shape[:2]}) > 1 or picture.shape != true_picture.shape:
        parser.error(f"the maps are of different sizes: {shapes}, pictures {picture.shape} and {true_picture.shape}")
    lines = report_lines(picture, depth_mm, confidence, true_picture, true_depth_mm, affine=arguments.affine)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
