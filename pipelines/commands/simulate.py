"""`faintfield simulate`: an elemental set of a synthetic scene with its ground truth."""

from pathlib import Path
from typing import Literal

import msgspec

from faintfield.pipelines.arguments import Count, NotNegative, Positive, Seed, SizePx
from faintfield.pipelines.console import inform
from faintfield.pipelines.simulation.options import SyntheticOptions

_DEFAULT = SyntheticOptions()


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
    snr: Positive = _DEFAULT.snr,
    seed: Seed = _DEFAULT.seed,
    rows: Count = _DEFAULT.rows,
    columns: Count = _DEFAULT.columns,
    pitch_mm: Positive = _DEFAULT.pitch_mm,
    size_px: SizePx = _DEFAULT.size_px,
    exposure_s: Positive = _DEFAULT.exposure_s,
    position_error_mm: NotNegative = _DEFAULT.position_error_mm,
    rotation_error_mrad: NotNegative = _DEFAULT.rotation_error_mrad,
    poses: Literal["true", "nominal"] = _DEFAULT.poses,
    colour: Literal["grey", "bayer"] = _DEFAULT.colour,
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
