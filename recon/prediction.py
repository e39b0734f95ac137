"""Prediction of a capture: the noise of a sample, the smallest contrast, and how sure a depth is.

All of it follows from the Fisher information of one pixel about its light, added up over the views. Light and noise are
those of one view: where a view is the sum of several frames, so are they.
"""

import math

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import read_noise_share

# Sum of the squared bilinear weights of the pixels that meet a sample over the sum of the weights, 2/3 along each axis,
# where pixels as wide as samples fall evenly on all places between these.
_SPREAD_EVENLY = 4 / 9

# Harmonics of the mean square of the weights over a pixel: what is left out is below 0.001.
_HARMONICS = 300

# Steps of the integral over the width of a feature, and how many deviations of the blur beyond a pixel it goes.
_STEPS, _DEVIATIONS = 2000, 10


def pixel_information(mean_e: float, read_noise_e: float) -> float:
    """Return the Fisher information in 1/(e⁻)² of a pixel `Poisson(λ) + N(0, σ²)` about its mean λ.

    It lies between 1/λ, without read noise, and 1/(λ + σ²). From 3 e⁻ of read noise on, and above 100 e⁻ of light, it
    is what the likelihood `auto` makes of a pixel, 1/(λ + σ²): 5 % less at most.
    """
    variance_e2 = mean_e + read_noise_share(mean_e, read_noise_e) * read_noise_e**2
    return math.inf if variance_e2 == 0 else 1 / variance_e2


