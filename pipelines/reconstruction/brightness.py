"""How dark a set is: its SNR and photons per pixel, by the paper's formulas and by counting."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.results.records import Brightness
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.channels import channel_layouts, lattice_noise, view_electrons
from faintfield.pipelines.reconstruction.object_region import Region, object_region
from faintfield.recon.metrics import photons_from_linear_snr, photons_from_moments, snr_from_powers


def brightness(loaded: ElementalSet, region_path: Path | None = None) -> Brightness:
    """Measure the reference view of a set, all colours together; over the set's own object region by default."""
    region, name = object_region(loaded, region_path)
    return brightness_within(loaded, region, name)


def brightness_within(loaded: ElementalSet, region: Region | None, name: str) -> Brightness:
    """Measure the reference view over a region (row, column) called `name`; over the whole view if it is None."""
    has_reference = len(loaded.noise_reference) >= loaded.frames_per_view
    signal, reference = [], []
    for layout in channel_layouts(loaded):
        images = view_electrons(loaded, layout, loaded.frame_paths(loaded.reference_view))
        no_light = view_electrons(loaded, layout, loaded.noise_reference[: loaded.frames_per_view])
        for index, lattice in enumerate(layout.lattices):
            where = np.ones(lattice.shape, bool) if region is None else lattice.of(region)
            signal.append(images[index][0][where])
            if has_reference:
                reference.append(no_light[index][0].ravel())
            else:
                noise = lattice_noise(loaded, lattice, None)
                dark_e = loaded.background_e(noise)
                power = np.broadcast_to(loaded.read_variance_e2(noise) + dark_e + np.square(dark_e), lattice.shape)
                reference.append(np.sqrt(power).ravel())
    return _figures(loaded, np.concatenate(signal), np.concatenate(reference), name, has_reference)


def _figures(
    loaded: ElementalSet,
    signal_e: NDArray[np.floating],
    reference_e: NDArray[np.floating],
    region: str,
    has_reference: bool,
) -> Brightness:
    """Return the figures by eq. (4) and (7), given the electrons of the region and of the noise reference."""
    noise = loaded.noise
    read_noise_e = float(np.sqrt(loaded.frames_per_view * np.mean(np.square(noise.read_noise_e))))
    snr = snr_from_powers(signal_e, reference_e) if read_noise_e > 0 else None
    dark_e = float(np.mean(loaded.background_e(noise)))
    linear_e = moments_e = None
    if snr and snr > 0:
        # With a quantum efficiency of 1 the formulas for photons give electrons
        counting = {"quantum_efficiency": 1.0, "read_noise_e": read_noise_e}
        linear_e, moments_e = (
            photons_from_linear_snr(snr, **counting),
            photons_from_moments(snr, dark_e=dark_e, **counting),
        )
    efficiency = noise.quantum_efficiency
    return Brightness(
        region=region,
        noise_from="noise reference" if has_reference else "noise model",
        snr=snr,
        electrons_linear=linear_e,
        electrons_from_moments=moments_e,
        mean_signal_e=float(np.mean(signal_e, dtype=np.float64)) - dark_e,
        photons_linear=linear_e / efficiency if efficiency and linear_e else None,
        photons_from_moments=moments_e / efficiency if efficiency and moments_e else None,
    )
