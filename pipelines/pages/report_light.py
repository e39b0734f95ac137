"""The photon budget of a set in a report: the light on a pixel by each formula, and the noise of its variance."""

from dataclasses import dataclass

from msgspec import UNSET

from faintfield.pipelines.formats.results.records import Overview
from faintfield.recon.metrics import noise_variance_e2


@dataclass(frozen=True)
class LightRow:
    """Light per pixel by one formula: electrons and photons of one view, photons per second, photons of all views."""

    words: str
    electrons: float
    photons: float | None = None
    flux: float | None = None
    all_views: float | None = None


@dataclass(frozen=True)
class Share:
    """A part of the variance of a pixel, in e⁻² and as a share of the whole."""

    words: str
    e2: float
    share: float


@dataclass(frozen=True)
class PhotonBudget:
    """The light on a pixel, in photons too if `in_photons`, and the variance of eq. (6) with its parts."""

    light: list[LightRow]
    in_photons: bool
    variance_e2: float
    shares: list[Share]


def photon_budget(overview: Overview) -> PhotonBudget | None:
    """Return the photon budget of a set, None without light, or if its dark level is not recorded.

    Light is in electrons, and in photons too if the quantum efficiency is known.
    """
    light, exposure_s, dark_e = overview.brightness, overview.exposure_s, overview.dark_e
    signal_e = light.mean_signal_e
    if dark_e is UNSET or signal_e <= 0:
        return None
    by_formula = (
        ("the paper’s linear formula, eq. (7)", light.electrons_linear),
        ("moments: a uniform object of this SNR, eq. (4) being a ratio of powers", light.electrons_from_moments),
        ("counted: mean signal above dark", signal_e),
    )
    variance = noise_variance_e2(
        signal_e / exposure_s,
        exposure_s,
        quantum_efficiency=1.0,
        dark_current_e_per_s=dark_e / exposure_s,
        read_noise_e=overview.read_noise_e,
    )
    parts = (("read noise", overview.read_noise_e**2), ("light", signal_e), ("dark current", dark_e))
    return PhotonBudget(
        light=[_light_row(words, electrons, overview) for words, electrons in by_formula if electrons is not None],
        in_photons=overview.quantum_efficiency is not None,
        variance_e2=variance,
        shares=[Share(words, part, part / variance) for words, part in parts],
    )


def _light_row(words: str, electrons: float, overview: Overview) -> LightRow:
    """Return light per pixel in all its units."""
    if overview.quantum_efficiency is None:
        return LightRow(words, electrons)
    photons = electrons / overview.quantum_efficiency
    return LightRow(words, electrons, photons, photons / overview.exposure_s, photons * overview.views)
