"""The errors of a depth map or a surface of the reference view, where the set brings its true depth."""

from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.files import remove, write_record
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.formats.sets.ground_truth import read_true_depth_mm

DEPTH_ERRORS_FILE = "depth_errors.json"

# An error of this share of the depth counts as right, as in the confidence.
_RIGHT = 0.02


class DepthErrors(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Errors of the depths that are known, at the samples where the truth is known, too.

    Attributes
    ----------
    file : str
        The map that was compared.
    samples, share : int, float
        Number of samples that were compared, and their share of those with a true depth.
    median_error_mm, median_relative_error : float
        Median of the error's size, in mm and as a share of the true depth.
    within_2_percent : float
        Share of the compared samples whose error is at most 2 % of the true depth.
    """

    file: str
    samples: int
    share: float
    median_error_mm: float
    median_relative_error: float
    within_2_percent: float


def write_depth_errors(
    elemental_set: ElementalSet, folder: Path, file: str, unit: Literal["mm", "px", "relative"]
) -> DepthErrors | None:
    """Compare a map in a folder of results with the set's true depth, and write its errors beside it.

    Parameters
    ----------
    elemental_set : ElementalSet
        The set that was reconstructed.
    folder : Path
        Of the results; an earlier comparison in it is removed.
    file : str
        The map, depths or disparities on the pixels of the reference view, NaN where nothing is known.
    unit : {"mm", "px", "relative"}
        Of its values. A truth in mm is only beside sets in mm.

    Returns
    -------
    DepthErrors or None
        None if the set brings no truth, or none for any sample of the map.
    """
    remove(folder / DEPTH_ERRORS_FILE)
    true_mm = read_true_depth_mm(elemental_set.folder)
    if true_mm is None or elemental_set.units.depth != "mm":
        return None
    found_mm = np.asarray(read_frame(folder / file).pixels_dn, np.float64)
    if unit == "px":
        found_mm = _depth_of(elemental_set, found_mm)
    if found_mm.shape != true_mm.shape:
        inform(f"{file}: is of shape {found_mm.shape}, the true depth {true_mm.shape} (rows, columns): not compared")
        return None
    errors = _errors(file, found_mm, true_mm)
    if errors is not None:
        write_record(folder / DEPTH_ERRORS_FILE, errors)
        inform(
            f"{file}: median error {errors.median_error_mm:.3g} mm ({errors.median_relative_error:.2%}) at the "
            f"{errors.share:.0%} of samples whose depth is known, {errors.within_2_percent:.0%} of these within 2 %"
        )
    return errors


def _errors(file: str, found_mm: NDArray[np.float64], true_mm: NDArray[np.float64]) -> DepthErrors | None:
    """Return the errors of depths (row, column); None if none can be compared."""
    known = np.isfinite(true_mm) & (true_mm > 0)
    both = known & np.isfinite(found_mm)
    if not both.any():
        return None
    error_mm = np.abs(found_mm - true_mm)[both]
    relative = error_mm / true_mm[both]
    return DepthErrors(
        file=file,
        samples=int(both.sum()),
        share=float(both.sum() / known.sum()),
        median_error_mm=float(np.median(error_mm)),
        median_relative_error=float(np.median(relative)),
        within_2_percent=float(np.mean(relative <= _RIGHT)),
    )


def _depth_of(elemental_set: ElementalSet, disparity_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the depths of disparities, NaN where they belong to none."""
    at_zero, slope = elemental_set.inverse_depth_of_disparity()
    inverse = at_zero + slope * disparity_px
    return np.where(inverse > 0, 1 / np.where(inverse > 0, inverse, 1.0), np.nan)
