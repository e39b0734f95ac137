"""Commands without hardware: the whole experiment on a simulated rig, simulated sets, and dark sets of bright ones."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from cyclopts import Parameter

from faintfield.pipelines.arguments import Count, NotNegative, Positive, Seed, SizePx
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
    flat frames as a session; noise, geometry and planes are found from that session. The truth is looked up last, in
    OUT/truth, and metrics.json gives the errors of the results: with measured poses, with nominal ones, and with the
    true ones.

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
    """The result of `faintfield simulate`."""

    out: str
    views: int
    snr: float
    photons_linear: float
    photons_from_moments: float
    photons_on_object: float


def simulate(
    out: Path,
    /,
    *,
    snr: Positive = _SYNTHETIC.snr,
    seed: Seed = _SYNTHETIC.seed,
    rows: Count = _SYNTHETIC.rows,
    columns: Count = _SYNTHETIC.columns,
    pitch_mm: Positive = _SYNTHETIC.pitch_mm,
    size_px: SizePx = _SYNTHETIC.size_px,
    exposure_s: Positive = _SYNTHETIC.exposure_s,
    position_error_mm: NotNegative = _SYNTHETIC.position_error_mm,
    rotation_error_mrad: NotNegative = _SYNTHETIC.rotation_error_mrad,
    poses: Literal["true", "nominal"] = _SYNTHETIC.poses,
    colour: Literal["grey", "bayer"] = _SYNTHETIC.colour,
    objects: Literal["toys", "surfaces"] = "toys",
    overwrite: bool = False,
) -> Simulated:
    """Simulate the paper's experiment: a toy truck at 500 mm and a toy airplane at 700 mm, almost dark.

    Writes the dark set, a noise-reference image, the same views without noise (`noise_free`, a set of its own), and
    the ground truth: the objects' textures and where they are visible, or the true depth and picture of surfaces; and
    the poses.

    Parameters
    ----------
    out
        Folder to write.
    snr
        SNR, eq. (4), over the object region of the reference view; it sets the light.
    seed
        Seed of the random generator.
    rows
        Rows of the grid of nodes.
    columns
        Columns of the grid of nodes.
    pitch_mm
        Distance between neighbouring nodes.
    size_px
        Width and height of the detector.
    exposure_s
        Exposure of each view.
    position_error_mm
        Standard deviation of each node's position along each axis; the centre node has no error.
    rotation_error_mrad
        Standard deviation of each node's rotation about each axis; the centre node has no error.
    poses
        Poses that elemental.toml states: those the camera really had (true), or those it was sent to (nominal).
    colour
        Sensor without colour filters (grey), or with a Bayer mosaic.
    objects
        The flat toys, or a scene that fills the view: a slanted wall, a rising floor, a ball, a tilted page and a thin
        rod (surfaces), at 517 to 1009 mm.
    overwrite
        Replace an earlier set in OUT.
    """
    options = {name: value for name, value in locals().items() if name not in ("out", "overwrite")}
    from faintfield.pipelines.simulation.synthetic_set import write_synthetic_set

    if objects == "toys":
        del options["objects"]
    truth = write_synthetic_set(out, SyntheticOptions(**options), overwrite=overwrite)
    inform(
        f"{out}: {rows} x {columns} views, SNR {truth.snr:.3f}; photons per pixel on the object: "
        f"{truth.photons_from_moments:.2f} (moments), {truth.photons_linear:.2f} (the paper's linear formula)"
    )
    photons = (truth.photons_linear, truth.photons_from_moments, truth.photons_on_object)
    return Simulated(str(out), rows * columns, truth.snr, *photons)


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
    for the paper's camera, or for the one given. An exposure without light is written as the noise reference.

    Parameters
    ----------
    set_path
        Folder with elemental.toml of the bright set.
    out
        Folder to write.
    overwrite
        Replace an earlier set in OUT.
    """
    from faintfield.pipelines.formats.sets.elemental_set import load_set
    from faintfield.pipelines.simulation.darken import darken_set

    darkened = darken_set(load_set(set_path), out, options, overwrite=overwrite)
    measured = "no SNR" if darkened.snr_measured is None else f"SNR {darkened.snr_measured:.3f}"
    photons = f"{darkened.photons_on_object:.2f} photons per pixel on the object"
    inform(f"{out}: {measured} measured for {options.snr:g} asked; {photons}")
    return darkened
