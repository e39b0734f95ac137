"""The start of every reconstruction: back-projection, and smooth positive samples."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.blur import blurred
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator, ViewSelection
from faintfield.recon.threads import elementwise

# Spacings of the blur, which has a standard deviation of 2 samples.
_START_BLUR = (1, 1, 1, 1, 2)

# Start level in electrons where the mean of the views is not positive: a start must be above zero.
_MIN_LEVEL_E = 1e-6


def back_projection(
    operator: SceneOperator, images: ElementalImages, views: ViewSelection = None, *, coverage: Image | None = None
) -> Image:
    """Return the mean of the views at each sample, `Hᵀ(g − b) / Hᵀ H 1`.

    Without flat field the denominator is s = Hᵀ 1, the number of views that contribute, as in the paper
    (docs/explanation/physics.md).

    Parameters
    ----------
    operator : SceneOperator
        H, such as a `PlaneOperator`.
    images : ElementalImages
        g, with the background b.
    views : sequence of int, optional
        The views that count; all by default.
    coverage : float array (samples), optional
        Hᵀ H 1, if it is known; else it is computed.

    Returns
    -------
    float array (samples)
        Electrons per detector pixel; zero where no view sees a sample.

    Examples
    --------
    A bright square, seen by three cameras:

    >>> import numpy as np
    >>> from faintfield import ElementalImages, Lens, PlaneGrid, PlaneOperator
    >>> from faintfield import back_projection, fronto_parallel_rt_ref_plane, plane_from_ray
    >>> lens = Lens((32, 24), fx_px=40.0, fy_px=40.0, cx_px=15.5, cy_px=11.5)
    >>> poses_rt_cam_ref = np.array([[0.0, 0.0, 0.0, x_mm, 0.0, 0.0] for x_mm in (20.0, 0.0, -20.0)])
    >>> homographies = plane_from_ray(poses_rt_cam_ref, fronto_parallel_rt_ref_plane(depth_mm=400.0))
    >>> grid = PlaneGrid.covering(-160.0, -120.0, 160.0, 120.0, pitch_mm=10.0)
    >>> operator = PlaneOperator(homographies, lens.rays(), grid)
    >>> plane_e = np.full(grid.shape, 2.0)
    >>> plane_e[8:16, 12:20] = 6.0
    >>> images = ElementalImages(operator.forward(plane_e), read_variance_e2=12.0)
    >>> back_projection(operator, images)[12, 9:15].round(1)
    array([2., 2., 2., 6., 6., 6.], dtype=float32)
    """
    light = operator.adjoint(images.electrons, views)
    if np.any(images.background_e):
        light -= operator.adjoint_of_map(images.background_e, views)
    coverage = operator.coverage(views) if coverage is None else coverage
    return np.divide(light, coverage, out=np.zeros_like(light), where=coverage > 0)


def smooth_start(operator: SceneOperator, images: ElementalImages, views: ViewSelection = None) -> Image:
    """Return positive samples to start from: the back-projection, blurred, at least a hundredth of its mean.

    The blur weights by coverage, so that samples that no view sees take the level of their neighbours. Several planes
    share the light, since the coverage of each counts what its pixels see of all.

    Parameters
    ----------
    operator : SceneOperator
        H, such as a `PlaneOperator`.
    images : ElementalImages
        g, with the background b.
    views : sequence of int, optional
        The views that count; all by default.

    Returns
    -------
    float array (samples)
        Electrons per detector pixel, above zero.

    Examples
    --------
    The edge of a bright square, blurred by two samples:

    >>> import numpy as np
    >>> from faintfield import ElementalImages, Lens, PlaneGrid, PlaneOperator
    >>> from faintfield import fronto_parallel_rt_ref_plane, plane_from_ray, smooth_start
    >>> lens = Lens((32, 24), fx_px=40.0, fy_px=40.0, cx_px=15.5, cy_px=11.5)
    >>> poses_rt_cam_ref = np.array([[0.0, 0.0, 0.0, x_mm, 0.0, 0.0] for x_mm in (20.0, 0.0, -20.0)])
    >>> homographies = plane_from_ray(poses_rt_cam_ref, fronto_parallel_rt_ref_plane(depth_mm=400.0))
    >>> grid = PlaneGrid.covering(-160.0, -120.0, 160.0, 120.0, pitch_mm=10.0)
    >>> operator = PlaneOperator(homographies, lens.rays(), grid)
    >>> plane_e = np.full(grid.shape, 2.0)
    >>> plane_e[8:16, 12:20] = 6.0
    >>> images = ElementalImages(operator.forward(plane_e), read_variance_e2=12.0)
    >>> smooth_start(operator, images)[12, 9:14].round(1)
    array([2.4, 2.9, 3.5, 4.3, 4.9], dtype=float32)
    """
    coverages = operator.planes_of(operator.coverage(views))
    lights = operator.planes_of(
        operator.adjoint(images.electrons, views) - operator.adjoint_of_map(images.background_e, views)
    )
    mean = sum(float(x.sum(dtype=np.float64)) for x in lights) / sum(float(x.sum(dtype=np.float64)) for x in coverages)
    level = max(mean, _MIN_LEVEL_E)
    starts = []
    for light, coverage in zip(lights, coverages, strict=True):
        covered = blurred(coverage, _START_BLUR)
        positive_mean = partial(_positive_mean, level, 1e-3 * float(covered.max()))
        starts.append(elementwise(positive_mean, blurred(light, _START_BLUR), covered))
    return operator.samples_of(starts)


def _positive_mean(level: float, least: float, light: Image, coverage: Image) -> Image:
    mean = np.full_like(light, level)
    np.divide(light, coverage, out=mean, where=coverage > least)
    return np.maximum(mean, 0.01 * level, out=mean)


def well_seen_samples(sensitivity: Image) -> NDArray[np.bool_]:
    """Return which samples represent a plane: those seen at least a hundredth as much as the best seen."""
    return np.asarray(sensitivity > 0.01 * sensitivity.max())


def mean_light_e(operator: SceneOperator, samples: Image) -> float:
    """Return the mean light of a pixel: the sum of the means over each plane's well-seen samples."""
    planes = zip(operator.planes_of(samples), operator.planes_of(operator.sensitivity()), strict=True)
    return sum(float(plane[well_seen_samples(seen)].mean(dtype=np.float64)) for plane, seen in planes)
