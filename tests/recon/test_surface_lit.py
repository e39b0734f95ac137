"""Samples with light, by the thresholds in closed form, on even views that nothing moves."""

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.surface.lit import lit_samples
from faintfield.recon.surface.pinhole_views import UNKNOWN
from tests.recon.surface_scene import CENTRES_MM, FOCAL_PX, NODES, READ_VARIANCE_E2, SHAPE, UNMOVED, views_of

EVERYWHERE = np.full(SHAPE, UNMOVED)

# The window of 1.5 samples averages as much noise as this many equal weights
WINDOW = 4 * np.pi * 1.5**2


def _lit(light_e: NDArray[np.floating], inverse_depth: NDArray[np.floating] = EVERYWHERE) -> NDArray[np.bool_]:
    return lit_samples(views_of(light_e), inverse_depth)


def _even(left_e: float, right_e: float | None = None, views: int = len(NODES)) -> NDArray[np.float64]:
    """Views of one brightness, or of two, whose border lies in the middle; all but the first of them know nothing."""
    light = np.full((len(NODES), *SHAPE), left_e)
    light[:, :, SHAPE[1] // 2 :] = left_e if right_e is None else right_e
    light[views:] = UNKNOWN
    return light


def test_light_of_four_standard_deviations_stands_out() -> None:
    views = 5
    share = 16 / (views * WINDOW)
    limit_e = (share + np.sqrt(share**2 + 4 * share * READ_VARIANCE_E2)) / 2
    assert not _lit(_even(0.98 * limit_e, views=views)).any()
    assert _lit(_even(1.02 * limit_e, views=views)).all()


def test_light_of_less_than_three_percent_of_the_level_does_not_count() -> None:
    # The level is that of the bright half, over √2
    for dim_e, stands_out in ((0.97 * 3 / np.sqrt(2), False), (1.03 * 3 / np.sqrt(2), True)):
        lit = _lit(_even(100.0, dim_e))
        assert lit[:, :30].all()
        assert (lit[:, 50:] == stands_out).all()


def test_noise_alone_is_not_light() -> None:
    generator = np.random.default_rng(3)
    noise = generator.normal(0, READ_VARIANCE_E2**0.5, (len(NODES), *SHAPE))
    assert not _lit(noise).any()


def test_the_light_is_that_at_the_depth_of_the_surface() -> None:
    # A disc around column 40 and row 30, so dim that one view alone would not stand out
    q = 1 / 300
    row, column = np.indices(SHAPE, float)
    light = np.array(
        [
            np.where(np.hypot(column + right * (q - UNMOVED) - 40, row + down * (q - UNMOVED) - 30) < 6, 0.5, 0)
            for right, down in FOCAL_PX * CENTRES_MM
        ]
    )
    lit = _lit(light, np.full(SHAPE, q))
    assert lit[30, 40]
    assert not lit[30, 60]
    assert not _lit(light)[30, 40]
