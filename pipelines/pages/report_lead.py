"""The numbers that a report begins with: how dark it was, and how well the camera is known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from faintfield.pipelines.formats.results.records import GeometryErrors, PlaneErrors
from faintfield.pipelines.pages.page import figure
from faintfield.pipelines.pages.report_calibration import GeometrySection, NoiseSection
from faintfield.pipelines.pages.report_sets import SetSection


@dataclass(frozen=True)
class Fact:
    """A number with its name and what it means."""

    name: str
    value: str
    means: str


def facts(
    the_set: SetSection | None,
    noise: NoiseSection | None,
    geometry: GeometrySection | None,
    *,
    against_truth: GeometryErrors | None,
    errors: Sequence[PlaneErrors],
) -> list[Fact]:
    """Return the numbers that the page begins with.

    Parameters
    ----------
    the_set : SetSection, optional
        The dark scene.
    noise, geometry : NoiseSection, GeometrySection, optional
        The calibrations.
    against_truth : GeometryErrors, optional
        Errors of the measured poses.
    errors : sequence of PlaneErrors
        Errors of the planes that the page begins with.
    """
    found = _light(the_set) if the_set else []
    found.append(_poses(geometry, against_truth))
    if noise is not None or (the_set and not the_set.noise_free):
        found.append(_noise(noise, the_set))
    if errors:
        values = ", ".join(figure(row.mse_bright) for row in errors)
        depths = ", ".join(f"{row.depth_mm:g}" for row in errors)
        found.append(Fact("Mean square error", values, f"at {depths} mm; objects 0…1, truth: plenty of light"))
    return found


def _light(the_set: SetSection) -> list[Fact]:
    """Return SNR and light of a view."""
    light = the_set.overview.brightness
    if light.snr is None or the_set.noise_free:
        return []
    found = [Fact("SNR of a view", figure(light.snr), f"eq. (4): {light.region} against {light.noise_from}")]
    if light.photons_from_moments is not None:
        value = f"{figure(light.photons_from_moments)} photons/px"
        found.append(Fact("Light", value, f"from moments; {figure(light.photons_linear)} by the paper’s eq. (7)"))
    elif light.electrons_from_moments is not None:
        value = f"{figure(light.electrons_from_moments)} e⁻/px"
        reason = "the quantum efficiency is not known, so that this is no number of photons"
        found.append(Fact("Light", value, f"from moments; {figure(light.electrons_linear)} by eq. (7); {reason}"))
    return found


def _poses(geometry: GeometrySection | None, against_truth: GeometryErrors | None) -> Fact:
    """Return how well the camera's positions are known."""
    if geometry is None:
        return Fact("Poses", "as stated", "by the set; not measured")
    record = geometry.record
    sigma_mm = [node.sigma_mm for node in record.nodes if node.node != record.reference_node]
    known = f"± {_length(float(np.sqrt(np.mean(np.square(sigma_mm))))) if sigma_mm else '–'}"
    means = f"σ of a node’s position, of {len(record.nodes)} nodes"
    if (off := record.stage.node_residual_rms_mm.value) is not None:
        means += f"; they lie {_length(off)} rms off a regular grid"
    if against_truth:
        means += f". Against the truth: {_length(against_truth.centre_rms_mm)} rms"
    return Fact("Poses, measured" if geometry.used else "Poses, not used here", known, means)


def _noise(noise: NoiseSection | None, the_set: SetSection | None) -> Fact:
    """Return the sensor's noise."""
    if noise is None:
        assert the_set is not None
        return Fact("Read noise", f"{figure(the_set.overview.read_noise_e)} e⁻", "as the set states it")
    read, dark = noise.record.read_noise_e, noise.record.dark_current_e_per_s
    means = [f"± {figure(read.se, 2)}"] if read.se else []
    means += [] if dark.value is None else [f"dark current {figure(dark.value)} e⁻/s"]
    name = "Read noise, measured" if noise.used else "Read noise, not used here"
    return Fact(name, f"{figure(read.value)} e⁻", "; ".join(means))


def _length(length_mm: float) -> str:
    """Return a length in the unit that suits it."""
    return f"{figure(length_mm)} mm" if length_mm >= 0.1 else f"{figure(1e3 * length_mm)} µm"
