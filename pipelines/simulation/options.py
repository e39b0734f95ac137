"""Options of simulated and darkened sets, apart from the code that makes them: help is shown without loading that."""

from typing import Literal

import msgspec


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


class DarkeningOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of `faintfield darken`, as its help explains them and provenance.json records them."""

    snr: float = 0.16
    seed: int = 1
    exposure_s: float = 0.1
    # As of the paper's camera, see `rig.simulation.optics`
    read_noise_e: float = 12.0**0.5
    dark_current_e_per_s: float = 0.2
    quantum_efficiency: float = 0.5

    @property
    def dark_e(self) -> float:
        """Expected dark electrons per pixel and view."""
        return self.dark_current_e_per_s * self.exposure_s
