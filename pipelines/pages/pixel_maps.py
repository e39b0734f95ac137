"""Maps of a sensor's pixels as pictures, in colours no finer than the errors of the maps, and its unusable pixels."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from faintfield.calib.estimate import Estimate
from faintfield.calib.noise import NoiseCalibration
from faintfield.calib.noise.strips import Map, Mask, map_of, mean_over, release
from faintfield.pipelines.calibration.noise import Lattice
from faintfield.pipelines.pages.noise_plots import Drawing
from faintfield.pipelines.pages.page import INK, blank_drawing, colour_bar, ink, svg

# Most steps of a scale of colours, and the standard errors that it spans at least to either side of its middle.
_MAX_STEPS, _MIN_SPAN_SE = 255, 3.0

# The kinds of unusable pixels, and their colours.
_KINDS = {"hot": "#d55e00", "noisy": "#cc79a7", "dead": "#0072b2"}


class _PixelMap(NamedTuple):
    """A map (row, column), with that of its standard errors or of their squares; `why` there may be none.

    It is shown less a number, and times a factor. The variance is of posterior means whose prior has the `spread`.
    """

    title: str
    unit: str
    values: Map | None
    se: Map | None = None
    variance: Map | None = None
    spread: Estimate | None = None
    why: str | None = None
    less: float = 0.0
    factor: float = 1.0

    def error(self, usable: Mask) -> float:
        """Return the root mean square of the errors of usable pixels as shown, 0 where they are not known."""
        if self.variance is not None:
            variance = mean_over(self.variance.__getitem__, usable)
            hidden = hidden_variance(variance, self.spread) if self.spread else 0.0
            return self.factor * float(np.sqrt(variance + hidden))
        se = self.se
        return 0.0 if se is None else self.factor * float(np.sqrt(mean_over(lambda rows: np.square(se[rows]), usable)))


def hidden_variance(variance: float, spread: Estimate) -> float:
    """Return what the variance of posterior means grows by if the spread of their prior is at the end of its interval.

    A prior of variance s² gives the posterior variance V and keeps V/s² of a pixel's deviation from the mean, which may
    be as large as S: the variance is V + (V/s²)²(S² − s²). Infinite if the frames do not determine the spread.
    """
    if spread.value is None or spread.ci95 is None:
        return float("inf")
    kept = min(variance / max(spread.value**2, 1e-12), 1.0)
    return kept**2 * (spread.ci95[1] ** 2 - spread.value**2)


def map_drawings(calibration: NoiseCalibration, lattice: Lattice, side_px: int) -> Iterator[Drawing]:
    """Yield the maps of one phase; their longer side has `side_px` means of pixels at most."""
    maps, usable = calibration.maps, ~calibration.maps.unusable
    relative, vignetting, pattern = maps.relative_response, maps.vignetting, None
    if relative is not None and vignetting is not None:
        pattern = map_of(lambda rows: relative[rows] / np.maximum(vignetting[rows], 1e-3), relative.shape)
    current, current_variance = maps.dark_current_e_per_s, maps.dark_current_variance_e2_per_s2
    estimates = calibration.estimates
    no_current, no_flats = estimates["dark_current_e_per_s"].why, "there are no flats"
    dsnu, dcnu = estimates["dsnu_dn"], estimates["dcnu_e_per_s"]
    no_read, no_gain = (maps.absent.get(name) for name in ("read_noise_e", "gain_dn_per_e"))
    se = maps.relative_response_se
    for pixel_map in (
        _PixelMap("Offset", "DN", maps.offset_dn, variance=maps.offset_variance_dn2, spread=dsnu),
        _PixelMap("Dark current", "e⁻/s", current, variance=current_variance, spread=dcnu, why=no_current),
        _PixelMap("Read noise", "e⁻", maps.read_noise_e, maps.read_noise_se_e, why=no_read),
        _PixelMap("Gain", "DN/e⁻", maps.gain_dn_per_e, maps.gain_se_dn_per_e, why=no_gain),
        _PixelMap("Response to light, vignetting included", "of its mean", relative, se, why=no_flats),
        _PixelMap("Response to light, vignetting taken out", "%", pattern, se, why=no_flats, less=1.0, factor=100.0),
    ):
        yield _drawn(pixel_map, usable, lattice, side_px)
        release()
    yield _unusable_pixels(calibration, lattice, side_px)


def colour_scale(low: float, high: float, error: float) -> tuple[float, float, int]:
    """Return first and last value of a scale for values from `low` to `high`, and its number of steps.

    No step is smaller than the error. The number is odd, so that values that do not differ have the middle colour.
    """
    middle, half = (low + high) / 2, max((high - low) / 2, _MIN_SPAN_SE * error, 1e-6)
    steps = int(min(2 * half / error, _MAX_STEPS) - 1) | 1 if error else _MAX_STEPS
    return middle - half, middle + half, steps


def _drawn(pixel_map: _PixelMap, usable: Mask, lattice: Lattice, side_px: int) -> Drawing:
    """Return a map; one step of its colours is no smaller than the error of what it shows."""
    title, unit, values, *_ = pixel_map
    if values is None or not usable.any():
        return Drawing(title, missing=pixel_map.why or "no pixel is usable")
    step = _step(values.shape, side_px)
    shown = pixel_map.factor * (_means(values, usable, step) - pixel_map.less)
    if not np.nanmin(shown) < np.nanmax(shown):
        return Drawing(title, missing="it is the same for all pixels")
    # Pixels of a row or of a column may share their errors: a mean over a square counts as one over its side
    error = pixel_map.error(usable) / float(np.sqrt(step))
    low, high = np.nanquantile(shown, [0.005, 0.995])
    known = np.isfinite(error)
    first, last, steps = colour_scale(low, high, error if known else 0.0)
    figure, axes, extent = _blank_map(values.shape, lattice)
    colours = colormaps["viridis"].resampled(steps)
    image = axes.imshow(shown, colours, extent=extent, interpolation="none", vmin=first, vmax=last)
    colour_bar(figure, image, axes, unit)
    what = "a pixel" if step == 1 else f"a mean over {step} × {step} pixels, at most"
    caption = f"Standard error of {what}: {error:.2g} {unit}; no step of the colours is finer." if error else ""
    if pixel_map.spread and not known:
        caption = f"Standard error: not known, and differences may be chance: {pixel_map.spread.why}."
    elif high - low < (last - first) / steps:
        caption += " The frames resolve no difference between 99 % of them."
    return Drawing(title, caption, svg(figure))


def _unusable_pixels(calibration: NoiseCalibration, lattice: Lattice, side_px: int) -> Drawing:
    """Return the places of unusable pixels by kind, as dots that are larger than the pixels."""
    title, masks = "Unusable pixels", {kind: getattr(calibration.pixels, kind) for kind in _KINDS}
    if not calibration.maps.unusable.any():
        return Drawing(title, missing="no pixel is hot, noisy or dead")
    figure, axes, extent = _blank_map(calibration.maps.unusable.shape, lattice)
    for (kind, mask), colour in zip(masks.items(), _KINDS.values(), strict=True):
        share = _means(mask, np.ones_like(mask), _step(mask.shape, side_px))
        dots = cv2.dilate(share, np.ones((2, 2))) > 0
        axes.imshow(np.where(dots, 1.0, np.nan), ListedColormap([colour]), extent=extent, interpolation="none")
        axes.plot([], [], "s", color=colour, label=f"{mask.sum()} {kind}")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False, labelcolor=INK)
    return Drawing(title, "They are left out of every number.", svg(figure))


def _blank_map(shape: tuple[int, ...], lattice: Lattice) -> tuple[Figure, Axes, tuple[float, float, float, float]]:
    """Return a drawing for a map (row, column), and the extent of the map in it, in pixels of the sensor."""
    (height, width), (top, left), (down, across) = shape, lattice.first, lattice.period
    figure, axes = blank_drawing(5.6, float(np.clip(4.2 * height / width, 1.5, 6.0)) + 0.7)
    axes.set(xlabel="column (px)", ylabel="row (px)")
    ink(axes)
    right, bottom = left + (width - 0.5) * across, top + (height - 0.5) * down
    return figure, axes, (left - 0.5 * across, right, bottom, top - 0.5 * down)


def _step(shape: tuple[int, ...], side_px: int) -> int:
    return -(-max(shape) // side_px)


def _means(values: NDArray[Any], usable: Mask, step: int) -> NDArray[np.float64]:
    """Return the means of usable pixels over squares of a side (row, column), NaN where there are none."""
    height, width = values.shape
    columns, lines = np.arange(0, width, step), []
    for top in range(0, height, step):
        used = usable[top : top + step]
        total = np.where(used, values[top : top + step], 0).sum(axis=0, dtype=np.float64)
        count = np.add.reduceat(used.sum(axis=0, dtype=np.float64), columns)
        lines.append(np.add.reduceat(total, columns) / np.where(count, count, np.nan))
    return np.array(lines)