def information_of_views(
    light_e: float, dark_e: float, read_noise_e: float, response: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return the information in 1/(e⁻)² of one pixel of each view about a sample, (view,).

    Parameters
    ----------
    light_e, dark_e, read_noise_e : float
        Expected electrons of light where the response is 1, those of dark current, and read noise.
    response : array (view,)
        Relative response where each view sees the sample (vignetting); 0 where it does not.
    """
    mean_e = light_e * float(np.mean(response)) + dark_e
    known_e2 = 1 / pixel_information(mean_e, read_noise_e) - mean_e + dark_e
    variance_e2 = response * light_e + known_e2
    information = np.zeros_like(variance_e2)
    np.divide(response**2, variance_e2, out=information, where=response > 0)
    return information


def interpolation(views: int) -> float:
    """Return `Σ h² / Σ h` of the bilinear weights h of the pixels that meet a sample on the axis.

    The pixels of the reference view lie on the samples, those of the other views on all places between them.
    """
    return _SPREAD_EVENLY + (1 - _SPREAD_EVENLY) / views


def interpolation_at(shifts_px: NDArray[np.floating], error_px: float) -> float:
    """Return the expected `interpolation` of views that are moved by shifts (view, 2), each with a normal error.

    Along an axis, Σ h² is `φ² + (1 − φ)² = 2/3 + Σ_k 2/(π k)² cos 2πkφ` at a part φ of a pixel, and the error damps its
    harmonics. Without any it is 1 at whole pixels, and 1/2 halfway. The reference view, which is not moved, has none.
    """
    order = np.arange(1, _HARMONICS + 1)
    error_px2 = np.where(shifts_px.any(axis=1), error_px, 0.0) ** 2
    damped = np.exp(-2 * (np.pi * order) ** 2 * error_px2[:, np.newaxis]) * 2 / (np.pi * order) ** 2
    along = 2 / 3 + np.sum(damped[:, np.newaxis] * np.cos(2 * np.pi * order * shifts_px[..., np.newaxis]), axis=-1)
    return float(along.prod(axis=1).mean())


def sample_sigma_e(information: float, spread: float) -> float:
    """Return the standard deviation in electrons of a sample of the unpenalised estimate, of samples as wide as pixels.

    The estimate is the back-projection, or for other than Gaussian noise one step of maximum likelihood from a smooth
    start, `f − ∇L/W` with W the row sums of the Hessian. Its variance is `Σ h² I / (Σ h I)²` over the pixels that meet
    the sample with weights h (`interpolation`). A penalty lowers it.

    Parameters
    ----------
    information, spread : float
        In 1/(e⁻)², summed over the views that see the sample, times the part of the pixels that have its colour; and
        `interpolation` or `interpolation_at` of these views.
    """
    return math.sqrt(spread / information)


def feature_area_px2(side_px: float, blur_px: float = 0.0) -> float:
    """Return the area in px² that counts of a square of a given side: the sum over pixels of its squared share in each.

    It is `side²` of a large square, and less of a small one, whose light pixels share with its surroundings: along each
    axis `side − 1/3` from one pixel on, in the mean over its places between pixels. The side is parallel to the pixels;
    `blur_px` is the standard deviation of the blur by the lens.
    """
    return _length_px(side_px, blur_px) ** 2


def smallest_contrast(
    side_px: float, light_e: float, information: float, *, k: float = 5.0, blur_px: float = 0.0
) -> float:
    """Return the contrast at which a square stands out of its surroundings by k standard deviations (Rose 1948).

    Its light differs from that of its surroundings, `light_e`, by this fraction. All pixels of all views that show it
    count, weighted by its share in each. Above 1 even a black square is not visible. `information` is as for
    `sample_sigma_e`, `side_px` and `blur_px` as for `feature_area_px2`.
    """
    return k / (light_e * math.sqrt(information * feature_area_px2(side_px, blur_px)))


def depth_sigma_mm(
    depth_mm: float,
    f_px: float,
    centres_mm: NDArray[np.floating],
    information: NDArray[np.floating],
    *,
    side_px: float,
    difference_e: float,
    blur_px: float = 0.0,
) -> float:
    """Return the Cramér–Rao bound of the depth of a square, found together with what it looks like.

    A change of depth by dz moves the square in the view of a camera at c by `f c dz / z²`, so the information of its
    pixels about z is `(f/z²)² Σ c² I · Σ (∂λ/∂x)²`, with c measured from the mean of the cameras: a movement common to
    all views says nothing. It assumes that the square is visible at all, or the depth found may be that of noise.

    Parameters
    ----------
    depth_mm, f_px : float
        Depth, and focal length in pixels.
    centres_mm, information : array (view, 2), array (view,)
        Positions of the cameras in the plane of the grid, and `information_of_views` times the part of the pixels that
        have a colour.
    side_px, blur_px, difference_e : float
        As for `feature_area_px2`, and the difference of the square's light to that of its surroundings.
    """
    mean_mm = information @ centres_mm / information.sum()
    spread = float(information @ np.square(centres_mm - mean_mm).sum(axis=1))
    edges = 2 * (_overlap(0.0, blur_px) - _overlap(side_px, blur_px))
    slopes_e2 = difference_e**2 * edges * _length_px(side_px, blur_px)
    return math.inf if spread == 0 else depth_mm**2 / (f_px * math.sqrt(spread * slopes_e2))


def depth_resolution_mm(depth_mm: float, f_px: float, aperture_mm: float) -> float:
    """Return the change of depth that moves a point by one pixel between the outermost views, `z² / (f B)`.

    It follows from the disparity `d = f B / z` (Gallup, Frahm, Mordohai and Pollefeys, CVPR 2008).
    """
    return depth_mm**2 / (f_px * aperture_mm)


def _length_px(side_px: float, blur_px: float) -> float:
    """Return the sum over pixels of the squared share of a bar of this width in each, along one axis."""
    at = np.linspace(0.0, min(side_px, 1 + _DEVIATIONS * blur_px), _STEPS + 1)
    return 2 * float(np.trapezoid([(side_px - u) * _overlap(u, blur_px) for u in at.tolist()], at))


def _overlap(shift_px: float, blur_px: float) -> float:
    """Return the overlap of two pixels along an axis, both blurred by the lens; without blur 1 at no shift."""
    left, centre, right = (_mean_distance(shift_px + step, blur_px) for step in (-1, 0, 1))
    return (left + right) / 2 - centre


def _mean_distance(x: float, blur_px: float) -> float:
    """Return the mean of |x + n|, with n the sum of two normal numbers of this deviation."""
    if blur_px == 0:
        return abs(x)
    return x * math.erf(x / (2 * blur_px)) + 2 * blur_px / math.sqrt(math.pi) * math.exp(-((x / (2 * blur_px)) ** 2))
