"""Result of a noise calibration: each quantity with its standard error, or the reason why it has no value."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.errors import NotIdentifiable
from faintfield.calib.estimate import Estimate
from faintfield.calib.noise.maps.measure import NoiseMaps
from faintfield.calib.noise.misfit import SeriesGoodness, TransferPoint
from faintfield.calib.noise.series.flats import Saturation
from faintfield.calib.noise.strips import Array, Mask
from faintfield.calib.noise_model import BentResponse, Map, NoiseModel

# Quantities without which there is no noise model.
_REQUIRED = ("offset_dn", "gain_dn_per_e", "read_noise_e")


@dataclass(frozen=True)
class Histogram:
    """Observed and predicted values of one dark series.

    Attributes
    ----------
    exposure_s : float
        Exposure time.
    value_dn : array (value,)
        All digital numbers from the lowest to the highest.
    count, expected : array (value,)
        Number of times each occurred among the sampled pixels and frames, and its expectation by the fit.
    """

    exposure_s: float
    value_dn: NDArray[np.int64]
    count: NDArray[np.int64]
    expected: Array


@dataclass(frozen=True)
class NoiseCalibration:
    """Result of `calib.noise.calibrate`.

    Attributes
    ----------
    estimates : dict of Estimate
        `offset_dn, gain_dn_per_e, read_noise_e, read_noise_dn, dark_current_e_per_s, dark_signal_dn_per_s, dsnu_e,
        dsnu_dn, dsnu_row_dn, dsnu_column_dn, dcnu_e_per_s, frame_jitter_dn, row_noise_dn, column_noise_dn, prnu,
        quantum_efficiency, nonlinearity_per_dn, linearity_error, saturation_e, noise_error, drift_dn, light_error,
        lamp_flicker`.
    covariance : tuple (names, array)
        Covariance of those of offset, gain, read noise and dark current that have values.
    likelihood : str
        Name of the likelihood that was used.
    maps : NoiseMaps
        Maps per pixel.
    hot, noisy, dead : array (row, column), bool
        The kinds of unusable pixels.
    telegraph : array (row, column), bool
        Pixels that jump between two levels; those that are not among the noisy ones are used.
    variance_ratio : array (row, column)
        Variance of each pixel over the frames, divided by that of the model.
    points : tuple of TransferPoint
        Photon transfer and dark signal of each series.
    histograms : tuple of Histogram
        Values of the shortest and the longest darks with their prediction; empty if the gain is unknown.
    saturation_dn : float
        Value from which a pixel is saturated, as stated or found.
    saturation : Saturation
        Saturation of the flats, and those that are left out.
    response : BentResponse, optional
        Bend of the response where the flats show one.
    goodness : tuple of SeriesGoodness
        Goodness of fit of each series that was used.
    warnings : tuple of str
        Problems of the frames.
    """

    estimates: dict[str, Estimate]
    covariance: tuple[tuple[str, ...], Array]
    likelihood: str
    maps: NoiseMaps
    hot: Mask
    noisy: Mask
    dead: Mask
    telegraph: Mask
    variance_ratio: NDArray[np.float32]
    points: tuple[TransferPoint, ...]
    histograms: tuple[Histogram, ...]
    saturation_dn: float
    saturation: Saturation
    response: BentResponse | None
    goodness: tuple[SeriesGoodness, ...]
    warnings: tuple[str, ...]

    def noise_model(self, *, per_pixel: bool = True) -> NoiseModel:
        """Return the noise model for a reconstruction, per pixel or as single numbers.

        The gain does not include the photo response, which belongs to the light: see `maps.relative_response`.

        Raises
        ------
        NotIdentifiable
            Offset, gain or read noise has no value.
        """
        values = {name: self.estimates[name].value for name in (*_REQUIRED, "dark_current_e_per_s")}
        for name in _REQUIRED:
            if values[name] is None:
                raise NotIdentifiable(f"{name}: no value: {self.estimates[name].why}")
        efficiency = self.estimates["quantum_efficiency"].value
        fields: dict[str, Map] = {name: value or 0.0 for name, value in values.items()}
        fields["dark_current_e_per_s"] = max(values["dark_current_e_per_s"] or 0.0, 0.0)
        if per_pixel:
            maps = {name: getattr(self.maps, name) for name in fields}
            fields |= {name: values for name, values in maps.items() if values is not None}
        return NoiseModel(
            **fields,
            quantum_efficiency=None if efficiency is None else min(efficiency, 1.0),
            saturation_dn=self.saturation_dn,
            response=self.response,
        )
