"""Faults of planes by priors: patterns in flat light and in the dark, and bright specks."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.arguments import PriorName, SolverOptions
from faintfield.pipelines.paper.figure4 import SNRS, StagedObject, stage_object
from faintfield.pipelines.reconstruction.planes.solve import solve
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.metrics import signal_scale_for_snr
from faintfield.recon.solver.initialization import back_projection
from faintfield.rig.simulation.scene import TexturedPlane

# Bands of spatial frequency, in cycles per sample.
BANDS = tuple(np.linspace(0, 0.5, 7).tolist())

# Standard deviation of the Gaussian that smooths a residual before its largest pattern is sought, in samples.
_PATTERN_BLUR = 3.0

# Share of the plane that is left out along each side: fewer views see it, and beyond it lies light without samples.
_RIM = 1 / 8

# A speck is brighter than this many medians of the 5 x 5 samples around it, and than so many standard deviations.
_MEDIANS, _DEVIATIONS, _WINDOW = 3.0, 3.0, 5

# Light of the truth, relative to white, below which a sample is dark; its neighbours must be dark, too.
_DARK = 0.02

# Width of a field, wider than the reference view, and its depth.
_FIELD_MM, _DEPTH_MM = 520.0, 600.0


@dataclass(frozen=True)
class Residual:
    """The residual of a plane, `plane − truth`, of one field by one method.

    Attributes
    ----------
    rms : float
        Its root mean square, in σ, the standard deviation of the back-projection's residual.
    pattern : float
        Its largest absolute value after smoothing, in σ.
    pattern_of_tv : float
        The same in standard deviations of total variation's smoothed residual.
    bands : tuple of float
        Its power by band of spatial frequency, relative to that of white noise of deviation σ.
    """

    field: str
    method: str
    rms: float
    pattern: float
    pattern_of_tv: float
    bands: tuple[float, ...]


def residuals_of_fields(priors: tuple[PriorName, ...], size_px: tuple[int, int], seed: int) -> Iterator[Residual]:
    """Yield the residuals of noise alone, of an even field and of a gradient, at the light of SNR 0.16."""
    rows, columns = 39, 52
    even = np.ones((rows, columns), np.float32)
    gradient = np.broadcast_to(np.linspace(0.2, 1, columns, dtype=np.float32), even.shape)
    for name, reflectance, light in (("noise alone", even, 0), ("even", even, 1), ("gradient", gradient, 1)):
        pose = (0.0, 0.0, 0.0, 0.0, 0.0, _DEPTH_MM)
        shown = TexturedPlane(name, np.ascontiguousarray(reflectance), even, _FIELD_MM / columns, pose)
        yield from _residuals(name, stage_object(shown, size_px), light, priors, seed)


def _residuals(
    name: str, stage: StagedObject, light: float, priors: tuple[PriorName, ...], seed: int
) -> Iterator[Residual]:
    """Yield the residuals of one field by back-projection and by each prior; `light` is 0 for noise alone."""
    sensor = stage.experiment.sensor
    dark_e = sensor.dark_current_e_per_s * stage.experiment.exposure_s
    in_region = stage.light[stage.experiment.reference_view][stage.region]
    scale_e = light * signal_scale_for_snr(in_region, SNRS[0], dark_e, sensor.read_noise_e)
    generator = np.random.default_rng(seed)
    electrons = generator.poisson(stage.light * scale_e + dark_e) + generator.normal(
        0, sensor.read_noise_e, stage.light.shape
    )
    images = ElementalImages(electrons.astype(np.float32), dark_e, sensor.read_noise_e**2)
    planes = {"back-projection": back_projection(stage.operator, images)}
    planes |= {prior: solve(stage.operator, images, "pmlem", SolverOptions(prior=prior)).plane for prior in priors}
    inside = tuple(slice(round(size * _RIM), round(size * (1 - _RIM))) for size in stage.bright.shape)
    of = {method: (plane - stage.bright * scale_e)[inside] for method, plane in planes.items()}
    sigma, sigma_of_tv = float(of["back-projection"].std()), float(smoothed(of["tv"]).std())
    for method, residual in of.items():
        largest = float(np.abs(smoothed(residual)).max())
        rms = float(np.sqrt(np.mean(np.square(residual, dtype=np.float64)))) / sigma
        bands = tuple(power / sigma**2 for power in power_by_band(residual))
        yield Residual(name, method, rms, largest / sigma, largest / max(sigma_of_tv, 1e-12), bands)


def smoothed(residual: Image) -> Image:
    """Return a residual (row, column) smoothed so that patterns of several samples stand out."""
    return np.asarray(cv2.GaussianBlur(residual, (0, 0), _PATTERN_BLUR))


def power_by_band(residual: Image) -> tuple[float, ...]:
    """Return the mean power of a residual (row, column) in each band; white noise has its variance in all of them."""
    rows, columns = residual.shape
    taper = np.outer(np.hanning(rows), np.hanning(columns))
    power = np.abs(np.fft.fft2(residual * taper)) ** 2 / np.sum(taper**2)
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.fftfreq(columns))
    band = np.digitize(frequency, BANDS[1:], right=True)
    return tuple(float(power[band == index].mean()) for index in range(len(BANDS) - 1))


def dark_samples(stage: StagedObject) -> NDArray[np.bool_]:
    """Return the samples (row, column) of a plane that are dark with all their neighbours."""
    lit = (stage.bright > _DARK) | stage.region[stage.window]
    return np.asarray(cv2.dilate(lit.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)


def specks(plane: Image, dark: NDArray[np.bool_], sigma: float) -> NDArray[np.bool_]:
    """Return the dark samples (row, column) that shine by themselves: far above those around them and above σ."""
    plane = np.asarray(plane, np.float32)
    around = cv2.medianBlur(plane, _WINDOW)
    return np.asarray(dark & (plane > _MEDIANS * around) & (plane > _DEVIATIONS * sigma))
