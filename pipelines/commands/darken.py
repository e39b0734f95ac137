"""`faintfield darken`: a photon-starved set from a bright one."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from faintfield.pipelines.arguments import Fraction, NotNegative, Positive, Seed
from faintfield.pipelines.console import inform
from faintfield.pipelines.simulation.options import DarkeningOptions

if TYPE_CHECKING:
    from faintfield.pipelines.simulation.darken import Darkened


_DEFAULT = DarkeningOptions()


type Result = Darkened


def darken(
    set_path: Annotated[Path, Parameter(name="SET")],
    out: Path,
    /,
    *,
    snr: Positive = _DEFAULT.snr,
    seed: Seed = _DEFAULT.seed,
    exposure_s: Positive = _DEFAULT.exposure_s,
    read_noise_e: NotNegative = _DEFAULT.read_noise_e,
    dark_current_e_per_s: NotNegative = _DEFAULT.dark_current_e_per_s,
    quantum_efficiency: Fraction = _DEFAULT.quantum_efficiency,
    overwrite: bool = False,
) -> Result:
    """Make a dark set from a bright one: the same views with a few photons per pixel.

    Each bright view is taken as the expected light, scaled so that the object region of the reference view (its
    brighter part, by Otsu's threshold) has the SNR asked for, and exposed anew: photon, dark and read noise are drawn
    for the paper's camera, or for the one given. An exposure without light is written as the noise reference.

    Parameters
    ----------
    set_path
        Folder with elemental.toml of the bright set.
    out
        Folder to write.
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
    overwrite
        Replace an earlier set in OUT.
    """
    options = {name: value for name, value in locals().items() if name not in ("set_path", "out", "overwrite")}
    from faintfield.pipelines.formats.sets.elemental_set import load_set
    from faintfield.pipelines.simulation.darken import darken_set

    darkened = darken_set(load_set(set_path), out, DarkeningOptions(**options), overwrite=overwrite)
    measured = "no SNR" if darkened.snr_measured is None else f"SNR {darkened.snr_measured:.3f}"
    photons = f"{darkened.photons_on_object:.2f} photons per pixel on the object"
    inform(f"{out}: {measured} measured for {snr:g} asked; {photons}")
    return darkened
