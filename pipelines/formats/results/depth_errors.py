"""`depth_errors.json`: how far the depths of a map or a surface are from the true ones, where a set brings these."""

import msgspec

DEPTH_ERRORS_FILE = "depth_errors.json"


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
