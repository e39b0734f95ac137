"""The simulated camera's lens and sensor: the ray of each detector sample, the light that reaches it, and its noise.

This module shares no code with `calib` or `recon`, so that both can be tested against it.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

type Points = NDArray[np.float64]


@dataclass(frozen=True)
class SimulatedOptics:
    """A lens and its detector, of width and height `size_px`; the centre of the first pixel is (0, 0).

    `distortion` has up to eight coefficients in OpenCV's order k1, k2, p1, p2, k3, k4, k5, k6. With vignetting, light
    falls off with the fourth power of the cosine of the field angle.
    """

    size_px: tuple[int, int]
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()
    vignetting: bool = True

    def rays(self, samples_per_px: int = 1) -> NDArray[np.float32]:
        """Return x, y at unit depth of every detector sample, (row, column, 2).

        The samples are spread evenly over each pixel, so that their mean is the mean over the pixel's area.
        """
        return _rays(self, samples_per_px)

    def relative_illumination(self) -> NDArray[np.float32]:
        """Return the light (row, column) of a scene of uniform radiance, relative to the optical axis."""
        return _relative_illumination(self)

    def ideal(self) -> "SimulatedOptics":
        """Return the optics without distortion and vignetting."""
        return SimulatedOptics(self.size_px, self.fx_px, self.fy_px, self.cx_px, self.cy_px, (), vignetting=False)


@lru_cache(maxsize=8)
def _rays(optics: SimulatedOptics, samples_per_px: int) -> NDArray[np.float32]:
    """Return the rays of a lens, cached because a capture uses the same lens for every frame."""
    width, height = optics.size_px
    inside = (np.arange(samples_per_px) + 0.5) / samples_per_px - 0.5
    columns = (np.arange(width)[:, np.newaxis] + inside).ravel()
    rows = (np.arange(height)[:, np.newaxis] + inside).ravel()
    x, y = np.meshgrid((columns - optics.cx_px) / optics.fx_px, (rows - optics.cy_px) / optics.fy_px)
    rays = np.stack(_undistort(x, y, optics.distortion), axis=-1).astype(np.float32)
    rays.flags.writeable = False
    return rays


@lru_cache(maxsize=8)
def _relative_illumination(optics: SimulatedOptics) -> NDArray[np.float32]:
    """Return cos⁴ of the angle of each pixel's ray, cached as the rays are."""
    if not optics.vignetting:
        return np.ones(optics.size_px[::-1], np.float32)
    x, y = np.moveaxis(optics.rays(), -1, 0)
    illumination: NDArray[np.float32] = 1 / (1 + x * x + y * y) ** 2
    illumination.flags.writeable = False
    return illumination


def distort(x: Points, y: Points, distortion: tuple[float, ...]) -> tuple[Points, Points]:
    """Return where the lens images rays x, y, in units of the focal length (rational model of OpenCV)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, *[0.0] * (8 - len(distortion)))
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@np.errstate(all="ignore")  # where the distortion folds, the iteration diverges
def _undistort(x_image: Points, y_image: Points, distortion: tuple[float, ...]) -> tuple[Points, Points]:
    """Invert `distort` by Newton's method, with a Jacobian from central differences."""
    x, y = x_image.copy(), y_image.copy()
    if not any(distortion):
        return x, y
    step = 1e-5
    for _ in range(20):
        x_now, y_now = distort(x, y, distortion)
        error_x, error_y = x_now - x_image, y_now - y_image
        if max(np.abs(error_x).max(), np.abs(error_y).max()) < 1e-10:
            return x, y
        dx_right, dy_right = distort(x + step, y, distortion)
        dx_left, dy_left = distort(x - step, y, distortion)
        dx_down, dy_down = distort(x, y + step, distortion)
        dx_up, dy_up = distort(x, y - step, distortion)
        xx, yx = (dx_right - dx_left) / (2 * step), (dy_right - dy_left) / (2 * step)
        xy, yy = (dx_down - dx_up) / (2 * step), (dy_down - dy_up) / (2 * step)
        determinant = xx * yy - xy * yx
        x -= (yy * error_x - xy * error_y) / determinant
        y -= (xx * error_y - yx * error_x) / determinant
    raise ValueError(f"distortion {distortion} cannot be inverted over the whole detector; take smaller coefficients")


@dataclass(frozen=True)
class SimulatedSensor:
    """Converts light to DN, with the noise of eq. (6) of the paper; the defaults are those of the paper's camera."""

    offset_dn: float = 100.0
    gain_dn_per_e: float = 2.0
    read_noise_e: float = 12.0**0.5  # standard deviation
    dark_current_e_per_s: float = 0.2
    quantum_efficiency: float = 0.5
    saturation_dn: int = 65535

    def __post_init__(self) -> None:
        if not 0 < self.saturation_dn <= 65535:
            raise ValueError(f"saturation_dn must lie within 1…65535 for a 16-bit file, got {self.saturation_dn}")

    def expose(
        self, photons_per_px: NDArray[np.floating], exposure_s: float, generator: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Return one frame (row, column) in DN, given the expected photons on each pixel during the exposure."""
        expected_e = self.quantum_efficiency * photons_per_px + self.dark_current_e_per_s * exposure_s
        electrons = generator.poisson(expected_e) + generator.normal(0.0, self.read_noise_e, expected_e.shape)
        return self.digitise(electrons)

    def digitise(self, electrons: NDArray[np.floating]) -> NDArray[np.uint16]:
        """Return electrons as integer DN within the converter's range."""
        dn = np.rint(electrons * self.gain_dn_per_e + self.offset_dn)
        return np.clip(dn, 0, self.saturation_dn).astype(np.uint16)


def through_mosaic(light: NDArray[np.floating], mosaic: tuple[str, ...]) -> NDArray[np.floating]:
    """Return the light (row, column) behind the colour filters of a mosaic, from light (row, column, RGB)."""
    rows, columns = np.indices(light.shape[:2])
    colours = np.array([["RGB".index(letter) for letter in row] for row in mosaic])
    chosen = colours[rows % colours.shape[0], columns % colours.shape[1]]
    return np.take_along_axis(light, chosen[:, :, np.newaxis], axis=2)[:, :, 0]
