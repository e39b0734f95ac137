"""Drawings of how pixels differ: spectrograms and accumulated histograms of DSNU and PRNU, as EMVA 1288 has them."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from faintfield.calib.noise.emva.nonuniformity import accumulated_histogram, high_pass, spectrogram
from faintfield.pipelines.calibration.noise_emva import EmvaMeasurement, MeanImage
from faintfield.pipelines.pages.emva_drawing import MEASURED, MODEL, SECOND, Drawing, drawn

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def image_drawings(measured: EmvaMeasurement) -> Iterator[Drawing]:
    """Yield the spectrograms and histograms of one phase of the mosaic."""
    images = (measured.dark, "DSNU", "DN", 1.0), (measured.bright, "PRNU", "%", 100.0)
    for words, draw in (("spectrograms", _spectrograms), ("accumulated histogram", _histogram)):
        for image, what, unit, factor in images:
            title = f"{what} {words}"
            yield draw(measured, title, image, unit, factor) if image else _missing(measured, title, what)


def _missing(measured: EmvaMeasurement, title: str, what: str) -> Drawing:
    """Return the reason why there is no image for DSNU or PRNU."""
    why = measured.estimates[f"{what.lower()}_total{'_e' if what == 'DSNU' else ''}"].why
    return Drawing(title, "", missing=why or "there is no image")


def _spectrograms(measured: EmvaMeasurement, title: str, image: MeanImage, unit: str, factor: float) -> Drawing:
    """Draw the horizontal and the vertical spectrogram, as amplitudes."""
    spectra = [spectrogram(image.values, measured.used, axis) for axis in (1, 0)]

    def draw(axes: "Axes") -> None:
        for spectrum, colour, label in zip(spectra, (MEASURED, SECOND), ("horizontal", "vertical"), strict=True):
            axes.semilogy(spectrum.frequency, factor * np.sqrt(spectrum.power), lw=0.9, color=colour, label=label)
        white = factor * float(np.sqrt(np.mean([spectrum.white for spectrum in spectra])))
        axes.axhline(white, color=MODEL, lw=1, label="white part")
        left = factor * np.sqrt(image.noise.variances[0])
        axes.axhline(left, color=MODEL, lw=1, ls="--", label="temporal noise left in the mean")
        axes.set(xlabel="spatial frequency (cycles/pixel)", ylabel=f"amplitude ({unit})", xlim=(0, 0.5))
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** 0.5)  # room for the legend

    return drawn(title, _of(image) + " White noise is level at its standard deviation; a peak is a pattern.", draw)


def _histogram(measured: EmvaMeasurement, title: str, image: MeanImage, unit: str, factor: float) -> Drawing:
    """Draw one accumulated histogram, of all pixels: here outliers are what counts."""
    from scipy.special import erfc

    every, is_flat = np.ones_like(measured.used), image.series.conditions.kind == "flat"
    histogram = accumulated_histogram(high_pass(image.values, every) if is_flat else image.values, every)

    def draw(axes: "Axes") -> None:
        deviation = factor * histogram.deviation
        percent = 100 * erfc(histogram.deviation / (np.sqrt(2) * max(histogram.sigma, 1e-12)))
        axes.semilogy(deviation, histogram.percent, color=MEASURED, drawstyle="steps-pre", label="all pixels")
        axes.semilogy(deviation, percent, color=MODEL, ls="--", label="normal law")
        axes.set(xlabel=f"absolute deviation from the mean ({unit})", ylabel="pixels beyond (%)")
        axes.set_ylim(50 / measured.used.size, 200)
        axes.set_xlim(left=0)

    filtered = " Less its mean over 5 × 5 pixels." if is_flat else ""
    return drawn(title, _of(image) + filtered + " Unusable pixels are included: they are its tail.", draw)


def _of(image: MeanImage) -> str:
    """Return which image is shown."""
    is_of = image.series.conditions
    if is_of.kind == "dark":
        return f"Mean of {image.series.frames} darks of {is_of.exposure_s:g} s."
    return f"Mean of {image.series.frames} flats of {image.signal_dn:.4g} DN, dark and vignetting taken out."
