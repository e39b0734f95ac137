"""Options of simulated and darkened sets, apart from the code that makes them: help is shown without loading that."""

from dataclasses import dataclass
from typing import Literal

import msgspec
from cyclopts import Parameter

from faintfield.pipelines.arguments import Fraction, NotNegative, Positive, Seed


class SyntheticOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of `faintfield simulate`, as its help explains them and provenance.json records them."""

    snr: float = 0.16
    seed: int = 1
    rows: int = 7
    columns: int = 7
    pitch_mm: float = 50.0
    size_px: tuple[int, int] = (640, 480)
    exposure_s: float = 0.1
    position_error_mm: float = 0.3
    rotation_error_mrad: float = 3.5
    poses: Literal["true", "nominal"] = "true"
    colour: Literal["grey", "bayer"] = "grey"
    # Sets of toys, which were the only ones once, do not record it
    objects: Literal["toys", "surfaces"] | msgspec.UnsetType = msgspec.UNSET


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DarkeningOptions:
    """Options of `faintfield darken`, as provenance.json records them; the camera is by default the paper's.

    Parameters
    ----------
    snr
        SNR of the reference view, eq. (4).
    seed
        Seed of the random generator.
    exposure_s
        Exposure of each dark view.
    read_noise_e
        Standard deviation of the dark camera's read noise.
    dark_current_e_per_s
        Dark electrons per pixel and second of the dark camera.
    quantum_efficiency
        Electrons per photon of the dark camera.
    """

    snr: Positive = 0.16
    seed: Seed = 1
    exposure_s: Positive = 0.1
    # As of the paper's camera, see `rig.simulation.optics`
    read_noise_e: NotNegative = 12.0**0.5
    dark_current_e_per_s: NotNegative = 0.2
    quantum_efficiency: Fraction = 0.5

    @property
    def dark_e(self) -> float:
        """Expected dark electrons per pixel and view."""
        return self.dark_current_e_per_s * self.exposure_s
