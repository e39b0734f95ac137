"""The simulated sensor: colour filters, noise by eq. (6) of the paper, then gain, offset, rounding and saturation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SimulatedSensor:
    """Converts light to DN; the defaults are those of the paper's camera.

    Parameters
    ----------
    offset_dn, gain_dn_per_e : float
        DN without electrons, and DN per electron.
    read_noise_e : float
        Standard deviation; the paper's variance is 12 e⁻².
    dark_current_e_per_s, quantum_efficiency : float
        Electrons per pixel and second without light; electrons per photon.
    saturation_dn : int
        Highest value of the converter.
    """

    offset_dn: float = 100.0
    gain_dn_per_e: float = 2.0
    read_noise_e: float = 12.0**0.5
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
