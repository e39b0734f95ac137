"""How dark a set is: its SNR and photons per pixel, by the paper's formulas and by counting."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.channels import channel_layouts, lattice_noise, view_electrons
from pipelines.elemental_set import LoadedSet
from pipelines.frames import read_frame
from recon.metrics import photons_from_linear_snr, photons_from_moments, snr_from_powers

# Beside a set's images, where it is known: the object region of the reference view.
OBJECT_REGION = "object_region.png"


@dataclass(frozen=True)
class Brightness:
    """The SNR and photon figures of a set's reference view.

    Attributes
    ----------
    region : str
        "object region" where the set brings one, else "whole view".
    noise_from : str
        "noise reference" image where the set brings one, else "noise model".
    snr : float, optional
        Eq. (4), a ratio of powers; None where the noise model states no read noise to compare with.
    photons_linear : float, optional
        Photons per pixel that eq. (7) reads from it, the paper's figure; None where the SNR is not positive.
    photons_from_moments : float, optional
        Photons per pixel of a uniform object that has this SNR.
    mean_signal_e : float
        Mean electrons per pixel above the dark level.
    """

    region: str
    noise_from: str
    snr: float | None
    photons_linear: float | None
    photons_from_moments: float | None
    mean_signal_e: float


def brightness(loaded: LoadedSet, region_path: Path | None = None) -> Brightness:
    """Measure the reference view of a set, in all its colours together; over the set's own object region by default."""
    region_path = region_path or loaded.folder / OBJECT_REGION
    region = read_frame(region_path).pixels_dn > 127 if region_path.is_file() else None
    has_reference = len(loaded.noise_reference) >= loaded.frames_per_view
    signal, reference = [], []
    for layout in channel_layouts(loaded):
        images = view_electrons(loaded, layout, loaded.frame_paths(loaded.reference_view))
        nothing = view_electrons(loaded, layout, loaded.noise_reference[: loaded.frames_per_view])
        for index, lattice in enumerate(layout.lattices):
            where = np.ones(lattice.shape, bool) if region is None else lattice.of(region)
            signal.append(images[index][0][where])
            if has_reference:
                reference.append(nothing[index][0].ravel())
            else:
                noise = lattice_noise(loaded, lattice, None)
                dark_e = loaded.background_e(noise)
                power = np.broadcast_to(loaded.read_variance_e2(noise) + dark_e + np.square(dark_e), lattice.shape)
                reference.append(np.sqrt(power).ravel())
    return _figures(loaded, np.concatenate(signal), np.concatenate(reference), region is not None, has_reference)


def _figures(
    loaded: LoadedSet,
    signal_e: NDArray[np.floating],
    reference_e: NDArray[np.floating],
    has_region: bool,
    has_reference: bool,
) -> Brightness:
    """Apply the formulas."""
    noise = loaded.noise
    read_noise_e = float(np.sqrt(loaded.frames_per_view * np.mean(np.square(noise.read_noise_e))))
    snr = snr_from_powers(signal_e, reference_e) if read_noise_e > 0 else None
    dark_e = float(np.mean(loaded.background_e(noise)))
    known = {"quantum_efficiency": noise.quantum_efficiency, "read_noise_e": read_noise_e}
    return Brightness(
        region="object region" if has_region else "whole view",
        noise_from="noise reference" if has_reference else "noise model",
        snr=snr,
        photons_linear=photons_from_linear_snr(snr, **known) if snr and snr > 0 else None,
        photons_from_moments=photons_from_moments(snr, dark_e=dark_e, **known) if snr and snr > 0 else None,
        mean_signal_e=float(np.mean(signal_e, dtype=np.float64)) - dark_e,
    )
