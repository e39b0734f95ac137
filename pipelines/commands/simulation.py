"""Commands without hardware: the whole experiment on a simulated rig, simulated sets, and dark sets of bright ones."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
from cyclopts import Parameter

from faintfield.pipelines.arguments import Positive, Seed
from faintfield.pipelines.console import inform
from faintfield.pipelines.simulation.options import DarkeningOptions, SyntheticOptions

if TYPE_CHECKING:
    from faintfield.pipelines.simulation.darken import Darkened
    from faintfield.pipelines.workflows.demo import DemoResult

_SYNTHETIC, _DARK = SyntheticOptions(), DarkeningOptions()

type Demo = DemoResult
type Dark = Darkened


def demo(out: Path = Path("demo"), /, *, quick: bool = False, snr: Positive = 0.16, seed: Seed = 1) -> Demo:
    """Run the paper's experiment on a simulated rig, from the first board sweep to the report.

    A simulated gantry behind a pseudo-terminal carries a simulated camera, which captures boards, objects, dark and
    flat frames as a session; noise, geometry, planes and a surface are found from that session. The truth is looked up
    last, in OUT/truth, and metrics.json gives the errors of the planes: together with occlusion, and each alone with
    measured, nominal and true poses.

    Parameters
    ----------
    out
        Folder to write; the results of an earlier demo are replaced.
    quick
        Capture fewer nodes and pixels.
    snr
        SNR of the dark views, eq. (4).
    seed
        Seed of the random generator.
    """
    from faintfield.pipelines.workflows.demo import run_demo

    return run_demo(out, quick, snr, seed)


class Simulated(msgspec.Struct, frozen=True):
    """The result of `faintfield simulate`.

    Attributes
    ----------
    out : str
        Folder of the set.
    views : int
        Number of views.
    snr : float
        Expected signal-to-noise ratio of the true light by eq. (4), a ratio of powers.
    photons_linear, photons_from_moments : float
        Photons per pixel by eq. (7), linear in the SNR; photons per pixel of a uniform object with the same SNR.
    photons_on_object : float
        Mean photons per pixel of the object region in the reference view.
    """

    out: str
    views: int
    snr: float
    photons_linear: float
    photons_from_moments: float
    photons_on_object: float


def simulate(out: Path, /, *, options: SyntheticOptions = _SYNTHETIC, overwrite: bool = False) -> Simulated:
    """Simulate the paper's experiment: a toy truck at 500 mm and a toy airplane at 700 mm, almost dark.

    Writes the dark set, a noise-reference image, the same views without noise (`noise_free`, a set of its own), and
    the ground truth: the objects' textures and where they are visible, or the true depth and picture of surfaces; and
    the poses.

    Parameters
    ----------
    out : Path
        Folder to write.
    options : SyntheticOptions
        Grid, camera, light and errors of the poses.
    overwrite : bool
        Replace an earlier set in OUT.

    Returns
    -------
    Simulated
        `out`, `views`, the `snr`, and the photons per pixel on the object: `photons_linear` by the paper's linear
        formula, `photons_from_moments` by the powers of the images, `photons_on_object` as drawn.

    Raises
    ------
    OutputExists
        OUT holds something that may not be replaced.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from faintfield import SyntheticOptions, simulate
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     simulated = simulate(Path(folder, "dark"), options=SyntheticOptions(rows=3, columns=3, size_px=(64, 48)))
    >>> simulated.views, round(simulated.snr, 2), round(simulated.photons_from_moments, 1)
    (9, 0.16, 1.9)
    """
    from faintfield.pipelines.simulation.synthetic_set import write_synthetic_set

    truth = write_synthetic_set(out, options, overwrite=overwrite)
    inform(
        f"{out}: {options.rows} x {options.columns} views, SNR {truth.snr:.3f}; photons per pixel on the object: "
        f"{truth.photons_from_moments:.2f} (moments), {truth.photons_linear:.2f} (the paper's linear formula)"
    )
    photons = (truth.photons_linear, truth.photons_from_moments, truth.photons_on_object)
    return Simulated(str(out), options.rows * options.columns, truth.snr, *photons)


def darken(
    set_path: Annotated[Path, Parameter(name="SET")],
    out: Path,
    /,
    *,
    options: DarkeningOptions = _DARK,
    overwrite: bool = False,
) -> Dark:
    """Make a dark set from a bright one: the same views with a few photons per pixel.

    Each bright view is taken as the expected light, scaled so that the object region of the reference view (its
    brighter part, by Otsu's threshold) has the SNR asked for, and exposed anew: photon, dark and read noise are drawn
    for the paper's camera, or for the one given. An exposure without light is written as the noise reference. A set
    that is dark already is refused: its noise would be taken as light.

    Parameters
    ----------
    set_path
        Folder with elemental.toml of the bright set.
    out
        Folder to write.
    overwrite
        Replace an earlier set in OUT.
    """
    from faintfield.pipelines.simulation.darken import darken_set

    darkened = darken_set(set_path, out, options, overwrite=overwrite)
    measured = "no SNR" if darkened.snr_measured is None else f"SNR {darkened.snr_measured:.3f}"
    photons = f"{darkened.photons_on_object:.2f} photons per pixel on the object"
    inform(f"{out}: {measured} measured for {options.snr:g} asked; {photons}")
    return darkened
